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
from mptc_gym.torch_episodes import Episodes, Number


def applied_flow(command: Tensor, edge: Number, u_min: Number, u_max: Number) -> Tensor:
    """Return the flow u_a that the actuator applies, (29), t/h.

    Its gradient is 1 within the limits, also in the dead zone, and 0 beyond. Commands of a
    magnitude above `edge` have an effect. The limits are both floats, or both of shape (n,).
    """
    are_floats = (
        isinstance(edge, float) and isinstance(u_min, float) and isinstance(u_max, float)
    )
    if are_floats and not command.requires_grad and u_min <= 0.0 <= u_max:
        # The fastest way to the same numbers.
        shrunk = functional.hardshrink(command, edge)  # type: ignore[arg-type]  # it is a float
        return shrunk.clamp_(u_min, u_max)  # type: ignore[arg-type]
    limited = torch.clamp(command, u_min, u_max)  # type: ignore[arg-type]
    # 1 where the command passes the dead zone, otherwise 0: a product is much faster than an
    # unpredictable branch.
    if not command.requires_grad:
        return limited.mul_(command.abs().gt_(edge))
    passes = command.detach().abs().gt_(edge)
    # limited + constant * (passes - 1): the same value, but with the gradient of `limited`.
    return torch.addcmul(limited, limited.detach(), passes.sub_(1.0))


