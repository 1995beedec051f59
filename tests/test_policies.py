"""Tests that `evaluate` runs each kind of policy as it was meant, or refuses it."""

import copy
import json
import zipfile
from contextlib import closing
from functools import partial
from types import SimpleNamespace

import gymnasium
import numpy as np
import pytest
import torch
from gymnasium.utils import RecordConstructorArgs
from gymnasium.wrappers import (
    FrameStackObservation,
    RescaleAction,
    ReshapeObservation,
    TimeLimit,
    TransformObservation,
)
from sb3_contrib import MaskablePPO
from stable_baselines3 import A2C, DQN, PPO, SAC, TD3
from stable_baselines3.common.vec_env import (
    DummyVecEnv,
    SubprocVecEnv,
    VecEnvWrapper,
    VecFrameStack,
    VecNormalize,
)

from agents import DirectNNController, PIController
from mptc_gym import MiddlePointEnv, evaluate, training
from mptc_gym.evaluation import SEED
from mptc_gym.sb3 import GymnasiumVecEnv, ScoreCallback, load, make_vec_env, save, spec_of
from mptc_gym.training import MEMBER
from mptc_gym.wrappers import IncrementalAction
from mptc_gym.wrappers.vector import IncrementalAction as IncrementalBatch

NOISY = "MiddlePointNoisy-v0"
LIMITS = np.float32([-2.0, 2.0])
# Without a dead zone, every action matters.
SHORT = {"max_episode_steps": 50, "dead_zone": 0.0}
VELOCITY = {"max_move": 0.3, "compensate_dead_zone": 4.0}


def made(**arguments):
    return gymnasium.make(NOISY, **SHORT, **arguments)


def errors_of(new_act, make=made, episodes=3):
    """Return the mean errors of a plain loop; `new_act()` gives a function for an episode."""
    errors = []
    for seed in range(SEED, SEED + episodes):
        with closing(make()) as env:
            act, total, ended = new_act(), [], False
            observation, _ = env.reset(seed=seed)
            while not ended:
                observation, _, _, ended, info = env.step(act(observation))
                total.append(abs(info["error"]))
        errors.append(np.mean(total))
    return errors


def acting(model, prepare=lambda seen: seen):
    """Return how a model of Stable-Baselines3 acts in one episode."""

    def new_act():
        memory = {"state": None, "episode_start": np.ones(1)}

        def act(observation):
            actions, state = model.predict(
                prepare(observation[None]), deterministic=True, **memory
            )
            memory.update(state=state, episode_start=np.zeros(1))
            return actions[0]

        return act

    return new_act


def stacked(n=3):
    """Return the n latest observations of one episode, zeros before its first."""
    seen = []

    def prepare(observation):
        seen.append(observation)
        zeros = [np.zeros_like(observation)] * (n - len(seen))
        return np.concatenate([*zeros, *seen[-n:]], axis=1)

    return prepare


def trained(algorithm, plants, steps=64):
    short = {"n_steps": 32} | ({"batch_size": 32} if algorithm is PPO else {})
    if algorithm not in (PPO, A2C):
        small = {"net_arch": [16]}
        short = {"learning_starts": 8, "buffer_size": 500, "policy_kwargs": small}
    return algorithm("MlpPolicy", plants, seed=0, device="cpu", **short).learn(steps)


def plants(n=4, **arguments):
    return make_vec_env(NOISY, n, seed=1, **arguments)


@pytest.fixture(scope="module")
def ppo():
    return trained(PPO, plants())


@pytest.fixture(scope="module")
def velocity():
    return trained(PPO, plants(wrapper=VELOCITY, action_window=5))


class Integrator:
    def __init__(self):
        self.sum = 0.0

    def __call__(self, observations):
        self.sum = self.sum + observations[..., 3:4]
        return -0.05 * observations[..., 3:4] - 0.002 * self.sum

    act = __call__


class Resettable(Integrator):
    def reset(self):
        self.sum = 0.0


class Levels(gymnasium.ActionWrapper, RecordConstructorArgs):
    """Choose among a few flows."""

    def __init__(self, env, levels):
        RecordConstructorArgs.__init__(self, levels=levels)
        gymnasium.ActionWrapper.__init__(self, env)
        self.levels, self.action_space = levels, gymnasium.spaces.Discrete(levels)

    def action(self, action):
        return np.array([2.0 * action / (self.levels - 1) - 1.0], np.float32)


