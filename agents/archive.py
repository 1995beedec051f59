"""Read `.npz` files from untrusted sources, and name the file that is damaged."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from os import PathLike
from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

PRETRAINED: Final = Path(__file__).parent / "pretrained"  # networks that come with the project
LARGEST: Final = 2**26  # bytes of all arrays, unpacked: hundreds of times what a network needs


@contextmanager
def reading(path: str | PathLike[str], holds: str) -> Iterator[Mapping[str, NDArray[Any]]]:
    """Yield the arrays of a file by name. Nothing in the file is executed.

    Raises
    ------
    FileNotFoundError
        If there is no such file.
    ValueError
        If the file is damaged or absurdly large, or the `with` block rejects its contents; the
        message says what it should hold.
    """
    with Path(path).open("rb") as raw:
        try:
            with np.load(raw, allow_pickle=False) as file:
                size = sum(member.file_size for member in file.zip.infolist())
                if size > LARGEST:
                    raise ValueError(f"its arrays have {size:,} bytes, over {LARGEST:,}")
                yield file
        except Exception as error:  # from zip, zlib, NumPy, JSON or a check
            raise ValueError(f"{path} holds no {holds}, or is damaged: {error}") from error
