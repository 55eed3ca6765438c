"""The frozen fields of a benchmark: made, planned for, proved, written down; and verified."""

import hashlib
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from baselines.compare.text_table import TextTable
from baselines.runs.files import read_arrays, read_json, versions, write_arrays, write_json
from mbn_marl.config import make_config
from mbn_marl.episode import play
from mbn_marl.errors import ConfigError, EpisodeError, FieldError, unknown
from mbn_marl.field import Field, FieldSampler, splits
from mbn_marl.field.generator.passages import Passages
from mbn_marl.field.splits import FIELDS, PASSAGES, SEARCH, VERSION, WEATHER, Split
from mbn_marl.planning import UnsolvableError, plan
from mbn_marl.planning.planner import WORK_LIMIT

COUNT = 100
COUPLED = 1.2
"""The least index, makespan / bound without collisions, of a field of 7-passages."""


@dataclass(frozen=True)
class Splits:
    """Make the frozen fields of the tiers, with proved bounds, or verify them."""

    tier: tuple[str, ...] = splits.NAMES
    """The tiers."""
    split: tuple[Split, ...] = ("validation", "test")
    """The splits."""
    count: int = COUNT
    """Fields of each; with --verify, of those that there are."""
    seconds: float = 60.0
    """Seconds of the planner for a field."""
    verify: bool = False
    """Recompute what is there instead: fields, plans in the engine, bounds."""
    out: Path = Path("envs_catalog/splits")
    """The folder with a file for each split and tier."""

    def run(self, command: str) -> bool:
        others = [tier for tier in self.tier if tier not in splits.NAMES]
        wrong = [f"tier: {tier!r}: {unknown('tier', tier, splits.NAMES)}" for tier in others]
        wrong += [f"count: at least 1, not {self.count}"] * (self.count < 1)
        wrong += [f"seconds: more than 0, not {self.seconds:g}"] * (not self.seconds > 0.0)
        if wrong:
            raise ConfigError("splits", wrong)
        self.out.mkdir(parents=True, exist_ok=True)
        problems: list[str] = []
        lines = []
        for split in self.split:
            for tier in self.tier:
                path = self.out / f"{split}-{tier}.json"
                if self.verify:
                    problems += [f"{path}: {one}" for one in self._problems(path, split, tier)]
                elif tier == WEATHER:
                    write_json(path, weather(self.out, split, self.count))
                else:
                    self._make(path, split, tier, command)
                lines.append(_line(read_json(path)))
        headings = ("split", "tier", "fields", "rejected", "proved", "gap", "seconds", "CPU s")
        caption = (
            "proved: the plan is a shortest one; gap, seconds: medians, to plan once;\n"
            "CPU s: processor time of all, compiling included"
        )
        TextTable(caption, headings, tuple(lines), words=2).print("splits")
        done = f"{'verified in' if self.verify else 'written to'} {self.out}"
        print("\n".join(problems or [done]))
        return not problems

    def _make(self, path: Path, split: Split, tier: str, command: str) -> None:
        """Try candidates until there are enough; the file is whole after each."""
        begun = definition(split, tier)
        record: dict[str, Any] = {**begun, "candidates": 0, "rejected": [], "instances": []}
        record["processor_seconds"] = 0.0
        plans: dict[str, NDArray[Any]] = {}
        if path.exists():
            record = read_json(path)
            plans = read_arrays(path.with_suffix(".npz")) if record["instances"] else {}
            if differing := [name for name in begun if record.get(name) != begun[name]]:
                problem = f"{', '.join(differing)}: not of version {VERSION}; move it aside"
                raise ConfigError(str(path), [problem])
        record |= {"command": command, "versions": versions()}
        while len(record["instances"]) < self.count:
            number, began = record["candidates"], time.process_time()
            known = {one["geometry"]: one["candidate"] for one in record["instances"]}
            found = self._try(splits.make_sampler(split, tier), tier, number, known)
            if isinstance(found, str):
                record["rejected"].append({"candidate": number, "reason": found})
            else:
                instance, plans[str(number)] = found
                record["instances"].append(instance)
                write_arrays(path.with_suffix(".npz"), plans, compress=True)
            record["candidates"] = number + 1
            record["processor_seconds"] += time.process_time() - began
            write_json(path, record)

    def _try(
        self, sampler: FieldSampler | Passages, tier: str, number: int, known: Mapping[str, int]
    ) -> str | tuple[dict[str, Any], NDArray[np.float32]]:
        try:
            field = sampler.field(number)
            geometry = splits.geometry_hash(field)
            if geometry in known:
                return f"the same as candidate {known[geometry]}"
            searched = drawn_empty(sampler, number) if tier == SEARCH else {}
            empty = searched.get("empty", ())
            limit: dict[str, Any] = {"time_limit": self.seconds}
            limit = {"work_limit": WORK_LIMIT} if tier == PASSAGES else limit
            found = plan(field, visited=empty, **limit)
        except (FieldError, UnsolvableError) as error:
            return str(error)
        if found.makespan is None:
            return "no plan was found"
        if searched and not found.optimal:
            return "no plan was proved"
        index = found.makespan / found.makespan_lower_bound
        if tier == PASSAGES and index < COUPLED:
            return f"index {index:.2f}"
        if problem := plan_problem(field, found.actions, found.makespan, known_of(sampler, empty)):
            return problem
        instance = {
            **{"family": field.name.partition("-")[0], "seed": sampler.seed, "candidate": number},
            **{"robots": len(field.starts), "rois": len(field.rois), "geometry": geometry},
            **searched,
            "makespan_lower_bound": found.makespan_lower_bound,
            "makespan": found.makespan,
            "plan": array_hash(found.actions),
            **({} if tier == PASSAGES else {"seconds": round(found.seconds, 2)}),
            **limit,
        }
        return instance, found.actions

    def _problems(self, path: Path, split: Split, tier: str) -> Iterator[str]:
        """Yield what is wrong with a file; ``count`` of its instances are recomputed."""
        record = read_json(path)
        if tier == WEATHER:
            if record != weather(self.out, split, len(record["instances"])):
                yield "is not made of the files of the first three tiers"
            return
        begun, instances = definition(split, tier), record["instances"]
        yield from (f"{name}: is another" for name in begun if record.get(name) != begun[name])
        if len({one["geometry"] for one in instances}) < len(instances):
            yield "geometry: two instances have the same"
        sampler, plans = splits.make_sampler(split, tier), read_arrays(path.with_suffix(".npz"))
        for k in np.unique(np.linspace(0, len(instances) - 1, self.count).astype(int)):
            one = instances[k]
            actions = plans[str(one["candidate"])].astype(np.float32)
            if tier == SEARCH and one["empty"] != drawn_empty(sampler, one["candidate"])["empty"]:
                yield f"instances[{k}]: empty: others are drawn"
            for problem in instance_problems(sampler, one, actions, self.seconds):
                yield f"instances[{k}]: {problem}"


