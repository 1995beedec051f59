"""Train the network of `nn-smith` by the gradient through plants of all kinds.

The network controls a batch of simulated plants, each with a model that is told its numbers.
The error of the whole run is differentiated with respect to the weights, back through plant,
actuator and law. The literature calls this differentiable predictive control (J. Drgona et al.,
"Differentiable predictive control: deep learning alternative to explicit model predictive
control for unknown nonlinear systems", Journal of Process Control 116, 2022, 80-92).
"""

from __future__ import annotations

import copy
import math
import time
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import torch
from torch import Tensor, nn

from agents.neural_law import INPUTS, MOST_ADDED, OUTPUTS, Law, LawNetwork, Prior
from benchmarks.lib.fingerprint import fingerprint
from benchmarks.lib.storage import replacing, versions
from mptc_gym import Parameters
from mptc_gym.plant import Dynamics
from mptc_gym.torch_env import MiddlePointTorchEnv

NOMINAL = Parameters(time_constant_factor=[0.2, 5.0])  # a range, so that it can be changed
DYNAMICS = Dynamics(NOMINAL)
GAIN = abs(sum(NOMINAL.b) / sum(NOMINAL.a))  # degC per t/h
RATE = 1.0 - float(np.abs(np.roots(NOMINAL.a)).max())  # of the dominant pole
LONGEST, BLOCK = 44, 4  # samples: told delays lie from BLOCK to LONGEST - BLOCK
VALIDATION_PLANTS, VALIDATION_SAMPLES, VALIDATION_SEED = 64, 600, 3_000_000
SAVED_EVERY = 50  # steps; a training takes minutes
# Kinds of validation plants, with the ranges drawn from: low, high, and the power of `small`.
KINDS: dict[str, dict[str, tuple[float, float, int]]] = {
    "calm": {},
    "noise": {"noise_variance": (0.1, 1.0, 2)},
    "load": {"disturbance_amplitude": (0.5, 2.5, 1)},
    "boiler": {
        "noise_variance": (0.3, 0.7, 2),
        "measurement_noise_variance": (0.05, 0.15, 2),
        "disturbance_amplitude": (1.0, 2.5, 1),
        "disturbance_walk_variance": (2e-4, 8e-4, 2),
    },
    "drift": {
        "noise_variance": (0.1, 1.0, 2),
        "gain_drift": (0.6, 1.6, 0),
        "time_constant_drift": (0.6, 1.6, 0),
    },
}

Numbers = dict[str, Tensor]


@dataclass(frozen=True)
class Training:
    """Everything that shapes the network, except versions and code."""

    seed: int = 10_000
    """Seed of the initial weights, the plants and their episodes."""
    steps: int = 600
    """Steps of the optimiser."""
    plants: int = 256
    """Plants per step."""
    samples: int = 300
    """Samples that a step runs and differentiates through."""
    stretches: int = 4
    """Steps on the same plants before new ones are drawn."""
    choosing: int = 64
    """Nodes of each hidden layer in the network that chooses."""
    adding: int = 24
    """Nodes of each hidden layer in the network that adds to the flow."""
    learning_rate: float = 2e-3
    """Initial learning rate of Adam; it falls linearly to a hundredth."""
    move_price: float = 0.007
    """Price of valve travel by half the range per sample, as a multiple of the reach."""
    tolerance: float = 0.003
    """Error below which the loss is quadratic (Huber), as a share of the reach."""
    spread: float = 0.4
    """Largest uncertainty of the told numbers."""
    averaging: float = 0.98
    """Factor of the exponential mean of the weights over past steps; the mean is kept."""


