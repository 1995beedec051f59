"""The speed benchmark: its arithmetic, and that it runs."""

import pandas as pd
import pytest

from benchmarks import speed


def test_ratios_compare_rounds_with_each_other():
    rates = pd.DataFrame({"slow": [100.0, 50.0, 100.0], "fast": [200.0, 400.0, 100.0]})
    table = speed.summary(rates)
    assert list(table["case"]) == ["slow", "fast"]
    assert list(table["steps a second"]) == ["100", "200"]
    assert list(table["ratio to slow"]) == ["1.00 (1.00 to 1.00)", "2.00 (1.20 to 6.80)"]


def test_a_rate_counts_the_steps_of_all_plants(monkeypatch):
    clock = iter([10.0, 12.0])
    monkeypatch.setattr(speed.time, "perf_counter", lambda: next(clock))
    plants = speed.make_environments(8, None)[speed.PLANT]
    assert speed.steps_a_second(plants) == 8 * 1201 / 2.0


@pytest.mark.parametrize("torch", [True, False])
def test_it_runs_with_and_without_pytorch(torch, monkeypatch, capsys):
    if torch:
        pytest.importorskip("torch")
    small = {"STEPS": 3, "SINGLE_STEPS": 3, "BATCHES": (1, 2), "ON_DEVICE": (3,)}
    for name, value in small.items():
        monkeypatch.setattr(speed, name, value)
    monkeypatch.setattr(speed.importlib.util, "find_spec", lambda _: torch or None)
    assert speed.main(["--rounds", "1"]) == 0
    printed = capsys.readouterr().out
    for words in ("CartPole-v1", "n = 2", "MiddlePoint-v0, hard"):
        assert words in printed
    assert ("in PyTorch" in printed) is torch
    if torch:
        assert speed.main(["--rounds", "1", "--device", "cpu"]) == 0
        assert "n = 3\n" in capsys.readouterr().out
