"""The frozen fields of the benchmark."""

from __future__ import annotations

import hashlib
import json
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from dataclasses import field as default
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ValidationError, ValidationInfo, field_validator
from pydantic import Field as Described

from mbn_marl.config import MOST, Condition, describe
from mbn_marl.errors import FieldError, ProblemsError, unknown
from mbn_marl.field.field import Field
from mbn_marl.field.generator.passages import Passages
from mbn_marl.field.generator.sampler import FieldSampler

VERSION = 1
"""Of the definition below: what changes it makes other splits."""
SEEDS = {"validation": 2_000_000, "test": 3_000_000}
"""Of the samplers of each split, to which the number of the tier is added."""
TIERS: Mapping[str, Mapping[str, Any]] = {
    "1-convex": {"families": ["convex"], "robots": 3, "rois": 6},
    "2-sizes": {"families": ["convex"], "robots": [2, 7], "rois": [3, 10], "size": [150, 420]},
    "3-shapes": {"families": ["concave", "corridors", "obstacles"], "robots": 3, "rois": 6},
    "4-crowds": {"families": ["convex"], "robots": [8, 16], "rois": [12, 24], "size": [230, 420]},
}
"""The tiers of one team that shares all it knows, and the arguments of their samplers."""
WEATHER = "5-weather"
"""Instance k is instance k of tier k mod 3 of the first three, under condition k mod 5."""
CONDITIONS: tuple[Condition, ...] = ("windy", "gusty", "noisy", "delayed", "failing")
SEARCH = "6-search"
"""Robots that know only their own look for the ROIs that are not empty."""
PASSAGES = "7-passages"
"""Two kinds of robots change sides, through doors for one at a time."""
ROIS, DECOYS = 24, 12
"""Those of 6-search, and how many of them are empty."""
FIELDS: Mapping[str, Mapping[str, Any]] = {
    **TIERS,
    SEARCH: {"families": ["convex"], "robots": 5, "rois": ROIS, "size": 700},
    PASSAGES: {},
}
"""The tiers that freeze fields."""
OWN: Mapping[str, Any] = {"knowledge": "own", "sensing_radius": 100.0, "max_steps": 600}
SETTINGS: Mapping[str, Mapping[str, Any]] = {
    SEARCH: {**OWN, "look_radius": 60.0},  # and each instance's empty_rois
    PASSAGES: {**OWN, "comm_radius": 100.0},
}
"""Those that a tier fixes."""
RADII: Mapping[str, float] = {"0": 0.0, "100": 100.0, "inf": math.inf}
"""Its communication radii by name: each makes an instance of every field."""
NAMES = (*TIERS, WEATHER, SEARCH, PASSAGES)
Split = Literal["validation", "test"]
FOLDER = files("envs_catalog") / "splits"
"""With a file for each split and tier."""
_Steps = Annotated[int, Described(ge=1)]


@dataclass(frozen=True)
class Instance:
    """A frozen field of a split, and what is known of it.

    Attributes:
        field: the field; its name is unique in the split's tier, and radius.
        condition: that of the environment, ``"calm"`` but in the tier ``5-weather``.
        makespan_lower_bound: steps, proved for a team that never pushes outside the field;
            ``None`` under a condition.
        best_known: steps, the shortest makespan that is known; ``None`` under a condition.
        settings: those of the environment that the tier fixes.
        radius: the name of the communication radius, in the tier ``6-search``.
    """

    field: Field
    condition: Condition = "calm"
    makespan_lower_bound: int | None = None
    best_known: int | None = None
    settings: Mapping[str, Any] = default(default_factory=dict)
    radius: str | None = None


class _Calm(BaseModel):
    candidate: Annotated[int, Described(ge=0)]
    geometry: str
    tier: None = None
    condition: Literal["calm"] = "calm"
    makespan_lower_bound: _Steps
    makespan: _Steps
    empty: tuple[()] = ()

    @field_validator("makespan")
    @classmethod
    def _not_below_bound(cls, steps: int, info: ValidationInfo) -> int:
        if steps < info.data.get("makespan_lower_bound", 0):
            raise ValueError("Input should be at least makespan_lower_bound")
        return steps


class _Searched(_Calm):
    empty: Annotated[  # type: ignore[assignment]
        tuple[Annotated[int, Described(ge=0, lt=ROIS)], ...],
        Described(min_length=DECOYS, max_length=DECOYS),
    ]


class _Weathered(BaseModel):
    candidate: Annotated[int, Described(ge=0)]
    geometry: str
    tier: Literal["1-convex", "2-sizes", "3-shapes"]
    condition: Literal["windy", "gusty", "noisy", "delayed", "failing"]
    makespan_lower_bound: None = None
    makespan: None = None
    empty: tuple[()] = ()


class _CalmFile(BaseModel):
    version: Literal[1]
    split: Split
    tier: str
    instances: Annotated[list[_Calm], Described(min_length=1)]


class _WeatheredFile(_CalmFile):
    instances: Annotated[list[_Weathered], Described(min_length=1)]  # type: ignore[assignment]


class _SearchFile(_CalmFile):
    instances: Annotated[list[_Searched], Described(min_length=1)]  # type: ignore[assignment]


