"""The roster: what holds for any controller, as every command runs it; and a user's own."""

import copy
import pickle
import re
import textwrap

import numpy as np
import pytest
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecNormalize

from benchmarks.controllers.own import own_controllers
from benchmarks.controllers.roster import ROSTER
from benchmarks.loop.runs import make_plants, simulate
from mptc_gym import IDS, PRESETS, Parameters, evaluate
from mptc_gym.sb3 import make_vec_env
from tests.conftest import ROOT
from tests.verify_bounds import errors

ACTUATOR = {"u_min": -9.0, "u_max": 14.0, "dead_zone": 4.0}
# A plant of the other direction, which shows an input sooner.
OTHER = {**ACTUATOR, "b": [0.0456, 0.00404], "delay": 9}
IDLE = 5.0  # mean |e| of an idle valve, degC


@pytest.fixture(params=ROSTER)
def entry(request):
    return ROSTER[request.param]


@pytest.fixture
def member(entry):
    return entry.members()[0]


def run_again(agent, plant, samples, runs, seed):
    """Run a controller that may have run before."""
    return simulate(make_plants(runs, samples, **plant), agent, samples, seed)


def test_each_controller_controls_another_plant(entry, member):
    assert entry.knows
    assert entry.searched
    plant = ACTUATOR if entry.direction else OTHER
    run_errors = errors(member, 2, 600, **plant)
    if entry.name == "idle":
        np.testing.assert_allclose(run_errors, IDLE)
        return
    assert (run_errors < 0.7 * IDLE).all()


def test_a_batch_is_its_members_again_and_mirrored(entry, member):
    def start(runs, seed, sign=1.0):
        # Plants with a limit that is nearer on one side, and set points beyond it.
        limits = {"u_min": -6.0, "u_max": 10.0} if sign > 0 else {"u_min": -10.0, "u_max": 6.0}
        plant = {**limits, "b": [sign * b for b in Parameters().b], "noise_variance": 0.1}
        agent, plant = member.start(plant, runs, seed)
        plant |= {"setpoint_amplitude": 6.0, "setpoint_period": 200}
        return agent, plant, 160, runs, seed

    three = start(3, 5)
    batch = run_again(*three)
    # Matrix products differ in their last digit by the number of rows.
    alone = run_again(*start(1, 7)).command[:, 0]
    np.testing.assert_allclose(alone, batch.command[:, 2], atol=1e-3)
    # An episode leaves nothing behind but what the network of 1992 learns.
    is_repeated = np.array_equal(run_again(*three).command, batch.command)
    assert is_repeated == (entry.name != "nn")
    # Some were made for plants of one direction; initial weights are random.
    if entry.direction or entry.random:
        return
    mirrored = run_again(*start(3, 5, sign=-1.0))
    # Actions have 24 bits, which limits the agreement.
    np.testing.assert_allclose(mirrored.command, -batch.command, atol=1e-2)
    if entry.name != "idle":
        assert (batch.command > 9.99).any()  # the limits, and anti-windup, had a part


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda a: pickle.loads(pickle.dumps(a))])
def test_a_copy_in_mid_episode_goes_on_like_the_original(member, copied):
    controller, arguments = member.start(PRESETS["hard"], 3, 5)
    plants = make_plants(3, 80, **arguments)
    observations, _ = plants.reset(seed=5)
    for k in range(80):
        if k == 40:
            twin = copied(controller)
        action = controller.act(observations)
        if k >= 40:
            np.testing.assert_array_equal(twin.act(observations), action)
        observations, *_ = plants.step(action)


@pytest.mark.parametrize(
    ("name", "dead_zone", "compensated"),
    [("ppo", 7.0, 7.0), ("ppo", [2.0, 4.0], 5.0), ("ppo-hard", 7.0, 0.0)],
)
def test_a_policy_acts_where_the_dead_zone_of_the_plant_is_compensated(
    name, dead_zone, compensated
):
    # A dead zone that is drawn from a range is not known before the run.
    _, arguments = ROSTER[name].members()[0].start({"dead_zone": dead_zone}, 1, 0)
    assert (arguments["action"], arguments["max_move"]) == ("change", 2.0)
    assert arguments["compensated_dead_zone"] == compensated