class Net(nn.Module):
    """The two networks of the law, in PyTorch."""

    def __init__(self, training: Training) -> None:
        super().__init__()

        def layers(hidden: int, outputs: int) -> nn.Sequential:
            return nn.Sequential(
                nn.Linear(INPUTS, hidden), nn.SiLU(), nn.Linear(hidden, hidden), nn.SiLU(),
                nn.Linear(hidden, outputs),
            )  # fmt: skip

        self.choosing = layers(training.choosing, OUTPUTS)
        self.adding = layers(training.adding, 1)
        with torch.no_grad():
            for last in (cast("nn.Linear", part[-1]) for part in (self.choosing, self.adding)):
                last.weight.mul_(0.1)
                last.bias.zero_()

    def forward(self, seen: Tensor, at_rest: Tensor) -> tuple[Tensor, Tensor]:
        """Return the outputs and the addition; see `agents.neural_law.Network`."""
        added = torch.tanh(self.adding(torch.cat([seen, at_rest])))[:, 0]
        n = len(seen)
        return self.choosing(seen), MOST_ADDED * (added[:n] - added[n:])

    def export(self, **provenance: Any) -> LawNetwork:
        """Return the networks in NumPy."""
        parts = [
            [
                (layer.weight.detach().double().numpy(), layer.bias.detach().double().numpy())
                for layer in part
                if isinstance(layer, nn.Linear)
            ]
            for part in (self.choosing, self.adding)
        ]
        return LawNetwork(parts[0], parts[1], provenance)


