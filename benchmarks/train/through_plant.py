"""Networks trained by the gradient through the plant.

A batch of simulated plants is run under the network, and the error of the whole run is
differentiated with respect to the weights, back through controller, actuator and plant. That
needs a model of the plant in PyTorch, and a loss; no value function, and no exploration. The
literature calls it differentiable predictive control (J. Drgona et al., "Differentiable
predictive control: deep learning alternative to explicit model predictive control for unknown
nonlinear systems", Journal of Process Control 116, 2022, 80-92) or analytic policy gradients.
"""

from __future__ import annotations

import itertools
import math
import time
from dataclasses import asdict, dataclass
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor, nn

from agents import PolicyNetwork
from benchmarks.designs import SPANS
from benchmarks.lib.fingerprint import fingerprint
from benchmarks.lib.storage import versions
from mptc_gym import Parameters
from mptc_gym.torch_env import MiddlePointTorchEnv

NOMINAL = Parameters()
GAIN = sum(NOMINAL.b) / sum(NOMINAL.a)  # steady-state, degC per t/h; limits are +-10 t/h
HOLDS = 0.1 / GAIN  # action that holds the output, per degC
VALIDATION_PLANTS, VALIDATION_SAMPLES = 64, 600
VALIDATION_SEED = 3_000_000  # met neither in training nor by any comparison
DRIFT_SAMPLES = 1200  # of plants that drift, as in the random design
LAST_RATE = 0.01  # what the learning rate falls to, as a share of the first

Signals = dict[str, Tensor]
Curve = list[dict[str, float]]


@dataclass(frozen=True)
class Training:
    """Everything that shapes a network, except versions and code."""

    plants: str = "nominal"
    """What to train on: "nominal", the paper's plant with any dead zone from 4 to 6.7 t/h; or
    "many", plants drawn as in the random design of `benchmarks.sweep`, half of which drift."""
    seed: int = 10_000
    """Of the initial weights, and of plants, set points and noise."""
    steps: int = 150
    """Of the optimiser, each on a new batch of plants."""
    batch: int = 64
    """Plants of a step."""
    samples: int = 400
    """Length of their runs."""
    window: int = 24
    """Past outputs and past actions that the network sees."""
    hidden: int = 64
    """Nodes of each of the two hidden layers."""
    learning_rate: float = 3e-3
    """Of Adam at the start; it falls linearly."""
    move_price: float = 0.01
    """Price of valve travel: degC per t/h that the applied flow moves in a sample."""
    tolerance: float = 0.02
    """Below this error, degC, the loss is quadratic (Huber), and above it linear. With 0.2 the
    network stays a little short of the set point, closer to where the next one may be."""
    noisy: float = 0.3
    """Share of the nominal plants that have noise."""
    noise_variance: float = 0.6
    """R of those that have is uniform from 0 to this, degC^2."""
    averaging: float = 0.95
    """What is kept and validated is the exponential mean of the weights of past steps."""
    validate_every: int = 25
    """Steps between two validations."""


TRAININGS: dict[str, Training] = {
    "nn-dpc": Training(),
    "nn-adaptive": Training(
        plants="many", steps=450, batch=128, samples=400, window=64, hidden=128,
        learning_rate=2e-3, averaging=0.98,
    ),
}  # fmt: skip


class Network(nn.Module):
    """The policy, odd in its inputs: what it does at a set point it undoes at the opposite one.

    It adds to the action that holds the set point on the nominal plant. Its inputs are the set
    point, the errors of past outputs from it, and past actions less that action. In the steady
    state of the nominal plant all but the set point are 0. An odd function without that input
    is 0 there for certain; with little of it, nearly so.

    Parameters
    ----------
    training
        Sizes.
    """

    SET_POINT, ERROR, REACH = 0.02, 0.5, 2.4  # input scales, per degC; largest output

    features: Tensor

    def __init__(self, training: Training) -> None:
        super().__init__()
        window, hidden = training.window, training.hidden
        self.window = window
        # From the observation (set point, outputs, actions) to the inputs.
        features = torch.zeros(1 + 2 * window, 1 + 2 * window)
        features[0, 0] = self.SET_POINT
        features[1:, 0] = torch.tensor([self.ERROR, -HOLDS]).repeat_interleave(window)
        scales = torch.tensor([-self.ERROR, 1.0]).repeat_interleave(window)
        features[1:, 1:] = torch.diag(scales)
        self.register_buffer("features", features)
        sizes = (1 + 2 * window, hidden, hidden, 1)
        self.layers = nn.ModuleList(
            nn.Linear(before, after, bias=False) for before, after in itertools.pairwise(sizes)
        )
        last = cast("nn.Linear", self.layers[-1])
        with torch.no_grad():
            last.weight.mul_(0.1)  # begins close to the action that holds

    def weights(self) -> list[Tensor]:
        """Return the weights of each layer, the first for observations."""
        first, *others = self.parameters()
        return [first @ self.features, *others]

    def export(self, **provenance: Any) -> PolicyNetwork:
        """Return the network in NumPy."""
        layers = [(W.detach().numpy(), np.zeros(len(W))) for W in self.weights()]
        direct = np.zeros(1 + 2 * self.window)
        direct[0] = HOLDS
        return PolicyNetwork(
            layers,
            observation=windows(self.window),
            input_scale=np.ones(1 + 2 * self.window),
            activation="tanh",
            output="tanh",
            output_scale=self.REACH,
            direct=direct,
            provenance=provenance,
        )


