"""Train the network that corrects the self-tuning controller, by gradients through plants.

The gradient of the control error with respect to the network's weights is computed by
backpropagation through the plant, the actuator and the control law. The literature calls such a
training differentiable predictive control (Drgona et al., "Differentiable predictive control:
deep learning alternative to explicit model predictive control for unknown nonlinear systems",
Journal of Process Control 116, 2022, 80-92).

The training is fast, because the estimates of the plants' parameters are computed in NumPy,
without gradients, and because the loss is an expected control error: a formula averages over
the noise and the set-point changes that come after the last command that affects an output.
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
# Least standard deviation of the noise in the expected error, degC. This limit rounds the kink
# of |e| at 0 for plants with little noise.
LEAST_NOISE = 0.05
LEAST_LEARNING_RATE = 0.02  # at the end of a training, as a share of the first learning rate


@dataclass(frozen=True)
class Training:
    """Settings for the training of a recurrent network."""

    steps: int = 1000  # number of steps of the optimiser
    plants: int = 128  # number of plants in each step
    segment: int = 100  # samples that a step simulates and differentiates through
    hard_share: float = 0.6  # share of the plants that are like those of the preset `hard`
    nodes: int = 32  # number of nodes of the recurrent unit
    hidden: int = 24  # number of nodes of the hidden layer after the recurrent unit
    learning_rate: float = 0.005  # learning rate of Adam at the first step; falls linearly
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
        # Small corrections at first: nearly the control law without a network.
        with torch.no_grad():
            self.output.weight.mul_(0.1)
            self.output.bias.zero_()
        self.state = torch.zeros(0, nodes)

    def begin(self, n: int) -> None:
        """Set the network's state to 0 for n control loops, before a new episode."""
        self.state = torch.zeros(n, self.cell.hidden_size)

    def forward(self, inputs: Tensor) -> Tensor:
        """Return the corrections of the control law, shape (n, OUTPUTS), and update `state`.

        `inputs` are the network's inputs at a sample, from `agents.law`, shape (n, INPUTS).
        """
        self.state = self.cell(inputs, self.state)
        hidden = nn.functional.silu(self.hidden(torch.cat([inputs, self.state], dim=1)))
        corrections: Tensor = self.output(torch.cat([hidden, inputs], dim=1))
        return corrections

    def export(self, **provenance: Any) -> RecurrentNetwork:
        """Return a copy of the network in NumPy.

        The keyword arguments `provenance` describe the training, with values that JSON can
        store.
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
        # `RecurrentNetwork` copies the arrays.
        arrays = {name: tensor.detach().numpy() for name, tensor in tensors.items()}
        return RecurrentNetwork(**arrays, provenance=provenance)


class Loops:
    """Control loops of n plants with the neural self-tuning controller, simulated from rest.

    The controller gets set points and outputs divided by the steady temperature change, degC,
    that half the actuator's range causes according to the step test of the plant.

    Parameters
    ----------
    plants
        The differentiable environment.
    batch
        Parameter values, set points and noise of the plants in an episode, and what the
        controllers know of the plants in advance.
    net
        Network that corrects the control law.
    seed
        Seed of all random numbers that are not in `batch`, such as the measurement noise.
    """

    def __init__(self, plants: MiddlePointTorchEnv, batch: Batch, net: Net, seed: int) -> None:
        self._plants = plants
        self._net = net
        self._temperature_ranges = batch.temperature_ranges
        self._bank = Bank(batch.prior)
        # Flows are shares of half the actuator's range, so the limits are -1 and 1.
        largest_flow = np.ones_like(batch.edges)
        limits = -largest_flow, largest_flow
        self._observer = Observer(self._bank, batch.edges, limits, batch.random_setpoint)
        self._control_law = Law(self._bank, batch.edges, limits, torch, torch.from_numpy)
        net.begin(self._bank.n)
        options = {"signals": batch.signals}
        self._observations, _ = plants.reset(seed=seed, options=options)

    def run(self, samples: int) -> tuple[Tensor, Tensor]:
        """Simulate the next `samples` samples of an episode, and return signals with gradients.

        Gradients of the returned signals do not reach back to samples before this call of
        `run`.

        Returns
        -------
        outputs : Tensor
            Outputs of the plants without measurement noise, degC, shape (samples, n).
        time_constant_factors : Tensor
            Time constants of the plants at the last sample, as multiples of the paper's time
            constant, shape (n,).
        """
        self._plants.detach()
        self._control_law.detach()
        self._net.state = self._net.state.detach()
        outputs = []
        for _ in range(samples):
            observations = self._observations.detach().numpy()
            scaled = observations / self._temperature_ranges[:, np.newaxis]
            setpoints, measurements = scaled.T
            estimates = self._observer.observe(setpoints, measurements)
            flows = self._control_law.flow(estimates, self._net)  # from -1 to 1
            self._bank.apply(flows.detach().numpy())
            # The control law is made for a positive gain, but the plants' gain is negative. The
            # sign of the flow can be changed, because the limits of the flow are symmetric.
            actions = -flows[:, None]
            self._observations, _, _, _, infos = self._plants.step(actions)
            outputs.append(infos["output"])
        return torch.stack(outputs), infos["time_constant_factor"].detach()


def noise_response(time_constant_factors: Tensor, samples: int) -> Tensor:
    """Return the impulse response from the white noise xi to the output, shape (samples, n).

    The transfer function from xi to the output is C / A, with the polynomials A and C of
    equation (28) of the paper.

    Parameters
    ----------
    time_constant_factors
        Time constants of n plants, as multiples of the paper's time constant, shape (n,).
    samples
        Number of samples of the impulse response.
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


