"""The model of the file format ``mbn-episode/1``, which ``docs/replay.md`` describes.

Arrays are base64 of their bytes, so that they are exact and small.
"""

from __future__ import annotations

import base64
import binascii
import math
from typing import Annotated, Any, Final, Literal, Self

import numpy as np
from annotated_types import Len
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from mbn_marl.config import MAX_ROBOTS, MAX_ROIS
from mbn_marl.episode.episode import Outcome

FORMAT: Final = "mbn-episode/1"
MAX_SOURCE = 200
_LITTLE = {"float32": "<f4", "float64": "<f8", "uint8": "<u1", "uint16": "<u2"}


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class PackedArray(_Strict):
    """An array as base64 of its numbers, little-endian, in C order."""

    dtype: Literal["float32", "float64", "uint8", "uint16"]
    shape: Annotated[list[Annotated[int, Field(ge=0)]], Len(1, 3)]
    data: str

    @classmethod
    def pack(cls, array: NDArray[Any]) -> Self:
        """Pack an array of one of these dtypes."""
        name: Any = array.dtype.name
        data = base64.b64encode(array.astype(_LITTLE[name]).tobytes()).decode("ascii")
        return cls(dtype=name, shape=list(array.shape), data=data)

    def unpack(self) -> NDArray[Any]:
        """Return the array; raise ``ValueError`` if the data is not base64, or of another size."""
        try:
            raw = base64.b64decode(self.data, validate=True)
        except binascii.Error as error:
            raise ValueError(f"data: not base64: {error}") from None
        dtype = np.dtype(_LITTLE[self.dtype])
        expected = math.prod(self.shape) * dtype.itemsize
        if len(raw) != expected:
            raise ValueError(f"data: {len(raw)} bytes; a {self.dtype} {self.shape} has {expected}")
        return np.frombuffer(raw, dtype).reshape(self.shape).astype(self.dtype)


class CodedArray(_Strict):
    """An array with few different numbers: the numbers, and the index of each entry's number."""

    values: list[float]
    indices: PackedArray

    @classmethod
    def pack(cls, array: NDArray[Any]) -> Self:
        """Pack an array with at most 65,536 different numbers."""
        values, indices = np.unique(array, return_inverse=True)
        smallest = np.uint8 if len(values) <= 256 else np.uint16
        packed = PackedArray.pack(indices.reshape(array.shape).astype(smallest))
        return cls(values=values.tolist(), indices=packed)

    def unpack(self) -> Any:
        """Return the array; raise ``ValueError`` if the indices are broken or out of range."""
        indices = self.indices.unpack()
        if indices.dtype.kind != "u" or (indices.size and indices.max() >= len(self.values)):
            raise ValueError(f"indices: allowed: whole numbers below {len(self.values)}")
        return np.asarray(self.values, np.float64)[indices]


class Rewards(_Strict):
    """The rewards of each step."""

    terms: list[str] = Field(description="The names of the terms.")
    robots: CodedArray = Field(description="(T, n, terms), the robots' own rewards by term.")
    team: CodedArray = Field(description="(T,), the centralised rewards.")


class EpisodeFile(_Strict):
    """An episode of mbn_marl in the format mbn-episode/1. n robots, m ROIs, T steps."""

    format: Literal["mbn-episode/1"] = Field(description="Name and version of the format.")
    version: str = Field(description="The version of mbn_marl that wrote it.")
    source: Annotated[str, Field(max_length=MAX_SOURCE)] = Field(
        description="The name of what acted."
    )
    seed: int | None = Field(description="Of the world and of what acted.")
    robots: Annotated[int, Field(ge=1, le=MAX_ROBOTS)] = Field(description="n.")
    steps: Annotated[int, Field(ge=0)] = Field(description="T.")
    outcome: Outcome = Field(description="How it ended.")
    team_return: float = Field(description="Sum of the centralised rewards.")
    wind: tuple[float, float] = Field(description="Speed (units/step per step), angle (degrees).")
    field: dict[str, Any] = Field(description="As in a field file of the format mbn-field/1.")
    config: dict[str, Any] = Field(description="Every setting of NavigationConfig but the wind.")
    visits: Annotated[list[int | None], Len(1, MAX_ROIS)] = Field(
        description="The step in which each ROI was visited, from 1 on; null for never."
    )
    positions: PackedArray = Field(description="(T + 1, n, 2), units, from the reset on.")
    actions: PackedArray = Field(description="(T, n, 2), in [-1, 1].")
    rewards: Rewards
