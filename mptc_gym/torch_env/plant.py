"""Simulate many plants in PyTorch, a block of successive samples at a time.

The plant is equation (28) of the paper, A(z^-1) y(k) = B(z^-1) u_a(k - d) + C(z^-1) xi(k), with
temperature y, applied flow u_a, delay d and white noise xi. The actuator, with dead zone and
limits, is equation (29) of the paper. `mptc_gym.plant.dynamics.PlantBatch` simulates many
plants in NumPy, a sample at a time.
"""

from collections import deque
from itertools import islice, pairwise

import torch
from torch import Tensor
from torch.nn import functional

from mptc_gym.plant.dynamics import DRIFT_INTERVAL, Dynamics, least_effective_command
from mptc_gym.plant.parameters import Parameters, PlantNumbers
from mptc_gym.torch_env.episodes import Block, Episodes, History, Number, Restart


def applied_flow(command: Tensor, edge: Number, u_min: Number, u_max: Number) -> Tensor:
    """Return the flow u_a that the actuator applies for a command u, t/h, shape (n,).

    The actuator is equation (29) of the paper: the applied flow is 0 for a command in the dead
    zone, and otherwise the command, clipped to the limits. The gradient of the applied flow
    with respect to the command is 1 within the limits, even in the dead zone, and 0 beyond the
    limits.

    Parameters
    ----------
    command
        Commanded flows u, t/h, shape (n,).
    edge
        Edge of the dead zone, t/h, from `least_effective_command`: a command with a larger
        magnitude has an effect.
    u_min, u_max
        Limits of the actuator, t/h: two floats, or two tensors of shape (n,).
    """
    are_floats = (
        isinstance(edge, float) and isinstance(u_min, float) and isinstance(u_max, float)
    )
    if are_floats and not command.requires_grad and u_min <= 0.0 <= u_max:
        # These two operations give the same numbers as the general way, but are faster.
        shrunk = functional.hardshrink(command, edge)  # type: ignore[arg-type]  # it is a float
        return shrunk.clamp_(u_min, u_max)  # type: ignore[arg-type]
    limited = torch.clamp(command, u_min, u_max)  # type: ignore[arg-type]
    # 1 where the command passes the dead zone, otherwise 0: a product is much faster than an
    # unpredictable branch.
    passes = command.detach().abs().gt_(edge)
    if not command.requires_grad:
        return limited.mul_(passes)
    # limited + constant * (passes - 1) has the value of limited * passes, but the gradient of
    # `limited`.
    return torch.addcmul(limited, limited.detach(), passes.sub_(1.0))


