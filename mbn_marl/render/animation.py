"""Writes frames as an animated GIF, or as H.264 in MP4, which every browser and office plays."""

from __future__ import annotations

import zlib
from collections.abc import Iterable
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbn_marl.errors import MbnError, load
from mbn_marl.files import check_ending, replacing

FPS = 20.0  # frames per second
_SAMPLED = 8  # frames that a GIF's palette is made from; with one, only what moves is stored
_QUALITY = 8  # of an MP4, out of 10; below it, thin lines fray
_EVEN = 2  # an MP4's sides are a multiple of this: colour is stored for every second pixel


class Mp4Writer(AbstractContextManager["Mp4Writer"]):
    """Writes an ``.mp4`` in a ``with`` block or until closed."""

    def __init__(self, path: str | Path) -> None:
        self.path = check_ending(Path(path), ".mp4")
        self._ffmpeg = load("imageio_ffmpeg", "render")
        self.shapes: list[tuple[int, ...]] = []
        self._open = ExitStack()

    def add(self, frame: NDArray[Any]) -> None:
        """Append a frame, uint8 (height, width, 3), all of one shape; an odd side loses a pixel."""
        _check_shape(frame, self.shapes, self.path)
        height, width = (side // _EVEN * _EVEN for side in frame.shape[:2])
        if len(self.shapes) == 1:
            temporary = self._open.enter_context(replacing(self.path))
            look = {"fps": FPS, "quality": _QUALITY, "macro_block_size": _EVEN}
            self._writer = self._ffmpeg.write_frames(temporary, (width, height), **look)
            self._open.callback(self._writer.close)
            self._writer.send(None)
        self._writer.send(np.ascontiguousarray(frame[:height, :width]))

    def close(self) -> None:
        """Complete the file, if there was a frame; closing twice does no harm."""
        self._open.close()

    def __exit__(self, *exception: Any) -> None:
        self._open.__exit__(*exception)


def write_mp4(frames: Iterable[NDArray[Any]], path: str | Path) -> Path:
    with Mp4Writer(path) as writer:
        for frame in frames:
            writer.add(np.asarray(frame))
        if not writer.shapes:
            raise MbnError(f"{writer.path}: there are no frames to write")
    return writer.path


def write_gif(frames: Iterable[NDArray[Any]], path: str | Path) -> Path:
    """Write ``frames`` to a ``.gif`` that loops."""
    path, image = check_ending(Path(path), ".gif"), load("PIL.Image", "render")
    packed: list[bytes] = []
    shapes: list[tuple[int, ...]] = []
    for frame in map(np.asarray, frames):
        _check_shape(frame, shapes, path)
        packed.append(zlib.compress(frame.tobytes(), level=1))
    if not packed:
        raise MbnError(f"{path}: there are no frames to write")

    def picture(data: bytes) -> NDArray[np.uint8]:
        return np.frombuffer(zlib.decompress(data), np.uint8).reshape(shapes[0])

    chosen = np.linspace(0, len(packed) - 1, _SAMPLED).astype(int)
    sample = image.fromarray(np.concatenate([picture(packed[index]) for index in chosen]))
    palette = sample.quantize(256, image.Quantize.FASTOCTREE)
    drawn = (
        image.fromarray(picture(data)).quantize(palette=palette, dither=image.Dither.NONE)
        for data in packed
    )
    how = {"save_all": True, "append_images": drawn, "duration": round(1000.0 / FPS), "loop": 0}
    with replacing(path) as temporary:
        next(drawn).save(temporary, **how)
    return path


def _check_shape(frame: NDArray[Any], shapes: list[tuple[int, ...]], path: Path) -> None:
    place = f"{path}: frame {len(shapes)}"
    if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3:
        raise MbnError(f"{place} is {frame.dtype} {frame.shape}, not uint8 (height, width, 3)")
    if shapes and frame.shape != shapes[0]:
        raise MbnError(f"{place} has shape {frame.shape}, the first has {shapes[0]}")
    shapes.append(frame.shape)
