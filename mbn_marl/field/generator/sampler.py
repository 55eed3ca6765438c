"""Random fields by family; (seed, world, episode) decides each."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from fractions import Fraction
from itertools import accumulate
from numbers import Integral, Real
from typing import Annotated, Any

import numpy as np
import numpy.typing as npt
from pydantic import Field as Described
from pydantic import (
    ValidationError,
    ValidationInfo,
    ValidatorFunctionWrapHandler,
    WrapValidator,
    field_validator,
)

from mbn_marl.config import MAX_ROBOTS, MAX_ROIS, Checked, RealNumber, WholeNumber
from mbn_marl.errors import ConfigError
from mbn_marl.field.field import Field
from mbn_marl.field.generator.layout import (
    FAMILIES,
    MILLI,
    MOST_EDGES,
    WEIGHT_SUM,
    Family,
    Tables,
    make_tables,
    scratch_rows,
)
from mbn_marl.field.schema import DEFAULT_ARENA, MAX_COORDINATE

MAX_SEED, MAX_EPISODE = 2**63 - 1, 2**32 - 1
"""Numbers of worlds go as far as seeds."""


def least_size(robots: int, rois: int) -> float:
    """Return the least size, in units, of fields that hold so many robots and ROIs."""
    return 10.0 * max(10, math.ceil(5.0 * math.sqrt(robots + rois / 3) - 2.0))


def _least_of(known: Mapping[str, Any]) -> tuple[float, str]:
    robots, rois = (known.get(name, (1, 1))[1] for name in ("robots", "rois"))
    return least_size(robots, rois), f"{robots} robots and {rois} ROIs"


def _as_range(value: Any, handler: ValidatorFunctionWrapHandler) -> Any:
    try:
        low, high = handler((value, value) if isinstance(value, Real) else value)
    except ValidationError as error:
        wrong = (one["msg"].removeprefix("Value error, ") for one in error.errors())
        number = "; ".join(dict.fromkeys(wrong)).replace("a valid tuple", "a number")
        raise ValueError(f"{number}, or a range (low, high) of such") from None
    if low > high:
        raise ValueError("Input should have a low end that is not above its high end")
    return low, high


RANGE = WrapValidator(_as_range)
"""One number is a range with two equal ends."""
Robots = Annotated[WholeNumber, Described(ge=1, le=MAX_ROBOTS)]
Rois = Annotated[WholeNumber, Described(ge=1, le=MAX_ROIS)]
Seed = Annotated[WholeNumber, Described(ge=0, le=MAX_SEED)]
_Size = Annotated[RealNumber, Described(ge=least_size(1, 1), le=MAX_COORDINATE)]
_Side = Annotated[RealNumber, Described(gt=0.0, le=MAX_COORDINATE)]


class FieldSampler(Checked):
    """Random fields of some families: one for each seed, world and episode.

    The fields are the same on every processor. All are valid and connected; no passage is narrower
    than 12 units. ROIs are at least 5 units apart, starts at least 12, and both at least 4 units
    from walls, and farther if there is room. A range that was given as one number is kept as a
    range with two equal ends. Samplers compare and hash by value, and can be pickled.

    Attributes:
        families: one or more of ``"convex"``, ``"concave"``, ``"corridors"``, ``"obstacles"`` and
            ``"farm"``.
        robots: how many starts, 1 to 64, or a range ``(low, high)`` that each field draws from.
        rois: how many ROIs, 1 to 24, or a range.
        arena: width and height in units, at most 1e6.
        size: the longest side of a field's bounding box, units, or a range; at most the arena's
            shorter side, and not too small for the most robots and ROIs. ``None``: 110 to 420, or
            more for many robots and ROIs, or less in a small arena.
        weights: how often a family is drawn, one number >= 0 for each; ``None``: equally often.
        seed: 0 to 2^63 - 1.

    Raises:
        ConfigError: naming every unknown or invalid argument and what is allowed.
    """

    families: tuple[Family, ...]
    robots: Annotated[tuple[Robots, Robots], RANGE]
    rois: Annotated[tuple[Rois, Rois], RANGE]
    arena: tuple[_Side, _Side]
    size: Annotated[tuple[_Size, _Size], RANGE]
    weights: tuple[Annotated[RealNumber, Described(ge=0.0, allow_inf_nan=False)], ...] | None
    seed: Seed

    def __init__(
        self,
        /,
        families: Sequence[str] = ("convex",),
        robots: int | Sequence[int] = 3,
        rois: int | Sequence[int] = 6,
        size: float | Sequence[float] | None = None,
        arena: Sequence[float] = DEFAULT_ARENA,
        weights: Sequence[float] | None = None,
        seed: int = 0,
        **others: Any,
    ) -> None:
        ranges = {"robots": robots, "rois": rois, "size": size}
        given = {"families": families, **ranges, "arena": arena, "weights": weights, "seed": seed}
        super().__init__(**given, **others)

    @field_validator("families")
    @classmethod
    def _different(cls, families: tuple[str, ...]) -> tuple[str, ...]:
        if len(set(families)) < len(families):
            raise ValueError("Input should name each family once")
        if not families:
            raise ValueError("Input should name at least one family")
        return families

    @field_validator("arena")
    @classmethod
    def _roomy(cls, arena: tuple[float, float], info: ValidationInfo) -> tuple[float, float]:
        least, team = _least_of(info.data)
        if min(arena) < least:
            raise ValueError(f"Input should have sides of at least {least:g}, the least for {team}")
        return arena

    @field_validator("size", mode="before")
    @classmethod
    def _by_default(cls, size: Any, info: ValidationInfo) -> Any:
        side, (least, _) = min(info.data.get("arena", DEFAULT_ARENA)), _least_of(info.data)
        fitting = min(max(110.0, least), side), min(max(420.0, 3.5 * least), side)
        return fitting if size is None else size

    @field_validator("size")
    @classmethod
    def _fitting(cls, size: tuple[float, float], info: ValidationInfo) -> tuple[float, float]:
        side, (least, team) = min(info.data.get("arena", DEFAULT_ARENA)), _least_of(info.data)
        if size[1] > side:
            raise ValueError(f"Input should be at most the arena's side, {side:g}")
        if size[0] < least:
            raise ValueError(f"Input should be at least {least:g}, the least for {team}")
        return size

    @field_validator("weights")
    @classmethod
    def _one_for_each(
        cls, weights: tuple[float, ...] | None, info: ValidationInfo
    ) -> tuple[float, ...] | None:
        families = info.data.get("families")
        if weights is not None and families is not None and len(weights) != len(families):
            raise ValueError(f"Input should have one number for each of {len(families)} families")
        if weights is not None and not any(weights):
            raise ValueError("Input should have a number above 0")
        return weights

    @property
    def most_edges(self) -> int:
        return max(MOST_EDGES[family] for family in self.families)

    @property
    def most_bends(self) -> int:
        """The greatest number of corners at which a field can be other than convex."""
        bent = [MOST_EDGES[family] for family in self.families if family != "convex"]
        return max(bent, default=3) - 3  # an outline has three corners at least where it is convex

    def numbers(self) -> npt.NDArray[np.int64]:
        """Return all but the seed as the whole numbers (13,) that ``families.make_field`` reads.

        These are the arena's sides, the ranges of sizes, robots and ROIs, and for each of
        ``FAMILIES`` the sum of the weights up to it, 2^30 in all; lengths in milli-units.
        """
        given = self.weights or (1.0,) * len(self.families)
        weights = dict.fromkeys(FAMILIES, Fraction(0))
        weights |= zip(self.families, map(Fraction, given), strict=True)
        sums = list(accumulate(weights.values()))
        shares = [math.floor(each / sums[-1] * WEIGHT_SUM) for each in sums]
        arena = [_millis(side) - (_millis(side) / MILLI > side) for side in self.arena]
        sizes = [min(_millis(length), *arena) for length in self.size]
        return np.array([*arena, *sizes, *self.robots, *self.rois, *shares], np.int64)

    def field(self, world: int = 0, episode: int = 0) -> Field:
        """Return the field of a world (0 to 2^63 - 1) in an episode (0 to 2^32 - 1).

        Its name is such as ``concave-7`` or ``concave-7-12-3``: family, seed, world and episode.
        Fields of the same name are equal if ``robots``, ``rois``, ``size`` and ``arena`` are.

        Raises:
            ConfigError: a number is not in its range.
        """
        from mbn_marl.field.generator.families import make_fields

        limits = {"world": (world, MAX_SEED), "episode": (episode, MAX_EPISODE)}
        if problems := [
            f"{name}: expected a whole number from 0 to {most}"
            for name, (number, most) in limits.items()
            if isinstance(number, bool)
            or not (isinstance(number, Integral) and 0 <= number <= most)
        ]:
            raise ConfigError("field", problems)
        tables = make_tables(self.most_edges, self.rois[1], self.robots[1], 1)
        scratch = np.zeros((scratch_rows(self.robots[1], self.rois[1]), 1), np.int64)
        families = np.zeros(1, np.int64)
        where = int(world), int(episode)
        make_fields(self.numbers(), self.seed, *where, scratch, tables, families)
        name = f"{FAMILIES[families[0]]}-{self.seed}"
        name += f"-{world}-{episode}" if world or episode else ""
        return field_of(tables, self.arena, name)


def _millis(length: float) -> int:
    return round(Fraction(length) * MILLI)


def field_of(tables: Tables, arena: tuple[float, float], name: str, f: int = 0) -> Field:
    """Return the field in column f of ``tables``."""
    rings: list[list[tuple[float, float]]] = []
    at = None
    for ax, ay, bx, by in tables.edges[:, :, f].T.tolist():
        if (ax, ay) == (bx, by):  # padding
            break
        if at != (ax, ay):
            rings.append([])
        rings[-1].append((ax, ay))
        at = bx, by
    rois = int(tables.codes[f]).bit_count()
    return Field(
        vertices=rings[0],
        rois=tables.rois[:, :rois, f].T,
        starts=tables.starts[:, : tables.robots_in[f], f].T,
        holes=rings[1:],
        arena=arena,
        name=name,
    )


def generate(
    family: str,
    seed: int = 0,
    *,
    robots: int | Sequence[int] = 3,
    rois: int | Sequence[int] = 6,
    size: float | Sequence[float] | None = None,
    arena: Sequence[float] = DEFAULT_ARENA,
) -> Field:
    """Return the random field of a family and a seed, such as ``convex-7``, equal on all machines.

    Arguments and errors as for :class:`FieldSampler`.
    """
    return FieldSampler((family,), robots, rois, size, arena, seed=seed).field()
