"""What a training that is not finished returns, and goes on from."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True)
class Checkpoint:
    """How far a training got.

    Attributes
    ----------
    content
        All that it needs to go on, as the bytes of a file.
    name
        Of that file, for messages, once there is one.
    steps
        How many are taken.
    """

    content: bytes
    name: str = ""
    steps: int = 0
