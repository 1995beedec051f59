"""Films of a controller show the run that is asked for."""

from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest
from PIL import Image

from agents import PIController
from benchmarks import watch
from benchmarks.watch import equal_steps, main
from mptc_gym import MiddlePointEnv
from tests.conftest import run_closed

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
    ("given", "plant", "samples", "written"),
    [
        (
            ["--set", "setpoint_period=400", "--scenario", "run", "--video", "new/film.gif"],
            {"setpoint_period": 400}, 1200, "new",
        ),
        # Without equal steps.
        (["--scenario", "constant"], {"setpoint": 5.0}, SAMPLES, "results/watch"),
    ],
)  # fmt: skip
def test_a_film_shows_steps_side_by_side(given, plant, samples, written, tmp_path, capsys):
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
    errors = np.abs(run_closed(MiddlePointEnv(**plant), PIController(), samples)["error"])
    assert f"mean absolute error {errors[1:].mean():.3f} °C" in capsys.readouterr().out


def test_multiples_are_of_the_reference_on_the_same_step(tmp_path, monkeypatch):
    # Of a run that has twice, then three times the reference's error.
    titles = []
    setpoint = np.tile(np.repeat([5.0, -5.0], 10), 2)[:, np.newaxis]
    error = np.ones((40, 1))
    runs = [
        Mock(setpoint=setpoint, next_error=error * np.repeat(factors, 10)[:, np.newaxis],
             output=setpoint, applied=setpoint)
        for factors in ([9.0, 2.0, 9.0, 3.0], [1.0, 1.0, 1.0, 1.0])
    ]  # fmt: skip
    from matplotlib.figure import Figure

    kept = Figure.suptitle
    monkeypatch.setattr(
        Figure, "suptitle", lambda self, text, **k: titles.append(text) or kept(self, text, **k)
    )
    watch.write_film(tmp_path / "film.gif", "mine", 8.0, *runs)
    assert titles[0].replace("\n", " ").startswith("mine: error 2.00 and 3.00 times that of")


def test_what_cannot_be_written_is_said_before_anything_is_run(refused, monkeypatch):
    monkeypatch.setattr(type(watch.REFERENCE), "run", None)
    assert "--video: " in refused(main, ["--video", "/proc/x.gif"])