class Gains(gymnasium.ActionWrapper, RecordConstructorArgs):
    def __init__(self, env, about):
        RecordConstructorArgs.__init__(self, about=about)
        gymnasium.ActionWrapper.__init__(self, env)
        self.gain = about["gains"][1].max()

    def action(self, action):
        return self.gain * action


class Masked(Levels):
    def action_masks(self):
        return np.array([False, True, False])


class Moves(IncrementalAction):
    def __init__(self, env, share=1.0, **arguments):
        super().__init__(env, **arguments)
        self.share = share

    def action(self, action):
        return super().action(self.share * action)


class Blocks(gymnasium.ObservationWrapper, RecordConstructorArgs):
    """Show set points and errors by name."""

    def __init__(self, env):
        RecordConstructorArgs.__init__(self)
        gymnasium.ObservationWrapper.__init__(self, env)
        box = env.observation_space
        self.observation_space = gymnasium.spaces.Dict(
            {
                "setpoints": gymnasium.spaces.Box(box.low[:3], box.high[:3]),
                "errors": gymnasium.spaces.Box(box.low[3:], box.high[3:]),
            }
        )

    def observation(self, observation):
        return {"setpoints": observation[:3], "errors": observation[3:]}


class Network(torch.nn.Module):
    def __init__(self):
        super().__init__()
        torch.manual_seed(0)
        layers = torch.nn.Linear(6, 9), torch.nn.Dropout(), torch.nn.Linear(9, 1)
        self.layers = torch.nn.Sequential(*layers)

    def forward(self, seen):
        return torch.tanh(self.layers(seen))


class Acting(torch.nn.Module):
    def __init__(self, module):
        super().__init__()
        self.module = module

    def act(self, observations):
        dtype = next(self.parameters()).dtype
        return self.module(torch.as_tensor(observations, dtype=dtype))


class Constant(torch.nn.Module):
    def __init__(self):
        super().__init__()
        self.register_buffer("gain", torch.tensor([0, 0, 0, -0.3, 0, 0], dtype=torch.float64))

    def forward(self, seen):
        return seen @ self.gain[:, None]


class Scaled(gymnasium.ObservationWrapper):
    def observation(self, observation):
        return observation * np.float32(0.01)


class OwnPlant(MiddlePointEnv):
    pass


class Times(VecEnvWrapper):
    def reset(self):
        return 0.01 * self.venv.reset()

    def step_wait(self):
        observations, *others = self.venv.step_wait()
        return 0.01 * observations, *others


