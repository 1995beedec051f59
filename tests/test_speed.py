"""The speed benchmark: its arithmetic, and that it runs."""

import pytest

from benchmarks import speed


def test_ratios_compare_rounds_with_each_other(monkeypatch):
    clock = iter([0, 1, 3, 3, 5, 6, 6, 7, 11])  # began, and the end of either case
    monkeypatch.setattr(speed.time, "perf_counter", lambda: next(clock))
    cases = {"slow": speed.Case(list, 100), "fast": speed.Case(list, 400)}
    table = speed.compare(cases, rounds=3)
    # Seconds: 1, 2, 1 and 2, 1, 4. Ratios of steps a second: 200/100, 400/50, 100/100.
    assert list(table["steps a second"]) == ["100", "200"]
    assert list(table["ratio to slow"]) == ["1.00 (1.00 to 1.00)", "2.00 (1.20 to 6.80)"]


@pytest.mark.parametrize("torch", [True, False])
def test_it_runs_with_and_without_pytorch(torch, monkeypatch, capsys):
    if torch:
        pytest.importorskip("torch")
    small = {"EPISODE": 3, "BATCHES": (1, 2), "ON_DEVICE": (3,)}
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
