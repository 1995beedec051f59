"""The speed benchmark: its arithmetic, and that it runs."""

from benchmarks.speed import command as speed
from benchmarks.speed.__main__ import main


def test_ratios_compare_rounds_with_each_other(monkeypatch):
    clock = iter([0, 1, 1, 3, 3, 5, 5, 6, 6, 7, 7, 11])  # began and ended, case after case
    monkeypatch.setattr(speed.time, "perf_counter", lambda: next(clock))
    cases = [speed.Timed("slow", lambda: None, 100), speed.Timed("fast", lambda: None, 400)]
    table = speed.compare(cases, rounds=3)
    # Seconds: 1, 2, 1 and 2, 1, 4. Ratios of steps a second: 200/100, 400/50, 100/100.
    assert list(table["steps a second"]) == ["100", "200"]
    assert list(table["ratio to slow"]) == ["1.00 (1.00 to 1.00)", "2.00 (1.20 to 6.80)"]


def peer(n):
    yield speed.Timed(f"{n} of a peer", lambda: None, n)


def test_it_runs(monkeypatch, capsys):
    small = {
        "SINGLE_STEPS": 50, "FRAMES": 3, "EPISODE": 5, "BATCHES": (1, 3), "LOOPS": (2,),
        "GRADIENTS": 2, "BACKWARD": 25, "PEERS": {"sys": peer, "not_installed": peer},
    }  # fmt: skip
    for name, value in small.items():
        monkeypatch.setattr(speed, name, value)
    main(["--rounds", "1"])
    shown = capsys.readouterr().out
    for words in (
        "n = 3", "Pendulum-v1", "picture", "batch of 2", "KiB", "PyTorch", "gradient",
        "import mptc_gym", "3 of a peer", "Without not_installed: pip install",
    ):  # fmt: skip
        assert words in shown


def test_a_device_can_be_measured_alone(monkeypatch, capsys):
    monkeypatch.setattr(speed, "DEVICE_BATCHES", (2, 3))
    monkeypatch.setattr(speed, "DEVICE_STEPS", 5)
    main(["--rounds", "1", "--device", "cpu"])
    shown = capsys.readouterr().out
    assert "on cpu" in shown
    assert "hard" in shown
    assert "CartPole" not in shown
