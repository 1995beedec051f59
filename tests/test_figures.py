"""The paper's figures drawn anew: what is typical, and that there is something to see."""

from unittest.mock import DEFAULT, Mock

import matplotlib.image
import numpy as np
import pandas as pd
import pytest

from benchmarks.figures import command as figures
from benchmarks.figures.__main__ import main
from benchmarks.loop.metrics import join
from tests.conftest import trajectory


def test_the_typical_run_is_the_median_one():
    outputs = [1.0, 9.0, 4.0, 2.0]  # errors 4, 4, 1, 3 of set point 5
    runs = join([trajectory([5.0], [y], [10.0 * y]) for y in outputs])
    row = figures.summarise(runs).iloc[0]
    assert (row["setpoint"], row["output_typical"], row["command_typical"]) == (5.0, 2.0, 20.0)
    assert row["output_p10"] == pytest.approx(1 + 0.3 * (2 - 1))
    assert row["output_p90"] == pytest.approx(4 + 0.7 * (9 - 4))


def test_every_figure_is_drawn(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(figures, "SAMPLES", 120)
    assert main(["--runs", "3", "--out", str(tmp_path)]) == 0
    names = [f"figure_{n:02d}.png" for n in range(5, 13)]
    assert sorted(path.name for path in tmp_path.glob("*.png")) == [*names, "figures.png"]
    for name in (*names, "figures.png"):
        picture = matplotlib.image.imread(tmp_path / name)[..., :3]
        dark_or_coloured = np.mean(picture.min(axis=2) < 0.9)
        assert 0.01 < dark_or_coloured < 0.5, name
    data = pd.read_csv(tmp_path / "nn_noise.csv")
    assert len(data) == 120
    assert (data["output_p10"] <= data["output_p90"]).all()
    assert (data["noise_p10"] < data["noise_p90"])[1:].all()  # at k = 0 there is none


def test_interrupted(tmp_path, monkeypatch, capsys):
    monkeypatch.setattr(figures, "SAMPLES", 60)
    at_the_third = [DEFAULT, DEFAULT, KeyboardInterrupt]
    stopped = Mock(wraps=figures.summarise, side_effect=at_the_third)
    monkeypatch.setattr(figures, "summarise", stopped)
    assert main(["--runs", "2", "--out", str(tmp_path)]) == 130
    assert "Interrupted" in capsys.readouterr().out
    kept = {path.name for path in tmp_path.iterdir()}
    pictures = {f"figure_{n:02d}.png" for n in (5, 6, 7)}
    assert kept == pictures | {"nn.csv", "nn_dead_zone.csv"}
