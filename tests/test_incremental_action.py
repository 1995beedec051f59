"""The wrappers whose action changes the flow."""

from functools import partial

import gymnasium
import numpy as np
import pytest
from gymnasium.envs.registration import EnvSpec
from gymnasium.error import ResetNeeded
from gymnasium.utils.env_checker import data_equivalence

from mptc_gym import MiddlePointEnv, MiddlePointVectorEnv
from mptc_gym.wrappers import IncrementalAction
from mptc_gym.wrappers import vector as many

RANGES = {
    "dead_zone": [2.0, 8.0], "delay": [3, 9],
    "noise_variance": 0.3, "setpoint": "random", "setpoint_period": 40, "action_window": 4,
    "move_weight": 0.1,
}  # fmt: skip


def make(arguments=None, **wrapper):
    env = gymnasium.make("MiddlePoint-v0", max_episode_steps=7, **(arguments or {}))
    return IncrementalAction(env, **wrapper)


def make_many(**wrapper):
    return many.IncrementalAction(gymnasium.make_vec("MiddlePoint-v0", 2, **RANGES), **wrapper)


def infos_of(env, moves, *, seed=0):
    """Reset, take moves, and return the infos of the steps."""
    env.reset(seed=seed)
    return [env.step(np.array([move], np.float32))[4] for move in moves]


@pytest.mark.parametrize(
    ("arguments", "wrapper", "moves", "flows"),
    [
        # Moves are a share of half the range, 10 t/h, and limits are left at once.
        ({"dead_zone": 0.0}, {"max_move": 0.2}, [1, 0.5, 0, -1, -0.25], [2, 3, 3, 1, 0.5]),
        ({"dead_zone": 0.0}, {"max_move": 0.5}, [1, 1, 1, 1, -1], [5, 10, 10, 10, 5]),
        # An action beyond the box moves no further.
        ({"dead_zone": 0.0}, {"max_move": 0.3}, [17], [3]),
        # The first flow is none, whatever the limits.
        ({"u_min": -7.3, "u_max": 12.9}, {}, [0], [0]),
        ({"u_min": -7.3, "u_max": 12.9}, {"compensate_dead_zone": True}, [0], [0]),
        # A number is compensated, whatever the dead zone is: a quarter wants half of the way.
        *(({"dead_zone": z}, {"max_move": 2, "compensate_dead_zone": 6}, [0.25], [6 + 4 * 0.5])
          for z in (0.0, [1.0, 4.0], 5.0)),
        # A limit within the dead zone is reached.
        ({"u_min": -3}, {"max_move": 2, "compensate_dead_zone": True}, [-0.1], [-3]),
    ],
)  # fmt: skip
def test_flows_by_hand(arguments, wrapper, moves, flows):
    infos = infos_of(make(arguments, **wrapper), moves)
    assert [info["applied"] for info in infos] == pytest.approx(flows, abs=5e-5)


def test_drawn_numbers_are_those_of_the_episode():
    env = make(RANGES, max_move=2.0, compensate_dead_zone=True)
    drawn = set()
    for _ in range(5):
        _, info = env.reset(seed=None if drawn else 3)
        drawn.add(info["dead_zone"])
        applied = [env.step(np.array([move]))[4]["applied"] for move in (1e-9, 1.0, -1.0)]
        assert applied == pytest.approx([info["dead_zone"], 10.0, -10.0], abs=1e-4)
    assert len(drawn) == 5


BAD_ACTIONS = {
    make: [np.array([np.nan]), np.array([np.inf]), np.zeros(2), "0.5"],
    make_many: [np.zeros(2), np.zeros((3, 1)), np.full((2, 1), np.nan), [["0.5"], ["1"]]],
}


@pytest.mark.parametrize("made", BAD_ACTIONS)
def test_a_reset_comes_first_and_a_bad_action_changes_nothing(made):
    env, other = made(), made()
    good = np.full(env.action_space.shape, 0.5, np.float32)
    with pytest.raises(ResetNeeded):
        env.step(good)
    env.reset(seed=0), other.reset(seed=0)
    for bad in BAD_ACTIONS[made]:
        with pytest.raises(ValueError, match="action"):
            env.step(bad)
        assert data_equivalence(env.step(-good), other.step(-good), exact=True)


@pytest.mark.parametrize("made", BAD_ACTIONS)
def test_bad_arguments_are_named(made):
    for name, values in {
        "max_move": (0.0, 2.1, float("nan"), "x", True),
        "compensate_dead_zone": (-1.0, np.inf, "yes", None, 10**400),
    }.items():
        for value in values:
            with pytest.raises(ValueError, match=f"^{name} must be"):
                made(**{name: value})
    made(compensate_dead_zone=0.0, max_move=2.0)


def test_other_environments_are_refused():
    wrap, wrap_many = IncrementalAction, many.IncrementalAction
    made = partial(gymnasium.make_vec, "CartPole-v1", 2)
    for wrapped, env, allowed in [
        (wrap, gymnasium.make("CartPole-v1"), "a MiddlePointEnv"),
        (wrap, "MiddlePoint-v0", "a MiddlePointEnv"),
        (wrap, MiddlePointVectorEnv(2), "a MiddlePointEnv.*vector takes many"),
        (wrap_many, "MiddlePoint-v0", "a vector environment"),
        (wrap_many, MiddlePointEnv(), "a vector environment.*mptc_gym.wrappers takes one"),
        (wrap_many, made(vectorization_mode="sync"), "a vector environment of MiddlePointEnv"),
        (wrap_many, made(), "a vector environment of MiddlePointEnv"),
    ]:
        with pytest.raises(ValueError, match=f"^env must be {allowed}"):
            wrapped(env)
    torch_env = pytest.importorskip("mptc_gym.torch_env", reason="it is refused")
    with pytest.raises(ValueError, match="of MiddlePointEnv in NumPy"):
        many.IncrementalAction(torch_env.MiddlePointTorchEnv(2))


def test_tensors_are_actions_but_those_with_a_graph_are_refused_for_many():
    torch = pytest.importorskip("torch", reason="the action is a tensor")
    env, envs = make(), make_many()
    env.reset(seed=0), envs.reset(seed=0)
    assert env.step(torch.ones(1, requires_grad=True))[4]["command"] == pytest.approx(4.0)
    assert envs.step(torch.ones(2, 1))[4]["command"].min() > 3.0
    for each in (envs, envs.unwrapped):
        with pytest.raises(ValueError, match="actions must be numbers"):
            each.step(torch.ones(2, 1, requires_grad=True))


def test_a_tensor_is_a_mask_of_the_plants_to_reset():
    torch = pytest.importorskip("torch", reason="the mask is a tensor")
    envs, twin = make_many(), make_many()
    actions = np.ones((2, 1))
    for env, mask in ((envs, torch.tensor([True, False])), (twin, np.array([True, False]))):
        env.reset(seed=0)
        env.step(actions)
        env.reset(options={"reset_mask": mask})
    assert data_equivalence(envs.step(actions), twin.step(actions), exact=True)


def test_the_spec_makes_it_again():
    env = make({"action_window": 20}, max_move=0.3, compensate_dead_zone=True)
    again = gymnasium.make(EnvSpec.from_json(env.spec.to_json()))
    assert isinstance(again, IncrementalAction)
    for _ in range(2):
        assert infos_of(env, [0.4, -1.0, 0.2]) == infos_of(again, [0.4, -1.0, 0.2])
