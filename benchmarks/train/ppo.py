"""PPO of Stable-Baselines3, trained on simulated plants before it is compared."""

from __future__ import annotations

import copy
import io
import math
import pickle
import tempfile
import time
from dataclasses import asdict, dataclass, field, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, cast

import gymnasium
import numpy as np
import pandas as pd
import torch
from numpy.typing import NDArray
from stable_baselines3 import PPO
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.torch_layers import BaseFeaturesExtractor
from stable_baselines3.common.vec_env import VecEnv
from tqdm import tqdm

from benchmarks.controllers.roster import Account, Training
from benchmarks.lib.fingerprint import fingerprint
from benchmarks.lib.storage import replacing, versions, write_json
from benchmarks.metrics import mean_error
from benchmarks.rollout import make_plants, rollout
from benchmarks.scenarios import SCENARIOS
from benchmarks.sweep.plants import SPANS
from benchmarks.train.sb3_vec_env import GymnasiumVecEnv
from mptc_gym import Parameters

DELAY = Parameters().delay
DEGREES = 5.0  # what temperatures are divided by before they enter a network
CHECKPOINT_INTERVAL = 32_768  # samples of experience between checkpoints
POLICIES = 5  # are trained and compared, from seeds in sequence
TUNING_SEED, FINAL_SEED = 1000, 2000  # of policies in a search, others than a comparison uses
VALIDATION_RUNS, VALIDATION_SAMPLES = 16, 600
VALIDATION_SEED = 2_000_000  # met neither in training nor by any comparison
# Set points that no comparison has, and that can be held: smaller ones need a flow in the dead
# zone. A policy is often worse at them at the end than it was before.
HELD = [level for level in (4.4, -5.6, 5.3, -4.1, 5.8, -4.7) for _ in range(150)]
PROBE = SCENARIOS["square"]  # shown in the learning curve, without a part in the training
PROBE_SEED = 1_000_000  # met by no comparison


@dataclass(frozen=True)
class PPOArguments:
    """Everything that shapes a policy, except versions and code."""

    seed: int = 10_000
    """Of the initial policy, the exploration, and the set points and noise met in training, of
    plant i with `seed + i`. No run of a comparison has any of these."""
    steps: int = 1_000_000
    """Samples of experience, all plants together."""
    noise_variance: float = 0.5
    """R of the plants trained on, degC^2. A policy trained with noise steers less nervously,
    and does better with another dead zone than one trained on that plant."""
    calm: float = 0.75
    """Share of the plants that have no noise. In noise, small offsets hardly cost anything."""
    plant: dict[str, Any] = field(default_factory=dict)
    """Arguments of the environment trained on, where it is not the nominal plant."""
    setpoint_amplitude: float = 6.0
    """Random set points are uniform within this, degC."""
    reward: str = "absolute"
    """The environment's; "absolute" is what the comparison measures."""
    error_scale: float = 50.0
    """The environment's, degC. It makes returns about 1 in size, which a value function learns
    much sooner than large ones."""
    output_window: int = 2
    """Past outputs in the observation."""
    action_window: int = DELAY + 2
    """Past actions in the observation; with delay + 2 the noise-free problem is Markov."""
    n_envs: int = 64
    """Plants that are stepped at once."""
    n_steps: int = 64
    """Samples of each plant between two updates."""
    batch_size: int = 256
    """Samples of a gradient step."""
    n_epochs: int = 5
    """How often an update goes through its samples."""
    learning_rate: float = 1e-3
    """At the start; it falls linearly, to a twentieth."""
    gamma: float = 0.95
    """Discount a sample."""
    gae_lambda: float = 1.0
    """Below 1, advantages lean on the value function, also for what the delay still hides."""
    clip_range: float = 0.2
    """How far an update may move the probability of an action."""
    log_std: tuple[float, float] = (-0.5, -2.0)
    """Logarithm of the standard deviation of the normalised action, at first and at last. Left
    to itself it stays high; and as the actuator cuts such noise off at its limits, a mean that
    is right with the noise is wrong without it."""
    log_std_falls: tuple[float, float] = (0.0, 1.0)
    """From where to where in the training it falls, linearly."""
    hidden: tuple[int, ...] = (64, 64)
    """Nodes of the hidden layers, of policy and value function alike."""

    @property
    def observation(self) -> dict[str, Any]:
        """Arguments of the environment that give the policy its observation."""
        return {"output_window": self.output_window, "action_window": self.action_window}

    @property
    def training(self) -> dict[str, Any]:
        """Arguments of the environment trained on."""
        return {
            **self.observation,
            **self.plant,
            "noise_variance": self.noise_variance,
            "reward": self.reward,
            "error_scale": self.error_scale,
            "setpoint": "random",
            "setpoint_amplitude": self.setpoint_amplitude,
        }

    @property
    def plants(self) -> list[tuple[int, dict[str, Any]]]:
        """How many plants to train on, and their arguments: the noisy ones, then the calm."""
        calm = round(self.calm * self.n_envs)
        groups = [
            (self.n_envs - calm, self.training),
            (calm, {**self.training, "noise_variance": 0.0}),
        ]
        return [(count, arguments) for count, arguments in groups if count]