class TestPoliciesWithoutARecord:
    @pytest.mark.parametrize("episodes", [3, 130])
    @pytest.mark.parametrize("form", ["call", "act", "method", "partial", "predict"])
    def test_memory_is_forgotten_before_the_episodes(self, form, episodes):
        policy = Resettable()
        if form == "method":
            policy = policy.act
        elif form == "partial":
            policy = partial(policy.act)
        elif form == "predict":
            policy = SimpleNamespace(predict=policy.act, reset=policy.reset)
        short = {**SHORT, "max_episode_steps": 30}
        given = {"episodes": episodes, **short}
        found = [evaluate(policy, NOISY, **given) for _ in range(2)]
        expected = errors_of(Integrator, partial(gymnasium.make, NOISY, **short), episodes)
        for each in found:
            np.testing.assert_allclose(each.errors, expected, atol=1e-9)

    @pytest.mark.parametrize("dtype", [torch.float32, torch.float64, torch.bfloat16])
    def test_modules_run_in_evaluation_mode(self, dtype):
        module = Network().to(dtype)
        frozen = module.layers[0].eval()
        evaluating = copy.deepcopy(module).eval()

        def act(observation):
            seen = torch.as_tensor(observation, dtype=dtype)
            return evaluating(seen).detach().float().numpy()

        expected = errors_of(lambda: act)
        for policy in (module, Acting(module), Acting(module).act):
            found = evaluate(policy, NOISY, episodes=3, **SHORT)
            assert found.errors == pytest.approx(expected, abs=1e-6)
        assert module.training
        assert not frozen.training

    def test_constants_of_a_module_set_its_dtype(self):
        found = evaluate(Constant(), NOISY, episodes=3, **SHORT)
        expected = errors_of(lambda: lambda seen: -0.3 * seen[3:4].astype(float))
        assert found.errors == pytest.approx(expected, abs=1e-6)

    @pytest.mark.parametrize("form", ["call", "act", "forward"])
    def test_what_explores_on_request_does_not(self, form):
        def act(observations, deterministic=False):
            return -0.3 * observations[..., 3:4] + (0.0 if deterministic else 0.5)

        policy = act if form == "call" else SimpleNamespace(act=act)
        if form == "forward":
            policy = torch.nn.Module()
            policy.forward = act
        found = evaluate(policy, NOISY, episodes=3, **SHORT)
        expected = errors_of(lambda: lambda seen: act(seen, True))
        assert found.errors == pytest.approx(expected, abs=1e-6)

    def test_keywords_pass_a_thin_wrapper(self, ppo):
        def named(observations, **keywords):
            return ppo.predict(observations, **keywords)

        def forwarded(*arguments, **keywords):
            return ppo.predict(*arguments, **keywords)

        expected = errors_of(acting(ppo))
        for predict in (named, forwarded):
            found = evaluate(SimpleNamespace(predict=predict), NOISY, episodes=3, **SHORT)
            assert found.errors == pytest.approx(expected, abs=1e-6)

    def test_a_state_is_handed_back(self):
        begun = []

        def predict(observations, state=None, episode_start=None, **_):
            assert (episode_start == (state is None)).all()
            if state is None:
                begun.append(len(observations))
            return 0.0 * observations[:, :1], (state or 0) + 1

        evaluate(SimpleNamespace(predict=predict), episodes=130, max_episode_steps=4)
        assert begun == [130]

    @pytest.mark.parametrize(
        ("policy", "message"),
        [
            (SimpleNamespace(predict=lambda *seen: 0), r"name its arguments.*got \(\*seen\)"),
            (SimpleNamespace(predict=lambda seen, deep: 0), "needs the observations alone"),
            (SimpleNamespace(predict=lambda seen: (0 * seen[:, :1], 1)),
             "must take the state that it returns"),
            (SimpleNamespace(act=Integrator(), reset=lambda seed: None),
             "policy.reset must be a method that needs no argument alone: missing"),
            (lambda seen: (0 * seen[:, :1], None), r"(?s)array of numbers.*its first element"),
            (lambda seen: torch.zeros(len(seen), 1, requires_grad=True),
             r"array of numbers, got tensor.*tensor\.detach\(\)"),
            (DirectNNController(), "made with num_envs=3, one loop per episode, got 1"),
            (DirectNNController(num_envs=2), "with num_envs=3, one loop per episode, got 2"),
        ],
    )  # fmt: skip
    def test_what_is_refused(self, policy, message):
        with pytest.raises(ValueError, match=message):
            evaluate(policy, NOISY, episodes=3, **SHORT)

    def test_a_controller_for_another_actuator_or_in_a_wrapper_is_refused(self):
        with pytest.raises(ValueError, match=r"limits of env, u_min=-10.0, u_max=6.0, got -10"):
            evaluate(PIController(), NOISY, u_max=6.0)
        with pytest.raises(ValueError, match=r"env must not be wrapped.*IncrementalAction"):
            evaluate(PIController(), lambda: IncrementalAction(made()))


