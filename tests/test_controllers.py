"""The roster: what holds for any controller, as every command runs it; and a user's own."""

import copy
import pickle
import re

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.wrappers import DelayObservation
from stable_baselines3 import PPO

from benchmarks.compare.comparison import run_case
from benchmarks.controllers.options import chosen, own_factory
from benchmarks.controllers.roster import ROSTER
from benchmarks.lib.command import UsageError
from benchmarks.loop.rollout import IdleValve
from benchmarks.loop.scenarios import Scenario
from benchmarks.sweep import SETPOINT, run_agent
from mptc_gym import IDS, PRESETS, Parameters, evaluate
from mptc_gym.evaluation import SEED
from mptc_gym.sb3 import load, make_vec_env, save, spec_of
from tests.verify_bounds import errors

ACTUATOR = {"u_min": -9.0, "u_max": 14.0, "dead_zone": 4.0}
# A plant of the other direction, which shows an input sooner.
OTHER = {**ACTUATOR, "b": [0.0456, 0.00404], "delay": 9}
IDLE = 5.0  # mean |e| of a valve that is left alone, degC
# Those that are made for the paper's plant, and told no more than the actuator.
UNTOLD = ("pi", "pi-searched", "ppo", "ppo-hard")


@pytest.fixture(params=ROSTER)
def entry(request):
    return ROSTER[request.param]


@pytest.fixture
def factory(entry):
    return entry.members()[0]


def test_every_command_tells_it_the_plant_that_it_is_made_for(entry, factory, monkeypatch):
    plant = ACTUATOR if entry.name in UNTOLD else OTHER
    monkeypatch.setattr(type(entry), "members", lambda *_: [factory])
    scenario = Scenario("other", "", 900, plant)
    ways = {
        "compare": run_case(scenario, entry.name, [factory], 2)["runs"]["mae"],
        "sweep": run_agent(factory, plant, {**plant, **SETPOINT}, 900, 2)["mae"],
    }
    for way, found in ways.items():
        if entry.name == "nothing":
            assert np.allclose(found, IDLE), way
        else:
            assert np.all(np.array(found) < 0.7 * IDLE), (way, found)
    if factory.learns:  # in a sweep it has learnt before, on this plant
        assert np.mean(ways["sweep"]) < 0.9 * np.mean(ways["compare"])


@pytest.fixture
def run(factory):
    """Run plants with a limit that is nearer on one side, and set points beyond it."""

    def run(runs, seed, sign=1.0, again=False):
        limits = {"u_min": -6.0, "u_max": 10.0} if sign > 0 else {"u_min": -10.0, "u_max": 6.0}
        plant = {**limits, "b": [sign * b for b in Parameters().b], "noise_variance": 0.1}
        controller = factory(plant, runs, seed)
        plant["setpoint_amplitude"] = 6.0
        if again:
            factory.run(plant, 700, runs, seed + 50, controller)
        return factory.run(plant, 700, runs, seed, controller)

    return run


def test_a_batch_does_what_its_members_do_alone(entry, run):
    batch = run(3, 5)
    # Where a network has learnt, its noise then was that of its place in the batch.
    for i in range(1 if entry.name == "nn-frozen" else 3):
        # Matrix products differ in their last digit by the number of rows.
        np.testing.assert_allclose(run(1, 5 + i).command[:, 0], batch.command[:, i], atol=1e-3)


def test_an_episode_leaves_nothing_behind_but_what_is_learnt(entry, factory, run):
    same = np.array_equal(run(2, 5).command, run(2, 5, again=True).command)
    assert same is not factory.learns


def test_a_mirrored_plant_gets_the_mirrored_flow(entry, factory, run):
    # Policies trained on the paper's plant are not told another; initial weights are random.
    if entry.name in (*UNTOLD, "nn", "nn-frozen"):
        return
    ours, theirs = run(2, 3), run(2, 3, sign=-1.0)
    # Actions have 24 bits, which limits the agreement.
    np.testing.assert_allclose(theirs.command, -ours.command, atol=1e-2)
    np.testing.assert_allclose(theirs.output, ours.output, atol=1e-3)
    if entry.name != "nothing":
        assert (ours.command > 9.99).any()  # the limits, and anti-windup, had a part


@pytest.mark.parametrize(
    "windows", [{"setpoint_window": 7}, {"setpoint_window": 0}, {"error_window": 0}], ids=str
)
def test_it_asks_for_its_own_windows(factory, windows):
    assert errors(factory, 1, 60, **windows) == errors(factory, 1, 60)