def definition(split: Split, tier: str) -> dict[str, Any]:
    sampler = splits.sampler_of(split, tier)
    return {"version": VERSION, "split": split, "tier": tier, "sampler": sampler}


def drawn_empty(sampler: FieldSampler | Passages, number: int) -> dict[str, list[int]]:
    """Return which ROIs of a candidate are empty; NumPy draws them by its seed and number."""
    rois, random = FIELDS[SEARCH]["rois"], np.random.default_rng([sampler.seed, number])
    return {"empty": sorted(random.choice(rois, splits.DECOYS, replace=False).tolist())}


def weather(folder: Path, split: Split, count: int) -> dict[str, Any]:
    """Return the tier under conditions; a ConfigError names files with too few instances."""
    sources = splits.NAMES[:3]
    paths = [folder / f"{split}-{tier}.json" for tier in sources]
    known = [read_json(path)["instances"] if path.exists() else [] for path in paths]
    if problems := [
        f"{path}: {len(have)} instances; needed: {count}"
        for path, have in zip(paths, known, strict=True)
        if len(have) < count
    ]:
        raise ConfigError(f"{split}-{WEATHER}", problems)
    same = ("family", "seed", "candidate", "robots", "rois", "geometry")
    instances = [
        {
            **{name: known[k % 3][k][name] for name in same},
            **{"tier": sources[k % 3], "condition": splits.CONDITIONS[k % len(splits.CONDITIONS)]},
        }
        for k in range(count)
    ]
    return {"version": VERSION, "split": split, "tier": WEATHER, "instances": instances}


def array_hash(actions: NDArray[np.float32]) -> str:
    """Return the SHA-256 of actions (T, n, 2) as little-endian float32, row by row."""
    return hashlib.sha256(actions.astype("<f4").tobytes()).hexdigest()


def known_of(sampler: FieldSampler | Passages, empty: Sequence[int]) -> Mapping[str, Any]:
    """Return the settings that the tier of a field fixes."""
    if isinstance(sampler, Passages):
        return splits.SETTINGS[PASSAGES]
    return splits.search_settings(empty, 0.0) if empty else {}


def plan_problem(
    field: Field, actions: NDArray[np.float32], makespan: int, fixed: Mapping[str, Any] = {}
) -> str | None:
    """Return why the actions (T, n, 2) are no clean episode of that length in the engine."""
    seen = {"observation": "entities"} if fixed else {}
    try:
        episode = play(field, make_config({**fixed, **seen}), actions)
    except EpisodeError as error:
        return f"plan: {error}"
    if episode.outcome != "success" or episode.steps != makespan:
        return f"plan: {episode.outcome} after {episode.steps} steps, not success after {makespan}"
    return None


def instance_problems(
    sampler: FieldSampler | Passages,
    one: Mapping[str, Any],
    actions: NDArray[np.float32],
    seconds: float,
) -> Iterator[str]:
    """Make, play and prove an instance again; yield what is not as it was written down."""
    field = sampler.field(one["candidate"])
    if splits.geometry_hash(field) != one["geometry"]:
        yield "geometry: the field is another"
        return
    if array_hash(actions) != one["plan"]:
        yield "plan: its hash is another"
    empty = one.get("empty", ())
    if problem := plan_problem(field, actions, one["makespan"], known_of(sampler, empty)):
        yield problem
    limit = {"work_limit": one["work_limit"]} if "work_limit" in one else {"time_limit": seconds}
    found = plan(field, visited=empty, **limit)
    if found.makespan_lower_bound > one["makespan"]:
        yield f"makespan: {one['makespan']}, but {found.makespan_lower_bound} is proved"
    if found.makespan_lower_bound < one["makespan_lower_bound"]:
        bound = f"{one['makespan_lower_bound']}, now {found.makespan_lower_bound} is proved"
        yield f"makespan_lower_bound: {bound}"


def _line(record: Mapping[str, Any]) -> tuple[str, ...]:
    instances, words = record["instances"], (record["split"], record["tier"])
    if record["tier"] == WEATHER:
        return *words, str(len(instances)), *["-"] * 5
    gaps = [1.0 - one["makespan_lower_bound"] / one["makespan"] for one in instances]
    seconds = [one["seconds"] for one in instances if "seconds" in one]
    return (
        *(*words, str(len(instances)), str(len(record["rejected"]))),
        *(str(gaps.count(0.0)), f"{np.median(gaps):.1%}"),
        f"{np.median(seconds):.1f}" if seconds else "-",
        f"{record['processor_seconds']:.0f}",
    )