# What makes a policy one for many plants, those of a random design.
RANDOMISED: dict[str, Any] = {
    "plant": {name: list(span) for name, span in SPANS.items() if name != "noise_variance"},
    "action_window": 38,
}


class FixedScaling(BaseFeaturesExtractor):
    """Scales observations by fixed factors: the same in training and in use."""

    def __init__(self, observation_space: gymnasium.spaces.Box, factors: list[float]) -> None:
        super().__init__(observation_space, features_dim=len(factors))
        self.register_buffer("factors", torch.tensor(factors))

    def forward(self, observations: torch.Tensor) -> torch.Tensor:
        """Return scaled observations."""
        return observations * self.factors


class PolicyController:
    """A trained policy as a controller; it takes the mean of the policy's distribution."""

    def __init__(self, model: BaseAlgorithm) -> None:
        self._model = model

    def reset(self) -> None:
        """Do nothing: the observation holds all that the policy remembers."""

    def act(self, observation: NDArray[np.float32]) -> NDArray[np.float32]:
        """Return actions, shape (runs, 1), for observations, shape (runs, n_obs)."""
        actions, _ = self._model.predict(observation, deterministic=True)
        return actions


@dataclass(frozen=True)
class Policy:
    """Makes controllers of one trained policy, which a folder keeps.

    Attributes
    ----------
    arguments
        How it was trained.
    folder
        Where it is.
    """

    arguments: PPOArguments
    folder: Path

    @property
    def observation(self) -> dict[str, Any]:
        """Arguments of the environment that give the policy its observation."""
        return self.arguments.observation

    @property
    def account(self) -> Account:
        """What it costs before it runs."""
        weights = sum(p.numel() for p in _loaded(self.folder).policy.parameters())
        return Account(
            "delay, by the past actions it sees",
            f"{weights:,} weights a policy",
            f"{self.arguments.steps / 1e6:g} M a policy",
        )

    @property
    def curve(self) -> list[dict[str, float]]:
        """The learning curve, a row a point."""
        curve = pd.read_csv(self.folder / "learning.csv")
        return cast("list[dict[str, float]]", curve.to_dict("records"))

    @property
    def provenance(self) -> dict[str, Any]:
        """Where it comes from."""
        return {"folder": str(self.folder), "arguments": asdict(self.arguments)}

    def __call__(self) -> PolicyController:
        """Return a controller."""
        return PolicyController(_loaded(self.folder))


@cache
def _loaded(folder: Path) -> PPO:
    torch.set_num_threads(1)  # the network is too small for more
    return PPO.load(folder / "policy.zip", device="cpu")


def members(training: Training, arguments: PPOArguments | None = None) -> list[Policy]:
    """Return policies that differ in their seeds, and train those that are missing.

    Parameters
    ----------
    training
        Where they are kept, how many there are, and what trains them.
    arguments
        How to train the first; the seeds of the others follow.
    """
    arguments = arguments or PPOArguments()
    if training.steps is not None:
        arguments = replace(arguments, steps=training.steps)
    seeds = range(arguments.seed, arguments.seed + (training.members or POLICIES))
    policies = [
        # Absolute, as workers may have been started elsewhere.
        Policy(each, (training.folder / policy_key(each)).absolute())
        for each in (replace(arguments, seed=seed) for seed in seeds)
    ]
    # A bar for each training; those of other machines do not come here.
    bars = training.fan_out.backend == "loky"
    cells = {
        f"PPO, seed {policy.arguments.seed}": partial(
            _train, policy.arguments, policy.folder, retrain=training.retrain, progress=bars
        )
        for policy in policies
        if training.retrain or not is_trained(policy.folder)
    }
    training.fan_out.run(cells, title="training PPO", progress=bool(cells) and not bars)
    for policy in policies:
        if not is_trained(policy.folder):
            raise FileNotFoundError(
                f"trained, but not here: the machines of a cluster must share {policy.folder}"
            )
    return policies


