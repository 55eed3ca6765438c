"""The field: an immutable, validated value."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any

import numpy as np
import numpy.typing as npt
import shapely

from mbn_marl.field.schema import DEFAULT_ARENA, FORMAT, KINDS, check

Points = Sequence[Sequence[float]] | npt.NDArray[Any]
"""A list of ``(x, y)``, or an array of shape (k, 2)."""


@dataclass(frozen=True, slots=True, init=False, eq=False, repr=False)
class Field:
    """A polygon with holes, its ROIs and the robots' starts, in arena units.

    The field is a closed set: it contains the boundaries of the outline and of the holes, and ROIs
    and starts that are outside by at most 1e-9 of its longer side count as on them.
    Fields compare and hash by value, and can be pickled.

    Args:
        vertices: corners of the outline in order, (k, 2) in units, in either direction, the first
            not repeated at the end; at least 3, at most 500 with those of the holes.
        rois: the regions of interest, (m, 2) in units, 1 to 24, inside the field.
        starts: the robots' starts, (s, 2) in units, 1 to 64, inside the field; in an environment at
            least its ``safety_distance`` apart. There can be up to s robots.
        holes: obstacles, at most 64, each a list of corners (k, 2) in units; inside the outline,
            touching neither it nor another hole.
        roi_kinds: for each ROI the kind of the robots that may visit it, from 0 on; ``None``: all
            may. No kinds by default.
        start_kinds: for each start the kind of its robot; given if ``roi_kinds`` is.
        arena: width and height in units; everything is in ``[0, width] x [0, height]``.
        name: 1 to 64 letters, digits, ``_``, ``.`` or ``-``.
        optimal_makespan: the proved least number of steps in which robots on all the starts visit
            every ROI without pushing outside the field, with the default dynamics and no wind;
            ``None`` if unknown.

    Attributes:
        vertices: as given, float64 and read-only, like ``rois``, ``starts`` and each of ``holes``.
        edges: float64 (E, 4), ``(ax, ay, bx, by)`` of each edge: the outline's, then each hole's.
        polygon: the field as a shapely polygon.

    Raises:
        FieldError: listing every problem with its place, e.g. ``starts[1]``.
    """

    vertices: npt.NDArray[np.float64]
    rois: npt.NDArray[np.float64]
    starts: npt.NDArray[np.float64]
    holes: tuple[npt.NDArray[np.float64], ...]
    edges: npt.NDArray[np.float64]
    arena: tuple[float, float]
    name: str
    optimal_makespan: int | None
    polygon: shapely.Polygon
    roi_kinds: tuple[int | None, ...]
    start_kinds: tuple[int, ...]
    _key: str

    def __init__(
        self,
        vertices: Points,
        rois: Points,
        starts: Points,
        holes: Sequence[Points] = (),
        *,
        roi_kinds: Sequence[int | None] = (),
        start_kinds: Sequence[int] = (),
        arena: Sequence[float] = DEFAULT_ARENA,
        name: str = "custom",
        optimal_makespan: int | None = None,
    ) -> None:
        values = check(
            {
                **{"format": FORMAT, "vertices": vertices, "rois": rois, "starts": starts},
                **{"holes": holes, "arena": arena, "name": name},
                **{"roi_kinds": roi_kinds, "start_kinds": start_kinds},
                "optimal_makespan": optimal_makespan,
            },
            "field",
        )
        del values["format"]
        rings = [values["vertices"], *values["holes"]]
        arrays = {name: _constant(values[name]) for name in ("vertices", "rois", "starts")}
        edges = [(*a, *b) for ring in rings for a, b in pairwise([*ring, ring[0]])]
        values |= {
            **arrays,
            **{name: tuple(values[name]) for name in KINDS},
            "holes": tuple(map(_constant, values["holes"])),
            "edges": _constant(edges),
            "polygon": shapely.Polygon(rings[0], rings[1:]),
            "_key": repr(values),
        }
        for attribute, value in values.items():
            object.__setattr__(self, attribute, value)

    @property
    def mine(self) -> npt.NDArray[np.bool_]:
        """Flags (s, m): whether the robot of each start may visit each ROI."""
        kinds = self.roi_kinds or (None,) * len(self.rois)
        teams = self.start_kinds or (0,) * len(self.starts)
        return np.array([[kind in (None, own) for kind in kinds] for own in teams])

    def to_dict(self) -> dict[str, Any]:
        """Return the field's arguments as plain lists, numbers and strings."""
        return {
            "name": self.name,
            "optimal_makespan": self.optimal_makespan,
            "arena": list(self.arena),
            "vertices": self.vertices.tolist(),
            "holes": [hole.tolist() for hole in self.holes],
            "rois": self.rois.tolist(),
            "starts": self.starts.tolist(),
            **{name: list(kinds) for name in KINDS if (kinds := getattr(self, name))},
        }

    def __eq__(self, other: object) -> bool:
        return self._key == other._key if isinstance(other, Field) else NotImplemented

    def __hash__(self) -> int:
        return hash(self._key)

    def __reduce__(self) -> tuple[partial[Field], tuple[()]]:
        return partial(Field, **self.to_dict()), ()

    def __repr__(self) -> str:
        width, height = self.arena
        return (
            f"<Field {self.name!r}: {len(self.vertices)} vertices, {len(self.holes)} holes, "
            f"{len(self.rois)} ROIs, {len(self.starts)} starts, arena {width:g} x {height:g}>"
        )


def _constant(rows: Sequence[Sequence[float]]) -> npt.NDArray[np.float64]:
    """Return an array over immutable bytes, which cannot be made writable."""
    array = np.array(rows, dtype=np.float64)
    return np.frombuffer(array.tobytes(), dtype=np.float64).reshape(array.shape)
