"""Test what all commands have in common: their help, and how they end."""

import importlib
import re
import shlex
import signal
import subprocess
import sys
import time

import pytest

pytest.importorskip("cyclopts", reason="the commands need the extra compare")

from benchmarks.__main__ import commands
from benchmarks.__main__ import main as show_map
from benchmarks.compare.__main__ import Options
from benchmarks.lib.command import read
from tests.conftest import ROOT, python

COMMANDS = commands()
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
    assert done.stdout.count("Usage: python -m benchmarks.") == len(COMMANDS)
    assert not HEAVY & set(done.stderr.split())


@pytest.mark.parametrize("name", COMMANDS)
def test_help_is_printed_alone(name, capsys):
    assert main_of(name)(["--help"]) == 0
    shown = capsys.readouterr().out
    assert shown.startswith(f"Usage: python -m benchmarks.{name}")
    for clutter in (str(ROOT), "default: None", "default: False", "default: [", "default: ("):
        assert clutter not in shown
    if "--seed " in shown:
        assert re.search(r"default: (0|1|7000000)\]", shown)  # 0 is a default, too
    if name == "compare":  # names are not broken between lines
        assert {"nn-frozen", "square-dead-zone-7"} <= {*re.split(r"[\s,]+", shown)}


@pytest.mark.parametrize("name", COMMANDS)
def test_an_unknown_option_is_named_in_one_line(name, refused):
    (line,) = refused(main_of(name), ["--nonsense"]).splitlines()
    assert line.startswith(f"python -m benchmarks.{name}: error: ")
    assert "--nonsense" in line or " is missing: name " in line


LOG = ROOT / "benchmarks/identify/example.csv"
REFUSED = {
    "claims": [(["everything"], "no 'everything'")],
    "compare": [
        (["--agents", "nn", "pie"], '"pie" for --agents. Choose from: .* Did you mean "pi"'),
        (["--agents"], "no controller"),
        (["--scenarios", "circle"], "no 'circle'"),
        (["--scenarios"], "--scenarios: none to run"),
        (["--runs", "0"], 'value "0" for --runs. Must be >= 1'),
        (["--runs", "2.5"], "--runs must be a whole number, got '2.5'"),
        (["--backend", "cloud"], "--backend"),
        (["--preset", "paper", "--presets"], "--presets cannot be combined with --plant"),
        (["--preset", "paper", "--scenarios", "load"], "no 'load'; there are square, constant"),
        (["--preset", "harder"], '"harder" for --preset. Choose from: "paper", "dead-z'),
        (["--rusn", "3"], "Unknown option: --rusn. Did you mean --runs?"),
        (["stray"], "stray"),
        (["--plant", "nowhere.json"], "nowhere.json"),
        (["--set", "delay"], "ARGUMENT=VALUE"),
        (["--set", "dely=3"], "'dely': did you mean 'delay'?"),
        (["--set", "delay=100000"], "--set: delay must be an integer from 0 to 10,000, got 10"),
        (["--set", "a=[1,-1.5]"], "--set: a must not have a root beyond the unit circle"),
        (["--set", "render_mode=human"], "--set: render_mode is not an argument of the plant"),
        (["--agent", "PI=agents:PIController"], "'PI' is taken"),
        (["--agent", "mine"], "NEW_NAME=MODULE:FACTORY"),
    ],
    "identify": [
        (["none.csv"], "none.csv cannot be read: No such file"),
        ([LOG, "--u-min", "nan"], 'value "nan" for --u-min. Must be < inf'),
        ([LOG, "--operating-flow", "1e9"], "operating_flow must be near the flows of the log"),
    ],
    "bounds": [
        (["--cache", __file__], "--cache: "),
    ],
    "speed": [
        (["--device", "toaster"], "--device: device must be one that PyTorch can use"),
    ],
    "sweep": [
        (["--agents", "nobody"], '"nobody" for --agents. Choose from: "nothing", "nn"'),
        (["--design", "random", "--set", "a=[1]"], "--design random: time_constant_factor"),
        (["--plants", "10"], "--plants and --design-seed are for --design random"),
        (["--design-seed", "3"], "--plants and --design-seed are for --design random"),
    ],
    "train": [([], "NETWORK is missing: name what to train, one of nn-smith, ppo, ppo-hard")],
    "watch": [
        (["--agent", "lqr"], "--agent: no 'lqr'; there are nothing, nn"),
        (["--agent", "agents:Nobody"], "--agent.*Nobody"),
        (["--scenario", "triangle"], "--scenario.*constant-noise"),
        (["--preset", "paper", "--scenario", "load"], "no 'load' on this plant"),
        (["--video", "film.avi"], "--video: must end in .gif"),
        (["--seed", "-1"], "--seed. Must be >= 0"),
    ],
}  # fmt: skip


