"""Test what all commands have in common: their help, and how they end."""

import importlib
import os
import re
import signal
import subprocess
import sys
import time

import pytest

pytest.importorskip("cyclopts", reason="the commands need the extra compare")

from tests.conftest import ROOT, python

# The modules of the commands `python -m benchmarks.NAME`, by NAME.
COMMANDS = {
    path.stem: f"benchmarks.{path.stem}"
    for path in sorted((ROOT / "benchmarks").glob("[a-z]*.py"))
}
for path in (ROOT / "benchmarks").glob("*/__main__.py"):
    COMMANDS[path.parent.name] = f"benchmarks.{path.parent.name}.__main__"
HEAVY = {
    "joblib", "matplotlib", "optuna", "pandas", "pygame", "ray", "scipy.optimize",
    "scipy.sparse", "stable_baselines3", "torch",
}  # fmt: skip


def main_of(name):
    return importlib.import_module(COMMANDS[name]).main


def test_help_imports_nothing_heavy():
    program = (
        "import importlib, sys\n"
        f"for module in {[*COMMANDS.values()]}:\n"
        "    importlib.import_module(module).main(['--help'])\n"
        "print(*sys.modules, file=sys.stderr)"
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
    "claims": [(["--draws", "0"], "Must be > 0")],
    "compare": [
        (["--agents", "nn", "pie"], "--agents: there is no 'pie'; choose from idle, nn, "),
        (["--agent", "mine=none.json"], "No such file or directory: 'none.json'"),
        (["--agents"], "name at least one controller"),
        (["--scenarios", "circle"], "no 'circle'"),
        (["--runs", "2.5"], "for --runs: invalid literal for int.. with base 10: '2.5'"),
        (["--preset", "paper", "--presets"], "--presets cannot be combined with --plant"),
        (["--preset", "paper", "--scenarios", "load"], "no 'load'; choose from square, con"),
        (["--rusn", "3"], "Unknown option: --rusn. Did you mean --runs"),
        (["--plant", "none.json"], "--plant: .*none.json must be a JSON file.*No such file"),
        (["--plant", ROOT / "README.md"], "--plant: .*README.md must be a JSON file"),
        (["--set", "delay"], "--set: delay must be an integer from 0"),
        (["--set", "dely=3"], "unexpected keyword argument 'dely'"),
        (["--set", "render_mode=human"], "unexpected keyword argument 'render_mode'"),
        (["--set", "action=change"], "--set: action must be left out, as each controller"),
        (["--agent", "PI=agents:PIController"], "a NAME that no other controller has"),
        (["--agent", "=agents:PIController"], "'=agents:PIController' must have"),
        (["--agent", "mine"], "must have the form NAME=MODULE:FACTORY"),
        (["--agent", "mine=nowhere:PI"], "'nowhere' is no module in the current folder"),
    ],
    "tune": [
        (["pi", "--set", "b=[0.1,-0.1]"], "the gain of the plant is 0, got a="),
    ],
    "train": [
        (["ppo-hard", "--set", "delay=9"], "--plant, --preset and --set are for ppo, not for"),
        (["pi"], '"pi" for NETWORK. Choose from: "ppo", "ppo-hard"'),
        ([], "name the network to train: ppo, ppo-hard"),
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
    assert re.match(rf"python -m benchmarks.{name}: .*({complaint})", said)
    assert not any(path.is_file() for path in tmp_path.rglob("*"))


def test_a_missing_package_is_named_with_the_extras(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "ray", None)
    assert main_of("bounds")(["--backend", "ray"]) == 2
    assert capsys.readouterr().err.endswith(': pip install -e ".[ray]"\n')
    done = python("-c", "import sys; sys.modules['cyclopts'] = None; import benchmarks.tune")
    assert "cyclopts" in done.stderr
    assert done.stderr.endswith(': pip install -e ".[bench]"\n')


def test_the_list_shows_the_questions_and_their_commands():
    done = python("-m", "benchmarks", check=True)
    assert (
        "Which gains are best for a controller?\n    python -m benchmarks.tune nn\n"
        in done.stdout
    )
    assert "](" not in done.stdout
    assert {*re.findall(r"benchmarks\.(\w+)", done.stdout)} == {*COMMANDS}


# A command as all are: it fans out, and writes what has finished, however it ends.
TOY = """
import signal, sys, time
from dataclasses import dataclass, field
from functools import partial
from benchmarks.lib.command import Folder, command, options
from benchmarks.lib.fan_out import FanOut
from benchmarks.lib.outputs import new_folder, provenance_of

signal.signal(signal.SIGINT, signal.default_int_handler)  # however this was started

@options
@dataclass(frozen=True)
class Options:
    seconds: int = 0
    out: Folder = None
    fan_out: FanOut = field(default_factory=FanOut)

def work(options):
    folder = new_folder(options.out, "toy", provenance_of())
    rest = partial(time.sleep, options.seconds)
    tasks = {"a": rest, "up": partial(print, "up", flush=True), "b": rest, "c": rest, "d": rest}
    finished = options.fan_out.run(tasks, "tasks")
    (folder / "report.md").write_text(f"{len(finished.results)} of 5")
    import matplotlib
    print("5 \N{DEGREE SIGN}C")
    if finished.error:
        raise finished.error

sys.exit(command("toy", Options, work)())
"""


@pytest.mark.skipif(sys.platform == "win32", reason="no signals to other processes")
# A terminal sends Ctrl-C to all processes, and a scheduler stops the first one.
@pytest.mark.parametrize(
    ("send", "number"), [("killpg", signal.SIGINT), ("kill", signal.SIGTERM)]
)
def test_after_a_stop_what_has_finished_is_written(send, number, tmp_path):
    words = ["--seconds", "60", "--jobs", "2", "--out", tmp_path]
    run = subprocess.Popen(
        [sys.executable, "-c", TOY, *words], cwd=ROOT, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True,
    )  # fmt: skip
    assert run.stdout.readline() == "up\n"
    time.sleep(2.0)  # until the other processes work
    getattr(os, send)(run.pid, number)
    out, err = run.communicate(timeout=60)
    assert run.returncode == 130
    assert out.endswith("5 \N{DEGREE SIGN}C\n")
    assert err.strip() == "python -m benchmarks.toy: interrupted: 4 of 5 tasks are missing"
    assert (tmp_path / "report.md").read_text() == "1 of 5"


@pytest.mark.parametrize(
    ("surroundings", "last_line"),
    [
        ({"PYTHONIOENCODING": "ascii"}, "5 ?C\n"),
        ({"MPLBACKEND": "module://matplotlib_inline.backend_inline"}, "5 \N{DEGREE SIGN}C\n"),
    ],
)
def test_the_surroundings_of_the_caller_stop_no_command(surroundings, last_line, tmp_path):
    environment = {**os.environ, "PYTHONIOENCODING": "utf-8", **surroundings}
    words = ["--jobs", "1", "--out", str(tmp_path)]
    done = python("-c", TOY, *words, env=environment, encoding="utf-8")
    assert (done.returncode, done.stderr.strip()) == (0, "")
    assert done.stdout.endswith(last_line)
