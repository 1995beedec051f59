"""The speed benchmark: its arithmetic, and that it runs."""

import numpy as np
import pytest

from benchmarks import speed


def test_ratios_compare_rounds_with_each_other():
    rates = np.array([[100.0, 200.0], [50.0, 400.0], [100.0, 100.0]])
    heading, slow, fast = speed.table(["slow", "fast"], rates).splitlines()
    assert heading.endswith("ratio to slow")
    assert " ".join(slow.split()) == "slow 100 1.00 (1.00 to 1.00)"
    assert " ".join(fast.split()) == "fast 200 2.00 (1.20 to 6.80)"


def test_a_rate_counts_the_steps_of_all_plants(monkeypatch):
    clock = iter([10.0, 12.0])
    monkeypatch.setattr(speed.time, "perf_counter", lambda: next(clock))
    plants = speed.make_environments(8, None)[speed.PLANT]
    assert speed.steps_per_second(plants) == 8 * 1201 / 2.0


@pytest.mark.parametrize(
    ("device", "numbers", "first"),
    [([], ["1", "2"], "CartPole-v1"), (["--device", "cpu"], ["3"], "in PyTorch")],
)
def test_it_runs_with_and_without_a_device(device, numbers, first, monkeypatch, capsys):
    small = {"STEPS": 3, "SINGLE_STEPS": 3, "BATCHES": (1, 2), "ON_DEVICE": (3,)}
    for name, value in small.items():
        monkeypatch.setattr(speed, name, value)
    assert speed.main(["--rounds", "1", *device]) == 0
    printed = capsys.readouterr().out
    assert [line[4:] for line in printed.splitlines() if line.startswith("n = ")] == numbers
    assert f"ratio to {first}" in printed
    assert "in PyTorch, hard" in printed