def load_split(
    split: str, tier: str, folder: str | os.PathLike[str] | None = None
) -> tuple[Instance, ...]:
    """Return the frozen fields of a tier; each is made again and compared with its hash.

    Those of ``6-search`` are there once for each communication radius.

    Args:
        split: ``"validation"`` or ``"test"``.
        tier: ``"1-convex"``, ``"2-sizes"``, ``"3-shapes"``, ``"4-crowds"``, ``"5-weather"``,
            ``"6-search"`` or ``"7-passages"``.
        folder: with the files; by default those that are installed.

    Raises:
        FieldError: listing every problem: there is no such split, tier or file, the file is not
            valid, or a field is not the one that was frozen, or is there twice.
    """
    given = {"split": (split, SEEDS), "tier": (tier, NAMES)}
    problems = [
        f"{name}: {value!r}: {unknown(name, str(value), known)}"
        for name, (value, known) in given.items()
        if value not in [*known]
    ]
    if problems:
        raise FieldError("split", problems)
    path = (FOLDER if folder is None else Path(folder)) / f"{split}-{tier}.json"
    models: Mapping[str, type[_CalmFile]] = {WEATHER: _WeatheredFile, SEARCH: _SearchFile}
    model = models.get(tier, _CalmFile)
    try:
        found = model.model_validate(json.loads(path.read_text(encoding="utf-8")))
    except ValidationError as error:
        raise FieldError(str(path), describe(error, model)) from None
    except (OSError, ValueError, RecursionError) as error:
        raise FieldError(str(path), [f"file: cannot be read: {error}"]) from None
    if (found.split, found.tier) != (split, tier):
        raise FieldError(str(path), [f"file: is of {found.split}, {found.tier}"])
    samplers = {name: make_sampler(found.split, name) for name in FIELDS}
    instances, fields = [], set[str]()
    for k, one in enumerate(found.instances):
        try:
            field = samplers[one.tier or tier].field(one.candidate)
        except ProblemsError as error:
            problems += [f"instances.{k}.candidate: {problem}" for problem in error.problems]
            continue
        if geometry_hash(field) != one.geometry:
            problems.append(f"instances.{k}.geometry: {field.name} is not the one that was frozen")
        if one.geometry in fields:
            problems.append(f"instances.{k}.candidate: {one.candidate} again")
        fields.add(one.geometry)
        known = one.makespan_lower_bound, one.makespan
        whole = Instance(field, one.condition, *known, SETTINGS.get(tier, {}))
        instances += (
            [whole]
            if tier != SEARCH
            else [
                replace(whole, radius=name, settings=search_settings(one.empty, radius))
                for name, radius in RADII.items()
            ]
        )
    if problems:
        raise FieldError(str(path), problems)
    return tuple(instances)


def sampler_of(split: Split, tier: str) -> dict[str, Any]:
    """Return the arguments of the sampler of a tier's fields, as JSON values."""
    return {**FIELDS[tier], "seed": SEEDS[split] + NAMES.index(tier)}


def make_sampler(split: Split, tier: str) -> FieldSampler | Passages:
    made = Passages if tier == PASSAGES else FieldSampler
    return made(**sampler_of(split, tier))


def search_settings(empty: Sequence[int], radius: float) -> dict[str, Any]:
    """Return what the tier 6-search fixes of the environment of an instance."""
    fixed = {"decoys": 0, "empty_rois": tuple(empty), "comm_radius": radius}
    return {**SETTINGS[SEARCH], **fixed}


def training_settings(tier: str | None) -> dict[str, Any]:
    """Return what a tier fixes of the environment in training, on fields like its own."""
    return {**SETTINGS[SEARCH], "decoys": DECOYS} if tier == SEARCH else {}


def search_side_by_side(split: str, radius: float) -> tuple[Instance, ...]:
    """Return the instances of 6-search at a radius; their ``settings`` are the same for all.

    The empty ROIs of each are the last ones, in place of the numbers that were frozen.
    """
    settings = search_settings(range(ROIS - DECOYS, ROIS), radius)
    return tuple(
        replace(one, field=_with_last(one.field, one.settings["empty_rois"]), settings=settings)
        for one in load_split(split, SEARCH)
        if one.radius == radius_name(radius)
    )


def radius_name(radius: float) -> str | None:
    """Return the name of a communication radius of 6-search, of which the greatest is all."""
    return {min(one, MOST): name for name, one in RADII.items()}.get(min(radius, MOST))


def _with_last(field: Field, rois: Sequence[int]) -> Field:
    order = [*(k for k in range(len(field.rois)) if k not in rois), *rois]
    parts = field.vertices, field.rois[order], field.starts, field.holes
    return Field(*parts, arena=field.arena, name=field.name)


def geometry_hash(field: Field) -> str:
    """Return the SHA-256 of arena, outline, holes, ROIs and starts in milli-units, and kinds."""
    rings: list[Any] = [[field.arena], field.vertices, *field.holes, field.rois, field.starts]
    millis = [np.rint(np.asarray(ring, float) * 1000.0).astype(int).tolist() for ring in rings]
    kinds = [field.roi_kinds, field.start_kinds] if field.start_kinds else []
    return hashlib.sha256(json.dumps([*millis, *kinds]).encode()).hexdigest()
