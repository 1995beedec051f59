"""Films of a controller show the run that is asked for."""

from dataclasses import replace

import numpy as np
import pytest
from PIL import Image

from agents import PIController
from benchmarks import watch
from benchmarks.watch import equal_steps, main
from mptc_gym import MiddlePointEnv
from tests.conftest import run

SAMPLES = 40


@pytest.fixture(autouse=True)
def short(monkeypatch, tmp_path):
    """Make the cases short, and keep what is written out of the checkout."""
    made = {name: replace(each, samples=SAMPLES) for name, each in watch.SCENARIOS.items()}
    monkeypatch.setattr(watch, "SCENARIOS", made)
    monkeypatch.setattr(watch, "PICTURES", 4)
    monkeypatch.chdir(tmp_path)


def test_equal_steps_by_hand():
    levels = [0.0, 5.0, -5.0, 5.0, -5.0, 5.0, 5.0, -5.0]
    found = equal_steps(np.repeat(levels, [4, 6, 6, 6, 6, 3, 3, 5]))
    assert found == [(10, 16), (22, 28)]  # from 5 to -5 for 6 samples; the last is shorter
    assert equal_steps(np.repeat([5.0], 7)) == [(0, 7)]


@pytest.mark.parametrize(
    ("given", "plant", "steps", "written"),
    [
        (
            ["--set", "setpoint_period=400", "--scenario", "run", "--video", "new/film.gif"],
            {"setpoint_period": 400}, [(200, 400), (1000, 1200)], "new",
        ),
        # Without equal steps.
        (["--scenario", "constant"], {"setpoint": 5.0}, [(0, SAMPLES)], "results/watch"),
    ],
)  # fmt: skip
def test_a_film_shows_steps_side_by_side(given, plant, steps, written, tmp_path, capsys):
    assert main(["--agent", "pi", *given]) == 0
    (film,) = (tmp_path / written).iterdir()
    with Image.open(film) as pictures:
        assert pictures.n_frames == 1 + 4
        inked = []
        for i in range(pictures.n_frames):
            pictures.seek(i)
            blue = np.abs(np.array(pictures.convert("RGB")) - [0, 114, 178.0]).max(axis=2) < 40
            inked.append(blue[100:430])
    total = [each.sum() for each in inked]
    # The first picture is the whole, as is the last; those between grow, and none is blank.
    assert total[0] == pytest.approx(total[-1], rel=0.02)
    assert 0 < total[1] < total[2] < total[3] < total[0]
    assert min(inked[0][:, :375].sum(), inked[0][:, 375:].sum()) > 0.3 * total[0]
    # Errors are multiples of the reference's on the same step.
    samples = steps[-1][1]
    ours = run(MiddlePointEnv(**plant), [PIController().act] * samples)["error"][1:]
    theirs = watch.REFERENCE.members()[0].run(plant, samples, 1, 0).next_error[:, 0]
    multiples = [np.abs(ours[a:b]).mean() / np.abs(theirs[a:b]).mean() for a, b in steps]
    found = " and ".join(f"{multiple:.2f}" for multiple in multiples)
    assert f"PI (1992): error {found} times that of" in capsys.readouterr().out


def test_a_film_stays_in_its_folder_whatever_the_name_of_the_controller(tmp_path, monkeypatch):
    (tmp_path / "a/b").mkdir(parents=True)
    monkeypatch.chdir(tmp_path / "a/b")
    assert main(["--agent", "../../$x=agents:PIController", "--scenario", "constant"]) == 0
    (film,) = tmp_path.rglob("*.gif")
    assert film == tmp_path / "a/b/results/watch/_______x-constant.gif"


def test_a_plant_with_set_points_of_its_own_needs_no_scenario(monkeypatch, capsys):
    monkeypatch.setattr(watch, "write_film", lambda *_: "found")
    assert main(["--agent", "pi", "--set", "setpoint=random"]) == 0
    assert "run.gif" in capsys.readouterr().out


def test_what_cannot_be_written_is_said_before_anything_is_run(refused, monkeypatch):
    monkeypatch.setattr(type(watch.REFERENCE), "run", None)
    assert "--video: " in refused(main, ["--video", "/proc/x.gif"])
