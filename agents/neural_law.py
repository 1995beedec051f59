"""Implement the control law of a trained network, and the Smith predictor that runs it.

The law leads from the signals of a nominal model to a flow. It is written once for NumPy and
PyTorch, so that the law in use is the one trained. All its quantities are scaled: flows by half
the actuator's range, temperatures by the *authority*, the steady-state effect of such a flow on
the plant, and times by the sampling interval.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from os import PathLike
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from agents.actuator import avoid_dead_zone
from agents.controller import Index, ModelBasedController, NotNegative
from agents.networks import (
    PRETRAINED,
    Layers,
    check_layers,
    forward,
    read_layers,
    reading,
    write,
)

Array = NDArray[np.float64]

# Weights of the newest sample in exponential means, of the load that explains the residual and
# of the residual itself. A weight of 1 keeps the newest sample alone.
LOAD_RATES: Final = (1.0, 0.5, 0.2, 0.07, 0.025, 0.008, 0.002)
RESIDUAL_RATES: Final = (1.0, 0.5, 0.2)
REFERENCE: Final = 2  # index of the load mean whose innovations the network sees
INNOVATIONS: Final = 7  # how many of them, the latest first
LEAST_NOISE: Final = 0.002  # of the authority
DOUBT: Final = 0.0002  # of the authority, added to the noise before its logarithm is taken
# The misses of the means are averaged over 20 and over 100 samples, to distinguish load from
# noise. The logarithms of their ratios are evidence, weighted by `TRUST` and saturated.
MISS_RATES: Final = (0.05, 0.01)  # per sample
TRUST: Final = (5.0, 30.0)
SATURATION: Final = 0.07
CALM: Final = 0.004  # of the authority, noise at which half of the aggressiveness is used
CLEARANCE: Final = 0.005  # of half the range, by which commands clear the dead zone
MOST_ADDED: Final = 0.45  # of half the range
# Logarithms of the means' prior weights, up to a constant: without evidence, no jump of the
# load is expected. The network tilts those of the load means.
LOAD_PREFERENCE: Final = (-4.0, -3.0, -2.0, -1.0, 0.0, 1.5, 2.5)
RESIDUAL_PREFERENCE: Final = (0.0, 1.0, 0.0)
TILT: Final = (-4.0, -3.0, -2.0, -1.0, 0.0, 1.0, 2.0)
_LOADS, _MEANS = len(LOAD_RATES), len(LOAD_RATES) + len(RESIDUAL_RATES)
INPUTS: Final = _MEANS - 2 + INNOVATIONS + 1 + 6 + 6 + 2 * _LOADS
OUTPUTS: Final = 1 + len(RESIDUAL_RATES) + 1
NOMINAL: Final = 20.62  # samples, the time constant of the paper's plant
SLOWEST: Final = 45.0  # samples, the largest time constant that the network was trained on

# The networks: from the inputs now and those at rest, each of shape (n, INPUTS), to outputs,
# shape (n, OUTPUTS), and an addition to the flow, shape (n,), 0 where both inputs are equal.
Network = Callable[[Any, Any], tuple[Any, Any]]


@dataclass(frozen=True)
class Prior:
    """Prior knowledge of n plants; every field has shape (n,)."""

    unit: Any
    """A(1) of the model: how far a steady input of 1 moves it from rest in one sample."""
    fading: Any
    """Share of a deviation that remains after the delay and one more sample."""
    time_constant: Any
    """Time constant, as a multiple of the paper's 20.6 samples."""
    delay: Any
    """Delay d, samples."""
    dead_zone: Any
    """Half width of the dead zone, as a multiple of half the range."""
    centre: Any
    """Centre of the limits: flows within 1 of it pass."""
    uncertainty: Any
    """Standard deviation of the gain's logarithm; it stands for all other numbers, too."""


