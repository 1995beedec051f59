"""Store the observations of many plants in PyTorch."""

from collections.abc import Sequence

import torch
from torch import Tensor

from mptc_gym.torch_env.episodes import History, Restart


class Window:
    """Observations of n plants, computed in advance for a block of successive samples."""

    def __init__(self, windows: Sequence[int], zeros: Tensor) -> None:
        """Prepare observations of n plants.

        Parameters
        ----------
        windows
            Numbers of set points, errors, outputs and past actions in an observation.
        zeros
            Zeros, shape (n,), with the device and the data type of all tensors of the
            environment.
        """
        *self._windows, self._past_actions = windows
        self._zeros = zeros
        # The histories of set points, errors and outputs, degC.
        self._histories = [History(zeros, window) for window in self._windows]
        self._actions = zeros.expand(self._past_actions, -1)  # past actions, the newest first
        # Observations of the rest of the block, without past actions, shape (size, n), the next
        # sample last.
        self._ahead: list[Tensor] = []

    def reset(self, restart: Restart, setpoint: Tensor, rest_action: Tensor) -> None:
        """Fill the observations of plants in `restart.mask` with the values of a plant at rest.

        `setpoint` holds the set points y_d(0), degC, and `rest_action` the actions that command
        a flow of 0 t/h, both of shape (n,).
        """
        setpoints, errors, outputs = self._histories
        setpoints.reset(restart, newest=setpoint)
        errors.reset(restart, newest=setpoint)
        outputs.reset(restart)
        self._actions = torch.where(restart.mask, rest_action.clamp(-1.0, 1.0), self._actions)

    def extend(self, *blocks: Tensor) -> None:
        """Store successive set points, errors and outputs, and compute the observations.

        `blocks` holds three tensors of shape (samples, n), degC: set points, errors and
        outputs.
        """
        for history, window, block in zip(self._histories, self._windows, blocks, strict=True):
            if window:
                history.extend(block.unbind())
        samples = len(blocks[0])
        self._ahead = self._stack(samples, first_place=1)[::-1]

    def next(self, actions: Tensor) -> Tensor:
        """Return the observations at the next sample of the block, shape (n, size).

        `actions`, shape (n,), are the actions of the step that leads to the next sample.
        """
        observations = self._ahead.pop()
        if self._past_actions:
            newest = actions.clamp(-1.0, 1.0)[None]
            self._actions = torch.cat((newest, self._actions))[:-1]
            observations = torch.cat((observations, self._actions))
        return observations.t()

    def present(self) -> Tensor:
        """Return the observations after a reset, shape (n, size)."""
        return torch.cat((*self._stack(1, first_place=0), self._actions)).t()

    def detach(self) -> None:
        """Detach stored observations from PyTorch's gradient graph of earlier actions."""
        for history in self._histories:
            history.detach()
        self._ahead = [observations.detach() for observations in self._ahead]
        self._actions = self._actions.detach()

    def _stack(self, samples: int, first_place: int) -> list[Tensor]:
        """Return observations at successive samples, without actions, each of shape (size, n).

        In the stored set points, errors and outputs, the oldest elements of the first
        observation have the index `first_place`.
        """
        newest_first: list[Tensor] = []  # the elements of all observations, shape (n,) each
        for place in range(first_place, first_place + samples):
            for history, window in zip(self._histories, self._windows, strict=True):
                newest_first += history.rows[place : place + window][::-1]
        n = len(self._zeros)
        if not newest_first:  # the observation holds past actions alone
            return [self._zeros.new_empty(0, n)] * samples
        return [*torch.stack(newest_first).view(samples, -1, n).unbind()]
