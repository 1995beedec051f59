"""Train the network that corrects the self-tuning controller, by gradients through plants.

The control error is differentiated with respect to the network's weights, back through plant,
actuator and control law. The literature calls this training differentiable predictive control
(J. Drgona et al., "Differentiable predictive control: deep learning alternative to explicit
model predictive control for unknown nonlinear systems", Journal of Process Control 116, 2022,
80-92).

The training is fast for two reasons:

- Only the control law and the plant have gradients. The bank of models and its estimates are
  computed in NumPy, and count as constants.
- The loss is an expected error. The error at the sample k depends on commands up to the sample
  k - d - 1, where d is the plant's delay. The effects of later noise and of later changes of
  the set point are averaged by a formula, and not by random samples.
"""

import copy
import math
import time
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
from benchmarks.train.plants import (
    HOLD_TIMES,
    PAPER,
    POLE,
    SAMPLES,
    Batch,
    Sampler,
    environment,
)
from mptc_gym import IDS, PRESETS, Parameters, evaluate
from mptc_gym.evaluation import VALIDATION_SEED
from mptc_gym.torch_env import MiddlePointTorchEnv

load = RecurrentNetwork.load
# Least standard deviation of the noise in the expected error, degC. For plants with little
# noise, it rounds the kink of |e| at 0.
LEAST_NOISE = 0.05
LEAST_LEARNING_RATE = 0.02  # at the end of a training, as a share of the first learning rate


@dataclass(frozen=True)
class Training:
    """The settings of a training of the network."""

    steps: int = 1000  # number of steps of the optimiser
    plants: int = 128  # number of plants in each step
    segment: int = 100  # samples that a step simulates and differentiates through
    hard_share: float = 0.6  # share of the plants that are like those of the preset `hard`
    nodes: int = 32  # number of nodes of the recurrent unit
    hidden: int = 24  # number of nodes of the hidden layer after the recurrent unit
    learning_rate: float = 0.005  # of Adam at the first step; it falls linearly
    largest_gradient: float = 0.3  # norm to which the gradient of a step is clipped
    averaging: float = 0.99  # factor per step of the exponential mean of the weights
    validation_episodes: int = 200  # number of episodes of the validation


RECIPES = {"neural": Training()}  # the settings of the published networks


class Net(nn.Module):
    """The network of `agents.RecurrentNetwork` in PyTorch, with the state of n control loops.

    Parameters
    ----------
    nodes
        Number of nodes of the recurrent unit.
    hidden
        Number of nodes of the hidden layer.
    """

    def __init__(self, nodes: int, hidden: int) -> None:
        super().__init__()
        self.cell = nn.GRUCell(INPUTS, nodes)
        self.hidden = nn.Linear(INPUTS + nodes, hidden)
        self.output = nn.Linear(hidden + INPUTS, OUTPUTS)
        with torch.no_grad():  # small corrections, so that the law is nearly linear at first
            self.output.weight.mul_(0.1)
            self.output.bias.zero_()
        self.state = torch.zeros(0, nodes)

    def begin(self, n: int) -> None:
        """Set the state to 0 for n control loops at rest, before a new episode."""
        self.state = torch.zeros(n, self.cell.hidden_size)

    def forward(self, inputs: Tensor) -> Tensor:
        """Return the corrections of the control law at a sample, and update `state`.

        `inputs` are the inputs that `agents.law` computes, shape (n, INPUTS). The corrections
        have the shape (n, OUTPUTS).
        """
        self.state = self.cell(inputs, self.state)
        hidden = nn.functional.silu(self.hidden(torch.cat([inputs, self.state], dim=1)))
        corrections: Tensor = self.output(torch.cat([hidden, inputs], dim=1))
        return corrections

    def export(self, **provenance: Any) -> RecurrentNetwork:
        """Return a copy of the network in NumPy.

        `provenance` says how the network was trained, as values that JSON can store.
        """
        tensors = {
            "input_weights": self.cell.weight_ih,
            "input_biases": self.cell.bias_ih,
            "state_weights": self.cell.weight_hh,
            "state_biases": self.cell.bias_hh,
            "hidden_weights": self.hidden.weight,
            "hidden_biases": self.hidden.bias,
            "output_weights": self.output.weight,
            "output_biases": self.output.bias,
        }
        arrays = {name: tensor.detach().numpy() for name, tensor in tensors.items()}
        return RecurrentNetwork(**arrays, provenance=provenance)