@pytest.mark.parametrize(
    "copied", [copy.deepcopy, lambda controller: pickle.loads(pickle.dumps(controller))]
)
def test_a_copy_goes_on_like_the_original_in_mid_episode(factory, copied, rng):
    controller = factory(ACTUATOR, 2, 5)
    size = Parameters(**factory.arguments(ACTUATOR)).observation_size
    before, after = np.float32(rng.uniform(-3, 3, (2, 30, 2, size)))
    for observation in before:
        controller.act(observation)
    twin = copied(controller)
    ours = [controller.act(observation) for observation in after]
    np.testing.assert_array_equal([twin.act(observation) for observation in after], ours)
    assert len(np.unique(ours)) > 1 or isinstance(controller, IdleValve)


def test_its_cost_is_known(factory):
    assert factory.cost.prior_knowledge


@pytest.fixture
def written(tmp_path, monkeypatch):
    monkeypatch.syspath_prepend(tmp_path)

    def write(code):
        name = f"own_{abs(hash(code))}"
        (tmp_path / f"{name}.py").write_text(code)
        return f"{name}:Mine"

    return write


class TestOwnControllers:
    """What is no controller is named before anything runs."""

    def test_a_factory_gets_what_it_asks_for(self, written):
        code = (
            "class Mine:\n"
            "    def __init__(self, {}): self.given = {}\n"
            "    reset = dict\n"
            "    act = lambda self, o: 0.0 * o[:, :1]\n"
        )
        named = code.format("num_envs, seed, parameters, gain=2", "locals()")
        some = own_factory(written(named))
        given = some({"delay": 3}, 3, 7).given
        assert (given["num_envs"], given["seed"], given["gain"]) == (3, 7, 2)
        assert given["parameters"].delay == 3
        everything = own_factory(written(code.format("**offered", "offered")))
        assert set(everything({}, 3, 7).given) == {
            "num_envs", "seed", "u_min", "u_max", "parameters",
        }  # fmt: skip

    @pytest.mark.parametrize("code", ["def Mine(:", "Mine = unknown", "raise SystemExit(3)"])
    def test_a_module_that_cannot_be_imported_is_named(self, written, code):
        location = written(code)
        with pytest.raises(UsageError, match=rf"--agent: '{location}' cannot be imported: \w+"):
            chosen([], [f"mine={location}"])

    def test_those_of_the_project_ask_for_their_windows(self):
        factory = own_factory("agents:PIController")
        assert errors(factory, 1, 60, setpoint_window=7) == errors(factory, 1, 60)

    @pytest.mark.parametrize(
        "location",
        ["agents", "agents:", "agents:No", "agents:__name__", "nowhere:x", ".:y", "..a:y"],
    )
    def test_bad_locations(self, location):
        with pytest.raises(UsageError, match=re.escape(f"--agent: {location!r} ")):
            chosen([], [f"mine={location}"])

    @pytest.mark.parametrize(
        ("body", "complaint"),
        [
            ("pass", "policy must be a function, or an object with predict or act"),
            ("observation = 3", "observation of .* must be a dict"),
            ("observation = ['error_window']", "observation of .* must be a dict"),
            ("observation = {'dead_zone': 0.0}", "out of .* got {'dead_zone': 0.0}"),
            ("reset = dict; act = lambda self, o: 0.0", r"shape \(2, 6\).*got \(\)"),
            ("reset = dict; act = lambda self, o: float(o)", "it raised TypeError"),
            ("__init__ = lambda self, gain: None", "it raised TypeError.*'gain'"),
        ],
    )
    def test_bad_ones(self, body, complaint, written):
        with pytest.raises(UsageError, match=complaint):
            chosen([], [f"mine={written('class Mine: ' + body)}"])


@pytest.fixture(scope="module")
def zips(tmp_path_factory):
    folder = tmp_path_factory.mktemp("models")
    velocity = {"max_move": 0.3, "compensate_dead_zone": True}
    for seed in (0, 1):
        windows = {"action_window": 20, "error_window": 2}
        plants = make_vec_env("MiddlePoint-v0", 2, wrapper=velocity, **windows)
        model = PPO("MlpPolicy", plants, n_steps=8, batch_size=16, seed=seed, device="cpu")
        save(model, folder / f"velocity-{seed}.zip")
    bare = PPO("MlpPolicy", gymnasium.make("MiddlePoint-v0"), device="cpu")
    bare.save(folder / "bare.zip")
    model.save(folder / "wide.zip")  # of other windows, which it does not say
    delayed = DelayObservation(gymnasium.make("MiddlePoint-v0"), 2)
    save(PPO("MlpPolicy", delayed, device="cpu"), folder / "delayed.zip")
    with torch.no_grad():
        for weight in model.policy.parameters():
            weight.fill_(torch.nan)
    save(model, folder / "nan.zip")
    return folder