def randomised_members(training: Training) -> list[Policy]:
    """Return policies for many plants, as `members` does."""
    return members(training, replace(PPOArguments(), **RANDOMISED))


def tuned(*, final: bool, member: int, **gains: float) -> Policy:
    """Train a policy with other settings, of a seed that no comparison has."""
    first = FINAL_SEED if final else TUNING_SEED
    arguments = PPOArguments(seed=first + member, **gains)
    with tempfile.TemporaryDirectory() as folder:
        policy = Policy(arguments, Path(folder))
        _train(arguments, policy.folder, retrain=False, progress=False)
        _loaded(policy.folder)  # while the folder is there
        return policy


def _train(arguments: PPOArguments, folder: Path, *, retrain: bool, progress: bool) -> None:
    """Train a policy, which lies in its folder then."""
    trained_policy(arguments, folder, retrain=retrain, progress=progress)


def is_trained(folder: Path) -> bool:
    """Say whether a folder holds a finished policy."""
    return (folder / "policy.zip").exists() and (folder / "learning.csv").exists()


def policy_key(arguments: PPOArguments) -> str:
    """Return a name made of everything that shapes a policy."""
    return fingerprint(__name__, arguments=asdict(arguments))


def trained_policy(
    arguments: PPOArguments, folder: Path, *, retrain: bool, progress: bool
) -> PPO:
    """Load the policy that a folder holds, or finish or begin its training.

    Parameters
    ----------
    arguments
        How to train.
    folder
        Where the policy is kept: `policy.zip`, `learning.csv` (the learning curve) and
        `arguments.json` when it is finished, `checkpoint.pkl` until then.
    retrain
        Whether to forget what the folder holds.
    progress
        Whether to show a progress bar.

    Returns
    -------
    PPO
        The policy that did best in validation: on set points that are met neither in training
        nor in a comparison. Training that was interrupted and resumed
        ends in the same policy, to the bit, as training that was not.
    """
    policy, checkpoint = folder / "policy.zip", folder / "checkpoint.pkl"
    curve_file = folder / "learning.csv"
    if retrain:
        policy.unlink(missing_ok=True)
        checkpoint.unlink(missing_ok=True)
    torch.set_num_threads(1)  # the network is too small for more
    try:
        if is_trained(folder):
            return PPO.load(policy, device="cpu")
        if checkpoint.exists():
            model, curve, best = _resume(checkpoint)
        else:
            model, curve, best = begin(arguments), [], {}
    except (EOFError, OSError, ValueError, pickle.UnpicklingError) as error:
        raise ValueError(f"{folder} is damaged ({error}): remove it, or --retrain") from error
    left = arguments.steps - model.num_timesteps
    bar = tqdm(
        desc=f"training PPO, seed {arguments.seed}",
        total=arguments.steps,
        initial=model.num_timesteps,
        unit=" samples",
        unit_scale=True,
        disable=not progress,
    )
    with bar:
        keeper = Keeper(arguments, checkpoint, curve, best, bar)
        model.learn(left, callback=keeper, reset_num_timesteps=False)
        keeper.record()
    model.policy.load_state_dict(keeper.best)
    with replacing(curve_file) as file:
        pd.DataFrame(keeper.curve).to_csv(file, index=False)
    write_json(folder / "arguments.json", asdict(arguments) | {"versions": versions()})
    with replacing(policy) as file:
        model.save(file)
    checkpoint.unlink(missing_ok=True)
    return model


def begin(arguments: PPOArguments, plants: VecEnv | None = None) -> PPO:
    """Make a model that has learnt nothing yet.

    Parameters
    ----------
    arguments
        How it is to be trained.
    plants
        What to train on, if not a batch of plants that are stepped at once.

    Returns
    -------
    PPO
        The model.
    """
    if plants is None:
        plants = GymnasiumVecEnv(
            *(
                gymnasium.make_vec("MiddlePoint-v0", count, autoreset_mode="SameStep", **given)
                for count, given in arguments.plants
            )
        )
    parameters = Parameters(**arguments.training)
    degrees = parameters.observation_size - parameters.action_window
    factors = [1.0 / DEGREES] * degrees + [1.0] * parameters.action_window
    return PPO(
        "MlpPolicy",
        plants,
        # The last update comes when no progress remains; it is not to be in vain.
        learning_rate=lambda remaining: arguments.learning_rate * max(remaining, 0.05),
        n_steps=arguments.n_steps,
        batch_size=arguments.batch_size,
        n_epochs=arguments.n_epochs,
        gamma=arguments.gamma,
        gae_lambda=arguments.gae_lambda,
        clip_range=arguments.clip_range,
        policy_kwargs={
            "features_extractor_class": FixedScaling,
            "features_extractor_kwargs": {"factors": factors},
            "net_arch": list(arguments.hidden),
        },
        seed=arguments.seed,
        device="cpu",
    )