class TestModels:
    @pytest.mark.parametrize("algorithm", [PPO, A2C, SAC, TD3])
    def test_algorithms(self, algorithm, tmp_path):
        model = trained(algorithm, plants(1))
        expected = errors_of(acting(model))
        save(model, tmp_path / "model.zip")
        for each in (model, load(tmp_path / "model.zip", device="cpu")):
            assert type(each) is algorithm
            found = evaluate(each, NOISY, episodes=3, **SHORT)
            assert found.errors == pytest.approx(expected, abs=1e-6)

    @pytest.mark.parametrize("kind", ["normalise", "stack", "both", "rewards alone"])
    @pytest.mark.parametrize("base", [plants, lambda: DummyVecEnv([made] * 2)])
    def test_vec_wrappers_are_those_of_the_training(self, kind, base, tmp_path):
        envs = base()
        if kind in ("stack", "both"):
            envs = VecFrameStack(envs, 3)
        if kind != "stack":
            seen = kind != "rewards alone"
            envs = VecNormalize(envs, norm_obs=seen, clip_obs=1.5, epsilon=0.1)
        model = trained(PPO, envs, 256)
        normalise = envs.normalize_obs if kind != "stack" else (lambda seen: seen)

        def new_act():
            stack = stacked() if kind in ("stack", "both") else (lambda seen: seen)
            return acting(model, lambda seen: normalise(stack(seen)))()

        expected = errors_of(new_act)
        save(model, tmp_path / "model.zip")
        for each in (model, load(tmp_path / "model.zip", device="cpu")):
            found = evaluate(each, NOISY, episodes=3, **SHORT)
            assert found.errors == pytest.approx(expected, abs=1e-6)
        if kind == "normalise":
            assert normalise(np.full((1, 6), 1e9)).max() == 1.5  # it was clipped, too

    def test_training_goes_on_where_it_stopped(self, tmp_path):
        model = trained(PPO, VecNormalize(plants()), 256)
        save(model, tmp_path / "model.zip")
        loaded = load(tmp_path / "model.zip", device="cpu")
        count = loaded.get_env().obs_rms.count
        assert count == model.get_env().obs_rms.count
        assert loaded.get_env().num_envs == 4
        loaded.learn(128, reset_num_timesteps=False)
        assert loaded.num_timesteps == 384
        assert loaded.get_env().obs_rms.count >= count + 128

    def test_environments_in_other_processes(self, tmp_path):
        envs = SubprocVecEnv([made] * 2, start_method="fork")
        try:
            model = trained(PPO, envs)
            save(model, tmp_path / "model.zip")
        finally:
            envs.close()
        found = evaluate(load(tmp_path / "model.zip", device="cpu"), NOISY, episodes=3, **SHORT)
        assert found.errors == pytest.approx(errors_of(acting(model)), abs=1e-6)
        for attempt in (evaluate, partial(save, path=tmp_path / "closed.zip")):
            with pytest.raises(ValueError, match="of policy's training are closed"):
                attempt(model)

    def test_the_default_environment_is_that_of_the_training(self, velocity):
        found = evaluate(velocity, episodes=3, **SHORT)
        wrapped = partial(gymnasium.make, "MiddlePoint-v0", action_window=5, **SHORT)
        expected = errors_of(acting(velocity), lambda: IncrementalAction(wrapped(), **VELOCITY))
        assert found.errors == pytest.approx(expected, abs=1e-6)
        with pytest.raises(ValueError, match="action_window must be that of policy's training"):
            evaluate(velocity, action_window=6)

    @pytest.mark.parametrize(
        ("algorithm", "wrap"),
        [
            (PPO, lambda env: FrameStackObservation(Scaled(env), 2)),
            (PPO, lambda env: RescaleAction(env, LIMITS[:1], LIMITS[1:])),
            (PPO, lambda env: ReshapeObservation(env, (2, 3))),
            (PPO, lambda env: Gains(env, {"gains": [0.1, np.float32([-0.2, 0.2])]})),
            (DQN, lambda env: Levels(env, 5)),
        ],
    )
    def test_wrappers_and_their_arguments_are_part_of_it(self, algorithm, wrap, tmp_path):
        model = trained(algorithm, wrap(made()))
        expected = errors_of(acting(model), lambda: wrap(made()))
        save(model, tmp_path / "model")
        for each in (model, load(tmp_path / "model.zip", device="cpu")):
            for env in (lambda: wrap(made()), spec_of(each, NOISY, **SHORT)):
                found = evaluate(each, env, episodes=3)
                assert found.errors == pytest.approx(expected, abs=1e-6)

    @pytest.mark.parametrize("order", ["first", "last"])
    def test_frames_are_stacked_along_the_axis_of_the_training(self, order, tmp_path):
        twice = lambda: FrameStackObservation(made(), 2)  # noqa: E731
        model = trained(PPO, VecFrameStack(DummyVecEnv([twice]), 3, channels_order=order))

        def new_act():
            frames = [np.zeros((2, 6), np.float32)] * 3

            def act(observation):
                frames[:] = [*frames[1:], observation]
                seen = np.concatenate(frames, axis=0 if order == "first" else 1)
                return model.predict(seen, deterministic=True)[0]

            return act

        expected = errors_of(new_act, twice)
        save(model, tmp_path / "model.zip")
        for each in (model, load(tmp_path / "model.zip", device="cpu")):
            found = evaluate(each, spec_of(each, NOISY, **SHORT), episodes=3)
            assert found.errors == pytest.approx(expected, abs=1e-6)

    def test_masked_actions_are_refused(self):
        model = MaskablePPO("MlpPolicy", Masked(made(), 3), device="cpu")
        with pytest.raises(ValueError, match="takes the action_masks of env, which are not"):
            evaluate(model, spec_of(model, NOISY, **SHORT), episodes=3)

    @pytest.mark.parametrize(
        ("policy", "env", "message"),
        [
            ("ppo", partial(made, action_window=3), "windows.* action_window=0, got action_w"),
            ("ppo", partial(made, error_window=0, output_window=3), "windows.*got error_win"),
            ("ppo", lambda: IncrementalAction(made()), "wrappers .*, none, got 1. mptc_gym"),
            ("ppo", lambda: RescaleAction(made(), *LIMITS), "wrappers .*, none, got 1. gym"),
            ("ppo", lambda: OwnPlant(noise_variance=0.5), "class of policy's training"),
            ("velocity", partial(made, action_window=5), r"wrappers .*max_move.*, got none: "),
            ("velocity", lambda: IncrementalAction(made(action_window=5), max_move=0.4),
             r"wrappers .*'max_move': 0.3.*'max_move': 0.4.*spec_of\(policy, 'MiddlePointN"),
            ("velocity", lambda: IncrementalAction(
                IncrementalAction(made(action_window=5), **VELOCITY), **VELOCITY
            ), "wrappers .*, none, got 2. mptc_gym"),
        ],
    )  # fmt: skip
    def test_another_environment_is_refused(self, policy, env, message, request):
        model = request.getfixturevalue(policy)
        with pytest.raises(ValueError, match=message):
            evaluate(model, env, episodes=3)

    def test_spec_of_replaces_windows_and_wrappers(self, ppo, velocity):
        other = IncrementalAction(made(output_window=2, action_window=9), max_move=1.0).spec
        for model, wrappers in ((ppo, 0), (velocity, 1)):
            spec = spec_of(model, other)
            assert len(spec.additional_wrappers) == wrappers
            assert evaluate(model, spec, episodes=2).mean_error > 0.0

    @pytest.mark.parametrize(
        ("make", "message"),
        [
            (lambda: Times(plants()), "trained in Times, and what that does is not known"),
            (lambda: GymnasiumVecEnv(
                IncrementalBatch(gymnasium.make_vec(NOISY, 2, autoreset_mode="SameStep"))
            ), "trained on a batch whose wrappers are not known"),
            (lambda: Levels(MiddlePointEnv(), 3), "Levels does not record its arguments"),
            (lambda: Moves(made(), 0.3), "Moves does not record its arguments"),
            (lambda: type("Local", (Scaled,), {})(made()), "Local must be at the top level"),
            (lambda: VecNormalize(DummyVecEnv([lambda: Blocks(made())])),
             "trained in VecNormalize on observations that are not a Box"),
            (lambda: VecFrameStack(DummyVecEnv([lambda: Blocks(made())]), 2),
             "trained in VecFrameStack on observations that are not a Box"),
            (lambda: "CartPole-v1", "policy must be trained on environments of this package"),
            (lambda: DummyVecEnv([made, partial(made, error_window=2, output_window=1)]),
             "plants of different windows or wrappers"),
        ],
    )  # fmt: skip
    def test_training_that_cannot_be_recorded(self, make, message, tmp_path):
        envs = make()
        discrete = isinstance(envs, Levels | str)
        named = not discrete and isinstance(envs.observation_space, gymnasium.spaces.Dict)
        policy = "MultiInputPolicy" if named else "MlpPolicy"
        model = (DQN if discrete else PPO)(policy, envs, device="cpu")
        for attempt in (evaluate, spec_of, partial(save, path=tmp_path / "x.zip")):
            with pytest.raises(ValueError, match=message):
                attempt(model)
        assert not [*tmp_path.iterdir()]

    def test_without_a_record_the_ways_out_are_told_and_work(self, ppo, tmp_path):
        ppo.save(tmp_path / "plain.zip")
        bare = PPO.load(tmp_path / "plain.zip", device="cpu")
        for each in (evaluate, spec_of):
            with pytest.raises(ValueError, match=r"save it by .*PPO\.load\(path, env=.*lambda"):
                each(bare)
        with pytest.raises(ValueError, match="does not say how it was trained"):
            evaluate(ppo.policy)
        with pytest.raises(ValueError, match=r"plain\.zip does not say how its policy was"):
            load(tmp_path / "plain.zip")
        with_env = PPO.load(tmp_path / "plain.zip", env=made(), device="cpu")
        save(with_env, tmp_path / "anew.zip")
        expected = errors_of(acting(ppo))
        for policy in (
            load(tmp_path / "anew.zip", device="cpu"),
            lambda observations: bare.predict(observations, deterministic=True)[0],
        ):
            found = evaluate(policy, NOISY, episodes=3, **SHORT)
            assert found.errors == pytest.approx(expected, abs=1e-6)

    def test_statistics_of_another_run_are_refused(self, tmp_path):
        envs = VecNormalize(plants())
        model = trained(PPO, envs, 256)
        expected = errors_of(acting(model, envs.normalize_obs))
        model.save(tmp_path / "plain.zip")
        envs.save(str(tmp_path / "statistics.pkl"))
        fresh = PPO.load(tmp_path / "plain.zip", env=VecNormalize(plants()), device="cpu")
        for attempt in (evaluate, partial(save, path=tmp_path / "fresh.zip")):
            with pytest.raises(ValueError, match=r"learnt from 256 samples.* has seen 0, so"):
                attempt(fresh)
        without = PPO.load(tmp_path / "plain.zip", env=plants(), device="cpu")
        fresh.set_env(plants())
        for each in (without, fresh):
            with pytest.raises(
                ValueError, match=r"trained in VecNormalize, and its env.* lack"
            ):
                evaluate(each, NOISY, **SHORT)
        kept = VecNormalize.load(str(tmp_path / "statistics.pkl"), plants())
        loaded = PPO.load(tmp_path / "plain.zip", env=kept, device="cpu")
        found = evaluate(loaded, NOISY, episodes=3, **SHORT)
        assert found.errors == pytest.approx(expected, abs=1e-6)