class TestSavedPolicies:
    """Zips of Stable-Baselines3, which say how their policies were trained."""

    @pytest.mark.parametrize("preset", ["noisy", "hard"])
    def test_it_does_what_it_was_trained_to(self, preset, zips):
        file = zips / "velocity-0.zip"
        entry = chosen([], [f"mine=PPO:{file}"])["mine"]
        (factory,) = entry.members()
        assert factory.cost.samples == "0 M a policy"
        controller = factory(PRESETS[preset], 3, SEED)
        found = errors(factory, 3, 1200, **PRESETS[preset])
        model = load(file, device="cpu")
        expected = evaluate(model, spec_of(model, IDS[preset]), episodes=3)
        np.testing.assert_allclose(found, expected.errors, rtol=0, atol=1e-12)
        # What it remembers, the flow, is forgotten at the beginning of an episode.
        first, again = (
            factory.run(PRESETS[preset], 50, 3, SEED, controller).applied for _ in range(2)
        )
        np.testing.assert_array_equal(first, again)

    def test_a_zip_of_any_other_kind_acts_in_the_plain_environment(self, zips):
        (factory,) = chosen([], [f"mine=PPO:{zips / 'bare.zip'}"])["mine"].members()
        model = PPO.load(zips / "bare.zip", device="cpu")
        expected = evaluate(model, IDS["noisy"], episodes=3)
        found = errors(factory, 3, 1200, **PRESETS["noisy"])
        np.testing.assert_allclose(found, expected.errors, rtol=0, atol=1e-12)

    def test_a_function_gives_the_policy_and_where_it_acts(self, zips, written):
        factory = own_factory(
            written(
                "import dataclasses, gymnasium\n"
                "from gymnasium.wrappers import DelayObservation\n"
                "from mptc_gym import MiddlePointEnv\n"
                "from stable_baselines3 import PPO\n"
                f"model = PPO.load({str(zips / 'delayed.zip')!r}, device='cpu')\n"
                "def Mine(parameters):\n"
                "    given = dataclasses.asdict(parameters)\n"
                "    return model, lambda: DelayObservation(MiddlePointEnv(**given), 2)\n"
            )
        )
        found = errors(factory, 3, 600, **PRESETS["noisy"])
        model = load(zips / "delayed.zip", device="cpu")
        spec = spec_of(model, IDS["noisy"], max_episode_steps=600)
        expected = evaluate(model, spec, episodes=3)
        np.testing.assert_allclose(found, expected.errors, rtol=0, atol=1e-9)

    def test_several_trainings_are_members_of_one(self, zips):
        both = [f"mine=PPO:{zips / 'velocity-0.zip'}", f"mine=PPO:{zips / 'velocity-1.zip'}"]
        pattern = [f"mine=PPO:{zips / 'velocity-*.zip'}"]
        for texts in (both, pattern):
            (entry,) = chosen([], texts).values()
            about = [member.provenance for member in entry.members()]
            assert [each["file"] for each in about] == ["velocity-0.zip", "velocity-1.zip"]
            assert about[0]["sha256"] != about[1]["sha256"]

    @pytest.mark.parametrize(
        ("location", "complaint"),
        [
            ("PPO:{}/wide.zip", "not act in the plain environment: write a function that ret"),
            ("PPO:{}/delayed.zip", "acts in DelayObservation, not in IncrementalAction alone"),
            ("No:{}/bare.zip", "No must be an algorithm of Stable-Baselines3, such as PPO"),
            ("PPO:{}/nan.zip", "trying it raised ValueError: Expected parameter loc"),
            ("{}/velocity-0.zip", "must be ALGORITHM:FILE.zip, such as PPO:.*velocity-0.zip"),
            ("PPO:{}/none.zip", "there is no file .*none.zip"),
            ("SAC:{}/velocity-0.zip", "holds a model of PPO, not of SAC"),
        ],
    )
    def test_what_is_refused(self, location, complaint, zips):
        with pytest.raises(UsageError, match=f"^--agent: .*{complaint}"):
            chosen([], [f"mine={location.format(zips)}"])