def act(weights: list[Tensor], observations: Tensor) -> Tensor:
    """Return actions, shape (n, 1), for observations, shape (n, n_obs); they may exceed 1."""
    x = observations.t()
    setpoint = x[:1]
    for W in weights[:-1]:
        x = torch.tanh(W @ x)
    return (HOLDS * setpoint + Network.REACH * torch.tanh(weights[-1] @ x)).t()


def windows(window: int) -> dict[str, int]:
    """Return the arguments of the environment for what a network sees."""
    return {
        "setpoint_window": 1,
        "error_window": 0,
        "output_window": window,
        "action_window": window,
    }


def make_plants(training: Training, count: int, samples: int) -> MiddlePointTorchEnv:
    """Return plants that take all that differs between them as signals at each reset."""
    arguments: dict[str, Any] = {"dead_zone": (0.0, 8.0)}
    if training.plants == "many":
        arguments |= SPANS
        for name in ("gain", "time_constant"):
            low, high = SPANS[f"{name}_factor"]
            arguments[f"{name}_drift"] = (low / high, high / low)
        arguments["drift_samples"] = DRIFT_SAMPLES
    arguments["noise_variance"] = 0.0  # handed in, too
    arguments |= windows(training.window)
    return MiddlePointTorchEnv(
        count,
        max_episode_steps=samples,
        differentiable=True,
        **arguments,
    )