class TestRecords:
    def test_files_that_are_no_models_or_cannot_be_written(self, ppo, tmp_path):
        save(ppo, tmp_path / "model.zip")
        assert [each.name for each in tmp_path.iterdir()] == ["model.zip"]
        with pytest.raises(ValueError, match=r"model\.zip/model\.zip cannot be written: Not a"):
            save(ppo, tmp_path / "model.zip/model.zip")
        (tmp_path / "text.zip").write_text("no zip")
        with pytest.raises(ValueError, match=r"text\.zip must be a zip that Stable-Baselines3"):
            load(tmp_path / "text.zip")
        with pytest.raises(ValueError, match=r"none\.zip cannot be read: No such file"):
            spec_of(tmp_path / "none.zip")

    @pytest.mark.parametrize(
        ("edit", "message"),
        [
            (lambda record: "[" * 100_000, "damaged record"),
            (lambda record: '{"env": "MiddlePoint-v0"}', "damaged record"),
            (lambda record: record["arguments"].pop("error_window"), "damaged.*error_window"),
            (lambda record: record.update(later=1), "damaged .* or that of another version"),
            (lambda record: record.update(env="None-v0"), "cannot be loaded as .*None-v0"),
            (lambda record: record.update(
                wrappers=[{"name": "X", "entry_point": "none:X", "kwargs": {}}]
            ), "wrappers of env must be importable: No module named 'none'"),
            (lambda record: record.update(vec_wrappers=[{"name": "VecTimes"}]),
             "cannot be loaded as .*VecTimes is not known here"),
        ],
    )  # fmt: skip
    def test_an_edited_record_is_refused(self, edit, message, ppo, tmp_path):
        save(ppo, tmp_path / "model.zip")
        with zipfile.ZipFile(tmp_path / "model.zip") as archive:
            record = json.loads(archive.read(MEMBER))
        text = edit(record)
        ppo.save(tmp_path / "model.zip")
        with zipfile.ZipFile(tmp_path / "model.zip", "a") as archive:
            archive.writestr(MEMBER, text if isinstance(text, str) else json.dumps(record))
        with pytest.raises(ValueError, match=message):
            load(tmp_path / "model.zip")

    def test_an_argument_that_is_no_value_cannot_be_saved(self, tmp_path):
        model = PPO("MlpPolicy", TransformObservation(made(), lambda seen: seen, None))
        for attempt in (partial(save, model), partial(model.learn, 8)):
            given = {"path": tmp_path / "model.zip"}
            if attempt.func != save:
                given = {"callback": ScoreCallback(**given)}
            with pytest.raises(ValueError, match="argument of a wrapper cannot be recorded"):
                attempt(**given)
        assert model.num_timesteps == 0

    def test_members_of_absurd_size_are_not_read(self, ppo, tmp_path, monkeypatch):
        assert training.LARGEST_MEMBER <= 2**30
        monkeypatch.setattr(training, "LARGEST_MEMBER", 1_000)
        save(ppo, tmp_path / "large.zip")
        with pytest.raises(ValueError, match=r"data in it has [\d,]+ bytes, and 1,000 are all"):
            load(tmp_path / "large.zip")