def chance_of_change(setpoint_ages: Tensor, samples: Tensor) -> Tensor:
    """Return the probability that a random set point changes within the next `samples` samples.

    Parameters
    ----------
    setpoint_ages
        Number of samples since the last change of the set point.
    samples
        Number of future samples, in a shape that broadcasts with that of `setpoint_ages`.
    """
    shortest, longest = HOLD_TIMES
    # All hold times from `passed` + 1 to `longest` samples are equally probable.
    passed = setpoint_ages.clamp(min=shortest - 1.0)
    possible_hold_times = (longest - passed).clamp(min=1.0)
    hold_times_that_end = (setpoint_ages + samples).clamp(max=longest) - passed
    return (hold_times_that_end / possible_hold_times).clamp(0.0, 1.0)


def mean_distance(distances: Tensor, deviations: Tensor) -> Tensor:
    """Return the mean of |x + z| for numbers x and normal random numbers z with the mean 0.

    `distances` are the numbers x, and `deviations` are the standard deviations of z, in shapes
    that broadcast.
    """
    ratios = distances / deviations
    density = math.sqrt(2.0 / math.pi) * torch.exp(-0.5 * ratios.square())
    return deviations * density + distances * torch.erf(ratios / math.sqrt(2.0))


def filtered(innovations: Tensor, responses: Tensor) -> Tensor:
    """Return white noise, filtered by a finite impulse response, shape (samples, n).

    Parameters
    ----------
    innovations
        White noise of n plants, shape (samples + lags - 1, n). The first lags - 1 rows of
        `innovations` are from samples before the first sample of the result.
    responses
        Impulse response for each plant, shape (lags, n).
    """
    # `conv1d` computes a correlation, so the impulse responses are reversed. Each plant is a
    # group of its own.
    kernels = responses.flip(0).T[:, None].contiguous()
    n = innovations.shape[1]
    return nn.functional.conv1d(innovations.T[None], kernels, groups=n)[0].T


