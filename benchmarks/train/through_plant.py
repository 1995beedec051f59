"""Train the network of `nn-smith` by the gradient through plants of all kinds.

The error of a whole run is differentiated with respect to the weights, back through plant,
actuator and law. The literature calls this differentiable predictive control (J. Drgona et al.,
"Differentiable predictive control: deep learning alternative to explicit model predictive
control for unknown nonlinear systems", Journal of Process Control 116, 2022, 80-92).
"""

import copy
import math
import statistics
import time
from dataclasses import asdict, dataclass, replace
from typing import Any, cast

import torch
from torch import Tensor, nn

from agents.neural_law import INPUTS, MOST_ADDED, OUTPUTS, LawNetwork
from benchmarks.lib.provenance import versions
from benchmarks.lib.seeds import SEEDS
from benchmarks.train.loops import Draw, Loops, environment

load = LawNetwork.load
VALIDATION_PLANTS, VALIDATION_SAMPLES = 64, 600
VALIDATION_SEED = SEEDS["preparation"].first
# Kinds of validation plants, with the ranges drawn from: low, high, and the power of `small`.
# They do not occur in training, and their models are exact.
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


@dataclass(frozen=True)
class Training:
    """Everything that shapes the network, except versions and code."""

    seed: int = 10_000  # of the initial weights, the plants and their episodes
    steps: int = 600  # of the optimiser
    plants: int = 256  # of a step
    samples: int = 300  # that a step runs and differentiates through
    stretches: int = 4  # steps on the same plants before new ones are drawn
    choosing: int = 64  # nodes of each hidden layer in the network that chooses
    adding: int = 24  # and in the network that adds to the flow
    learning_rate: float = 2e-3  # of Adam at first; it falls linearly to a hundredth
    move_price: float = 0.007  # of travel by half the range a sample, of the authority
    tolerance: float = 0.003  # error below which the loss is quadratic, of the authority
    spread: float = 0.4  # largest uncertainty of the nominal models
    averaging: float = 0.98  # factor of the exponential mean of the weights, which is kept


RECIPES = {"nn-smith": Training()}  # as published


class Net(nn.Module):
    """The two networks of the law, in PyTorch."""

    def __init__(self, training: Training) -> None:
        super().__init__()

        def layers(hidden: int, outputs: int) -> nn.Sequential:
            first, second = nn.Linear(INPUTS, hidden), nn.Linear(hidden, hidden)
            return nn.Sequential(
                first, nn.SiLU(), second, nn.SiLU(), nn.Linear(hidden, outputs)
            )

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

        def arrays(part: Any) -> Any:
            layers = part[::2]  # without the activations
            return [
                (each.weight.detach().numpy(), each.bias.detach().numpy()) for each in layers
            ]

        return LawNetwork(arrays(self.choosing), arrays(self.adding), provenance)


def loss_of(errors: Tensor, applied: Tensor, small: Tensor, training: Training) -> Tensor:
    """Return the mean over the plants of the logarithm of error plus price of moves."""
    tolerance = training.tolerance * small
    size = errors.abs()
    huber = torch.where(size < tolerance, size**2 / (2.0 * tolerance), size - tolerance / 2.0)
    moves = applied.diff(dim=0).abs().mean(0)
    return (huber.mean(0) + training.move_price * moves).clamp(min=tolerance).log().mean()


def validate(net: Net, training: Training) -> dict[str, float]:
    """Return the geometric mean of |e|, of the authority, for each of `KINDS` and for all."""
    n, samples = VALIDATION_PLANTS, VALIDATION_SAMPLES
    plants, found = environment(n, samples), {}
    for i, (kind, drawn) in enumerate(KINDS.items()):
        draw = Draw(n, samples, training.spread, VALIDATION_SEED, i)
        numbers = draw.plants()
        for name in numbers:
            if any(each in name for each in ("disturbance", "noise", "drift")):
                numbers[name] = torch.full((n,), float("drift" in name))
        numbers["disturbance_interval"] = torch.full((n,), 200.0)
        for name, (low, high, power) in drawn.items():
            numbers[name] = draw.uniform(low, high) * numbers["small"] ** power
        models = draw.models(numbers, exact=True)
        with torch.no_grad():
            errors, _ = Loops(plants, numbers, models, VALIDATION_SEED).run(net, samples)
        found[kind] = float(errors.abs().mean(0).log().mean().exp())
    return {**found, "all": statistics.geometric_mean(found.values())}


def train(training: Training, seed: int) -> LawNetwork:
    """Train and return the network."""
    training = replace(training, seed=seed)
    torch.set_num_threads(1)  # the network is too small for more
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        net = Net(training)
    mean, optimiser = copy.deepcopy(net), torch.optim.Adam(net.parameters())
    began = time.process_time()
    length = training.stretches * training.samples
    plants = environment(training.plants, length)
    for step in range(training.steps):
        if step % training.stretches == 0:
            draw = Draw(training.plants, length, training.spread, seed, step)
            numbers = draw.plants()
            loops = Loops(plants, numbers, draw.models(numbers), step)
        left = max(1.0 - step / training.steps, 0.01)
        optimiser.param_groups[0]["lr"] = training.learning_rate * left
        loss = loss_of(*loops.run(net, training.samples), numbers["small"], training)
        optimiser.zero_grad()
        loss.backward()
        if math.isfinite(nn.utils.clip_grad_norm_(net.parameters(), 1.0)):
            optimiser.step()
        # At first the mean forgets faster, so that the initial weights have no influence.
        share = 1.0 - min(training.averaging, (step + 1) / (step + 11))
        with torch.no_grad():
            for slow, new in zip(mean.parameters(), net.parameters(), strict=True):
                slow.lerp_(new, share)
    seconds = time.process_time() - began
    return mean.export(
        training=asdict(training),
        validation=validate(mean, training),
        cpu_seconds=round(seconds, 1),
        versions=versions(),
    )