class Law:
    """The law for n loops, with its memory.

    The residual r is the part of the output that the delayed model does not explain. A steady
    load of A(z^-1) r / A(1) would explain it. The law predicts the residual at the end of the
    delay, when it will have moved part of the way to the load, from means of both. The errors
    of a load mean on the newest samples count against it; the network tilts the weights to
    means of newer or of older samples. It also chooses a mean of the residual, the rate at
    which the model approaches the rest of the set point, and a small addition to the flow.
    `aggressiveness`, how much quicker the law is than the network asks for, tilts the load
    means to newer samples and is added to the logit of the rate.
    """

    # Those of the class and not of its objects, so that these can be copied and pickled.
    _xp: Any = np  # the array module, NumPy or PyTorch

    @staticmethod
    def _stop_gradient(value: Any) -> Any:
        return value

    def __init__(self, prior: Prior, aggressiveness: float = 0.0) -> None:
        self.prior, self._zero = prior, prior.unit * 0.0
        of_load = np.arange(_MEANS) < _LOADS
        self._of_load = self._array(of_load)
        self._alike = self._array(np.equal.outer(of_load, of_load))  # means of one kind
        self._rates = self._array(LOAD_RATES + RESIDUAL_RATES)
        self._sharpness = self._array([1.0, *(rate**-0.5 for rate in LOAD_RATES[1:-1])])
        self._load_preference = self._array(LOAD_PREFERENCE)
        self._residual_preference = self._array(RESIDUAL_PREFERENCE)
        self._tilt, self._aggressiveness = self._array(TILT), aggressiveness
        self._means = self._zero[:, None] * self._rates
        self._innovations = self._zero[:, None] + self._array([0.0] * INNOVATIONS)
        self._misses = [self._means[:, :_LOADS] + LEAST_NOISE] * len(MISS_RATES)
        self.adopt(prior, self._zero + 1.0, self._zero)

    def adopt(self, prior: Prior, ratio: Any, residual: Any) -> None:
        """Adopt new numbers of the plants, and convert the memory to them.

        `ratio` is that of the old authority to the new one, and `residual` the change of the
        last residual, as a multiple of the new authority.
        """
        units = ratio * prior.unit / self.prior.unit
        loads = self._means[:, :_LOADS] * units[:, None] + (prior.unit * residual)[:, None]
        residuals = self._means[:, _LOADS:] * ratio[:, None] + residual[:, None]
        self._means = self._xp.concatenate([loads, residuals], axis=1)
        self._innovations = self._innovations * units[:, None]
        self._misses = [misses * units[:, None] for misses in self._misses]
        self._shares = self._of_each_mean((1.0 - prior.fading) / prior.unit, prior.fading)
        constant, delay = self._xp.log(prior.time_constant), prior.delay / 20.0 - 1.0
        uncertainty = 3.0 * prior.uncertainty
        known = [constant, delay, prior.dead_zone, prior.centre, uncertainty]
        self.prior, self._known = prior, self._xp.stack(known, axis=1)

    def flow(
        self, network: Network, setpoint: Any, residual: Any, load: Any, state: Any
    ) -> Any:
        """Return the wanted flow, before the actuator, shape (n,), like all that is given.

        This is y_d(k), r(k), A(z^-1) r(k), which is A(1) times the load, and in `state` the
        model's undelayed output, the one before it, and the last flow that passed.
        """
        xp = self._xp
        noise, misses, evidence = self._judge(load)
        newest = self._of_each_mean(load, residual)
        means = self._means = self._means + self._rates * (newest - self._means)
        level = 0.3 * xp.log(noise + DOUBT) + 1.5
        about = xp.concatenate([level[:, None], misses, 0.1 * evidence, self._known], axis=1)
        outputs, added = network(*self._inputs(setpoint, residual, noise, about, state))

        # On a calm plant it would amplify what the model misses at each return of the delay.
        hurry = self._aggressiveness * noise / (noise + CALM)
        tilted = (2.0 * outputs[:, :1] - hurry[:, None]) * self._tilt
        tilted = tilted + (self._load_preference - evidence)
        chosen = 3.0 * outputs[:, 1:-1] + self._residual_preference
        weights = xp.concatenate([tilted, chosen], axis=1)
        weights = xp.exp(xp.clip(weights, -40.0, 40.0))  # never beyond a float
        weights = weights / (weights @ self._alike)
        target = setpoint - (weights * means * self._shares).sum(1)
        rate = 1.0 / (1.0 + xp.exp(xp.clip(0.5 - hurry - outputs[:, -1], None, 80.0)))
        return target + rate / self.prior.unit * (target - state[0]) + added

    def _judge(self, load: Any) -> tuple[Any, Any, Any]:
        """Return the noise, shape (n,), and of each load mean, shape (n, 7), two judgements.

        They are the logarithm of its misses in relation to those of the reference, and the
        evidence against it.
        """
        xp = self._xp
        missed = load[:, None] - self._means[:, :_LOADS]
        latest = missed[:, REFERENCE : REFERENCE + 1]
        self._innovations = xp.concatenate([latest, self._innovations[:, :-1]], axis=1)
        size = abs(self._stop_gradient(missed))
        size = xp.clip(size, None, 4.0 * self._misses[0] + LEAST_NOISE)  # limits outliers
        self._misses = [
            misses + rate * (size - misses)
            for rate, misses in zip(MISS_RATES, self._misses, strict=True)
        ]
        quick, slow = (
            xp.log((misses + DOUBT) / (misses[:, REFERENCE] + DOUBT)[:, None])
            for misses in self._misses
        )
        evidence = TRUST[0] * quick + TRUST[1] * slow
        evidence = evidence / (1.0 + SATURATION * abs(evidence))
        return self._misses[0][:, REFERENCE], quick, evidence

    def _inputs(
        self, setpoint: Any, residual: Any, noise: Any, about: Any, state: Any
    ) -> tuple[Any, Any]:
        """Return the inputs of the network, now and at rest."""
        xp, means, zero = self._xp, self._means, self._zero
        now, before, last = state
        expected = self._shares[:, REFERENCE] * means[:, REFERENCE]
        error = setpoint - (expected + self.prior.fading * residual) - now
        signals = [
            (means[:, : _LOADS - 1] - means[:, 1:_LOADS]) * self._sharpness,
            residual[:, None] - means[:, _LOADS + 1 :],
            self._innovations,
            0.5 * error[:, None],
        ]
        # In relation to the noise, squashed into (-1, 1).
        scale = 0.5 / (2.0 * noise + LEAST_NOISE)
        compared = xp.concatenate(signals, axis=1) * scale[:, None]
        compared = compared / (1.0 + abs(compared))
        held = setpoint - residual
        wanted, off = 1.4 * setpoint, 3.0 * residual
        seen = [10.0 * (now - before), wanted, 1.4 * now, last, off, 3.0 * error]
        resting = [zero, wanted, 1.4 * held, held, off, zero]
        return (
            xp.concatenate([compared, xp.stack(seen, axis=1), about], axis=1),
            xp.concatenate([0.0 * compared, xp.stack(resting, axis=1), about], axis=1),
        )

    def applied(self, flow: Any) -> tuple[Any, Any]:
        """Move flows in the dead zone to its edge or 0; return them, also clipped to limits."""
        xp, zone, hard = self._xp, self.prior.dead_zone, self._stop_gradient(flow)
        edge = zone + CLEARANCE * (zone > 0.0)
        flow = flow + (avoid_dead_zone(hard, edge, xp) - hard)  # straight-through gradient
        return flow, xp.clip(flow, self.prior.centre - 1.0, self.prior.centre + 1.0)

    def _of_each_mean(self, load: Any, residual: Any) -> Any:
        """Return one column per mean: those of the load, then those of the residual."""
        return load[:, None] * self._of_load + residual[:, None] * (1.0 - self._of_load)

    def _array(self, values: Any) -> Any:
        values = np.asarray(values, dtype=np.float64)
        return values if self._xp is np else self._zero.new_tensor(values)


