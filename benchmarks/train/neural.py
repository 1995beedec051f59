"""Train the network of the self-tuning law by the gradient through random plants.

The error of a run is differentiated with respect to the weights, back through plant, actuator
and law. The literature calls this differentiable predictive control (J. Drgona et al.,
"Differentiable predictive control: deep learning alternative to explicit model predictive
control for unknown nonlinear systems", Journal of Process Control 116, 2022, 80-92).

Two things make it quick. Only what depends on the flows has a gradient: the bank of models and
all that it learns are NumPy, and constant to the optimiser. And the loss is an expectation: the
error at k depends on commands up to k - d - 1, so noise and changes of the set point after
these samples are averaged by formula, instead of by chance.
"""

import copy
import math
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from agents import NeuralSelfTuningController, RecurrentNetwork
from agents.bank import FAST_POLE, Bank
from agents.law import INPUTS, OUTPUTS, Law, Observer
from benchmarks.controllers.roster import with_bank
from benchmarks.controllers.spec import BANK, knowledge
from benchmarks.lib.provenance import versions
from benchmarks.train.plants import HOLDS, PAPER, POLE, SAMPLES, Batch, Sampler, environment
from mptc_gym import IDS, PRESETS, Parameters, evaluate
from mptc_gym.evaluation import VALIDATION_SEED
from mptc_gym.torch_env import MiddlePointTorchEnv

load = RecurrentNetwork.load
LEAST_NOISE = 0.05  # degC; below it the expected error is rounded at 0, where |e| has a kink


@dataclass(frozen=True)
class Training:
    """Everything that shapes the network, except versions and code."""

    steps: int = 1000  # of the optimiser
    plants: int = 128  # of a step
    segment: int = 100  # samples that a step runs and differentiates through
    hard_share: float = 0.6  # of the plants that are like those of `hard`
    nodes: int = 32  # of the recurrent unit
    hidden: int = 24  # nodes of the layer behind it
    learning_rate: float = 0.005  # of Adam at first; it falls linearly to a fiftieth
    largest_gradient: float = 0.3  # norm to which gradients are clipped
    averaging: float = 0.99  # factor of the running mean of the weights, which is kept
    validation_episodes: int = 200


RECIPES = {"neural": Training()}  # as published


class Net(nn.Module):
    """The network of `agents.RecurrentNetwork` in PyTorch, with the state of n loops."""

    def __init__(self, nodes: int, hidden: int) -> None:
        super().__init__()
        self.cell = nn.GRUCell(INPUTS, nodes)
        self.hidden = nn.Linear(INPUTS + nodes, hidden)
        self.output = nn.Linear(hidden + INPUTS, OUTPUTS)
        with torch.no_grad():  # so that the law is nearly linear at first
            self.output.weight.mul_(0.1)
            self.output.bias.zero_()
        self.state = torch.zeros(0, nodes)

    def begin(self, n: int) -> None:
        """Forget the loops, and begin with n at rest."""
        self.state = torch.zeros(n, self.cell.hidden_size)

    def forward(self, inputs: Tensor) -> Tensor:
        """Return corrections of the law, shape (n, OUTPUTS), for inputs, (n, INPUTS)."""
        self.state = self.cell(inputs, self.state)
        hidden = nn.functional.silu(self.hidden(torch.cat([inputs, self.state], dim=1)))
        corrections: Tensor = self.output(torch.cat([hidden, inputs], dim=1))
        return corrections

    def export(self, **provenance: Any) -> RecurrentNetwork:
        """Return the network in NumPy."""
        names = {
            "input": (self.cell.weight_ih, self.cell.bias_ih),
            "state": (self.cell.weight_hh, self.cell.bias_hh),
            "hidden": (self.hidden.weight, self.hidden.bias),
            "output": (self.output.weight, self.output.bias),
        }
        arrays = {}
        for name, (weights, biases) in names.items():
            arrays[f"{name}_weights"] = weights.detach().numpy()
            arrays[f"{name}_biases"] = biases.detach().numpy()
        return RecurrentNetwork(**arrays, provenance=provenance)


class Loops:
    """Plants under the law, from rest, in segments that gradients do not leave."""

    def __init__(self, plants: MiddlePointTorchEnv, batch: Batch, net: Net, seed: int) -> None:
        self._plants = plants
        self._net = net
        self._authorities = batch.authorities
        self._bank = Bank(batch.prior)
        one = np.ones_like(batch.edges)
        self._observer = Observer(self._bank, batch.edges, (-one, one), batch.random_setpoint)
        self._law = Law(self._bank, batch.edges, (-one, one), torch, torch.from_numpy)
        net.begin(self._bank.n)
        options = {"signals": batch.signals}
        self._observations, self._infos = plants.reset(seed=seed, options=options)

    def run(self, samples: int) -> tuple[Tensor, Tensor]:
        """Return true outputs, degC, shape (samples, n), and time-constant factors, (n,)."""
        self._plants.detach()
        self._law.detach()
        self._net.state = self._net.state.detach()
        outputs = []
        for _ in range(samples):
            seen = self._observations.detach().numpy() / self._authorities[:, np.newaxis]
            situation = self._observer.observe(seen[:, 0], seen[:, 1])
            flow = self._law.flow(situation, self._net)
            self._bank.apply(flow.detach().numpy())
            # The plant's gain is negative, and its limits are symmetric.
            self._observations, *_, self._infos = self._plants.step(-flow[:, None])
            outputs.append(self._infos["output"])
        return torch.stack(outputs), self._infos["time_constant_factor"].detach()


