"""Move many plants in PyTorch by (28) and (29), a block of samples at a time.

`PlantBatch` in `mptc_gym.plant` does so in NumPy, a sample at a time.
"""

from collections import deque
from itertools import islice, pairwise
from typing import Any

import torch
from torch import Tensor
from torch.nn import functional

from mptc_gym.parameters import Parameters, PlantNumbers
from mptc_gym.plant import DRIFT_INTERVAL, Dynamics, least_effective
from mptc_gym.torch_signals import Episodes, Number


def applied_flow(command: Tensor, edge: Number, u_min: Number, u_max: Number) -> Tensor:
    """Return the flow u_a that the actuator applies, (29), t/h.

    Its gradient is 1 within the limits, also in the dead zone, and 0 beyond. Commands of a
    magnitude above `edge` have an effect. The limits are both floats, or both of shape (n,).
    """
    alike = isinstance(edge, float) and isinstance(u_min, float) and isinstance(u_max, float)
    if alike and not command.requires_grad and u_min <= 0.0 <= u_max:
        shrunk = functional.hardshrink(command, edge)  # type: ignore[arg-type]  # it is a float
        return shrunk.clamp_(u_min, u_max)  # type: ignore[arg-type]  # the same, at once
    limited = torch.clamp(command, u_min, u_max)  # type: ignore[arg-type]
    # 0 inside the dead zone and 1 outside: a product is much faster than an unpredictable
    # branch.
    if not command.requires_grad:
        return limited.mul_(command.abs().gt_(edge))
    passes = command.detach().abs().gt_(edge)
    return torch.addcmul(limited, limited.detach(), passes.sub_(1.0))


class TorchPlants:
    """Many plants side by side, with gradients where the actions have them.

    With d the shortest delay that can be drawn, the outputs of the d + 1 samples after an
    action follow from the actions so far, and are computed in a block of `most_samples`.
    """

    def __init__(self, parameters: Parameters, episodes: Episodes) -> None:
        self._episodes, self._zeros = episodes, episodes.zeros
        self._dynamics = Dynamics(parameters)
        self._drifts, self._scales = parameters.drifts, parameters.changes_dynamics
        self._drift_samples = parameters.drift_samples
        self._beta = tuple(parameters.b)
        shortest, self._longest = map(int, parameters.range_of("delay"))
        self.most_samples = shortest + 1
        self._order = len(parameters.a) - 1  # of A
        # Flows that have yet to take effect, for all terms of B; and outputs, those of the
        # latest block and those that A needs from before it. Both have the oldest first.
        flows = self._longest + len(self._beta)
        self._flows = deque([self._zeros] * flows, flows)
        self._outputs = [self._zeros] * self._order

    def reset(self, mask: Tensor) -> None:
        """Bring some plants to rest, with the numbers of the current episodes."""
        numbers, zeros = self._episodes.numbers, self._zeros
        self._now: tuple[Any, Any] | None = None  # factors and coefficients of (28)
        plants = PlantNumbers(**numbers)
        self._factors = self._dynamics.factors(plants, 0)
        if self._drifts:
            # The factors at the start of the drifts, and their total change.
            last = self._dynamics.factors(plants, self._drift_samples)
            self._drift = [
                (zeros + begin, zeros + (end - begin))
                for begin, end in zip(self._factors, last, strict=True)
            ]
        used = self._outputs[: len(self._outputs) - self._episodes.unused]
        self._outputs = [each.masked_fill(mask, 0.0) for each in used]
        self._flows.extend(torch.stack([*self._flows]).masked_fill_(mask, 0.0).unbind())
        self._limits = u_min, u_max = numbers["u_min"], numbers["u_max"]
        self._middle = zeros.new_zeros(()) + (u_min + u_max) / 2.0
        self._half_range = (u_max - u_min) / 2.0
        rounding = 2.0**-21 if zeros.dtype == torch.float32 else 2.0**-50
        self._edge = least_effective(numbers["dead_zone"], u_min, u_max, rounding)
        delay, n = numbers["delay"], len(zeros)
        self._places = None  # of each plant's delayed flows, where delays differ
        if isinstance(delay, Tensor):
            columns = torch.arange(n, device=delay.device)
            rows = torch.arange(self.most_samples + len(self._beta) - 1, device=delay.device)
            oldest = self._longest - delay.to(torch.int64)
            self._places = (rows[:, None] + oldest) * n + columns

    def apply(self, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Apply a(k) of all plants, shape (n,), and return u(k) and u_a(k), t/h."""
        u_min, u_max = self._limits
        # Section 4, last formula: rounded as in NumPy in float64, faster in float32.
        if actions.dtype == torch.float64:
            command = actions.add(1.0).mul_(self._half_range).add_(u_min)
        else:
            command = _plus(self._middle, self._half_range, actions)
        applied = applied_flow(command, self._edge, u_min, u_max)
        self._flows.append(applied.clone())  # as the caller may overwrite what is returned
        return command, applied

    def outputs(
        self, samples: int, noise: Tensor | None, load: Tensor | None
    ) -> tuple[Tensor, list[tuple[Number, Number]]]:
        """Compute the outputs of the next samples, after the action before them was applied.

        n and w, if any, and y have the shape (samples, n), degC. Also return gain and time
        constant at each sample, as multiples of those of A and B.
        """
        rows, all_factors = self._outputs[len(self._outputs) - self._order :], []
        response = self._response(samples)
        due = self._episodes.any_due if self._drifts else (lambda row: False)
        begins = [k for k in range(samples) if k == 0 or due(k)]
        for first, last in pairwise([*begins, samples]):
            if self._now is None or due(first):
                self._now = self._dynamics_at(first)
            factors, (alpha, scale, load_gain) = self._now
            forced = response[first:last]
            if noise is not None:
                forced = _plus(noise[first:last], scale, forced)
            elif self._scales:
                forced = forced * scale
            if load is not None:
                forced = _plus(forced, load_gain, load[first:last])
            all_factors += [factors] * (last - first)
            for output in forced.unbind():
                for lag, coefficient in enumerate(alpha, start=1):
                    output = _plus(output, coefficient, rows[-lag])
                rows.append(output)
        self._outputs = rows
        return torch.stack(rows[self._order :]), all_factors

    def detach(self) -> None:
        """Cut the graph that leads to earlier actions."""
        self._outputs = [each.detach() for each in self._outputs]
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

    def _dynamics_at(self, row: int) -> tuple[Any, Any]:
        """Return gain and time constant at a row, and the coefficients of (28) for them."""
        factors: tuple[Any, ...] = self._factors
        if self._drifts:
            age = self._episodes.age(row)
            if isinstance(age, Tensor):
                age = age.to(self._zeros.dtype)
            share = self._dynamics.share(age - age % DRIFT_INTERVAL)
            factors = tuple(_plus(first, share, more) for first, more in self._drift)
        return factors, self._dynamics.coefficients(*factors)


def _plus(first: Tensor, factor: Number, second: Tensor) -> Tensor:
    """Return first + factor * second, in one operation."""
    if isinstance(factor, Tensor):
        return torch.addcmul(first, factor, second)
    return torch.add(first, second, alpha=factor)