class TorchPlants:
    """Many plants side by side, with gradients where the actions have them.

    Attributes
    ----------
    most_samples : int
        d + 1, with d the shortest delay that can be drawn: so many outputs after an action
        follow from the actions so far, and can be computed in one block.
    """

    def __init__(self, parameters: Parameters, episodes: Episodes) -> None:
        self._episodes = episodes
        self._zeros = episodes.zeros
        self._dynamics = Dynamics(parameters)
        self._drifts = parameters.drifts
        self._changes_dynamics = parameters.changes_dynamics
        self._drift_samples = parameters.drift_samples
        self._beta = tuple(parameters.b)
        shortest, self._longest = map(int, parameters.range_of("delay"))
        self.most_samples = shortest + 1
        self._order = len(parameters.a) - 1  # of A
        # The flows that terms of B still need, the oldest first.
        flows = self._longest + len(self._beta)
        self._flows = deque([self._zeros] * flows, flows)
        # The outputs that A needs from before the latest block, then those of the block.
        self._outputs = [self._zeros] * self._order

    def reset(self, mask: Tensor) -> None:
        """Bring some plants to rest, with the numbers of the current episodes."""
        used_outputs = self._outputs[: len(self._outputs) - self._episodes.unused]
        self._outputs = [output.masked_fill(mask, 0.0) for output in used_outputs]
        self._flows.extend(torch.stack([*self._flows]).masked_fill_(mask, 0.0).unbind())
        self._reset_dynamics()
        self._reset_actuator()
        self._reset_delays()

    def _reset_dynamics(self) -> None:
        """Compute the factors of gain and time constant at k = 0, and their drifts."""
        numbers = PlantNumbers(**self._episodes.numbers)
        self._factors = self._dynamics.factors(numbers, 0)
        if self._drifts:
            # The factors at the start of the drifts, and their total change.
            final_factors = self._dynamics.factors(numbers, self._drift_samples)
            self._drift = [
                (self._zeros + initial, self._zeros + (final - initial))
                for initial, final in zip(self._factors, final_factors, strict=True)
            ]
        # The present factors and coefficients of (28), if they are known.
        self._present: tuple[Any, Any] | None = None

    def _reset_actuator(self) -> None:
        """Compute what `apply` needs of the actuator's numbers."""
        numbers = self._episodes.numbers
        u_min = numbers["u_min"]
        u_max = numbers["u_max"]
        self._limits = u_min, u_max
        self._middle = self._zeros.new_zeros(()) + (u_min + u_max) / 2.0
        self._half_range = (u_max - u_min) / 2.0
        rounding = 2.0**-21 if self._zeros.dtype == torch.float32 else 2.0**-50
        self._edge = least_effective(numbers["dead_zone"], u_min, u_max, rounding)

    def _reset_delays(self) -> None:
        """Compute where the delayed flows of each plant lie in all flows, if delays differ."""
        self._places: Tensor | None = None  # in the flattened flows
        delay = self._episodes.numbers["delay"]
        if isinstance(delay, Tensor):
            n = len(self._zeros)
            columns = torch.arange(n, device=delay.device)
            rows = torch.arange(self.most_samples + len(self._beta) - 1, device=delay.device)
            first_rows = self._longest - delay.to(torch.int64)
            self._places = (rows[:, None] + first_rows) * n + columns

    def apply(self, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Apply a(k) of all plants, shape (n,), and return u(k) and u_a(k), t/h."""
        u_min, u_max = self._limits
        # Section 4, last formula: rounded as in NumPy in float64, faster in float32.
        if actions.dtype == torch.float64:
            command = actions.add(1.0).mul_(self._half_range).add_(u_min)
        else:
            command = _add_product(self._middle, self._half_range, actions)
        applied = applied_flow(command, self._edge, u_min, u_max)
        self._flows.append(applied.clone())  # as the caller may overwrite what is returned
        return command, applied

    def outputs(
        self, samples: int, noise: Tensor | None, load: Tensor | None
    ) -> tuple[Tensor, list[tuple[Number, Number]]]:
        """Compute the outputs of the next samples, after the action before them was applied.

        Parameters
        ----------
        samples
            Length of the block, at most `most_samples`.
        noise, load
            n and w, degC, shape (samples, n); None if they are always 0.

        Returns
        -------
        Tensor
            y, degC, shape (samples, n).
        list of tuple
            Gain and time constant at each sample, as multiples of those of A and B.
        """
        outputs = self._outputs[len(self._outputs) - self._order :]
        all_factors: list[tuple[Number, Number]] = []
        response = self._response(samples)
        # The coefficients are constant from each of these rows to the next.
        boundaries = [row for row in range(samples) if row == 0 or self._has_drifted(row)]
        for first, end in pairwise([*boundaries, samples]):
            if self._present is None or self._has_drifted(first):
                self._present = self._dynamics_at(first)
            factors, (alpha, scale, load_gain) = self._present
            all_factors += [factors] * (end - first)
            forced = response[first:end]
            if noise is not None:
                forced = _add_product(noise[first:end], scale, forced)
            elif self._changes_dynamics:
                forced = forced * scale
            if load is not None:
                forced = _add_product(forced, load_gain, load[first:end])
            for forced_row in forced.unbind():
                output = forced_row
                for lag, coefficient in enumerate(alpha, start=1):
                    output = _add_product(output, coefficient, outputs[-lag])
                outputs.append(output)
        self._outputs = outputs
        return torch.stack(outputs[self._order :]), all_factors

    def _has_drifted(self, row: int) -> bool:
        """Return whether the dynamics of some plant change at a row of the block."""
        return self._drifts and self._episodes.any_due(row)

    def detach(self) -> None:
        """Cut the graph that leads to earlier actions."""
        self._outputs = [output.detach() for output in self._outputs]
        self._flows.extend([flow.detach() for flow in self._flows])

    def _response(self, samples: int) -> Tensor:
        """Return the response to the flows, B of (28), shape (samples, n)."""
        needed = samples + len(self._beta) - 1
        if self._places is None:
            flows = torch.stack([*islice(self._flows, needed)])
        else:
            older = self._longest - self.most_samples + 1
            all_flows = torch.stack([*islice(self._flows, older + needed)]).reshape(-1)
            places = self._places[:needed].reshape(-1)
            flows = all_flows.index_select(0, places).view(needed, -1)
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
            factors = tuple(
                _add_product(initial, share, change) for initial, change in self._drift
            )
        return factors, self._dynamics.coefficients(*factors)


def _add_product(first: Tensor, factor: Number, second: Tensor) -> Tensor:
    """Return first + factor * second, in one operation."""
    if isinstance(factor, Tensor):
        return torch.addcmul(first, factor, second)
    return torch.add(first, second, alpha=factor)