def noise_response(time_constant_factors: Tensor, samples: int) -> Tensor:
    """Return the response of n(k) in (28) to xi, C / A, shape (samples, n)."""
    pole = 1.0 - (1.0 - POLE) / time_constant_factors
    response: list[Tensor] = []
    for lag in range(samples):
        value = torch.zeros_like(pole)
        if lag < len(PAPER.c):
            value = value + PAPER.c[lag]
        if lag >= 1:
            value = value + (pole + FAST_POLE) * response[lag - 1]
        if lag >= 2:
            value = value - pole * FAST_POLE * response[lag - 2]
        response.append(value)
    return torch.stack(response)


def chance_of_change(ages: Tensor, samples: Tensor) -> Tensor:
    """Return the probability that a random set point changes within the next samples."""
    shortest, longest = HOLDS
    earliest = ages.clamp(min=shortest - 1.0)
    possible = (longest - earliest).clamp(min=1.0)  # lengths, of which these end the level:
    ending = (ages + samples).clamp(max=longest) - earliest
    return (ending / possible).clamp(0.0, 1.0)


def mean_distance(distances: Tensor, deviations: Tensor) -> Tensor:
    """Return the mean of |x + z| for normal z with these standard deviations."""
    ratios = distances / deviations
    density = math.sqrt(2.0 / math.pi) * torch.exp(-0.5 * ratios.square())
    return deviations * density + distances * torch.erf(ratios / math.sqrt(2.0))


def expected_error(
    outputs: Tensor, batch: Batch, time_constant_factors: Tensor, first: int
) -> Tensor:
    """Return the mean of |e(k)| that was to be expected when its commands were chosen, degC.

    `outputs`, shape (samples, n), are those from k = `first` on. The last command that reaches
    y(k) is that of k - d - 1. Since then xi has added normal noise to y(k), which is taken out
    again, and the set point may have changed to a level that is uniform in its range.
    """
    samples, n = outputs.shape
    delays = batch.numbers["delay"]
    longest = int(delays.max()) + 1
    response = noise_response(time_constant_factors, longest)
    response = response * (torch.arange(longest)[:, None] <= delays)
    innovations = torch.cat([torch.zeros(longest, n), batch.innovations])
    innovations = innovations[first + 1 : first + samples + longest]
    kernels = response.flip(0).T[:, None].contiguous()
    noise = nn.functional.conv1d(innovations.T[None], kernels, groups=n)[0].T
    variances = batch.numbers["noise_variance"] * response.square().sum(0)
    deviations = variances.sqrt().clamp(min=LEAST_NOISE)

    expected = outputs - noise
    chosen = torch.arange(first, first + samples)[:, None] - delays.long() - 1
    counts = chosen >= 0
    chosen = chosen.clamp(min=0)
    kept = mean_distance(batch.setpoints.gather(0, chosen) - expected, deviations)
    amplitudes = batch.amplitudes
    changed = amplitudes.square() + expected.square() + deviations.square()
    changed = changed / (2.0 * amplitudes)
    chance = chance_of_change(batch.ages.gather(0, chosen), delays + 1.0)
    chance = chance * batch.changes_by_surprise
    errors = (1.0 - chance) * kept + chance * changed
    return (errors * counts).sum() / counts.sum().clamp(min=1)


def validate(network: RecurrentNetwork, episodes: int) -> dict[str, float]:
    """Return mean error, degC, and valve travel, t/h, on validation episodes of `hard`."""
    plant = Parameters(**PRESETS["hard"])
    known = knowledge(BANK, plant, episodes, VALIDATION_SEED)
    controller = with_bank(NeuralSelfTuningController, network=network, **known)
    result = evaluate(controller, IDS["hard"], episodes=episodes, seed=VALIDATION_SEED)
    return {"mean_error": result.mean_error, "travel": result.travel}


def train(
    training: Training, seed: int, watch: Callable[[int, Net], object] | None = None
) -> RecurrentNetwork:
    """Train and return the network; `watch` gets each step and the mean of the weights."""
    torch.set_num_threads(1)  # the network is too small for more
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        net = Net(training.nodes, training.hidden)
    began = time.process_time()
    mean = optimise(training, net, seed, watch)
    seconds = time.process_time() - began
    return mean.export(
        seed=seed,
        training=asdict(training),
        validation=validate(mean.export(), training.validation_episodes),
        cpu_seconds=round(seconds, 1),
        versions=versions(),
    )


def optimise(
    training: Training,
    net: Net,
    seed: int,
    watch: Callable[[int, Net], object] | None = None,
) -> Net:
    """Train a network, and return the running mean of its weights."""
    mean = copy.deepcopy(net)
    optimiser = torch.optim.Adam(net.parameters())
    sampler = Sampler(training.plants, training.hard_share, seed)
    plants = environment(training.plants)
    segments = SAMPLES // training.segment
    for step in range(training.steps):
        if step % segments == 0:
            batch = sampler.batch()
            loops = Loops(plants, batch, net, seed * training.steps + step)
        outputs, factors = loops.run(training.segment)
        first = step % segments * training.segment + 1
        loss = expected_error(outputs, batch, factors, first)
        share = max(1.0 - step / training.steps, 0.02)
        optimiser.param_groups[0]["lr"] = training.learning_rate * share
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(net.parameters(), training.largest_gradient)
        optimiser.step()
        # In the first steps, the mean is that of all steps so far.
        new = max(1.0 - training.averaging, 1.0 / (step + 1.0))
        with torch.no_grad():
            for kept, value in zip(mean.parameters(), net.parameters(), strict=True):
                kept.lerp_(value, new)
        if watch is not None:
            watch(step + 1, mean)
    return mean
