"""Writes frames as a small animated GIF."""

from __future__ import annotations

import zlib
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbn_marl.errors import MbnError
from mbn_marl.files import replacing
from mbn_marl.render.frames import checked_frames

SLOWEST, FASTEST = 0.01, 50.0
"""Frames per second; a GIF counts hundredths of a second, and viewers slow a delay of one down."""
_COLOURS = 256
_SAMPLED = 8
"""How many frames the one palette is made from; with one palette only what moves is stored."""
_FAST = 1
"""How hard zlib tries: flat colours shrink to a fiftieth all the same."""


def write_gif(frames: Iterable[NDArray[Any]], path: str | Path, fps: float = 20.0) -> Path:
    """Write ``frames`` to ``path``, played in an endless loop.

    Args:
        frames: uint8 arrays, all of one shape (height, width, 3).
        path: a ``.gif`` file; missing folders are made, and a file is replaced only once the new
            one is complete.
        fps: frames per second, 0.01 to 50; the delay is rounded to 0.01 s.

    Returns:
        The path.

    Raises:
        MbnError: naming the path, the frame or the number that is wrong.
        ImportError: if Pillow is not installed.
        OSError: naming the path, if it cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".gif":
        raise MbnError(f"{path}: the file name has to end in .gif")
    if not SLOWEST <= fps <= FASTEST:
        raise MbnError(f"{path}: fps has to be {SLOWEST:g} to {FASTEST:g}, not {fps}")
    try:
        from PIL import Image
    except ModuleNotFoundError as error:
        raise ImportError(
            'writing a GIF needs Pillow: pip install "mbn_marl[render]"', name="PIL"
        ) from error
    packed = []
    shape: tuple[int, ...] = ()
    for frame in checked_frames(frames, path):
        packed.append(zlib.compress(frame.tobytes(), _FAST))
        shape = frame.shape

    def picture(index: int) -> NDArray[np.uint8]:
        return np.frombuffer(zlib.decompress(packed[index]), np.uint8).reshape(shape)

    chosen = np.linspace(0, len(packed) - 1, _SAMPLED).astype(int)
    sample = Image.fromarray(np.concatenate([picture(index) for index in chosen]))
    palette = sample.quantize(_COLOURS, Image.Quantize.FASTOCTREE)
    drawn = (
        Image.fromarray(picture(index)).quantize(palette=palette, dither=Image.Dither.NONE)
        for index in range(len(packed))
    )
    delay = 10 * round(100.0 / fps)
    with replacing(path) as temporary:
        first = next(drawn)
        first.save(temporary, save_all=True, append_images=drawn, duration=delay, loop=0)
    return path
