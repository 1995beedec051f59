"""Networks that are trained and come with the project."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from typing import Any

from agents import PolicyNetwork


@dataclass(frozen=True)
class Pretrained:
    """Makes controllers of a network that comes with the project.

    Attributes
    ----------
    name
        As `PolicyNetwork.pretrained` takes it.
    """

    name: str

    @property
    def observation(self) -> dict[str, int]:
        """Arguments of the environment that give the network its observation."""
        return dict(_loaded(self.name).observation)

    @property
    def provenance(self) -> dict[str, Any]:
        """Where it comes from, without its learning curve."""
        kept = _loaded(self.name).provenance
        return {"file": f"{self.name}.npz"} | {k: v for k, v in kept.items() if k != "curve"}

    def __call__(self, u_min: float, u_max: float) -> PolicyNetwork:
        """Return a controller."""
        return PolicyNetwork.pretrained(self.name, u_min=u_min, u_max=u_max)


@cache
def _loaded(name: str) -> PolicyNetwork:
    return PolicyNetwork.pretrained(name)


nn_dpc = Pretrained("nn-dpc")
nn_adaptive = Pretrained("nn-adaptive")