@dataclass(frozen=True)
class LawNetwork:
    """The two networks of the law, in NumPy and float32."""

    choosing: Layers
    """The network of the outputs."""
    adding: Layers
    """The network of the addition to the flow."""
    provenance: Mapping[str, Any] = field(default_factory=dict)
    """Origin of the networks, JSON-serialisable."""

    def __call__(self, seen: Array, at_rest: Array) -> tuple[Array, Array]:
        """Return the outputs and the addition; see `Network`."""
        added = np.tanh(forward(self.adding, "silu", np.concatenate([seen, at_rest])))[:, 0]
        half = len(seen)
        return forward(self.choosing, "silu", seen), MOST_ADDED * (added[:half] - added[half:])

    @classmethod
    def load(cls, path: str | PathLike[str] = PRETRAINED / "nn-smith.npz") -> LawNetwork:
        """Read networks written by `save`; errors are those of `agents.networks.reading`."""
        with reading(path, "network of the law") as file:
            return cls(
                check_layers(read_layers(file, 3, "choosing_"), INPUTS, OUTPUTS),
                check_layers(read_layers(file, 3, "adding_"), INPUTS, 1),
                json.loads(str(file["provenance"])),
            )

    def save(self, path: str | PathLike[str]) -> None:
        """Write the networks to a `.npz` file."""
        layers = {"choosing_": self.choosing, "adding_": self.adding}
        write(path, layers, provenance=json.dumps(dict(self.provenance)))


