"""Test which changes invalidate a kept result."""

import sys

import pytest

import mptc_gym
from benchmarks.lib import fingerprint as module
from benchmarks.lib.fingerprint import behaviour, code, fingerprint, imported

HELPER = "def double(x):\n    return 2 * x\n"
USER = "from own.helper import double\n\n\ndef four():\n    return double(2)\n"


@pytest.fixture
def own(tmp_path, monkeypatch):
    """Return a function that writes a package `own` and says its fingerprint."""
    monkeypatch.setattr(module, "ROOT", tmp_path)
    (tmp_path / "own").mkdir()

    def write(helper=HELPER, user=USER, **shaped_by):
        for name, text in (("helper", helper), ("user", user), ("__init__", "")):
            (tmp_path / "own" / f"{name}.py").write_text(text)
        clear()
        return fingerprint("own.user", **shaped_by)

    def clear():
        imported.cache_clear()
        code.cache_clear()

    yield write
    clear()


def test_comments_docstrings_and_layout_do_not_count(own):
    edited = '"""A helper."""\n\n\ndef double(x):\n    """Twice."""\n'
    edited += "    # really\n    return (2 * x)\n"
    assert own() == own(helper=edited)
    field = "class Options:\n    runs: int = 1\n"
    assert own(user=USER + field) == own(user=USER + field + '    """Number of runs."""\n')


def test_code_that_is_imported_counts(own):
    assert own() != own(helper=HELPER.replace("2 * x", "3 * x"))
    assert own() != own(user=USER + "FIVE = 5\n")


def test_a_moved_function_counts(own):
    moved = USER.replace("own.helper", "own.elsewhere")
    assert own() != own(user=moved)


def test_arguments_count(own):
    assert own(seed=1) == own(seed=1) != own(seed=2)


def test_what_the_environment_does_counts(own, monkeypatch):
    before = own()
    behaviour.cache_clear()
    monkeypatch.setitem(mptc_gym.PRESETS, "noisy", {"noise_variance": 0.6})
    assert own() != before
    monkeypatch.undo()
    behaviour.cache_clear()


def test_imports_are_followed_through_modules():
    found = imported("benchmarks.sweep.tasks")
    assert {
        "benchmarks.sweep.tasks",
        "benchmarks.loop.rollout",
        "benchmarks.loop.metrics",
    } <= found
    assert not any(name.startswith("mptc_gym") for name in found)
    # Without loading them.
    assert "benchmarks.examples.through_plant" not in sys.modules
    assert "benchmarks.examples.through_plant" in imported("benchmarks.examples.through_plant")
