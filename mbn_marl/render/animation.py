"""Writes frames as an animated GIF, or as H.264 in MP4, which every browser and office plays."""

from __future__ import annotations

import importlib
import zlib
from collections.abc import Iterable
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbn_marl.errors import MbnError, install
from mbn_marl.files import replacing

GIF_RATES, MP4_RATES = (0.01, 50.0), (0.01, 120.0)
"""Allowed frames per second; a GIF counts hundredths of a second, and viewers slow down a one."""
_SAMPLED = 8  # frames that a GIF's palette is made from; with one, only what moves is stored
_QUALITY = 8  # of an MP4, out of 10; below it, thin lines fray
_EVEN = 2  # an MP4's sides are a multiple of this: colour is stored for every second pixel


class Mp4Writer(AbstractContextManager["Mp4Writer"]):
    """Writes a video frame by frame, in a ``with`` block or until it is closed.

    Args:
        path: an ``.mp4`` file; missing folders are made, and a file is replaced only once the new
            one is complete.
        fps: frames per second, 0.01 to 120.

    Attributes:
        count: how many frames there are so far.

    Raises:
        MbnError: naming the path, or the number that is wrong.
        ImportError: if imageio-ffmpeg is not installed.
    """

    def __init__(self, path: str | Path, fps: float = 20.0) -> None:
        self.path = _checked(path, ".mp4", fps, MP4_RATES)
        self._ffmpeg = _load("imageio_ffmpeg")
        self._fps, self.count = fps, 0
        self._shape: tuple[int, ...] | None = None
        self._open = ExitStack()

    def add(self, frame: NDArray[Any]) -> None:
        """Append a frame.

        Args:
            frame: uint8 (height, width, 3), all of one shape; an odd side loses a pixel.

        Raises:
            MbnError: it is something else.
            OSError: naming the path, if it cannot be written.
        """
        self._shape = _checked_shape(frame, self.count, self._shape, self.path)
        height, width = (side // _EVEN * _EVEN for side in self._shape[:2])
        if not self.count:
            temporary = self._open.enter_context(replacing(self.path))
            how = {"fps": self._fps, "quality": _QUALITY, "macro_block_size": _EVEN}
            self._writer = self._ffmpeg.write_frames(temporary, (width, height), **how)
            self._open.callback(self._writer.close)
            self._writer.send(None)
        self._writer.send(np.ascontiguousarray(frame[:height, :width]))
        self.count += 1

    def close(self) -> None:
        """Complete the file, if there was a frame; closing twice does no harm."""
        self._open.close()

    def __exit__(self, *exception: Any) -> None:
        self._open.__exit__(*exception)


def write_mp4(frames: Iterable[NDArray[Any]], path: str | Path, fps: float = 20.0) -> Path:
    """Write ``frames`` to ``path``, and return that; arguments and errors as :class:`Mp4Writer`.

    Raises:
        MbnError: there is no frame.
    """
    with Mp4Writer(path, fps) as writer:
        for frame in frames:
            writer.add(np.asarray(frame))
        if not writer.count:
            raise MbnError(f"{writer.path}: there are no frames to write")
    return writer.path


def write_gif(frames: Iterable[NDArray[Any]], path: str | Path, fps: float = 20.0) -> Path:
    """Write ``frames`` to ``path``, played in an endless loop, and return that.

    Args:
        frames: uint8 arrays, all of one shape (height, width, 3).
        path: a ``.gif`` file; missing folders are made, and a file is replaced only once the new
            one is complete.
        fps: frames per second, 0.01 to 50; the delay is rounded to 0.01 s.

    Raises:
        MbnError: naming the path, the frame or the number that is wrong.
        ImportError: if Pillow is not installed.
        OSError: naming the path, if it cannot be written.
    """
    path = _checked(path, ".gif", fps, GIF_RATES)
    image = _load("PIL.Image")
    packed: list[bytes] = []
    shape: tuple[int, ...] | None = None
    for index, frame in enumerate(map(np.asarray, frames)):
        shape = _checked_shape(frame, index, shape, path)
        packed.append(zlib.compress(frame.tobytes(), level=1))
    if shape is None:
        raise MbnError(f"{path}: there are no frames to write")

    def picture(data: bytes) -> NDArray[np.uint8]:
        return np.frombuffer(zlib.decompress(data), np.uint8).reshape(shape)

    chosen = np.linspace(0, len(packed) - 1, _SAMPLED).astype(int)
    sample = image.fromarray(np.concatenate([picture(packed[index]) for index in chosen]))
    palette = sample.quantize(256, image.Quantize.FASTOCTREE)
    drawn = (
        image.fromarray(picture(data)).quantize(palette=palette, dither=image.Dither.NONE)
        for data in packed
    )
    delay = 10 * round(100.0 / fps)
    try:
        with replacing(path) as temporary:
            next(drawn).save(temporary, save_all=True, append_images=drawn, duration=delay, loop=0)
    except OverflowError:
        raise MbnError(f"{path}: equal frames last longer than a GIF allows; raise fps") from None
    return path


def _checked(path: str | Path, ending: str, fps: float, rates: tuple[float, float]) -> Path:
    """Check the name and the rate; return the path."""
    path = Path(path)
    if path.suffix.lower() != ending:
        raise MbnError(f"{path}: the file name has to end in {ending}")
    if not rates[0] <= fps <= rates[1]:
        raise MbnError(f"{path}: fps has to be {rates[0]:g} to {rates[1]:g}, not {fps}")
    return path


def _load(name: str) -> Any:
    """Import a library of the extra ``render``."""
    try:
        return importlib.import_module(name)
    except ModuleNotFoundError as error:
        library = name.split(".")[0]
        raise ImportError(
            f"animations need {library}: {install('render')}", name=library
        ) from error


def _checked_shape(
    frame: NDArray[Any], index: int, shape: tuple[int, ...] | None, path: Path
) -> tuple[int, ...]:
    """Check frame ``index`` of ``path``, whose first frame has ``shape``; return its shape."""
    if frame.dtype != np.uint8 or frame.ndim != 3 or frame.shape[2] != 3:
        wrong = f"{frame.dtype} {frame.shape}"
        raise MbnError(f"{path}: frame {index} is {wrong}, not uint8 (height, width, 3)")
    if shape not in (None, frame.shape):
        raise MbnError(f"{path}: frame {index} has shape {frame.shape}, the first has {shape}")
    return frame.shape
