"""What all commands have in common: their help."""

import importlib
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
COMMANDS = (
    *("compare", "limits", "claims", "figures", "sweep", "identify", "identify.study"),
    *("train", "train.defaults", "tune", "watch", "datasets", "identify.tclab_twin"),
)


@pytest.mark.parametrize("name", COMMANDS)
def test_help_shows_defaults_as_one_would_type_them(name, capsys):
    module = f"benchmarks.{name}"
    if (ROOT / module.replace(".", "/")).is_dir():
        module += ".__main__"
    try:
        command = importlib.import_module(module)
    except ImportError as error:  # `.ci/versions` tests without the extras
        pytest.skip(f"it needs an extra: {error}")
    try:
        status = command.main(["--help"])
    except SystemExit as stop:
        status = stop.code
    assert status == 0
    shown = capsys.readouterr().out
    for clutter in (str(ROOT), "default: None", "default: False", "default: ["):
        assert clutter not in shown
    if "--seed " in shown:
        assert re.search(r"default: [01][])]", shown)  # 0 is a default, too


def test_help_keeps_names_whole(capsys):
    compare = pytest.importorskip("benchmarks.compare.__main__")
    compare.main(["--help"])
    shown = capsys.readouterr().out
    for name in ("nn-frozen", "dead-zone-7", "square-dead-zone-7", "constant-noise"):
        assert name in shown
