"""From what a model explains of a loop to the flow that it needs: the law of a told network.

It is written once for NumPy and for PyTorch, so that what is trained is what runs. All is in
multiples: temperatures of what half the actuator's range moves the plant by, the *reach*, flows
of half that range, times of samples.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from os import PathLike
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from agents.archive import PRETRAINED, reading

Array = NDArray[np.float64]

# Exponential means, by the share that the newest sample has: of the load that explains the
# residual, and of the residual itself. A share of 1 is the newest sample alone.
LOAD_RATES: Final = (1.0, 0.5, 0.2, 0.07, 0.025, 0.008, 0.002)
RESIDUAL_RATES: Final = (1.0, 0.5, 0.2)
REFERENCE: Final = 2  # of the loads, the one that news are told from
NEWS: Final = 7  # samples of news that the network sees
LEAST_NOISE: Final = 0.002  # of the reach
DOUBT: Final = 0.0002  # of the reach, added to noise before its logarithm is taken
# Misses of the means are remembered for 20 samples and for 100, by which a load is told from
# noise. Logarithms of their ratios are evidence, weighed so, and more of it counts for less.
MISS_RATES: Final = (0.05, 0.01)  # a sample
TRUST: Final = (5.0, 30.0)
SATURATION: Final = 0.07
CLEARANCE: Final = 0.005  # of half the range, that commands pass the dead zone by
MOST_ADDED: Final = 0.45  # of half the range
MOST_WEIGHT: Final = 40.0  # the logarithm, up or down
# Weights of the means before the network has a say: logarithms, but for a constant. Unless
# there is evidence of it, no load is expected to jump. The network tilts those of the loads.
PREFERENCE: Final = (-4.0, -3.0, -2.0, -1.0, 0.0, 1.5, 2.5, 0.0, 1.0, 0.0)
TILT: Final = (-4.0, -3.0, -2.0, -1.0, 0.0, 1.0, 2.0)
_LOADS, _MEANS = len(LOAD_RATES), len(LOAD_RATES) + len(RESIDUAL_RATES)
INPUTS: Final = _MEANS - 2 + NEWS + 1 + 6 + 6 + 2 * _LOADS
OUTPUTS: Final = 1 + len(RESIDUAL_RATES) + 1
PARTS: Final = "choosing", "adding"  # of the networks


# What the law asks at each sample, with what is seen and with what there is at rest: returns
# outputs, shape (n, OUTPUTS), and an addition to the flow, shape (n,), which is 0 where the two
# are the same.
Network = Callable[[Any, Any], tuple[Any, Any]]


@dataclass(frozen=True)
class Prior:
    """What the law is told of n plants; every field has shape (n,)."""

    unit: Any
    """A(1) of the model: by so much a steady input of 1 moves it from rest in a sample."""
    fading: Any
    """What is left of a deviation once the delay and a sample are over."""
    time_constant: Any
    """In multiples of the paper's, which has 20.6 samples."""
    delay: Any
    """d, samples."""
    dead_zone: Any
    """In multiples of half the range."""
    centre: Any
    """Of the flows that the limits let pass: they are within 1 of it."""
    uncertainty: Any
    """By how much, in natural logarithms, the gain may be wrong (a standard deviation); it
    stands for the other numbers, too."""