class Draw:
    """Random draws of a batch of plants, their set points and their told numbers."""

    def __init__(self, training: Training, n: int, samples: int, *seed: int) -> None:
        self._n, self._samples, self._spread = n, samples, training.spread
        self._generator = torch.Generator()
        # Hashed, so that neighbouring seeds give unrelated draws.
        state = np.random.SeedSequence(seed).generate_state(1, np.uint64)[0]
        self._generator.manual_seed(int(state >> np.uint64(1)))

    def uniform(self, low: Any, high: Any, *shape: int) -> Tensor:
        """Draw uniformly, with shape (n,) by default."""
        drawn = torch.rand(*(shape or (self._n,)), generator=self._generator)
        values: Tensor = low + drawn * (high - low)
        return values

    def some(self, share: float, low: float, high: float) -> Tensor:
        """Draw uniformly for a share of the plants, and return 0 for the others."""
        return self.uniform(low, high) * (self.uniform(0.0, 1.0) < share)

    def plants(self) -> Numbers:
        """Draw the numbers of the plants for `MiddlePointTorchEnv`, and `small`.

        `small` is a factor of set point, dead zone, noise and load: the same problem within a
        fraction of the plant's reach.
        """
        one = torch.ones(self._n)
        gain, constant = (
            torch.exp(self.uniform(math.log(low), math.log(high)))
            for low, high in ((0.7, 1.7), (0.45, 2.2))
        )
        skewed = self.uniform(0.0, 1.0) < 0.25
        u_min = torch.where(skewed, -self.uniform(8.5, 13.0), -10.0 * one)
        u_max = torch.where(skewed, self.uniform(8.5, 13.0), 10.0 * one)
        small = torch.where(self.uniform(0.0, 1.0) < 0.25, self.uniform(0.1, 0.6), one)
        kind = self.uniform(0.0, 1.0)  # calm, load alone, or everything
        loaded, noisy = small * (kind > 0.15), small**2 * (kind > 0.35)
        drifts = self.uniform(0.0, 1.0) < 0.2
        numbers = {
            "gain_factor": gain,
            "time_constant_factor": constant,
            "delay": self.uniform(6.0, 37.0).floor(),
            "dead_zone": self.some(0.9, 0.0, 8.0) * small,
            "u_min": u_min,
            "u_max": u_max,
            "noise_variance": self.some(0.85, 0.0, 1.0) * noisy,
            "measurement_noise_variance": self.some(0.5, 0.0, 0.2) * noisy,
            "disturbance_amplitude": self.some(0.45, 0.0, 2.5) * loaded,
            "disturbance_interval": self.uniform(100.0, 300.0),
            "disturbance_walk_variance": self.some(0.4, 0.0, 0.001) * noisy,
            "small": small,
        }
        for name in ("gain_drift", "time_constant_drift"):
            numbers[name] = torch.where(drifts, self.uniform(0.75, 1.33), one)
        numbers["setpoint"] = self.levels(numbers)
        return numbers

    def levels(self, numbers: Numbers) -> Tensor:
        """Draw set points for k = 0 to `samples`: levels held for a while, or a square wave."""
        n, age = self._n, torch.arange(self._samples + 1)[:, None]
        room = torch.minimum(-numbers["u_min"], numbers["u_max"]) * GAIN
        most = (room * numbers["gain_factor"] * numbers["small"]).clamp(max=6.5)
        size = (0.3 + 0.65 * self.uniform(0.0, 1.0, self._samples // 60 + 2, n)) * most
        sign = torch.sign(self.uniform(-1.0, 1.0, *size.shape))
        begun, length = self.uniform(0.0, 150.0).floor(), self.uniform(60.0, 300.0).floor()
        held = (size * sign).gather(
            0, ((age + begun) // length).long().clamp(max=len(size) - 1)
        )
        phase = self.uniform(0.0, 600.0).floor()
        square = torch.where((age + phase) // 300 % 2 == 0, size[0], -size[0])
        return torch.where(self.uniform(0.0, 1.0) < 0.5, square, held)

    def told(self, numbers: Numbers, *, exact: bool = False) -> Numbers:
        """Draw the told numbers: first-order models for 60 % of the plants, some wrong."""
        told = {name: numbers[name] for name in ("u_min", "u_max", "dead_zone")}
        told["first"] = self.uniform(0.0, 1.0) < 0.6
        k = self.some(0.0 if exact else 0.5, 0.0, self._spread)
        # Some numbers are out of date, which their uncertainty does not show.
        aged = self.some(0.0 if exact else 0.1, 0.0, 0.3)
        wrong = torch.randn(3, self._n, generator=self._generator) * k
        wrong[:2] += self.uniform(-1.5, 1.5, 2, self._n) * aged
        told["uncertainty"] = k
        told["gain_factor"] = numbers["gain_factor"] * torch.exp(wrong[0])
        constant = numbers["time_constant_factor"] * torch.exp(1.5 * wrong[1])
        told["time_constant_factor"] = constant.clamp(0.3, 3.3)
        delay = numbers["delay"] + (20.0 * wrong[2]).round()
        told["delay"] = delay.clamp(BLOCK, LONGEST - BLOCK)
        return told


def environment(
    n: int, samples: int, dtype: torch.dtype = torch.float32
) -> MiddlePointTorchEnv:
    """Return plants that take all numbers that differ between them as signals at each reset."""
    return MiddlePointTorchEnv(
        n,
        max_episode_steps=samples,
        dtype=dtype,
        differentiable=True,
        setpoint_window=1,
        error_window=0,
        output_window=1,
        action_window=0,
        drift_samples=1200,
        delay=(4, 60),
        dead_zone=(0.0, 8.5),
        gain_factor=(0.3, 3.0),
        time_constant_factor=(0.2, 5.0),
        gain_drift=(0.3, 3.0),
        time_constant_drift=(0.3, 3.0),
        noise_variance=(0.0, 1.0),
        measurement_noise_variance=(0.0, 0.2),
        disturbance_amplitude=(0.0, 3.0),
        disturbance_interval=(50.0, 400.0),
        disturbance_walk_variance=(0.0, 0.001),
        u_min=(-14.0, -8.5),
        u_max=(8.5, 14.0),
    )


class Loops:
    """A batch of plants controlled by the network, starting from rest.

    The law and the told models are those of `NeuralSmithPredictor`.
    """

    def __init__(
        self, plants: MiddlePointTorchEnv, numbers: Numbers, told: Numbers, seed: int
    ) -> None:
        gain, constant = told["gain_factor"], told["time_constant_factor"]
        low, high, first = told["u_min"], told["u_max"], told["first"]
        self._plants, self._first = plants, first
        self._low, self._half = low, (high - low) / 2.0
        self._reach = gain * GAIN * self._half
        alpha, _, unit = DYNAMICS.coefficients(gain, constant)
        pole, zero = 1.0 - RATE / constant, torch.zeros_like(gain)
        unit = torch.where(first, 1.0 - pole, unit)
        self._alpha = torch.where(first, pole, alpha[0]), torch.where(first, zero, alpha[1])
        newer, older = (unit * (b / sum(NOMINAL.b)) for b in NOMINAL.b)
        self._beta = torch.where(first, unit, newer), torch.where(first, zero, older)
        self._delay = told["delay"].long()
        self._law = Law(
            Prior(
                unit=unit,
                fading=pole ** (told["delay"] + 1.0 + 0.5 * first),
                time_constant=constant,
                delay=told["delay"],
                dead_zone=told["dead_zone"] / self._half,
                centre=-(high + low) / (high - low),
                uncertainty=told["uncertainty"],
            ),
            torch,
            Tensor.detach,
        )
        self._before = torch.zeros(LONGEST + BLOCK, len(gain))  # the model's outputs
        self._new: list[Tensor] = []
        self._model = self._last_model = self._flow = self._last_flow = zero
        self._residual = self._last_residual = self._off = zero
        signals = {name: values for name, values in numbers.items() if name != "small"}
        self._observations, _ = plants.reset(seed=seed, options={"signals": signals})

    def run(self, net: Net, samples: int) -> tuple[Tensor, Tensor]:
        """Continue; return e(k + 1) as multiples of the reach, u_a(k) of half the range.

        Both have the shape (samples, n). Gradients do not reach back beyond this call.
        """
        self._plants.detach()
        for owner in (self, self._law):
            for name, value in vars(owner).items():
                if isinstance(value, Tensor):
                    setattr(owner, name, value.detach())
        self._new = [each.detach() for each in self._new]
        errors, applied = [], []
        for _ in range(samples):
            self._observations, _, _, _, infos = self._plants.step(self._act(net))
            errors.append(infos["error"])
            applied.append(infos["applied"])
        return torch.stack(errors) / self._reach, torch.stack(applied) / self._half

    def _act(self, net: Net) -> Tensor:
        """Return actions, shape (n, 1)."""
        setpoint, output = (self._observations / self._reach[:, None]).unbind(1)
        k = len(self._new) % BLOCK
        if k == 0:  # looked up a block at a time, which is cheaper
            if self._new:
                self._before = torch.cat([self._before[BLOCK:], torch.stack(self._new)])
                self._new = []
            rows = len(self._before) - self._delay + torch.arange(BLOCK)[:, None]
            self._delayed = self._before.gather(0, rows).unbind()
        off = output - self._delayed[k]
        residual = torch.where(self._first, (off + self._off) / 2.0, off)
        self._off = off
        load = residual - self._alpha[0] * self._residual - self._alpha[1] * self._last_residual
        self._residual, self._last_residual = residual, self._residual
        state = self._model, self._last_model, self._flow
        wanted, passed = self._law.applied(self._law.flow(net, setpoint, residual, load, state))
        self._new.append(self._model)
        self._flow, self._last_flow = passed, self._flow
        new = self._alpha[0] * self._model + self._alpha[1] * self._last_model
        new = new + self._beta[0] * self._flow + self._beta[1] * self._last_flow
        self._model, self._last_model = new, self._model
        # The plant's gain is negative.
        action: Tensor = (-wanted * self._half - self._low) / self._half - 1.0
        return action[:, None]


def loss_of(errors: Tensor, applied: Tensor, small: Tensor, training: Training) -> Tensor:
    """Return the mean over the plants of the logarithm of error plus price of moves."""
    tolerance = training.tolerance * small
    size = errors.abs()
    huber = torch.where(size < tolerance, size**2 / (2.0 * tolerance), size - tolerance / 2.0)
    moves = applied.diff(dim=0).abs().mean(0)
    return (huber.mean(0) + training.move_price * moves).clamp(min=tolerance).log().mean()


def validate(net: Net, training: Training) -> dict[str, float]:
    """Return the mean logarithm of the mean |e|, and the travel, for each kind of plants.

    These plants do not occur in training. Their told numbers are exact.
    """
    plants = environment(VALIDATION_PLANTS, VALIDATION_SAMPLES)
    found = {}
    for i, (kind, drawn) in enumerate(KINDS.items()):
        draw = Draw(training, VALIDATION_PLANTS, VALIDATION_SAMPLES, VALIDATION_SEED, i)
        numbers = draw.plants()
        for name in numbers:
            if "disturbance" in name or "noise" in name:
                numbers[name] = torch.zeros(VALIDATION_PLANTS)
            if name.endswith("_drift"):
                numbers[name] = torch.ones(VALIDATION_PLANTS)
        numbers["disturbance_interval"] = torch.full((VALIDATION_PLANTS,), 200.0)
        for name, (low, high, power) in drawn.items():
            numbers[name] = draw.uniform(low, high) * numbers["small"] ** power
        told = draw.told(numbers, exact=True)
        with torch.no_grad():
            loops = Loops(plants, numbers, told, VALIDATION_SEED)
            errors, applied = loops.run(net, VALIDATION_SAMPLES)
        each, first = errors.abs().mean(0).log(), told["first"]
        found[kind] = float(each.mean())
        found[f"{kind} 1"] = float(each[first].mean())  # told a first-order model
        found[f"{kind} 2"] = float(each[~first].mean())
        found[f"{kind}, travel"] = 10.0 * float(applied.diff(dim=0).abs().mean())
    return found


def train(training: Training, state: Path | None = None, source: str = "") -> LawNetwork:
    """Train, and return the network.

    Parameters
    ----------
    training
        Arguments of the training.
    state
        File that stores the progress; the training resumes from it if it exists.
    source
        Commit of the code that runs, for the provenance.
    """
    torch.set_num_threads(1)  # the network is too small for more
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(training.seed)
        net = Net(training)
    mean, optimiser = copy.deepcopy(net), torch.optim.Adam(net.parameters())
    done, seconds = 0, 0.0
    parts: dict[str, Any] = {"net": net, "mean": mean, "optimiser": optimiser}
    if state is not None and state.exists():
        kept = torch.load(state, weights_only=True)
        for name, part in parts.items():
            part.load_state_dict(kept[name])
        done, seconds = kept["done"], kept["seconds"]
    plants = environment(training.plants, training.stretches * training.samples)
    for step in range(done, training.steps, training.stretches):
        began = time.process_time()
        _advance(net, mean, optimiser, plants, training, step)
        seconds += time.process_time() - began
        done = step + training.stretches
        if state is not None and done % SAVED_EVERY < training.stretches:
            kept = {name: part.state_dict() for name, part in parts.items()}
            with replacing(state) as file:
                torch.save({**kept, "done": done, "seconds": seconds}, file)
    return mean.export(
        training=asdict(training),
        validation={"seed": VALIDATION_SEED, **validate(mean, training)},
        cpu_seconds=round(seconds, 1),
        code=training_key(training),
        versions=versions(),
        commit=source,
    )


def _advance(
    net: Net,
    mean: Net,
    optimiser: torch.optim.Adam,
    plants: MiddlePointTorchEnv,
    training: Training,
    step: int,
) -> None:
    """Take up to `stretches` steps of the optimiser on new plants."""
    length = training.stretches * training.samples
    draw = Draw(training, training.plants, length, training.seed, step)
    numbers = draw.plants()
    loops = Loops(plants, numbers, draw.told(numbers), step)
    for now in range(step, min(step + training.stretches, training.steps)):
        left = max(1.0 - now / training.steps, 0.01)
        optimiser.param_groups[0]["lr"] = training.learning_rate * left
        errors, applied = loops.run(net, training.samples)
        loss = loss_of(errors, applied, numbers["small"], training)
        optimiser.zero_grad()
        loss.backward()
        if math.isfinite(nn.utils.clip_grad_norm_(net.parameters(), 1.0)):
            optimiser.step()
        # At first the mean forgets faster, so that the initial weights have no influence.
        share = 1.0 - min(training.averaging, (now + 1) / (now + 11))
        with torch.no_grad():
            for slow, new in zip(mean.parameters(), net.parameters(), strict=True):
                slow.lerp_(new, share)


def training_key(training: Training) -> str:
    """Return a fingerprint of all that shapes a network: arguments, versions and code."""
    return fingerprint(__name__, training=asdict(training))
