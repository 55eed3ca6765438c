"""Small splits, without a planner."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from benchmarks.splits import definition, weather
from mbn_marl import Field
from mbn_marl.field.splits import DECOYS, FIELDS, SEARCH, WEATHER, geometry_hash, make_sampler


def write_split(
    folder: Path,
    tier: str,
    count: int = 3,
    bounds: Callable[[int, Field], tuple[int, int]] = lambda k, field: (k + 10, k + 12),
    **changed: Any,
) -> Path:
    sampler, instances = make_sampler("test", tier), []
    for k in range(count):
        field = sampler.field(2 * k)
        least, best = bounds(k, field)
        sizes = {"robots": len(field.starts), "rois": len(field.rois)}
        known = {"family": field.name.partition("-")[0], "seed": sampler.seed, **sizes}
        known |= {"candidate": 2 * k, "geometry": geometry_hash(field)}
        known |= {"empty": [*range(DECOYS)]} if tier == SEARCH else {}
        instances.append({**known, "makespan_lower_bound": least, "makespan": best})
    path = folder / f"test-{tier}.json"
    path.write_text(json.dumps({**definition("test", tier), "instances": instances, **changed}))
    return path


def write_splits(folder: Path, count: int) -> None:
    for tier in FIELDS:
        write_split(folder, tier, count)
    path = folder / f"test-{WEATHER}.json"
    path.write_text(json.dumps(weather(folder, "test", count)))