class Keeper(BaseCallback):
    """Records the learning curve and keeps checkpoints, both between two updates.

    Parameters
    ----------
    arguments
        How the policy is trained.
    checkpoint
        Where to keep checkpoints.
    curve
        The learning curve up to now; more points are added to it.
    best
        The parameters of the policy that did best in validation up to now.
    bar
        Shows the progress.
    """

    def __init__(
        self,
        arguments: PPOArguments,
        checkpoint: Path,
        curve: list[dict[str, float]],
        best: dict[str, torch.Tensor],
        bar: tqdm[Any],
    ) -> None:
        super().__init__()
        self.curve = curve
        self.best = best
        self._bar = bar
        self._arguments = arguments
        self._checkpoint = checkpoint
        self._errors: list[float] = []
        self._began = time.perf_counter() - (curve[-1]["seconds"] if curve else 0.0)

    def _on_step(self) -> bool:
        self._errors.append(float(np.mean(np.abs(self.training_env.infos["error"]))))
        self._bar.update(self.training_env.num_envs)
        return True

    def _on_rollout_start(self) -> None:
        done = self.num_timesteps / self._arguments.steps
        with torch.no_grad():
            log_std = np.interp(done, self._arguments.log_std_falls, self._arguments.log_std)
            self.model.policy.log_std.fill_(float(log_std))
        before = self.curve[-1]["steps"] if self.curve else 0
        if self.num_timesteps - before >= CHECKPOINT_INTERVAL:
            self.record()
            _save(self, self._checkpoint)

    def record(self) -> None:
        """Add a point to the learning curve, and keep the policy if it is the best so far."""
        random = self._arguments.training
        held = {**self._arguments.observation, "setpoint": HELD}
        size = VALIDATION_RUNS, VALIDATION_SAMPLES, VALIDATION_SEED
        validation = (self._mae(random, *size) + self._mae(held, 1, len(HELD), 0)) / 2
        if not self.curve or validation < min(point["validation_mae"] for point in self.curve):
            self.best = copy.deepcopy(self.model.policy.state_dict())
        square = {**self._arguments.observation, **PROBE.arguments}
        self.curve.append(
            {
                "steps": self.num_timesteps,
                "seconds": time.perf_counter() - self._began,
                "training_mae": float(np.mean(self._errors)) if self._errors else math.nan,
                "validation_mae": validation,
                "square_mae": self._mae(square, 1, PROBE.samples, PROBE_SEED),
            }
        )
        self._errors.clear()
        self._bar.set_postfix_str(f"mean |e| {validation:.3f}")

    def _mae(self, arguments: dict[str, Any], runs: int, samples: int, seed: int) -> float:
        plants = make_plants(runs, samples, **arguments)
        trajectory = rollout(plants, PolicyController(self.model), samples, seed)
        return float(mean_error(trajectory).mean())


def _save(keeper: Keeper, path: Path) -> None:
    saved = io.BytesIO()
    keeper.model.save(saved)
    state = {
        "model": saved.getvalue(),
        "plants": keeper.model.get_env(),
        "numpy": np.random.get_state(),  # noqa: NPY002 (SB3 shuffles its batches with it)
        "torch": torch.get_rng_state(),
        "curve": keeper.curve,
        "best": keeper.best,
    }
    with replacing(path) as new, new.open("wb") as file:
        pickle.dump(state, file)


def _resume(path: Path) -> tuple[PPO, list[dict[str, float]], dict[str, torch.Tensor]]:
    with path.open("rb") as file:
        state = pickle.load(file)
    # force_reset=False: go on in the middle of the episodes.
    model = PPO.load(
        io.BytesIO(state["model"]), env=state["plants"], device="cpu", force_reset=False
    )
    np.random.set_state(state["numpy"])  # noqa: NPY002
    torch.set_rng_state(state["torch"])
    return model, state["curve"], state["best"]
