"""The roster: what holds for any controller, as every command runs it; and a user's own."""

import copy
import pickle
import re

import numpy as np
import pytest

from benchmarks.compare.comparison import run_case
from benchmarks.controllers.options import chosen
from benchmarks.controllers.roster import ROSTER
from benchmarks.lib.command import CommandError
from benchmarks.loop.rollout import make_plants, mean_error
from benchmarks.loop.scenarios import Scenario
from mptc_gym import IDS, PRESETS, Parameters, evaluate
from mptc_gym.evaluation import SEED
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


def test_each_controller_controls_another_plant(entry, member):
    assert entry.knows
    assert entry.searched
    plant = ACTUATOR if "direction" in entry.assumes else OTHER
    case = Scenario("other", "", 600, plant)
    run_errors = run_case(case, member, 2, SEED).runs["mae"].to_numpy()
    if entry.name == "idle":
        np.testing.assert_allclose(run_errors, IDLE)
        return
    assert (run_errors < 0.7 * IDLE).all()
    if member.learns:  # A controller in service has learnt on this plant before.
        learnt = member.run(plant, 600, 2, SEED, member.in_service(plant, 2, SEED))
        assert mean_error(learnt).mean() < 0.9 * run_errors.mean()


def test_a_batch_is_its_members_again_and_mirrored(entry, member):
    def run(runs, seed, sign=1.0, controller=None):
        # Plants with a limit that is nearer on one side, and set points beyond it.
        limits = {"u_min": -6.0, "u_max": 10.0} if sign > 0 else {"u_min": -10.0, "u_max": 6.0}
        plant = {**limits, "b": [sign * b for b in Parameters().b], "noise_variance": 0.1}
        controller = controller or member.make(plant, runs, seed)
        plant |= {"setpoint_amplitude": 6.0, "setpoint_period": 200}
        return controller, member.run(plant, 160, runs, seed, controller)

    controller, batch = run(3, 5)
    # Matrix products differ in their last digit by the number of rows.
    alone = run(1, 5 + 2)[1].command[:, 0]
    np.testing.assert_allclose(alone, batch.command[:, 2], atol=1e-3)
    # An episode leaves nothing behind but what is learnt.
    again = run(3, 5, controller=controller)[1]
    assert np.array_equal(again.command, batch.command) is not member.learns
    # Some were made for plants of one direction; initial weights are random.
    if "direction" in entry.assumes or entry.random:
        return
    _, mirrored = run(3, 5, sign=-1.0)
    # Actions have 24 bits, which limits the agreement.
    np.testing.assert_allclose(mirrored.command, -batch.command, atol=1e-2)
    if entry.name != "idle":
        assert (batch.command > 9.99).any()  # the limits, and anti-windup, had a part


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda a: pickle.loads(pickle.dumps(a))])
def test_a_copy_in_mid_episode_goes_on_like_the_original(member, copied):
    plant = {**PRESETS["hard"], **member.observation}
    plants = make_plants(3, 80, **plant)
    controller = member.make(PRESETS["hard"], 3, 5)
    observations, _ = plants.reset(seed=5)
    for k in range(80):
        if k == 40:
            twin = copied(controller)
        action = controller.act(observations)
        if k >= 40:
            np.testing.assert_array_equal(twin.act(observations), action)
        observations, *_ = plants.step(action)


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
    return chosen([], [f"mine={location}" for location in locations])["mine"].members()


class TestOwnControllers:
    """What is no controller is named by the tasks that need it."""

    def test_a_factory_gets_what_it_asks_for(self, written):
        code = (
            "class Mine:\n"
            "    def __init__(self, {}): self.given = {}\n"
            "    reset = dict\n"
            "    act = lambda self, o: 0.0 * o[:, :1]\n"
        )
        named = code.format("num_envs, seed, parameters, gain=2", "locals()")
        (some,) = members_of(written(named))
        given = some.make({"delay": 3}, 3, 7).given
        assert (given["num_envs"], given["seed"], given["gain"]) == (3, 7, 2)
        assert given["parameters"].delay == 3
        (everything,) = members_of(written(code.format("**offered", "offered")))
        assert set(everything.make({}, 3, 7).given) == {
            "num_envs", "seed", "u_min", "u_max", "parameters",
        }  # fmt: skip

    @pytest.mark.parametrize("location", ["agents", "agents:No", "nowhere:x", ".:y", "..a:y"])
    def test_bad_locations(self, location):
        with pytest.raises(CommandError, match=f"--agent: .*{re.escape(location)}' "):
            members_of(location)

    @pytest.mark.parametrize(
        ("code", "complaint"),
        [
            ("def Mine(:", "--agent: .* cannot be loaded: SyntaxError"),
            ("raise SystemExit(3)", "--agent: .* cannot be loaded: SystemExit: 3"),
            ("class Mine: pass", "policy must be a function, or an object with pre"),
            ("class Mine: observation = 3", "cannot be loaded: .* a dict .* got 3"),
            ("class Mine: observation = {'delay': 0}", "with keys from .* got {'delay': 0}"),
            (
                "class Mine: reset = dict; act = lambda self, o: 0.0",
                r"policy must return finite actions, shape \(2, 1\), got .*, shape \(\)",
            ),
            (
                "class Mine: reset = dict; act = lambda self, o: o[:, :1] + float('nan')",
                r"mine=own_\d+:Mine' cannot be run: policy must return finite .*, got",
            ),
            (
                "class Mine: reset = dict; act = lambda self, o: 1 / 0",
                r"mine=.* cannot be run: ZeroDivisionError: [^\n]+\n\nTraceback",
            ),
            ("Mine = 3", r"mine=.* cannot be loaded: 'Mine' must be a function or a class"),
            ("Yours = 3", r"mine=.* cannot be loaded: the module '\w+' has no 'Mine'"),
            ("def Mine(): return 1 / 0", r"mine=.* cannot be made: ZeroDivisionError"),
            (
                "class Mine: __init__ = lambda self, gain: None",
                r"mine=.* cannot be made: .*argument: 'gain': a factory gets only \w+",
            ),
        ],
    )
    def test_bad_ones(self, code, complaint, written):
        with pytest.raises(CommandError, match=complaint) as error:
            members_of(written(code))[0].run({"delay": 3}, 2, 2, 0)
        # A traceback follows where the user's code has failed.
        has_traceback = "Traceback" in str(error.value)
        assert has_traceback == bool(re.search("Error: |SystemExit: ", str(error.value)))

    def test_the_same_name_again_is_another_training(self, written):
        other = written("from agents import PIController as Mine")
        members = members_of("agents:PIController", other)
        files = [member.provenance["file"] for member in members]
        assert files == ["agents:PIController", other]
        assert errors(members[0], 1, 60, setpoint_window=7) == errors(members[0], 1, 60)


def test_a_function_gives_the_policy_and_what_it_observes(written):
    code = "def Mine(): return lambda seen: -0.1 * seen[:, :1], {'setpoint_window': 0}\n"
    (member,) = members_of(written(code))
    found = errors(member, 3, 100, **PRESETS["noisy"])
    plant = {"max_episode_steps": 100, "setpoint_window": 0}
    expected = evaluate(lambda seen: -0.1 * seen[:, :1], IDS["noisy"], episodes=3, **plant)
    np.testing.assert_allclose(found, expected.errors, rtol=0, atol=1e-9)