class Law:
    """The law for n loops, with all that it remembers.

    The residual r is what the model, with the delay, does not explain of the output. A steady
    load of A(z^-1) r / A(1) would explain it. Means of that load and of the residual are
    *foreseen*: at the end of the delay, the residual will have gone some way to the load. What
    each mean of the load has missed of the newest samples speaks against it; the network tilts
    that to newer samples or to older ones. It also chooses a mean of the residual, the rate at
    which the model is brought to what is then left of the set point, and a small addition.

    Parameters
    ----------
    prior
        What is told.
    xp
        NumPy or PyTorch.
    still
        Returns a number without its gradient.
    haste
        How much quicker than the network asks for: it tilts the means of the load to the newer
        samples, and is added to the logit of the rate.
    """

    def __init__(
        self,
        prior: Prior,
        xp: Any = np,
        still: Callable[[Any], Any] = lambda value: value,
        haste: float = 0.0,
    ) -> None:
        self._xp, self._still = xp, still
        zero = self._zero = prior.unit * 0.0
        self._rates = self._array(LOAD_RATES + RESIDUAL_RATES)
        self._tilt, self._haste = self._array(TILT), haste
        self._preference = self._array(PREFERENCE)
        self._preference[:_LOADS] -= haste * self._tilt
        self._sharpness = self._array([1.0, *(rate**-0.5 for rate in LOAD_RATES[1:-1])])
        groups = np.zeros((_MEANS, _MEANS))
        groups[:_LOADS, :_LOADS] = groups[_LOADS:, _LOADS:] = 1.0
        self._groups = self._array(groups)
        self._nothing, self._means, self._news, self._plain = (
            zero[:, None] + self._array([0.0] * size)
            for size in (_MEANS - 1 + NEWS, _MEANS, NEWS, _MEANS - _LOADS)
        )
        self._misses = [self._means[:, :_LOADS] + LEAST_NOISE] * len(MISS_RATES)
        self._tell(prior)

    def retell(self, prior: Prior, ratio: Any, residual: Any) -> None:
        """Take over other numbers of the plants, and what has been seen in their light.

        Parameters
        ----------
        prior
            What is told from now on.
        ratio
            Of the reach before to the reach now.
        residual
            How the last residual changes, in multiples of the reach now.
        """
        units = ratio * prior.unit / self.prior.unit
        loads = self._means[:, :_LOADS] * units[:, None] + (prior.unit * residual)[:, None]
        residuals = self._means[:, _LOADS:] * ratio[:, None] + residual[:, None]
        self._means = self._xp.concatenate([loads, residuals], axis=1)
        self._news = self._news * units[:, None]
        self._misses = [misses * units[:, None] for misses in self._misses]
        self._tell(prior)

    def _tell(self, prior: Prior) -> None:
        xp, self.prior = self._xp, prior
        self._shares = self._of_each_mean((1.0 - prior.fading) / prior.unit, prior.fading)
        numbers = [
            xp.log(prior.time_constant),
            prior.delay / 20.0 - 1.0,
            prior.dead_zone,
            prior.centre,
            3.0 * prior.uncertainty,
        ]
        self._told = xp.stack(numbers, axis=1)

    def flow(
        self, network: Network, setpoint: Any, residual: Any, load: Any, state: Any
    ) -> Any:
        """Return the flow that is wanted, before the actuator.

        Parameters
        ----------
        network
            Is asked.
        setpoint, residual
            y_d(k) and r(k).
        load
            A(z^-1) r(k), A(1) times the load.
        state
            The model's output without delay, the one before, and the last flow that passed.
        """
        xp, still = self._xp, self._still
        now, before, last = state
        missed = load[:, None] - self._means[:, :_LOADS]
        news, size = missed[:, REFERENCE], abs(still(missed))
        size = xp.clip(size, None, 4.0 * self._misses[0] + LEAST_NOISE)  # no outliers
        self._misses = [
            misses + rate * (size - misses)
            for rate, misses in zip(MISS_RATES, self._misses, strict=True)
        ]
        noise = self._misses[0][:, REFERENCE]
        doubts, slow = (
            xp.log((misses + DOUBT) / (misses[:, REFERENCE] + DOUBT)[:, None])
            for misses in self._misses
        )
        against = TRUST[0] * doubts + TRUST[1] * slow
        against = against / (1.0 + SATURATION * abs(against))
        newest = self._of_each_mean(load, residual)
        means = self._means = self._means + self._rates * (newest - self._means)
        self._news = xp.concatenate([news[:, None], self._news[:, :-1]], axis=1)

        # What is small beside the noise, or large: limited to 1.
        foreseen = (
            self._shares[:, REFERENCE] * means[:, REFERENCE] + self.prior.fading * residual
        )
        error = setpoint - foreseen - now
        compared = (
            xp.concatenate(
                [
                    (means[:, : _LOADS - 1] - means[:, 1:_LOADS]) * self._sharpness,
                    residual[:, None] - means[:, _LOADS + 1 :],
                    self._news,
                    0.5 * error[:, None],
                ],
                axis=1,
            )
            * (0.5 / (2.0 * noise + LEAST_NOISE))[:, None]
        )
        compared = compared / (1.0 + abs(compared))
        level = 0.3 * xp.log(noise + DOUBT) + 1.5
        about = xp.concatenate([level[:, None], doubts, 0.1 * against, self._told], axis=1)
        held, zero = setpoint - residual, self._zero
        seen = [10.0 * (now - before), 1.4 * setpoint, 1.4 * now, last]
        seen += [3.0 * residual, 3.0 * error]
        resting = [zero, 1.4 * setpoint, 1.4 * held, held, 3.0 * residual, zero]
        outputs, added = network(
            xp.concatenate([compared, xp.stack(seen, axis=1), about], axis=1),
            xp.concatenate([self._nothing, xp.stack(resting, axis=1), about], axis=1),
        )
        preferred = xp.concatenate([-against, self._plain], axis=1) + self._preference
        chosen = [2.0 * outputs[:, :1] * self._tilt, 3.0 * outputs[:, 1:-1]]
        weights = xp.concatenate(chosen, axis=1) + preferred
        weights = xp.exp(xp.clip(weights, -MOST_WEIGHT, MOST_WEIGHT))
        weights = weights / (weights @ self._groups)
        target = setpoint - (weights * means * self._shares).sum(1)
        rate = 1.0 / (1.0 + xp.exp(0.5 - self._haste - outputs[:, -1]))
        return target + rate / self.prior.unit * (target - now) + added

    def applied(self, flow: Any) -> tuple[Any, Any]:
        """Move flows within the dead zone to its edge or to 0; return them, and what passes."""
        xp, zone, hard = self._xp, self.prior.dead_zone, self._still(flow)
        edge = zone + CLEARANCE * (zone > 0.0)
        size = abs(hard)
        moved = xp.where(size < edge, edge * xp.sign(hard) * (size >= edge / 2.0), hard)
        flow = flow + (moved - hard)  # straight through, for the gradient
        return flow, xp.clip(flow, self.prior.centre - 1.0, self.prior.centre + 1.0)

    def _of_each_mean(self, load: Any, residual: Any) -> Any:
        """Return a column for each mean: those of the load, then those of the residual."""
        loads = load[:, None] + 0.0 * self._rates[:_LOADS]
        residuals = residual[:, None] + 0.0 * self._rates[_LOADS:]
        return self._xp.concatenate([loads, residuals], axis=1)

    def _array(self, values: Any) -> Any:
        if self._xp is np:
            return np.asarray(values, dtype=np.float64)
        return self._zero.new_tensor(values)


