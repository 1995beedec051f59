"""What command lines have in common."""

from __future__ import annotations

import argparse


def number(text: str) -> int:
    """Read a number of at least 1; argparse shows this function's name in its complaints."""
    value = int(text)
    if value < 1:
        raise argparse.ArgumentTypeError(f"must be at least 1, got {value}")
    return value