class Draw:
    """Draws what a batch of plants meets, all from one generator."""

    def __init__(self, training: Training, count: int, samples: int, *seed: int) -> None:
        self._training, self._count, self._samples = training, count, samples
        self._generator = torch.Generator()
        # Hashed, so that the draws of neighbouring seeds have nothing in common.
        state = np.random.SeedSequence(seed).generate_state(1, np.uint64)[0]
        self._generator.manual_seed(int(state >> np.uint64(1)))

    def uniform(self, low: float, high: float, *shape: int) -> Tensor:
        """Draw uniformly, shape (count,) if no other is given."""
        drawn = torch.rand(*(shape or (self._count,)), generator=self._generator)
        return low + drawn * (high - low)

    def noise(self, variance: Tensor) -> Tensor:
        """Draw n(k) of (28) for k = 0 to `samples`, degC; xi is 0 up to k = 0."""
        order = len(NOMINAL.c) - 1
        xi = torch.randn(self._samples + 1, self._count, generator=self._generator)
        xi = torch.cat([torch.zeros(order, self._count), xi * variance.sqrt()])
        xi[order] = 0.0
        lags = [xi[order - i : len(xi) - i] * c for i, c in enumerate(NOMINAL.c)]
        return torch.stack(lags).sum(0)

    def levels(self, least: Tensor | float) -> Tensor:
        """Draw set points for k = 0 to `samples`: held for 100, or the square wave."""
        n, age = self._count, torch.arange(self._samples + 1)[:, None]
        begins = torch.randint(0, 100, (n,), generator=self._generator)
        size = least + (6.0 - least) * self.uniform(0.0, 1.0, self._samples // 100 + 2, n)
        sign = torch.sign(self.uniform(-1.0, 1.0, *size.shape))
        random = (size * sign).gather(0, (age + begins) // 100)
        begins = torch.randint(0, 600, (n,), generator=self._generator)
        square = torch.where((age + begins) // 300 % 2 == 0, size[0], -size[0])
        return torch.where(self.uniform(0.0, 1.0) < 0.4, square, random)

    def signals(self) -> Signals:
        """Draw all that a batch of training plants needs."""
        if self._training.plants == "many":
            return self._many()
        dead_zone = self.uniform(4.0, 6.7)
        noisy = self.uniform(0.0, 1.0) < self._training.noisy
        variance = torch.where(noisy, self.uniform(0.0, self._training.noise_variance), 0.0)
        # Smaller set points would need a flow within the dead zone, and nothing holds them.
        return {
            "dead_zone": dead_zone,
            "noise": self.noise(variance),
            "setpoint": self.levels(4.6),
        }

    def _many(self) -> Signals:
        drifts = self.uniform(0.0, 1.0) < 0.5
        signals: Signals = {}
        for name in ("gain", "time_constant"):
            span = SPANS[f"{name}_factor"]
            factor, later = self.uniform(*span), self.uniform(*span)
            signals[f"{name}_factor"] = factor
            signals[f"{name}_drift"] = torch.where(drifts, later / factor, 1.0)
        shortest, longest = SPANS["delay"]
        return signals | {
            "delay": self.uniform(shortest, longest + 1).floor(),
            "dead_zone": self.uniform(*SPANS["dead_zone"]),
            "noise": self.noise(self.uniform(*SPANS["noise_variance"])),
            "setpoint": self.levels(3.0),
        }


def run(
    plants: MiddlePointTorchEnv, network: Network, signals: Signals, samples: int
) -> tuple[Tensor, Tensor]:
    """Return e(k + 1), degC, and u_a(k), t/h, for k = 0, 1, ..., each (samples, plants)."""
    observations, _ = plants.reset(seed=0, options={"signals": signals})
    weights = network.weights()
    errors, applied = [], []
    for _ in range(samples):
        observations, _, _, _, infos = plants.step(act(weights, observations))
        errors.append(infos["error"])
        applied.append(infos["applied"])
    return torch.stack(errors), torch.stack(applied)


def loss_of(errors: Tensor, applied: Tensor, training: Training) -> Tensor:
    """Return what is minimised, degC."""
    tolerance = training.tolerance
    error = nn.functional.huber_loss(errors, torch.zeros_like(errors), delta=tolerance)
    return error / tolerance + training.move_price * applied.diff(dim=0).abs().mean()


def validate(network: Network, training: Training) -> dict[str, float]:
    """Return mean |e|, degC, and what the valve travels a sample, t/h, on held-out plants."""
    plants = make_plants(training, VALIDATION_PLANTS, VALIDATION_SAMPLES)
    draw = Draw(training, VALIDATION_PLANTS, VALIDATION_SAMPLES, VALIDATION_SEED)
    with torch.no_grad():
        errors, applied = run(plants, network, draw.signals(), VALIDATION_SAMPLES)
    return {
        "validation_mae": float(errors.abs().mean()),
        "validation_travel": float(applied.diff(dim=0).abs().mean()),
    }


class Trainer:
    """A training, step by step.

    Parameters
    ----------
    training
        What to do.

    Attributes
    ----------
    step : int
        How many steps have been taken.
    averaged : Network
        Mean of the weights of past steps.
    curve : list of dict
        A row each validation.
    """

    def __init__(self, training: Training) -> None:
        self.training = training
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(training.seed)
            self._network = Network(training)
        self.averaged = Network(training)
        self.averaged.load_state_dict(self._network.state_dict())
        self._optimiser = torch.optim.Adam(self._network.parameters())
        self._plants = make_plants(training, training.batch, training.samples)
        self.step = 0
        self.curve: Curve = []
        self._best = self.averaged.state_dict()
        self._seconds = 0.0

    def advance(self) -> float:
        """Take a step of the optimiser and return the loss, degC."""
        began = time.process_time()
        training = self.training
        left = max(1.0 - self.step / training.steps, LAST_RATE)
        self._optimiser.param_groups[0]["lr"] = training.learning_rate * left
        draw = Draw(training, training.batch, training.samples, training.seed, self.step)
        errors, applied = run(self._plants, self._network, draw.signals(), training.samples)
        loss = loss_of(errors, applied, training)
        self._optimiser.zero_grad()
        loss.backward()
        norm = nn.utils.clip_grad_norm_(self._network.parameters(), 1.0)
        if math.isfinite(norm):
            self._optimiser.step()
        self.step += 1
        # At first the mean forgets faster, so that the initial weights have no part in it.
        share = 1.0 - min(training.averaging, self.step / (self.step + 10.0))
        with torch.no_grad():
            pairs = zip(self.averaged.parameters(), self._network.parameters(), strict=True)
            for mean, new in pairs:
                mean.lerp_(new, share)
        self._seconds += time.process_time() - began
        return loss.item()

    def record(self) -> dict[str, float]:
        """Validate, add a row to the curve, and keep the weights if they are the best yet."""
        row = {"step": self.step, **validate(self.averaged, self.training)}
        row["score"] = row["validation_mae"]
        row["score"] += self.training.move_price * row["validation_travel"]
        row["cpu_seconds"] = round(self._seconds, 2)
        if not self.curve or row["score"] < min(each["score"] for each in self.curve):
            self._best = {k: v.clone() for k, v in self.averaged.state_dict().items()}
        self.curve.append(row)
        return row

    def best(self) -> Network:
        """Return the network that did best in validation."""
        network = Network(self.training)
        network.load_state_dict(self._best)
        return network


def train(training: Training, source: str) -> PolicyNetwork:
    """Train, and return the network that did best in validation.

    Parameters
    ----------
    training
        What to do.
    source
        The commit that this is run from, for the provenance.
    """
    torch.set_num_threads(1)  # the network is too small for more
    trainer = Trainer(training)
    while trainer.step < training.steps:
        trainer.advance()
        if trainer.step == training.steps or trainer.step % training.validate_every == 0:
            trainer.record()
    best = min(trainer.curve, key=lambda row: row["score"])
    return trainer.best().export(
        training=asdict(training),
        validation={"seed": VALIDATION_SEED, "plants": VALIDATION_PLANTS, **best},
        cpu_seconds=trainer.curve[-1]["cpu_seconds"],
        curve=trainer.curve,
        code=training_key(training),
        versions=versions(),
        commit=source,
    )


def training_key(training: Training) -> str:
    """Return a name made of everything that shapes a network: arguments, versions and code."""
    return fingerprint(__name__, training=asdict(training))