@pytest.mark.parametrize(
    ("name", "given", "complaint"),
    [(name, *each) for name in REFUSED for each in REFUSED[name]],
)
def test_what_does_not_fit_is_refused_before_anything_is_run_or_written(
    name, given, complaint, refused, tmp_path, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    assert re.search(complaint, refused(main_of(name), given))
    assert not any(path.is_file() for path in tmp_path.rglob("*"))


@pytest.mark.parametrize(
    ("given", "package", "extra"),
    [
        ("datasets", "minari", "data"), ("watch", "pygame", "render"),
        ("train nn-smith", "torch", "torch"), ("tune pi", "optuna", "bench"),
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
    name, *options = given.split()
    said = refused(main_of(name), options)
    assert f'{package} is not installed: pip install -e ".[{extra}]"' in said


def test_without_cyclopts_a_command_names_the_extra():
    program = "import sys; sys.modules['cyclopts'] = None; import benchmarks.claims.__main__"
    done = python("-c", program)
    assert done.returncode == 2
    assert 'cyclopts is not installed: pip install -e ".[compare]"' in done.stderr
    assert "Traceback" not in done.stderr


def test_the_map_shows_questions_and_commands_as_text(capsys):
    assert show_map([]) == 0
    shown = capsys.readouterr().out
    assert "Which gains are best?" in shown
    assert {name for name in COMMANDS if f"benchmarks.{name}" in shown} >= {"tune", "bounds"}
    assert "`" not in shown
    assert "](" not in shown
    assert ":--" not in shown  # the glossary is another table


@pytest.mark.parametrize(
    "page",
    [ROOT / "README.md", *(ROOT / "benchmarks").rglob("*.md")],
    ids=lambda page: str(page.relative_to(ROOT)),
)
def test_a_command_on_a_page_can_be_typed_as_it_stands(page):
    text = page.read_text("utf-8").replace("\\\n", "")
    for name, options in re.findall(r"python -m benchmarks\.([\w.]+)([^`|#\n]*)", text):
        if name in COMMANDS:  # an example takes no options
            declared = importlib.import_module(COMMANDS[name]).Options
            assert read(declared, name, shlex.split(options)), name


def test_the_map_names_the_command_that_was_meant(refused):
    assert "no command 'comprae'; did you mean compare?" in refused(show_map, ["comprae"])


@pytest.mark.skipif(sys.platform == "win32", reason="no SIGINT to another process")
def test_an_interruption_while_it_imports_shows_no_traceback():
    # A marker says that the interpreter is up: what comes before cannot be caught.
    program = (
        "import signal, sys; signal.signal(signal.SIGINT, signal.default_int_handler)\n"
        "from benchmarks.compare.__main__ import main; print('up', flush=True)\n"
        "sys.exit(main(['--runs', '1']))"
    )
    run = subprocess.Popen(
        [sys.executable, "-c", program], cwd=ROOT, stdout=subprocess.PIPE,
        stderr=subprocess.PIPE, text=True,
    )  # fmt: skip
    assert run.stdout.readline() == "up\n"
    time.sleep(0.1)
    run.send_signal(signal.SIGINT)
    out, err = run.communicate(timeout=60)
    assert run.returncode == 130
    assert "Interrupted" in out
    assert "Traceback" not in err


def test_of_a_repeated_option_the_last_counts_and_lists_add_up():
    given = [
        "--agents", "nn", "pi", "--agents", "mpc", "--runs", "3", "--runs", "4",
        "--set", "delay=3", "--set", "a=[1,-0.5]",
    ]  # fmt: skip
    options = read(Options, "program", given)
    assert (options.agents, options.runs) == (("nn", "pi", "mpc"), 4)
    assert options.plant.set == ("delay=3", "a=[1,-0.5]")