class Loops:
    """A batch of plants under the control law, simulated from rest in segments of samples.

    An observation is the set point and the output, divided by the authority of the plant: the
    steady change of temperature, degC, that half the actuator's range causes.

    Parameters
    ----------
    plants
        The differentiable environment.
    batch
        Plant numbers, set points and noise of an episode, and what controllers know of plants.
    net
        The network that corrects the control law.
    seed
        Seed of the environment, for random numbers that `batch` does not contain.
    """

    def __init__(self, plants: MiddlePointTorchEnv, batch: Batch, net: Net, seed: int) -> None:
        self._plants = plants
        self._net = net
        self._authorities = batch.authorities
        self._bank = Bank(batch.prior)
        # Flows are shares of half the actuator's range, so the limits are -1 and 1.
        largest_flow = np.ones_like(batch.edges)
        limits = -largest_flow, largest_flow
        self._observer = Observer(self._bank, batch.edges, limits, batch.random_setpoint)
        self._law = Law(self._bank, batch.edges, limits, torch, torch.from_numpy)
        net.begin(self._bank.n)
        options = {"signals": batch.signals}
        self._observations, _ = plants.reset(seed=seed, options=options)

    def run(self, samples: int) -> tuple[Tensor, Tensor]:
        """Simulate the next segment of `samples` samples, through which gradients can flow.

        No gradient flows back into the segment before.

        Returns
        -------
        outputs : Tensor
            Outputs without noise of the transmitter, degC, shape (samples, n).
        time_constant_factors : Tensor
            Time constants at the end of the segment, as multiples of the paper's, shape (n,).
        """
        self._plants.detach()
        self._law.detach()
        self._net.state = self._net.state.detach()
        outputs = []
        for _ in range(samples):
            scaled = self._observations.detach().numpy() / self._authorities[:, np.newaxis]
            setpoints, measurements = scaled.T
            situation = self._observer.observe(setpoints, measurements)
            flows = self._law.flow(situation, self._net)  # from -1 to 1
            self._bank.apply(flows.detach().numpy())
            # The law is made for a positive gain. The gain of the plants is negative, and the
            # limits are symmetric.
            actions = -flows[:, None]
            self._observations, _, _, _, infos = self._plants.step(actions)
            outputs.append(infos["output"])
        return torch.stack(outputs), infos["time_constant_factor"].detach()


def noise_response(time_constant_factors: Tensor, samples: int) -> Tensor:
    """Return the impulse response of C / A, from the noise xi to the output.

    A and C are the polynomials of the plant, equation (28) of the paper.

    Parameters
    ----------
    time_constant_factors
        Time constants of n plants, as multiples of the paper's, shape (n,).
    samples
        Length of the impulse response.

    Returns
    -------
    Tensor
        Shape (samples, n).
    """
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
    """Return the probability that a random set point changes within the next samples.

    Parameters
    ----------
    ages
        Number of samples since the last change of the set point.
    samples
        Number of future samples, in a shape that broadcasts with the shape of `ages`.
    """
    shortest, longest = HOLD_TIMES
    # A hold time is longer than `passed`, and all longer hold times are equally probable.
    passed = ages.clamp(min=shortest - 1.0)
    possible_hold_times = (longest - passed).clamp(min=1.0)
    hold_times_that_end = (ages + samples).clamp(max=longest) - passed
    return (hold_times_that_end / possible_hold_times).clamp(0.0, 1.0)


def mean_distance(distances: Tensor, deviations: Tensor) -> Tensor:
    """Return the mean of |x + z| for numbers x and normal random numbers z with the mean 0.

    `distances` are the numbers x, and `deviations` the standard deviations of z. The shapes of
    both broadcast.
    """
    ratios = distances / deviations
    density = math.sqrt(2.0 / math.pi) * torch.exp(-0.5 * ratios.square())
    return deviations * density + distances * torch.erf(ratios / math.sqrt(2.0))


def filtered(innovations: Tensor, responses: Tensor) -> Tensor:
    """Return white noise after a filter of finite impulse response, shape (samples, n).

    Parameters
    ----------
    innovations
        The white noise of n plants, shape (samples + lags - 1, n). The first lags - 1 values
        are those before the first result.
    responses
        The impulse response for each plant, shape (lags, n).
    """
    # `conv1d` multiplies without reversing the kernel. Each plant is a group of its own.
    kernels = responses.flip(0).T[:, None].contiguous()
    n = innovations.shape[1]
    return nn.functional.conv1d(innovations.T[None], kernels, groups=n)[0].T