class Reseeded(gymnasium.Wrapper):
    def reset(self, *, seed=None, options=None):
        return self.env.reset(seed=5, options=options)


class Skipping(gymnasium.Wrapper):
    def step(self, action):
        for _ in range(3):
            self.env.step(action)
        return self.env.step(action)


class TestEpisodes:
    @pytest.mark.parametrize(
        ("make", "message"),
        [
            (lambda: Reseeded(made()), "episodes of its seeds, whose noise by sample 1"),
            (lambda: Reseeded(made(noise_variance=0.0, delay=[3, 9])), "whose delay by"),
            (lambda: Skipping(made()), "whose noise by sample 1 is"),
            (lambda: TimeLimit(
                Skipping(gymnasium.make("MiddlePoint-v0", max_episode_steps=4800)), 1200
            ), "whose output by sample 29 is"),
            (lambda: Flatters(made()), "whose error by sample 1 is"),
            (lambda: Faster(noise_variance=0.5), "whose output by sample 2"),
            (lambda: made(delay=int(np.random.default_rng().integers(2, 1000))),
             "makes the same plant at each call"),
            (lambda: Ends(gymnasium.make("MiddlePoint-v0", max_episode_steps=60)),
             "env must run episodes of 60 samples, got 41"),
        ],
    )  # fmt: skip
    def test_other_episodes_are_refused(self, make, message):
        with pytest.raises(ValueError, match=message):
            evaluate(Integrator(), make, episodes=3)

    def test_one_environment_for_all_episodes_is_refused(self):
        one = gymnasium.make("MiddlePoint-v0", setpoint=5.0)
        scaled = Scaled(one)
        for make in (lambda: scaled, lambda: Scaled(one)):
            with pytest.raises(ValueError, match="makes a new environment at each call"):
                evaluate(Integrator(), make, episodes=3)


class Flatters(gymnasium.Wrapper):
    def step(self, action):
        *others, info = self.env.step(action)
        return *others, info | {"error": 0.1 * info["error"]}


class Faster(MiddlePointEnv):
    """A plant other than its arguments say."""

    def reset(self, **given):
        other = MiddlePointEnv(time_constant_factor=0.5)
        other.reset()
        returned = super().reset(**given)
        self._plant = other._plant
        return returned


class Ends(gymnasium.Wrapper):
    def reset(self, **given):
        self.left = 41
        return self.env.reset(**given)

    def step(self, action):
        self.left -= 1
        *others, info = self.env.step(action)
        others[2] = self.left == 0
        return *others, info
