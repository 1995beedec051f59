"""The action form "change": actions that change the flow."""

import gymnasium
import numpy as np
import pytest


def make(**arguments):
    return gymnasium.make("MiddlePoint-v0", action="change", **arguments)


@pytest.mark.parametrize(
    ("arguments", "actions", "flows"),
    [
        # Changes are a share of half the range, 10 t/h, and limits are left at once.
        ({"dead_zone": 0.0, "max_move": 0.2}, [1, 0.5, 0, -1, -0.25], [2, 3, 3, 1, 0.5]),
        ({"dead_zone": 0.0, "max_move": 0.5}, [1, 1, 1, 1, -1], [5, 10, 10, 10, 5]),
        # An action beyond the box changes the flow no further.
        ({"dead_zone": 0.0, "max_move": 0.3}, [17], [3]),
        # The flow is 0 before the first change, whatever the limits.
        ({"u_min": -7.3, "u_max": 12.9, "compensated_dead_zone": 5.0}, [0], [0]),
        # The policy's dead zone is compensated, whatever that of the plant is.
        *(({"dead_zone": zone, "max_move": 2, "compensated_dead_zone": 6}, [0.25], [8])
          for zone in (0.0, [1.0, 4.0], 5.0)),
        # The flow between the dead zone and each limit is shared out evenly.
        ({"u_max": 20, "max_move": 1, "compensated_dead_zone": 5}, [-0.2, 0.4], [-6.5, 7.25]),
        # The smallest change leaves a dead zone whose edge float32 does not hold.
        ({"dead_zone": 7.0, "compensated_dead_zone": 7.0}, [1e-9, -2e-9], [7, -7]),
        # A limit within the dead zone is reached.
        ({"u_min": -3, "max_move": 2, "compensated_dead_zone": 5.0}, [-0.1], [-3]),
    ],
)  # fmt: skip
def test_flows_by_hand(arguments, actions, flows):
    env = make(**arguments)
    env.reset(seed=0)
    infos = [env.step(np.array([action], np.float32))[4] for action in actions]
    assert [info["applied"] for info in infos] == pytest.approx(flows, abs=5e-5)


def test_a_past_action_commands_the_same_flow_in_the_other_form():
    env = make(action_window=1, compensated_dead_zone=5.0)
    flow = gymnasium.make("MiddlePoint-v0")
    env.reset()
    flow.reset()
    observation, *_, info = env.step(np.array([0.123], np.float32))
    assert flow.step(observation[-1:])[-1] == info  # to the bit


def test_the_cost_of_a_move_is_that_of_the_commanded_flow():
    rewards = []
    for move_weight in (0.0, 1.0):
        env = make(move_weight=move_weight, max_move=0.4)
        env.reset()
        rewards.append(env.step(np.ones(1, np.float32))[1])
    assert rewards[0] - rewards[1] == pytest.approx(0.4)
