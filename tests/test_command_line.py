"""Test what all commands have in common: their help, and how they end."""

import importlib
import os
import re
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

pytest.importorskip("cyclopts", reason="the commands need the extra compare")

from benchmarks.lib.command import read
from tests.conftest import ROOT, python

# The modules of the commands `python -m benchmarks.NAME`, by NAME.
COMMANDS = {
    path.stem: f"benchmarks.{path.stem}"
    for path in sorted((ROOT / "benchmarks").glob("[a-z]*.py"))
}
for path in (ROOT / "benchmarks").glob("*/__main__.py"):
    COMMANDS[path.parent.name] = f"benchmarks.{path.parent.name}.__main__"
HEAVY = {
    "joblib", "matplotlib", "optuna", "pandas", "pygame", "ray", "scipy", "stable_baselines3",
    "torch",
}  # fmt: skip


def main_of(name):
    return importlib.import_module(COMMANDS[name]).main


def test_help_imports_nothing_heavy():
    program = (
        "import importlib, sys\n"
        f"for module in {[*COMMANDS.values()]}:\n"
        "    importlib.import_module(module).main(['--help'])\n"
        "print(*{name.partition('.')[0] for name in sys.modules}, file=sys.stderr)"
    )
    done = python("-c", program, check=True)
    assert not HEAVY & set(done.stderr.split())
    # All are shown, without what is of no use.
    assert done.stdout.count("Usage: python -m benchmarks.") == len(COMMANDS)
    for clutter in (str(ROOT), "default: None", "default: False", "default: [", "default: ("):
        assert clutter not in done.stdout
    assert "default: 100]" in done.stdout
    # Names are not broken between lines.
    assert {"pi-searched", "square-dead-zone-7"} <= {*re.split(r"[\s,]+", done.stdout)}