def expected_error(
    outputs: Tensor, batch: Batch, time_constant_factors: Tensor, first: int
) -> Tensor:
    """Return the loss: the mean over samples and plants of the expected |e(k)|, degC.

    The error e(k) is the set point minus the output y(k). The last command that affects y(k) is
    the command of the sample k - d - 1, where d is the plant's delay. The expectation is that
    of an observer at the sample k - d - 1. For the observer, the effect of later noise xi on
    y(k) has a normal distribution, and the set point may change later to a level that is
    uniformly distributed. Samples k up to d, which no command affects, do not count.

    Parameters
    ----------
    outputs
        The simulated outputs from k = `first` on, degC, shape (samples, n).
    batch
        Plant numbers, set points and noise of the episode.
    time_constant_factors
        Present time constants, as multiples of the paper's, shape (n,).
    first
        The sample k of the first output.
    """
    samples, n = outputs.shape
    delays = batch.numbers["delay"]
    lags = int(delays.max()) + 1
    responses = noise_response(time_constant_factors, lags)
    # Of each plant, only the d + 1 latest values of xi are later than the last command.
    responses = responses * (torch.arange(lags)[:, None] <= delays)
    innovations = torch.cat([torch.zeros(lags, n), batch.innovations])
    noise = filtered(innovations[first + 1 : first + samples + lags], responses)
    expected_outputs = outputs - noise
    variances = batch.numbers["noise_variance"] * responses.square().sum(0)
    deviations = variances.sqrt().clamp(min=LEAST_NOISE)

    # The sample of the last command that affects each output.
    decisions = torch.arange(first, first + samples)[:, None] - delays.long() - 1
    is_affected = decisions >= 0
    decisions = decisions.clamp(min=0)
    setpoints = batch.setpoints.gather(0, decisions)
    if_kept = mean_distance(setpoints - expected_outputs, deviations)
    # The mean distance of y from a uniform level in [-A, A] is (A^2 + y^2) / 2A.
    amplitudes = batch.amplitudes
    squares = amplitudes.square() + expected_outputs.square() + deviations.square()
    if_changed = squares / (2.0 * amplitudes)
    chances = chance_of_change(batch.ages.gather(0, decisions), delays + 1.0)
    chances = chances * batch.changes_by_surprise
    errors = (1.0 - chances) * if_kept + chances * if_changed
    # At the start of an episode, no command may affect any output yet.
    return (errors * is_affected).sum() / is_affected.sum().clamp(min=1)


def validate(network: RecurrentNetwork, episodes: int) -> dict[str, float]:
    """Return a network's "mean_error", degC, and "travel" (of the valve, t/h), in validation.

    The network corrects the self-tuning controller on `episodes` validation episodes of the
    environment `MiddlePointHard-v0`.
    """
    plant = Parameters(**PRESETS["hard"])
    known = knowledge(BANK, plant, episodes, VALIDATION_SEED)
    controller = with_bank(NeuralSelfTuningController, network=network, **known)
    result = evaluate(controller, IDS["hard"], episodes=episodes, seed=VALIDATION_SEED)
    return {"mean_error": result.mean_error, "travel": result.travel}


def train(training: Training, seed: int) -> RecurrentNetwork:
    """Train a network, and return the network with the results of its validation.

    Parameters
    ----------
    training
        The settings of the training.
    seed
        Seed of the initial weights, the plants, and their set points and noise.
    """
    torch.set_num_threads(1)  # the network is too small for more
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        net = Net(training.nodes, training.hidden)
    began = time.process_time()
    mean = optimise(training, net, seed)
    seconds = time.process_time() - began
    return mean.export(
        seed=seed,
        training=asdict(training),
        validation=validate(mean.export(), training.validation_episodes),
        cpu_seconds=round(seconds, 1),
        versions=versions(),
    )


def optimise(training: Training, net: Net, seed: int) -> Net:
    """Train a network in place, and return a network with the running mean of its weights.

    Parameters
    ----------
    training
        The settings of the training.
    net
        The untrained network.
    seed
        Seed of the plants, and of their set points and noise.
    """
    mean = copy.deepcopy(net)
    optimiser = torch.optim.Adam(net.parameters())
    sampler = Sampler(training.plants, training.hard_share, seed)
    plants = environment(training.plants)
    segments = SAMPLES // training.segment  # of an episode
    for step in range(training.steps):
        segment = step % segments
        if segment == 0:  # A new episode begins.
            batch = sampler.batch()
            loops = Loops(plants, batch, net, seed * training.steps + step)
        outputs, time_constant_factors = loops.run(training.segment)
        first = segment * training.segment + 1
        loss = expected_error(outputs, batch, time_constant_factors, first)
        remaining = max(1.0 - step / training.steps, LEAST_LEARNING_RATE)
        optimiser.param_groups[0]["lr"] = training.learning_rate * remaining
        optimiser.zero_grad()
        loss.backward()
        nn.utils.clip_grad_norm_(net.parameters(), training.largest_gradient)
        optimiser.step()
        # In the first steps, the mean of all steps so far takes the place of the running mean.
        share = max(1.0 - training.averaging, 1.0 / (step + 1.0))
        with torch.no_grad():
            for weights, new_weights in zip(mean.parameters(), net.parameters(), strict=True):
                weights.lerp_(new_weights, share)
    return mean
