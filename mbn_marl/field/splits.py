"""The frozen fields of the benchmark: which there are, and how they are read."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ValidationError
from pydantic import Field as Described

from mbn_marl.config import Condition, describe
from mbn_marl.errors import FieldError, ProblemsError, unknown
from mbn_marl.field.field import Field
from mbn_marl.field.sampler import FieldSampler

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
"""The tiers with fields of their own, and the arguments of their samplers."""
WEATHER = "5-weather"
"""Instance k is instance k of tier k mod 3 of the first three, under condition k mod 5."""
CONDITIONS: tuple[Condition, ...] = ("windy", "gusty", "noisy", "delayed", "failing")
NAMES = (*TIERS, WEATHER)
Split = Literal["validation", "test"]
FOLDER = files("envs_catalog") / "splits"
"""With a file for each split and tier."""
_Steps = Annotated[int, Described(ge=1)]


@dataclass(frozen=True)
class Instance:
    """A frozen field of a split, and what is known of it.

    Attributes:
        field: the field; its name is unique in the split's tier.
        condition: that of the environment, ``"calm"`` but in the tier ``5-weather``.
        makespan_lower_bound: steps, the proved least number in which the team visits every ROI
            without pushing outside the field; ``None`` under a condition.
        best_known: steps, the shortest makespan that is known, at least the bound; ``None`` under
            a condition.
    """

    field: Field
    condition: Condition = "calm"
    makespan_lower_bound: int | None = None
    best_known: int | None = None


class _Entry(BaseModel):
    """The keys of an instance that are read."""

    candidate: Annotated[int, Described(ge=0)]
    geometry: str
    makespan_lower_bound: _Steps | None = None
    makespan: _Steps | None = None
    tier: Literal["1-convex", "2-sizes", "3-shapes"] | None = None
    condition: Condition = "calm"


class _File(BaseModel):
    """The keys of a file that are read."""

    version: int
    split: Split
    tier: str
    instances: Annotated[list[_Entry], Described(min_length=1)]


def load_split(
    split: str, tier: str, folder: str | os.PathLike[str] | None = None
) -> tuple[Instance, ...]:
    """Return the frozen fields of a tier; each is made again and compared with its hash.

    Args:
        split: ``"validation"`` or ``"test"``.
        tier: ``"1-convex"``, ``"2-sizes"``, ``"3-shapes"``, ``"4-crowds"`` or ``"5-weather"``.
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
    try:
        found = _File.model_validate(json.loads(path.read_text(encoding="utf-8")))
    except ValidationError as error:
        raise FieldError(str(path), describe(error, _File)) from None
    except (OSError, ValueError, RecursionError) as error:
        raise FieldError(str(path), [f"file: cannot be read: {error}"]) from None
    if (found.version, found.split, found.tier) != (VERSION, split, tier):
        theirs = f"{found.split}, {found.tier}, version {found.version}"
        raise FieldError(str(path), [f"file: is of {theirs}; needed: version {VERSION}"])
    samplers = {name: FieldSampler(**sampler_of(found.split, name)) for name in TIERS}
    instances = []
    first: dict[tuple[str, int], int] = {}
    for k, one in enumerate(found.instances):
        source = one.tier or tier
        wrong = [*_contradictions(one, tier)]
        if (same := first.setdefault((source, one.candidate), k)) != k:
            wrong.append(f"candidate: {one.candidate} again, as in instances[{same}]")
        if not wrong:
            instances.append(_made(one, samplers[source], wrong))
        problems += [f"instances[{k}].{problem}" for problem in wrong]
    if problems:
        raise FieldError(str(path), problems)
    return tuple(one for one in instances if one)


def _made(one: _Entry, sampler: FieldSampler, problems: list[str]) -> Instance | None:
    """Return an instance with its field; ``None`` if that is another, which ``problems`` learn."""
    try:
        field = sampler.field(one.candidate)
    except ProblemsError as error:
        problems += [f"candidate: {problem}" for problem in error.problems]
        return None
    if geometry_hash(field) != one.geometry:
        problems.append(f"geometry: {field.name} is not the field that was frozen")
    return Instance(field, one.condition, one.makespan_lower_bound, one.makespan)


def _contradictions(one: _Entry, tier: str) -> Iterator[str]:
    """Yield what an instance of a tier has that it must not have, and what it lacks."""
    least, best = one.makespan_lower_bound, one.makespan
    bounds = {"makespan_lower_bound": least, "makespan": best}
    if tier == WEATHER:
        if one.tier is None:
            yield "tier: missing; it has the field of another tier"
        if one.condition == "calm":
            yield f"condition: 'calm'; allowed: {', '.join(CONDITIONS)}"
        yield from (f"{name}: {n}; none is known of {tier}" for name, n in bounds.items() if n)
        return
    if one.tier is not None:
        yield f"tier: {one.tier}; allowed: none, the fields are this tier's own"
    if one.condition != "calm":
        yield f"condition: {one.condition!r}; allowed: 'calm'"
    yield from (f"{name}: missing" for name, n in bounds.items() if n is None)
    if least is not None and best is not None and least > best:
        yield f"makespan_lower_bound: {least}; allowed: at most the makespan, {best}"


def sampler_of(split: Split, tier: str) -> dict[str, Any]:
    """Return the arguments of the sampler of a tier's fields, as JSON values."""
    return {**TIERS[tier], "seed": SEEDS[split] + NAMES.index(tier)}


def geometry_hash(field: Field) -> str:
    """Return the SHA-256 of a field's arena, outline, holes, ROIs and starts in milli-units."""
    rings: list[Any] = [[field.arena], field.vertices, *field.holes, field.rois, field.starts]
    return hashlib.sha256(json.dumps([_millis(ring) for ring in rings]).encode()).hexdigest()


def _millis(points: Any) -> list[Any]:
    whole: list[Any] = np.rint(np.asarray(points, float) * 1000.0).astype(int).tolist()
    return whole