REFUSED = {
    "claims": [(["everything"], "no 'everything'")],
    "compare": [
        (["--agents", "nn", "pie"], "--agents: there is no 'pie'; choose from idle, nn, "),
        (["--agent", "mine=none.json"], "needs the file .none.json., which does not exist"),
        (["--agents"], "name at least one controller"),
        (["--scenarios", "circle"], "no 'circle'"),
        (["--scenarios"], "--scenarios: name at least one case"),
        (["--runs", "2.5"], "for --runs: must be a whole number, got 2.5"),
        (["--preset", "paper", "--presets"], "--presets cannot be combined with --plant"),
        (["--preset", "paper", "--scenarios", "load"], "no 'load'; choose from square, con"),
        (["--rusn", "3"], "Unknown option: --rusn. Did you mean --runs"),
        (["--set", "delay"], "ARGUMENT=VALUE"),
        (["--set", "dely=3"], "'dely': did you mean 'delay'?"),
        (["--set", "a=[1,-1.5]"], "--set: a must not have a root beyond the unit circle"),
        (["--set", "render_mode=human"], "--set: render_mode is not an argument of the plant"),
        (["--agent", "PI=agents:PIController"], "'PI' is taken"),
        (["--agent", "mine"], "NEW_NAME=MODULE:FACTORY"),
        (["--agent", "mine=my_controllers.py:PI"], r"\(MODULE without \.py\)"),
        (["--agent", "mine=my_controllers:PI"], "needs the module .my_controllers., which is"),
        (["--out", ""], "--out: . must not be the current folder"),
        (["--out", "/proc/here"], "cannot be written to: "),
    ],
    "datasets": [(["middlepoint/paper/ppo-v0"], 'Choose from: "middle')],
    "speed": [
        (["--device", "toaster"], "--device: device must be a device that PyTorch can use"),
    ],
    "tune": [
        (["pi", "--set", "b=[0.1,-0.1]"], "--plant: the gain must be finite and above 0 for a"),
    ],
    "train": [
        (["ppo-hard", "--set", "delay=9"], "--plant, --preset and --set are for ppo, not for"),
        (["pi"], '"pi" for NETWORK. Choose from: "ppo", "ppo-hard"'),
    ],
}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "given", "complaint"),
    [
        *((name, ["--nonsense"], "--nonsense|requires an argument") for name in COMMANDS),
        *((name, *each) for name in REFUSED for each in REFUSED[name]),
    ],
)
def test_what_does_not_fit_is_refused_before_anything_is_run_or_written(
    name, given, complaint, refused, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    said = refused(main_of(name), given)
    assert re.match(rf"python -m benchmarks.{name}: error: .*({complaint})", said)
    assert not any(path.is_file() for path in tmp_path.rglob("*"))


@pytest.mark.parametrize(
    ("given", "package", "extra"),
    [
        ("datasets", "minari", "data"),
        ("train ppo", "torch", "torch"), ("tune pi", "optuna", "bench"),
        ("claims --backend ray", "ray", "ray"),
    ],
)  # fmt: skip
def test_a_missing_package_is_named_with_its_extra(
    given, package, extra, monkeypatch, refused, tmp_path
):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setitem(sys.modules, package, None)
    for name in [*sys.modules]:  # those that import it are imported anew
        if re.fullmatch(r"benchmarks\.train\.(?!__main__).*", name):
            monkeypatch.delitem(sys.modules, name)
            monkeypatch.delattr(sys.modules["benchmarks.train"], name.rpartition(".")[2], False)
    name, *options = given.split()
    said = refused(main_of(name), options)
    assert f'{package} is not installed: pip install -e ".[{extra}]"' in said


def test_without_cyclopts_a_command_names_the_extra():
    program = "import sys; sys.modules['cyclopts'] = None; import benchmarks.compare.__main__"
    done = python("-c", program)
    assert done.returncode == 2
    assert 'cyclopts is not installed: pip install -e ".[compare]"' in done.stderr
    assert "Traceback" not in done.stderr


def test_the_list_shows_the_questions_and_their_commands():
    done = python("-m", "benchmarks", check=True)
    assert (
        "Which gains are best for a controller?\n    python -m benchmarks.tune nn\n"
        in done.stdout
    )
    assert "](" not in done.stdout
    assert {*re.findall(r"benchmarks\.(\w+)", done.stdout)} == {*COMMANDS}


@pytest.mark.parametrize(
    "page",
    [ROOT / "README.md", *(ROOT / "benchmarks").rglob("*.md")],
    ids=lambda page: str(page.relative_to(ROOT)),
)
def test_a_command_on_a_page_can_be_typed_as_it_stands(page):
    text = page.read_text("utf-8").replace("\\\n", "").replace("\\`", "`")
    for name, options in re.findall(r"python -m benchmarks\.([\w.]+)([^`|#\n]*)", text):
        if name in COMMANDS:  # an example takes no options
            declared = importlib.import_module(COMMANDS[name]).Options
            assert read(declared, name, shlex.split(options)), name


# A command as all are: it fans out, and writes what has finished, however it ends.
TOY = """
import pathlib, signal, sys, time
from dataclasses import dataclass, field
from functools import partial
from benchmarks.lib.command import command, options
from benchmarks.lib.parallel import FanOut
from benchmarks.lib.storage import write_text

signal.signal(signal.SIGINT, signal.default_int_handler)  # however this was started

@options
@dataclass(frozen=True)
class Options:
    fan_out: FanOut = field(default_factory=FanOut)

def work(options):
    try:
        print("up", flush=True)
        tasks = {name: partial(time.sleep, 60) for name in "abcd"}
        dict(options.fan_out.stream(tasks, "tasks"))
    finally:
        print("writes", flush=True)
        time.sleep(2)
        write_text(out / "report.md", "all" * 1000)
    return "done"

out = pathlib.Path(sys.argv.pop(1))
sys.exit(command("toy", Options, work)())
"""
SHORT = TOY.replace("60)", "0)").replace("sleep(2)", "sleep(0)")


@pytest.mark.skipif(sys.platform == "win32", reason="no signals to other processes")
class TestEnds:
    """Signals, a full disk and a reader that has gone end in a sentence."""

    @pytest.mark.parametrize("name", COMMANDS)
    def test_all_commands_end_alike(self, name):
        assert main_of(name).__module__ == "benchmarks.lib.command"

    @pytest.mark.parametrize(
        ("jobs", "sent"), [("1", [signal.SIGTERM]), ("2", [signal.SIGINT] * 2)]
    )
    def test_after_signals(self, jobs, sent, tmp_path):
        run = subprocess.Popen(
            [sys.executable, "-c", TOY, tmp_path, "--jobs", jobs], cwd=ROOT, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True,
        )  # fmt: skip
        for number, said in zip(sent, ("up", "writes"), strict=False):
            assert run.stdout.readline() == f"{said}\n"
            time.sleep(1.0)  # the first one: until the other processes work
            os.killpg(run.pid, number)  # as a terminal sends it
        out, err = run.communicate(timeout=60)
        assert run.returncode == 128 + sent[0]
        assert out.endswith("\nInterrupted.\n")
        assert err == ""
        assert [path.name for path in tmp_path.iterdir()] == ["report.md"]

    def test_on_a_full_disk(self, tmp_path):
        small = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (100, 100))"
        done = python("-c", small + SHORT, str(tmp_path), "--jobs", "1")
        assert done.returncode == 1
        assert "toy: nothing more can be written: File too large" in done.stderr
        assert "Traceback" not in done.stderr

    @pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
    @pytest.mark.parametrize("name", ["benchmarks", "benchmarks.bounds"])
    def test_with_an_output_that_is_full(self, name):
        with Path("/dev/full").open("w") as full:
            words = [sys.executable, "-m", name, "--help"]
            done = subprocess.run(
                words, cwd=ROOT, stdout=full, stderr=subprocess.PIPE, text=True
            )
        assert done.returncode == 1
        assert "nothing more can be written: No space left on device" in done.stderr
        assert "Traceback" not in done.stderr
