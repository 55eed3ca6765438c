"""The file format ``mbn-field/1``: its model, and the JSON schema for editors.

A file is one YAML mapping. Lengths are in arena units::

    format: mbn-field/1
    name: square                # optional; the file's stem when absent
    arena: [1000, 1000]         # optional; width, height
    vertices: [[0, 0], [100, 0], [100, 100], [0, 100]]
    holes:                      # optional
    - [[40, 40], [60, 40], [50, 60]]
    rois: [[90, 90]]
    starts: [[10, 10], [10, 90]]
    optimal_makespan: 24        # optional; proved, for robots on all starts and no wind
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from annotated_types import Len
from pydantic import BaseModel, ConfigDict, SkipValidation
from pydantic import Field as Described

from mbn_marl.config import MAX_ROBOTS, MAX_ROIS
from mbn_marl.field.limits import MAX_COORDINATE, MAX_HOLES, MAX_NAME, MAX_VERTICES, NAME_PATTERN

FORMAT = "mbn-field/1"
SAMPLER_FORMAT = "mbn-sampler/1"
"""Of files with the arguments of a :class:`~mbn_marl.field.FieldSampler`."""

_Coordinate = Annotated[float, Described(ge=0.0, le=MAX_COORDINATE)]
_Side = Annotated[float, Described(gt=0.0, le=MAX_COORDINATE)]
_Point = tuple[_Coordinate, _Coordinate]
_Ring = Annotated[list[_Point], Len(3, MAX_VERTICES)]


class FieldFile(BaseModel):
    """A field of mbn_marl in the format mbn-field/1. Lengths are in arena units."""

    # The model checks ``format`` and the set of keys. The other types are for the JSON schema;
    # ``Field`` checks their values, so that one error lists all problems.
    model_config = ConfigDict(extra="forbid", frozen=True, title="mbn_marl field")

    format: Literal["mbn-field/1"] = Described(description="Name and version of the format.")
    name: SkipValidation[
        Annotated[str, Described(pattern=NAME_PATTERN, max_length=MAX_NAME)] | None
    ] = Described(default=None, description="The field's name; the file's stem when absent.")
    optimal_makespan: SkipValidation[Annotated[int, Described(ge=1, le=1_000_000)] | None] = (
        Described(
            default=None,
            description="Proved least number of steps in which robots on all the starts visit "
            "every ROI, with the default dynamics and no wind.",
        )
    )
    arena: SkipValidation[tuple[_Side, _Side]] = Described(
        default=(1000.0, 1000.0), description="Width and height of the arena, in units."
    )
    vertices: SkipValidation[_Ring] = Described(
        description="Corners of the outline in order, not repeated at the end."
    )
    holes: SkipValidation[Annotated[list[_Ring], Len(0, MAX_HOLES)]] = Described(
        default=[], description="Obstacles inside the outline that touch nothing."
    )
    rois: SkipValidation[Annotated[list[_Point], Len(1, MAX_ROIS)]] = Described(
        description="Regions of interest; the first is the visit code's most significant bit."
    )
    starts: SkipValidation[Annotated[list[_Point], Len(1, MAX_ROBOTS)]] = Described(
        description="Starts of the robots, at least the safety distance (10 by default) apart."
    )


def json_schema() -> dict[str, Any]:
    """Return the JSON schema of a field file, as in ``envs_catalog/field.schema.json``."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **FieldFile.model_json_schema(),
    }
