"""Controllers on a plant whose temperature rises with the flow: the mirror image of ours."""

import numpy as np
import pytest

from agents import DirectNNController, PIController, SmithPredictor
from benchmarks.loop.rollout import make_plants, rollout
from mptc_gym import Parameters

SHOWN = {"time_constant": 161.0, "delay": 152.0}
GAIN = 0.6825
LIMITS, MIRRORED = {"u_min": -6.0, "u_max": 10.0}, {"u_min": -10.0, "u_max": 6.0}
NOISY = {"noise_variance": 0.1, "setpoint_amplitude": 6.0}  # beyond the nearer limit
SAMPLES = 1200


def smith(gain, **limits):
    return SmithPredictor(
        gain=gain, closed_loop_time_constant=80.0, dead_zone=5.0, **SHOWN, **limits
    )


def simc(gain, **limits):
    return PIController.simc(gain=gain, **SHOWN, **limits)


@pytest.mark.parametrize("make", [simc, smith])
def test_mirrored_plant_sees_the_mirrored_flow(make):
    ours, theirs = (
        rollout(
            make_plants(2, SAMPLES, **plant, **limits, **NOISY), controller, SAMPLES, seed=3
        )
        for plant, limits, controller in (
            ({}, LIMITS, make(-GAIN, **LIMITS)),
            ({"b": [-b for b in Parameters().b]}, MIRRORED, make(GAIN, **MIRRORED)),
        )
    )
    # Actions have 24 bits, which limits the agreement.
    np.testing.assert_allclose(theirs.command, -ours.command, atol=1e-3)
    np.testing.assert_allclose(theirs.output, ours.output, atol=1e-3)
    assert (ours.command > LIMITS["u_max"]).any()  # the limits, and anti-windup, had a part


def test_network_learns_the_other_direction():
    plant = {"b": [-b for b in Parameters().b]}
    late = {}
    for direction in (-1, 1):
        controller = DirectNNController(direction=direction, num_envs=8)
        run = rollout(make_plants(8, SAMPLES, **plant), controller, SAMPLES, seed=0)
        error = np.abs(run.setpoint - run.output)[SAMPLES // 2 :]
        late[direction] = np.median(error.mean(axis=0))
    assert late[1] < 4.0  # with no control it is 5
    assert late[-1] > 6.0  # the wrong way round it drives the error up
