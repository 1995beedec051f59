"""The layout: who imports whom, what an import loads, and the README."""

import ast
import re
import sys

import gymnasium
import pytest

from tests.conftest import ROOT, python

ALLOWED = {
    "mptc_gym": {"mptc_gym", "gymnasium", "numpy", "pygame"},  # the last when it is used
    "agents": {"agents", "numpy"},
}
FOLDERS = "mptc_gym", "agents", "benchmarks"
SOURCES = {
    path: path.read_text(encoding="utf-8")
    for package in FOLDERS
    for path in (ROOT / package).rglob("*.py")
}


def packages(code):
    """Return which packages are imported, also within functions."""
    found = set()
    for node in ast.walk(ast.parse(code)):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            found.add(node.module or "")
    return {module.partition(".")[0] for module in found}


@pytest.mark.parametrize("package", ALLOWED)
def test_layers_import_downwards_only(package):
    for path in (ROOT / package).rglob("*.py"):
        allowed = ALLOWED[package] | sys.stdlib_module_names
        allowed |= {"torch"} if path.parent.name == "torch_env" else set()
        allowed |= {"stable_baselines3"} if path.parent.name == "sb3" else set()
        assert packages(SOURCES[path]) <= allowed, path


def test_what_is_printed_can_be_redirected_on_windows():
    # Its encoding of files and pipes has no arrows, and printing one there is an error.
    for code in SOURCES.values():
        code.encode("cp1252")


PAGES = [ROOT / "README.md"]
PAGES += [page for name in FOLDERS for page in (ROOT / name).rglob("*.md")]
PAGES = [page for page in PAGES if "published" not in page.parts]
EXAMPLES = [
    example
    for page in PAGES
    for example in re.findall(
        r"```python\n(.*?)```(?:\n\n```text\n(.*?)```)?", page.read_text("utf-8"), re.DOTALL
    )
]


COMPARE = {  # the extra
    "cyclopts", "filelock", "joblib", "matplotlib", "pandas", "rich", "scipy", "tabulate",
}  # fmt: skip


@pytest.mark.parametrize(("example", "printed"), EXAMPLES, ids=range(len(EXAMPLES)))
def test_examples_of_the_pages_run(example, printed, monkeypatch, tmp_path, capsys):
    names = packages(example)
    # `.ci/versions` tests without the extras; then only what needs none of them can run.
    needed = COMPARE if "benchmarks" in names else set()
    for name in needed | names - {"agents", "benchmarks"}:
        pytest.importorskip(name, reason=f"the example needs {name}, of an extra")
    monkeypatch.chdir(tmp_path)
    if "minari" in names:
        from benchmarks.datasets import main  # as it needs Minari

        monkeypatch.setenv("MINARI_DATASETS_PATH", str(tmp_path))
        assert main([*re.findall(r"middlepoint/[\w/-]+", example), "--episodes", "2"]) == 0
    elif not printed:
        for spec in gymnasium.registry.values():
            if spec.id.startswith("MiddlePoint"):
                monkeypatch.setattr(spec, "max_episode_steps", 30)
    # A short time will do to see that it runs, where the page does not say what it prints.
    exec(
        (example if printed else re.sub(r"\d+_000", "1", example))
        .replace("samples=1200", "samples=100, episodes=5")
        .replace('-v0", 256', '-v0", 4')
        .replace("2048", "64"),
        {},
    )
    shown = capsys.readouterr().out
    if printed and ".learn(" in example:  # another processor rounds otherwise
        scores = [re.search(r"score (\S+);", text)[1] for text in (shown, printed)]
        assert float(scores[0]) == pytest.approx(float(scores[1]), abs=0.05)
    elif printed:
        assert shown == printed


def test_controllers_are_evaluated_without_any_extra():
    program = """
import sys
for name in ("torch", "stable_baselines3", "scipy", "pandas", "matplotlib", "pygame"):
    sys.modules[name] = None  # an import is an error from now on
import agents, mptc_gym
print(mptc_gym.evaluate(agents.PIController(), "MiddlePointNoisy-v0").mean_error)
import mptc_gym.torch_env
"""
    done = python("-OO", "-c", program)  # and without docstrings
    # Between the least possible error and that of an idle valve.
    assert 1.6 < float(done.stdout) < 5.0, done.stderr
    assert 'pip install "mptc_gym[torch]"' in done.stderr.splitlines()[-1]


@pytest.mark.parametrize("page", PAGES, ids=lambda page: str(page.relative_to(ROOT)))
def test_what_a_page_links_to_is_there(page):
    targets = re.findall(r"\]\(([^)]*)\)", page.read_text("utf-8"))
    for target in targets:
        file, _, place = target.partition("#")
        unknown = target == "ADDRESS"  # the project's own, in the text for Gymnasium's list
        if unknown or target.startswith("https://"):
            continue
        there = page.parent / file if file else page
        assert there.exists(), target
        if place:
            text = re.sub(r"[^\w\n# -]", "", there.read_text("utf-8")).lower().replace(" ", "-")
            assert re.search(f"^#+-{place}$", text, re.MULTILINE), target