@dataclass(eq=False, kw_only=True)
class NeuralSmithPredictor(ModelBasedController):
    """A trained network with a nominal model of the plant.

    As in a Smith predictor, a model runs in parallel with the plant, so the response to past
    flows is known before the delay is over. The network sees the model's output, the part of
    the measured output that the model does not explain, and the model's numbers; see `Law`. It
    was trained once, on many plants, and does not learn online. All its inputs are scaled by
    the flow's authority and by the sampling interval, so one set of weights serves plants of
    either sign, with any limits and any sampling interval. With a time constant of at least 90
    samples, it acts every second sample or less often.

    The other parameters are those of `ModelBasedController`.

    Parameters
    ----------
    uncertainty
        Standard deviation of the gain, as a share of it; 0 where the numbers are exact. It also
        stands for the time constant, which may be wrong by half as much again, and for the
        delay: 0.1 means two samples.
    setpoint_index, error_index
        Indices of y_d(k) and e(k), degC, in the observation.
    network
        The weights; by default those that come with the project.
    """

    uncertainty: NotNegative = 0.0
    setpoint_index: Index = 0
    error_index: Index = 3
    network: LawNetwork = field(default_factory=LawNetwork.load, repr=False)

    def __post_init__(self) -> None:
        super().__post_init__()
        self.n_obs = max(self.setpoint_index, self.error_index) + 1
        self._edge = self.dead_zone
        constant = self.time_constant / self.sampling_interval
        # A slow plant is seen as the network knows plants, by longer sampling.
        self._every = max(1, int(constant / SLOWEST))
        constant /= self._every
        self._pole = math.exp(-1.0 / constant)
        half = (self.u_max - self.u_min) / 2.0
        self._flow = math.copysign(half, self.gain)  # t/h at a flow of 1
        self._authority = abs(self.gain) * half  # degC
        self._delay = max(round(self._delay_samples / self._every) - 1, 0)
        self._about = Prior(
            unit=1.0 - self._pole,
            fading=self._pole ** (self._delay + 1.5),
            time_constant=min(max(constant / NOMINAL, 0.3), 3.3),
            delay=min(self._delay, 44),
            dead_zone=self.dead_zone / half,
            centre=(self.u_max + self.u_min) / 2.0 / self._flow,
            uncertainty=self.uncertainty,
        )

    def reset(self) -> None:
        """Forget the episode, and return the model to rest."""
        super().reset()
        self._k = 0

    def _control(self, rows: Array) -> Array:
        if self._k == 0:
            self._start(len(rows))
        if self._k % self._every == 0:
            self._last = self._decide(rows)
        self._k += 1
        return self._last

    def _start(self, loops: int) -> None:
        """Set the model and the law to rest."""
        # Undelayed outputs of the model, what it misses, residuals, newest first, and the flow
        # that passed last.
        self._model = np.zeros((self._delay + 3, loops))
        self._off, self._residual = np.zeros((2, 2, loops))
        self._passed = np.zeros(loops)
        about = {name: np.full(loops, x) for name, x in vars(self._about).items()}
        self._law = Law(Prior(**about))

    def _decide(self, rows: Array) -> Array:
        """Return commands, t/h, shape (loops,), for observations."""
        setpoint = rows[:, self.setpoint_index] / self._authority
        output = setpoint - rows[:, self.error_index] / self._authority
        model = self._model
        off = self._off = _shifted(self._off, output - model[self._delay])
        # First-order models miss fast dynamics, which the average of two samples reduces.
        residual = self._residual = _shifted(self._residual, (off[0] + off[1]) / 2.0)
        state, load = (model[0], model[1], self._passed), residual[0] - self._pole * residual[1]
        wanted = self._law.flow(self.network, setpoint, residual[0], load, state)
        wanted, self._passed = self._law.applied(wanted)
        new = (1.0 - self._pole) * self._passed + self._pole * model[0]
        self._model = _shifted(model, new)
        command: Array = self._flow * wanted
        return command


def _shifted(past: Array, newest: Array) -> Array:
    """Return the last samples, newest first, after one more."""
    return np.concatenate([newest[np.newaxis], past[:-1]])
