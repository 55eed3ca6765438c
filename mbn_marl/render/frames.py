"""Frames of an animation, checked."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbn_marl.errors import MbnError


def checked_frames(frames: Iterable[NDArray[Any]], path: Path) -> Iterator[NDArray[np.uint8]]:
    """``frames`` one after the other, as uint8 arrays of one shape (height, width, 3).

    Args:
        frames: what to check; none is kept.
        path: the file that they are for, named in errors.

    Raises:
        MbnError: naming the frame that is something else, or that there is none.
    """
    shape: tuple[int, ...] | None = None
    for index, frame in enumerate(map(np.asarray, frames)):
        shape = shape or frame.shape
        check_frame(frame, index, shape, path)
        yield frame
    if shape is None:
        raise MbnError(f"{path}: there are no frames to write")


def check_frame(frame: NDArray[Any], index: int, shape: tuple[int, ...], path: Path) -> None:
    """Check frame ``index`` of ``path``, whose first frame has ``shape``.

    Raises:
        MbnError: it is not uint8 (height, width, 3), or of another shape.
    """
    if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3:
        wrong = f"{frame.dtype} {frame.shape}"
        raise MbnError(f"{path}: frame {index} is {wrong}, not uint8 (height, width, 3)")
    if frame.shape != shape:
        raise MbnError(f"{path}: frame {index} has shape {frame.shape}, the first has {shape}")