def expected_error(
    outputs: Tensor, batch: Batch, time_constant_factors: Tensor, first: int
) -> Tensor:
    """Return the loss of the training: the mean expected absolute control error, degC.

    The control error e(k) is the set point minus the output y(k) at the sample k. The last
    command that affects y(k) is the command of the sample k - d - 1, where d is the plant's
    delay. The expected |e(k)| is the mean over everything that is random after the last command
    that affects y(k): the effect of noise on the output y(k) has a normal distribution, and a
    random set point may change to a level that is uniformly distributed. The loss is a mean
    over plants and samples, without the outputs that no command affects.

    Parameters
    ----------
    outputs
        Simulated outputs from the sample k = `first` on, degC, shape (samples, n).
    batch
        Parameter values, set points and noise of the plants in the episode.
    time_constant_factors
        Present time constants of the plants, as multiples of the paper's time constant, shape
        (n,).
    first
        Number k of the first sample in `outputs`.
    """
    samples, n = outputs.shape
    delays = batch.numbers["delay"]
    lags = int(delays.max()) + 1
    responses = noise_response(time_constant_factors, lags)
    # Only the d + 1 latest values of xi are later than the last command that affects y(k).
    responses = responses * (torch.arange(lags)[:, None] <= delays)
    # With `lags` zeros in front, the index i of `innovations` holds xi(i - lags).
    innovations = torch.cat([torch.zeros(lags, n), batch.innovations])
    noise = filtered(innovations[first + 1 : first + samples + lags], responses)
    expected_outputs = outputs - noise
    variances = batch.numbers["noise_variance"] * responses.square().sum(0)
    deviations = variances.sqrt().clamp(min=LEAST_NOISE)

    # For each output, the number of the sample with the last command that affects the output.
    decisions = torch.arange(first, first + samples)[:, None] - delays.long() - 1
    is_affected = decisions >= 0
    decisions = decisions.clamp(min=0)
    setpoints = batch.setpoints.gather(0, decisions)
    if_kept = mean_distance(setpoints - expected_outputs, deviations)
    # For |y| <= A, the mean distance of y from a uniform level in [-A, A] is (A^2 + y^2) / 2A.
    amplitudes = batch.amplitudes
    squares = amplitudes.square() + expected_outputs.square() + deviations.square()
    if_changed = squares / (2.0 * amplitudes)
    chances = chance_of_change(batch.setpoint_ages.gather(0, decisions), delays + 1.0)
    chances = chances * batch.has_random_setpoint
    errors = (1.0 - chances) * if_kept + chances * if_changed
    # At the start of an episode, it is possible that no output is affected by a command.
    return (errors * is_affected).sum() / is_affected.sum().clamp(min=1)


def validate(network: RecurrentNetwork, episodes: int) -> dict[str, float]:
    """Return the mean error, degC, and the valve travel, t/h, of a network in validation.

    The network corrects the self-tuning controller on `episodes` validation episodes of the
    environment `MiddlePointHard-v0`. The returned dict has the keys `mean_error` and `travel`,
    both means over the episodes. The valve travel of an episode is the sum of the absolute
    changes of the flow.
    """
    plant = Parameters(**PRESETS["hard"])
    # The quantities that a self-tuning controller knows of the plants in advance, whose names
    # are in `BANK`.
    known = knowledge(BANK, plant, episodes, VALIDATION_SEED)
    # The controller assumes the widest dead zone that a plant of `hard` may have.
    controller = with_bank(NeuralSelfTuningController, network=network, **known)
    result = evaluate(controller, IDS["hard"], episodes=episodes, seed=VALIDATION_SEED)
    return {"mean_error": result.mean_error, "travel": result.travel}


def train(training: Training, seed: int) -> RecurrentNetwork:
    """Train a network, and return it with validation results in the attribute `provenance`.

    Parameters
    ----------
    training
        Settings of the training.
    seed
        Seed of the initial weights, the plants, the set points and the noise.
    """
    torch.set_num_threads(1)  # the network is too small for more threads
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
    """Train `net` in place, and return a network with the running mean of `net`'s weights.

    Parameters
    ----------
    training
        Settings of the training.
    net
        The untrained network.
    seed
        Seed of the plants, the set points and the noise.
    """
    mean = copy.deepcopy(net)
    optimiser = torch.optim.Adam(net.parameters())
    sampler = Sampler(training.plants, training.hard_share, seed)
    plants = environment(training.plants)
    segments = SAMPLES // training.segment  # number of segments in an episode
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
        # In the first steps, the weights in `mean` are the mean of the weights after all steps
        # so far, and later an exponential mean.
        share = max(1.0 - training.averaging, 1.0 / (step + 1.0))
        with torch.no_grad():
            for weights, new_weights in zip(mean.parameters(), net.parameters(), strict=True):
                weights.lerp_(new_weights, share)
    return mean
