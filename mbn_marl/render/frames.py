"""Frames of an animation, checked."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbn_marl.errors import MbnError


def checked_frames(frames: Iterable[NDArray[Any]], path: Path) -> list[NDArray[np.uint8]]:
    """``frames`` as a list of uint8 arrays of one shape (height, width, 3).

    Args:
        frames: what to check.
        path: the file that they are for, named in errors.

    Raises:
        MbnError: naming the frame that is something else, or that there is none.
    """
    pictures: list[NDArray[np.uint8]] = []
    for index, frame in enumerate(map(np.asarray, frames)):
        shape = pictures[0].shape if pictures else frame.shape
        if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3:
            wrong = f"{frame.dtype} {frame.shape}"
            raise MbnError(f"{path}: frame {index} is {wrong}, not uint8 (height, width, 3)")
        if frame.shape != shape:
            raise MbnError(f"{path}: frame {index} has shape {frame.shape}, the first has {shape}")
        pictures.append(frame)
    if not pictures:
        raise MbnError(f"{path}: there are no frames to write")
    return pictures