@dataclass(frozen=True)
class LawNetwork:
    """The two networks of the law, in NumPy.

    Attributes
    ----------
    choosing, adding
        Weights, shape (outputs, inputs), and biases, shape (outputs,), of each layer.
    provenance
        Where they come from, in a form for JSON.
    """

    choosing: Sequence[tuple[Array, Array]]
    adding: Sequence[tuple[Array, Array]]
    provenance: Mapping[str, Any] = field(default_factory=dict)

    def __call__(self, seen: Array, at_rest: Array) -> tuple[Array, Array]:
        """Return the outputs and the addition; see `Network`."""
        added = np.tanh(_forward(self.adding, np.concatenate([seen, at_rest])))[:, 0]
        half = len(seen)
        return _forward(self.choosing, seen), MOST_ADDED * (added[:half] - added[half:])

    @classmethod
    def load(cls, path: str | PathLike[str] = PRETRAINED / "nn-smith.npz") -> LawNetwork:
        """Read networks that `save` has written. Nothing in the file is executed.

        Raises
        ------
        FileNotFoundError
            If there is no such file.
        ValueError
            If the file is damaged or holds something else.
        """
        with reading(path, "told network") as file:
            choosing, adding = (
                [(file[f"{part}_W{i}"], file[f"{part}_b{i}"]) for i in range(3)]
                for part in PARTS
            )
            _check(choosing, OUTPUTS)
            _check(adding, 1)
            return cls(choosing, adding, json.loads(str(file["provenance"])))

    def save(self, path: str | PathLike[str]) -> None:
        """Write the networks to a `.npz` file."""
        layers = {
            f"{part}_{name}{i}": array.astype(np.float32)
            for part in PARTS
            for i, layer in enumerate(getattr(self, part))
            for name, array in zip("Wb", layer, strict=True)
        }
        about = json.dumps(dict(self.provenance))
        np.savez_compressed(path, provenance=about, **layers)


def _forward(layers: Sequence[tuple[Array, Array]], x: Array) -> Array:
    *hidden, (last_W, last_b) = layers
    for W, b in hidden:
        x = x @ W.T + b
        x = x * 0.5 * (1.0 + np.tanh(0.5 * x))  # SiLU
    return x @ last_W.T + last_b


def _check(layers: Sequence[tuple[Array, Array]], outputs: int) -> None:
    inputs = INPUTS
    for W, b in layers:
        if W.shape != (len(b), inputs) or not np.isfinite(np.append(W, b)).all():
            raise ValueError(f"layers must be finite and fit together, got shape {W.shape}")
        inputs = len(b)
    if inputs != outputs:
        raise ValueError(f"the last layer must have {outputs} nodes, got {inputs}")