def test_it_asks_for_its_own_windows(member):
    windows = {"setpoint_window": 7, "error_window": 0}
    assert errors(member, 1, 60, **windows) == errors(member, 1, 60)


@pytest.fixture
def written(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)

    def write(code):
        name = f"own_{abs(hash(code))}"
        (tmp_path / f"{name}.py").write_text(code)
        return f"{name}:Mine"

    return write


def members_of(*locations):
    return own_controllers([f"mine={location}" for location in locations])["mine"].members()


class TestOwnControllers:
    def test_a_factory_gets_what_it_asks_for(self, written):
        code = (
            "class Mine:\n"
            "    def __init__(self, num_envs, seed, parameters, u_max, gain=2):\n"
            "        self.given = locals()\n"
            "    reset = dict\n"
            "    act = lambda self, o: 0.0 * o[:, :1]\n"
        )
        (member,) = members_of(written(code))
        given = member.start({"delay": 3, "u_max": 9.0}, 3, 7)[0].given
        assert (given["num_envs"], given["seed"], given["gain"]) == (3, 7, 2)
        assert (given["parameters"].delay, given["u_max"]) == (3, 9.0)

    def test_the_same_name_again_is_another_training(self, written):
        other = written("from agents import PIController as Mine")
        members = members_of("agents:PIController", other)
        assert len(members) == 2
        assert errors(members[1], 1, 60) == errors(ROSTER["pi"], 1, 60)

    def test_a_factory_may_return_a_function_and_the_windows_that_it_reads(self, written):
        policy = "lambda seen: -0.1 * seen[:, 5:6]"
        windows = {"setpoint_window": 5, "action_window": 20}
        (member,) = members_of(written(f"def Mine():\n    return ({policy}), {windows}\n"))
        expected = evaluate(eval(policy), IDS["noisy"], episodes=3, **windows)
        np.testing.assert_allclose(
            errors(member, 3, 1200, **PRESETS["noisy"]), expected.errors, rtol=0, atol=1e-12
        )

    def test_a_factory_cannot_choose_another_plant(self, written):
        (member,) = members_of(written("def Mine():\n    return abs, {'delay': 0}\n"))
        with pytest.raises(ValueError, match="got delay"):
            member.start({}, 1, 0)

    def test_a_model_cannot_lose_its_statistics(self, written):
        code = """
            from stable_baselines3 import PPO
            from stable_baselines3.common.vec_env import VecNormalize
            from mptc_gym.sb3 import make_vec_env
            def Mine():
                return PPO("MlpPolicy", VecNormalize(make_vec_env("MiddlePoint-v0", 1)))
        """
        (member,) = members_of(written(textwrap.dedent(code)))
        with pytest.raises(ValueError, match="VecNormalize must come as a function"):
            member.start({}, 1, 0)

    @pytest.mark.parametrize("factory", ["ppo", "ppo_normalised"])
    def test_a_model_of_stable_baselines3_enters_by_the_lines_of_the_page(
        self, factory, written, tmp_path, monkeypatch
    ):
        interface = {
            "action": "change", "max_move": 2.0, "error_window": 8, "action_window": 30
        }  # fmt: skip
        env = make_vec_env("MiddlePointNoisy-v0", 4, **interface)
        (tmp_path / "best-hard").mkdir()
        if factory == "ppo_normalised":
            env = VecNormalize(env)
        model = PPO("MlpPolicy", env, n_steps=16, batch_size=64, seed=0, device="cpu").learn(1)
        model.save(tmp_path / "best-hard/best_model.zip")
        if factory == "ppo_normalised":
            env.save(tmp_path / "best-hard/vecnormalize.pkl")
        page = (ROOT / "benchmarks/examples/train_your_own.md").read_text(encoding="utf-8")
        (code,) = re.findall(r"```python\n([^`]*def ppo[^`]*)```", page)
        monkeypatch.chdir(tmp_path)
        (member,) = members_of(written(f"{code}\nMine = {factory}\n"))
        expected = evaluate(model, IDS["noisy"], episodes=3)
        np.testing.assert_allclose(
            errors(member, 3, 1200, **PRESETS["noisy"]), expected.errors, rtol=0, atol=1e-9
        )
