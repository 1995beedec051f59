"""Plant and actuator in PyTorch, (28) and (29): many plants, a block of samples at a time.

`PlantBatch` in `mptc_gym.plant` is the same in NumPy, a sample at a time.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Collection, Iterable, Mapping, Sequence
from itertools import islice
from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.nn import functional

from mptc_gym.parameters import Parameters, PlantNumbers
from mptc_gym.plant import DRIFT_INTERVAL, Dynamics
from mptc_gym.torch_signals import Number


def flow_command(actions: Tensor, middle: Tensor, half_range: Number) -> Tensor:
    """Scale normalised actions to commands u, t/h: the last formula of Section 4.

    Parameters
    ----------
    actions
        Normalised, shape (n,).
    middle, half_range
        Of the limits, t/h: (U_min + U_max) / 2 and (U_max - U_min) / 2.
    """
    return _plus(middle, half_range, actions)


def applied_flow(command: Tensor, edge: Number, u_min: Number, u_max: Number) -> Tensor:
    """Return the flow u_a that the actuator applies, (29), t/h.

    Its gradient with respect to the command is 1 up to the limits, straight through the dead
    zone as if there were none, and 0 beyond the limits.

    Parameters
    ----------
    command
        u, t/h, shape (n,).
    edge
        The largest magnitude of a command without effect: see `largest_dead`.
    u_min, u_max
        The limits, t/h, both floats or both of shape (n,).
    """
    alike = isinstance(edge, float) and isinstance(u_min, float) and isinstance(u_max, float)
    if alike and not command.requires_grad and u_min <= 0.0 <= u_max:
        shrunk = functional.hardshrink(command, edge)  # type: ignore[arg-type]  # it is a float
        return shrunk.clamp_(u_min, u_max)  # type: ignore[arg-type]  # the same, at once
    limited = torch.clamp(command, u_min, u_max)  # type: ignore[arg-type]
    # 0 inside the dead zone and 1 outside: a product takes a processor much less time than a
    # condition that it cannot foresee.
    if not command.requires_grad:
        return limited.mul_(command.abs().gt_(edge))
    passes = command.detach().abs().gt_(edge)
    return torch.addcmul(limited, limited.detach(), passes.sub_(1.0))


def largest_dead(dead_zone: Number, like: Tensor) -> Number:
    """Return the largest magnitude below a dead zone, as numbers of a type go."""
    if isinstance(dead_zone, Tensor):
        return dead_zone.nextafter(torch.full_like(dead_zone, -1.0))
    kind = np.float32 if like.dtype == torch.float32 else np.float64
    return float(np.nextafter(kind(dead_zone), kind(-1.0)))


class TorchPlants:
    """Many plants side by side, with gradients where the actions have them.

    Because of the delay d, the outputs of the d + 1 samples after an action follow from the
    actions so far, whatever comes next. So they are worked out in a block, d being the shortest
    delay that can be drawn.

    Parameters
    ----------
    parameters
        Uses `a`, `b`, the delay, and what `Dynamics` does.
    nothing
        Zeros of the device and type to use, shape (n,).

    Attributes
    ----------
    most_samples : int
        How many samples can be worked out at once.
    """

    def __init__(self, parameters: Parameters, nothing: Tensor) -> None:
        self._nothing = nothing
        self._dynamics = Dynamics(parameters)
        self._drifts, self._scales = parameters.drifts, parameters.changes_dynamics
        self._drift_samples = parameters.drift_samples
        self._beta = tuple(parameters.b)
        shortest, self._longest = map(int, parameters.range_of("delay"))
        self.most_samples = shortest + 1
        self._order = len(parameters.a) - 1  # of A

    def rest(
        self,
        which: Tensor | None,
        taken: int,
        numbers: Mapping[str, Number],
        starts: Tensor | int,
        phases: Collection[int],
    ) -> None:
        """Bring plants to rest.

        Parameters
        ----------
        which
            Whether each is, shape (n,), bool; None for all.
        taken
            How many samples of the last block have passed.
        numbers
            The plant numbers of all plants from now on, by name.
        starts
            The clock at the beginning of each plant's episode, shape (n,), or one int if it is
            the same for all.
        phases
            The remainders of `starts` when divided by `DRIFT_INTERVAL`.
        """
        self._numbers, self._starts, self._phases = numbers, starts, phases
        self._now: tuple[Any, Any] | None = None  # factors, and what (28) has for them
        plants = PlantNumbers(**numbers)
        self._factors = self._dynamics.factors(plants, 0)
        if self._drifts:
            # At the beginning of drifts, and what has been added at their end.
            last = self._dynamics.factors(plants, self._drift_samples)
            self._drift = [
                (self._nothing + begin, self._nothing + (end - begin))
                for begin, end in zip(self._factors, last, strict=True)
            ]
        # The flows that are still to have an effect, oldest first, for all terms of B; and the
        # outputs, also oldest first: what A needs from before the last block, and the block.
        if which is None:
            flows = self._longest + len(self._beta)
            self._flows = deque([self._nothing] * flows, flows)
            self._history = [self._nothing] * self._order
        else:
            past = self._history[taken : taken + self._order]
            self._history = [each.masked_fill(which, 0.0) for each in past]
            self._flows.extend(torch.stack([*self._flows]).masked_fill_(which, 0.0).unbind())
        u_min, u_max = numbers["u_min"], numbers["u_max"]
        self._middle = self._nothing.new_zeros(()) + (u_min + u_max) / 2.0
        self._half_range = (u_max - u_min) / 2.0
        self._edge = largest_dead(numbers["dead_zone"], self._nothing)
        delay, n = numbers["delay"], len(self._nothing)
        self._places = None  # of what each plant is shown, where delays differ
        if isinstance(delay, Tensor):
            columns = torch.arange(n, device=delay.device)
            rows = torch.arange(self.most_samples + len(self._beta) - 1, device=delay.device)
            oldest = self._longest - delay.to(torch.int64)
            self._places = (rows[:, None] + oldest) * n + columns

    def apply(self, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Take a(k) of all plants, shape (n,), and return u(k) and u_a(k), t/h."""
        command = flow_command(actions, self._middle, self._half_range)
        numbers = self._numbers
        applied = applied_flow(command, self._edge, numbers["u_min"], numbers["u_max"])
        self._flows.append(applied.clone())  # as the caller may write in what is returned
        return command, applied

    def outputs(
        self,
        taken: int,
        clock: int,
        samples: int,
        noise: Tensor | None,
        load: Tensor | None,
    ) -> tuple[Tensor, list[tuple[Number, Number]]]:
        """Work out the next samples, once the action before them has been applied.

        Parameters
        ----------
        taken
            How many samples of the last block have passed.
        clock
            Of the first of the next ones.
        samples
            How many, at most `most_samples`.
        noise, load
            n and w of these samples, degC, shape (samples, n), if there are any.

        Returns
        -------
        Tensor, list of tuple
            y, degC, shape (samples, n); and of each sample gain and time constant, as multiples
            of those that A and B have.
        """
        rows, told = self._history[taken : taken + self._order], []
        response = self._response(samples)
        for first, last in self._stretches(clock, samples):
            factors, (alpha, scale, load_gain) = self._drifted(clock + first)
            forced = response[first:last]
            if noise is not None:
                forced = _plus(noise[first:last], scale, forced)
            elif self._scales:
                forced = forced * scale
            if load is not None:
                forced = _plus(forced, load_gain, load[first:last])
            told += [factors] * (last - first)
            rows = _follow(rows, forced.unbind(), alpha)
        self._history = rows
        return torch.stack(rows[self._order :]), told

    def detach(self) -> None:
        """Cut the graph that leads to earlier actions."""
        self._history = [each.detach() for each in self._history]
        self._flows.extend([each.detach() for each in self._flows])

    def _response(self, samples: int) -> Tensor:
        """Return the response to the flows, B of (28), shape (samples, n)."""
        needed = samples + len(self._beta) - 1
        if self._places is None:
            flows = torch.stack([*islice(self._flows, needed)])
        else:
            past = self._longest - self.most_samples + 1
            flows = torch.stack([*islice(self._flows, past + needed)]).reshape(-1)
            flows = flows.index_select(0, self._places[:needed].reshape(-1)).view(needed, -1)
        response = flows[-samples:] * self._beta[0]
        for lag, coefficient in enumerate(self._beta[1:], start=1):
            earlier = flows[needed - samples - lag : needed - lag]
            response = response.add_(earlier, alpha=coefficient)
        return response

    def _stretches(self, clock: int, samples: int) -> list[tuple[int, int]]:
        """Return from which to which sample the dynamics of no plant change."""
        begins = [0]
        if self._drifts:
            begins += [
                r for r in range(1, samples) if (clock + r) % DRIFT_INTERVAL in self._phases
            ]
        return list(zip(begins, [*begins[1:], samples], strict=True))

    def _drifted(self, clock: int) -> tuple[Any, Any]:
        """Return gain and time constant at a sample, and what (28) has for them."""
        if self._now is None or (self._drifts and clock % DRIFT_INTERVAL in self._phases):
            factors: tuple[Any, ...] = self._factors
            if self._drifts:
                slow = clock - self._starts
                slow = slow - slow % DRIFT_INTERVAL
                if isinstance(slow, Tensor):
                    slow = slow.to(self._nothing.dtype)
                share = self._dynamics.share(slow)
                factors = tuple(_plus(first, share, more) for first, more in self._drift)
            gain, time_constant = factors
            self._now = factors, self._dynamics.coefficients(gain, time_constant)
        return self._now


def _follow(
    past: Sequence[Tensor], forced: Iterable[Tensor], alpha: Sequence[Number]
) -> list[Tensor]:
    """Return past outputs and those that follow, by A of (28), oldest first."""
    outputs = list(past)
    for output in forced:
        for lag, coefficient in enumerate(alpha, start=1):
            output = _plus(output, coefficient, outputs[-lag])
        outputs.append(output)
    return outputs


def _plus(first: Tensor, factor: Number, second: Tensor) -> Tensor:
    """Return first + factor * second, in one operation."""
    if isinstance(factor, Tensor):
        return torch.addcmul(first, factor, second)
    return torch.add(first, second, alpha=factor)