class TorchPlants:
    """n plants and their actuators in PyTorch, with gradients if the actions have gradients.

    Attributes
    ----------
    most_samples : int
        Maximum number of samples in a block: d + 1, where d is the shortest delay that can be
        drawn. With a delay of d samples, the temperatures of the d + 1 samples after an action
        do not depend on later actions.
    """

    def __init__(self, parameters: Parameters, episodes: Episodes) -> None:
        """Prepare the plants, whose delays, dead zones and other values are in `episodes`."""
        self._episodes = episodes
        self._zeros = episodes.zeros
        self._dynamics = Dynamics(parameters)
        self._drifts = parameters.drifts
        self._drift_samples = parameters.drift_samples
        self._beta = tuple(parameters.b)
        shortest_delay, self._longest_delay = map(int, parameters.range_of("delay"))
        self.most_samples = shortest_delay + 1
        # The applied flows that terms of the polynomial B still need, t/h, the oldest first.
        flows = self._longest_delay + len(self._beta)
        self._flows = deque([self._zeros] * flows, flows)
        # The temperatures, degC. The polynomial A needs as many past temperatures as A has
        # coefficients from z^-1 on.
        self._outputs = History(self._zeros, len(parameters.a) - 1)

    def reset(self, restart: Restart, age: Tensor | int) -> None:
        """Bring the plants in `restart.mask` to rest, with parameter values of a new episode.

        `age` is the sample number k of each plant, shape (n,), or one number for all plants.
        """
        self._outputs.reset(restart)
        flows = torch.stack([*self._flows]).masked_fill_(restart.mask, 0.0)
        self._flows.extend(flows.unbind())  # the deque drops its old flows
        self._reset_actuator()
        self._reset_delays()
        numbers = PlantNumbers(**self._episodes.numbers)
        self._factors: tuple[Number, ...] = self._dynamics.factors(numbers, 0)
        if self._drifts:
            # Gain factor and time constant factor at k = 0, and their total change by drift.
            self._initial_factors = [self._zeros + initial for initial in self._factors]
            final_factors = self._dynamics.factors(numbers, self._drift_samples)
            self._factor_changes = [
                self._zeros + (final - initial)
                for initial, final in zip(self._factors, final_factors, strict=True)
            ]
        self._update_dynamics(age)

    def _reset_actuator(self) -> None:
        """Compute the limits and dead zones of the actuators, for `apply`."""
        numbers = self._episodes.numbers
        u_min = numbers["u_min"]
        u_max = numbers["u_max"]
        self._limits = u_min, u_max
        self._middle = self._zeros.new_zeros(()) + (u_min + u_max) / 2.0
        self._half_range = (u_max - u_min) / 2.0
        # Bound of the relative error of eight roundings, each of at most half an eps.
        rounding = 4.0 * torch.finfo(self._zeros.dtype).eps
        self._edge = least_effective_command(numbers["dead_zone"], u_min, u_max, rounding)

    def _reset_delays(self) -> None:
        """Compute the indices at which `_response` reads the delayed flows of each plant.

        The computed indices, shape (rows, n), refer to the applied flows of all plants in one
        flat tensor. If all plants always have the same delay, `_response` needs no indices.
        """
        self._delayed_at: Tensor | None = None
        delay = self._episodes.numbers["delay"]
        if isinstance(delay, Tensor):
            n = len(self._zeros)
            columns = torch.arange(n, device=delay.device)
            rows = torch.arange(self.most_samples + len(self._beta) - 1, device=delay.device)
            first_rows = self._longest_delay - delay.to(torch.int64)
            self._delayed_at = (rows[:, None] + first_rows) * n + columns

    def _update_dynamics(self, age: Tensor | int) -> None:
        """Compute the coefficients of equation (28) of the paper at sample k = `age`.

        The coefficients multiply past temperatures, past flows and the load in equation (28).
        If gain or time constant drifts, the coefficients change at sample numbers that are
        multiples of `DRIFT_INTERVAL`. `age` is the sample number k of each plant, shape (n,),
        or one number for all plants.
        """
        if self._drifts:
            if isinstance(age, Tensor):
                age = age.to(self._zeros.dtype)
            share = self._dynamics.drift_share(age - age % DRIFT_INTERVAL)
            self._factors = tuple(
                _add_product(initial, share, change)
                for initial, change in zip(
                    self._initial_factors, self._factor_changes, strict=True
                )
            )
        coefficients = self._dynamics.coefficients(*self._factors)
        self._alpha, self._scale, self._load_gain = coefficients

    def apply(self, actions: Tensor) -> tuple[Tensor, Tensor]:
        """Apply the actions a(k) of all plants, shape (n,), and store the applied flows.

        `apply` returns the commanded flows u(k) and the applied flows u_a(k), t/h, shape (n,).
        """
        u_min, u_max = self._limits
        # Actions from -1 to 1 command flows from u_min to u_max (last formula of the paper's
        # Section 4). In float64, the formula rounds as NumPy does; in float32, a faster formula
        # is used.
        if actions.dtype == torch.float64:
            command = actions.add(1.0).mul_(self._half_range).add_(u_min)
        else:
            command = _add_product(self._middle, self._half_range, actions)
        applied = applied_flow(command, self._edge, u_min, u_max)
        self._flows.append(applied.clone())  # a copy, as the caller may overwrite `applied`
        return command, applied

    def outputs(
        self, block: Block, noise: Tensor | None, load: Tensor | None
    ) -> tuple[Tensor, list[tuple[Number, ...]]]:
        """Return the temperatures and drift factors of a block of successive samples.

        Parameters
        ----------
        block
            Block of at most `most_samples` samples, which follow the last action that `apply`
            has applied.
        noise, load
            Coloured noise n and load w, degC, shape (samples, n). None for the noise or the
            load means that this signal is always 0.

        Returns
        -------
        Tensor
            Temperatures y, degC, shape (samples, n).
        list of tuple
            Gain factor and time constant factor at each sample, relative to the gain and the
            time constant of the polynomials A and B.
        """
        outputs = [*self._outputs.rows]
        factors: list[tuple[Number, ...]] = []
        response = self._response(block.samples)
        rows_of_change = block.due_rows if self._drifts else []
        # Between two boundaries, the coefficients are constant.
        boundaries = sorted({0, *rows_of_change, block.samples})
        for first, end in pairwise(boundaries):
            if first in rows_of_change:
                self._update_dynamics(block.age(first))
            factors += [self._factors] * (end - first)
            # The temperatures without the terms of earlier temperatures.
            forced = response[first:end]
            if noise is not None:
                forced = _add_product(noise[first:end], self._scale, forced)
            else:
                forced = forced * self._scale
            if load is not None:
                forced = _add_product(forced, self._load_gain, load[first:end])
            for forced_row in forced.unbind():
                output = forced_row
                for lag, coefficient in enumerate(self._alpha, start=1):
                    output = _add_product(output, coefficient, outputs[-lag])
                outputs.append(output)
        new_outputs = outputs[-block.samples :]
        self._outputs.extend(new_outputs)
        return torch.stack(new_outputs), factors

    def detach(self) -> None:
        """Detach past flows and temperatures from the gradient graph of earlier actions."""
        self._outputs.detach()
        self._flows.extend([flow.detach() for flow in self._flows])

    def _response(self, samples: int) -> Tensor:
        """Return the effect of past flows on the temperatures, degC, shape (samples, n).

        The effect at sample k is B(z^-1) u_a(k-d), with the polynomial B of equation (28) of
        the paper, applied flow u_a and delay d. `samples` is the number of samples in the
        block.
        """
        # One delayed flow for each sample, and earlier flows for the further terms of B.
        rows = samples + len(self._beta) - 1
        if self._delayed_at is None:
            delayed_flows = torch.stack([*islice(self._flows, rows)])
        else:
            shortest_delay = self.most_samples - 1
            rows_of_all = rows + self._longest_delay - shortest_delay
            all_flows = torch.stack([*islice(self._flows, rows_of_all)])
            indices = self._delayed_at[:rows].reshape(-1)
            delayed_flows = all_flows.reshape(-1).index_select(0, indices).view(rows, -1)
        response = delayed_flows[-samples:] * self._beta[0]
        for lag, coefficient in enumerate(self._beta[1:], start=1):
            earlier = delayed_flows[rows - samples - lag : rows - lag]
            response = response.add_(earlier, alpha=coefficient)
        return response


def _add_product(first: Tensor, factor: Number, second: Tensor) -> Tensor:
    """Return first + factor * second in one operation of PyTorch, which is faster than two."""
    if isinstance(factor, Tensor):
        return torch.addcmul(first, factor, second)
    return torch.add(first, second, alpha=factor)
