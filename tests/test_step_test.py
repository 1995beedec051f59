"""A step test of any plant, plants in files, and the wear of the valve."""

import numpy as np
import pytest

from benchmarks.lib.command import UsageError
from benchmarks.loop.linear import StepTest, nominal, step_test
from benchmarks.loop.plants import PlantOptions
from mptc_gym import Parameters


def first_order(gain, time_constant, delay):
    """Return arguments of a plant of first order, with `delay` samples until an input shows."""
    pole = np.exp(-8.0 / time_constant)
    return {"a": [1.0, -pole], "b": [gain * (1.0 - pole)], "delay": delay - 1}


def test_paper_plant_shows_the_numbers_its_controllers_are_tuned_with():
    found = step_test(Parameters())
    # Steady-state gain -0.0496 / 0.0727, the time constant of the pole at 0.9515, 19 samples.
    assert found == StepTest(-0.6825, 161.0, 152.0, 8.0)


@pytest.mark.parametrize("gain", [-0.3, 0.02, 4.0])
@pytest.mark.parametrize("time_constant", [4.0, 60.0, 900.0])
@pytest.mark.parametrize("delay", [1, 5, 80])
def test_plant_of_first_order_shows_its_own_numbers(gain, time_constant, delay):
    found = step_test(Parameters(**first_order(gain, time_constant, delay)))
    assert found.gain == pytest.approx(gain, rel=1e-3)
    assert found.time_constant == pytest.approx(time_constant, rel=0.01, abs=1.0)
    assert found.delay == 8.0 * delay


def test_model_is_close_to_the_response_of_a_plant_of_higher_order():
    a = np.poly([0.95, 0.9, 0.8])
    plant = Parameters(a=a.tolist(), b=[0.001, 0.0005], delay=10)
    found = step_test(plant)
    times = 8.0 * np.arange(300)
    model = found.gain * -np.expm1(
        -np.maximum(times - found.delay + 8.0, 0) / found.time_constant
    )
    model[times < found.delay] = 0.0
    assert np.abs(model - nominal(plant).step_response(300)).max() < 0.1 * found.gain


def test_sampling_interval_scales_times():
    slow = step_test(Parameters(sampling_interval=80.0))
    assert (slow.time_constant, slow.delay) == (1610.0, 1520.0)


@pytest.mark.parametrize(
    ("arguments", "name"),
    [({"a": [1.0, -1.0]}, "a"), ({"a": [1.0, -1.1]}, "a"), ({"b": [0.1, -0.1]}, "b")],
)
def test_plant_without_a_new_steady_state_is_refused(arguments, name):
    with pytest.raises(ValueError, match=f"^{name} must"):
        step_test(Parameters(**arguments))


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        (None, "plant.json cannot be read: No such file"),
        ("{", "plant.json must be a JSON file"),
        ("[1, 2]", "plant.json must hold one object"),
        ('{"delay": -1}', "delay must be"),
        ("[" * 100_000, "plant.json must be a JSON file"),
    ],
)
def test_bad_plant_file_is_named(tmp_path, text, complaint):
    path = tmp_path / "plant.json"
    if text is not None:
        path.write_text(text)
    with pytest.raises(UsageError, match=f"^--plant: .*{complaint}"):
        PlantOptions(plant=path).chosen()


def test_lists_of_any_depth_are_refused_by_name():
    for depth in range(600, 1000, 5):  # what JSON still reads may be too deep to be shown
        with pytest.raises(UsageError, match=r"^--set: delay must be an integer"):
            PlantOptions(set=("delay=" + "[" * depth + "]" * depth,)).chosen()
