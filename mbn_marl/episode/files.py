"""Save and load episodes in the format ``mbn-episode/1``, which ``docs/replay.md`` describes."""

from __future__ import annotations

import base64
import binascii
import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Final, Literal, Self

import numpy as np
from annotated_types import Len
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from mbn_marl import field as fields
from mbn_marl.config import MAX_ROBOTS, MAX_ROIS, describe, make_config
from mbn_marl.engine import REWARD_TERMS
from mbn_marl.episode.episode import Episode, Outcome
from mbn_marl.errors import ConfigError, EpisodeError, FieldError
from mbn_marl.files import check_ending, replacing
from mbn_marl.version import __version__

FORMAT: Final = "mbn-episode/1"
EXPECTED = f"an episode in the format {FORMAT}, as `mbn render -o episode.json` writes it"
MAX_SOURCE = 200
_Step = Annotated[int, Field(ge=1)]
_LITTLE = {"float32": "<f4", "float64": "<f8", "uint8": "<u1", "uint16": "<u2"}


class _Strict(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)


class PackedArray(_Strict):
    """An array as base64 of its numbers, little-endian, in C order: exact and small."""

    dtype: Literal["float32", "float64", "uint8", "uint16"]
    shape: Annotated[list[Annotated[int, Field(ge=0)]], Len(1, 3)]
    data: str

    @classmethod
    def pack(cls, array: NDArray[Any]) -> Self:
        name: Any = array.dtype.name
        data = base64.b64encode(array.astype(_LITTLE[name]).tobytes()).decode("ascii")
        return cls(dtype=name, shape=list(array.shape), data=data)

    def unpack(self, shape: tuple[int, ...], dtype: str) -> NDArray[Any]:
        """Return the array; raise ``ValueError`` if it is another, or broken."""
        if (tuple(self.shape), self.dtype) != (shape, dtype):
            raise ValueError(f"shape {self.shape} of {self.dtype}; allowed: {shape} of {dtype}")
        try:
            raw = base64.b64decode(self.data, validate=True)
        except binascii.Error as error:
            raise ValueError(f"data: not base64: {error}") from None
        stored = np.dtype(_LITTLE[dtype])
        if len(raw) != (expected := math.prod(shape) * stored.itemsize):
            raise ValueError(f"data: {len(raw)} bytes; allowed: {expected}")
        return np.frombuffer(raw, stored).reshape(shape).astype(dtype)


class CodedArray(_Strict):
    """An array with at most 65,536 different numbers: they, and each entry's index in them."""

    values: list[float]
    indices: PackedArray

    @classmethod
    def pack(cls, array: NDArray[Any]) -> Self:
        values, indices = np.unique(array, return_inverse=True)
        smallest = np.uint8 if len(values) <= 256 else np.uint16
        packed = PackedArray.pack(indices.reshape(array.shape).astype(smallest))
        return cls(values=values.tolist(), indices=packed)

    def unpack(self, shape: tuple[int, ...], dtype: str) -> NDArray[Any]:
        indices = self.indices.unpack(shape, self.indices.dtype)
        if indices.dtype.kind != "u" or (indices.size and indices.max() >= len(self.values)):
            raise ValueError(f"indices: allowed: whole numbers below {len(self.values)}")
        found: NDArray[Any] = np.asarray(self.values, dtype)[indices]
        return found


class Rewards(_Strict):
    terms: list[str]
    robots: CodedArray  # (T, n, terms)
    team: CodedArray  # (T,)


class EpisodeFile(_Strict):
    """An episode of mbn_marl in the format mbn-episode/1. n robots, m ROIs, T steps."""

    format: Literal["mbn-episode/1"]
    version: str
    source: str = Field(max_length=MAX_SOURCE)
    seed: int | None
    world: int = Field(default=0, ge=0)
    episode: int = Field(default=0, ge=0)
    robots: int = Field(ge=1, le=MAX_ROBOTS)
    steps: int = Field(ge=0)
    outcome: Outcome
    team_return: float
    wind: tuple[float, float]
    field: dict[str, Any]
    config: dict[str, Any]  # without the wind, unless it was drawn
    visits: Annotated[list[_Step | None], Len(1, MAX_ROIS)]
    positions: PackedArray  # (T + 1, n, 2)
    headings: PackedArray | None = None  # (T + 1, n)
    winds: PackedArray | None = None  # (T + 1, 2)
    drawn: dict[str, float] = Field(default_factory=dict)
    failed: Annotated[list[_Step | None], Len(1, MAX_ROBOTS)] | None = None
    actions: PackedArray  # (T, n, 2)
    rewards: Rewards


def save_episode(episode: Episode, path: str | Path) -> Path:
    path = check_ending(Path(path), ".json")
    document = to_file(episode).model_dump(mode="json")
    text = json.dumps(document, ensure_ascii=False, separators=(",", ":"))
    with replacing(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")
    return path


def load_episode(path: str | Path) -> Episode:
    """Load the episode at ``path`` without replaying it (see :func:`check_episode`).

    Raises:
        EpisodeError: naming the file and all its problems.
        OSError: there is no such file, or it cannot be read.
    """
    path = Path(path)
    if path.exists() and not (path.is_file() or path.is_dir()):  # a pipe would wait for ever
        raise EpisodeError(str(path), ["file: no regular file; allowed: a file"])
    try:
        document = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, RecursionError) as error:  # not text, not JSON, or nested without end
        problem = f"file: not JSON, or cut off ({error}); expected {EXPECTED}"
        raise EpisodeError(str(path), [problem]) from None
    found = document.get("format") if isinstance(document, Mapping) else None
    if found != FORMAT:
        named = "there is none" if found is None else f"{found!r:.80}"
        problem = f"format: {named}; expected {EXPECTED}"
        raise EpisodeError(str(path), [problem])
    try:
        document.pop("checksum", None)  # of older versions
        content = EpisodeFile.model_validate(document)
    except ValidationError as error:
        raise EpisodeError(str(path), describe(error, EpisodeFile)) from None
    episode = _from_file(content, str(path))
    stored, total = content.team_return, episode.team_return
    if stored != total:
        problem = f"team_return: {stored}; allowed: {total}, the sum of rewards.team"
        raise EpisodeError(str(path), [problem])
    return episode


def is_episode_file(path: str | Path) -> bool:
    """Return whether the file at ``path`` claims to be an episode, of any version or cut off."""
    path = Path(path)
    if path.suffix.lower() != ".json" or not path.is_file():
        return False
    return b'"mbn-episode/' in path.read_bytes()


def to_file(episode: Episode) -> EpisodeFile:
    robots, team = CodedArray.pack(episode.terms), CodedArray.pack(episode.team_rewards)
    missing, config = np.isnan(episode.headings), episode.config
    fixed = config.wind == config.with_drawn(episode.drawn).wind
    return EpisodeFile(
        format=FORMAT,
        version=__version__,
        source=episode.source[:MAX_SOURCE],
        seed=episode.seed,
        world=episode.world,
        episode=episode.number,
        robots=episode.positions.shape[1],
        steps=episode.steps,
        outcome=episode.outcome,
        team_return=episode.team_return,
        wind=config.with_drawn(episode.drawn).wind,
        field=episode.field.to_dict(),
        config=config.model_dump(mode="json", exclude={"wind"} if fixed else set()),
        visits=[int(step) or None for step in episode.visits],
        positions=PackedArray.pack(episode.positions),
        headings=None if missing.all() else PackedArray.pack(episode.headings),
        winds=None if episode.winds is None else PackedArray.pack(episode.winds),
        drawn=dict(episode.drawn),
        failed=[int(step) or None for step in episode.failed] if episode.failed.any() else None,
        actions=PackedArray.pack(episode.actions),
        rewards=Rewards(terms=list(REWARD_TERMS), robots=robots, team=team),
    )


def _from_file(content: EpisodeFile, name: str) -> Episode:
    problems: list[str] = []
    try:
        field = fields.Field(**content.field)
    except FieldError as error:
        problems += [f"field.{problem}" for problem in error.problems]
    except TypeError as error:
        problems.append(f"field: {error}")
    try:
        config = make_config({"wind": content.wind, **content.config})
    except ConfigError as error:
        problems += [f"config.{problem}" for problem in error.problems]
    if problems:
        raise EpisodeError(name, problems)
    steps, robots, dtype = content.steps, content.robots, str(config.dtype)
    terms, known = content.rewards.terms, list(REWARD_TERMS)
    packed: dict[str, tuple[PackedArray | CodedArray | None, tuple[int, ...], str]] = {
        "positions": (content.positions, (steps + 1, robots, 2), dtype),
        "actions": (content.actions, (steps, robots, 2), dtype),
        "headings": (content.headings, (steps + 1, robots), dtype),
        "winds": (content.winds, (steps + 1, 2), "float64"),
        "rewards.robots": (content.rewards.robots, (steps, robots, len(terms)), "float64"),
        "rewards.team": (content.rewards.team, (steps,), "float64"),
    }
    arrays: dict[str, Any] = {}
    for part, (array, shape, kind) in packed.items():
        if array is not None:
            try:
                found = arrays[part] = array.unpack(shape, kind)
                if (np.isinf(found) if part == "headings" else ~np.isfinite(found)).any():
                    raise ValueError("allowed: finite numbers")
            except ValueError as error:
                problems.append(f"{part}: {error}")
    count, failed = len(field.rois), content.failed or [None] * robots
    late = f"allowed: null, or a step from 1 to {steps}"
    checks = {
        f"rewards.terms: {terms}; allowed: each at most once of {known}": (
            len(set(terms)) < len(terms) or not set(terms) <= set(known)
        ),
        f"drawn: {sorted(content.drawn)}; allowed: {sorted(config.drawn)}": (
            set(content.drawn) != set(config.drawn)
        ),
        f"config.n_robots: {config.n_robots}; allowed: {robots}": config.n_robots != robots,
        f"visits: {len(content.visits)}; allowed: {count}": len(content.visits) != count,
        f"failed: {len(failed)}; allowed: {robots}": len(failed) != robots,
        f"visits: {late}": max(step or 0 for step in content.visits) > steps,
        f"failed: {late}": max(step or 0 for step in failed) > steps,
    }
    problems += [problem for problem, wrong in checks.items() if wrong]
    if problems:
        raise EpisodeError(name, problems)
    own_terms = np.zeros((steps, robots, len(known)))  # of those that the file does not know: 0
    own_terms[..., list(map(known.index, terms))] = arrays["rewards.robots"]
    return Episode(
        field=field,
        config=config,
        actions=arrays["actions"],
        positions=arrays["positions"],
        headings=arrays.get("headings", np.full((steps + 1, robots), np.nan, dtype)),
        failed=np.array([step or 0 for step in failed], np.int32),
        visits=np.array([step or 0 for step in content.visits], np.int32),
        terms=own_terms,
        team_rewards=arrays["rewards.team"],
        outcome=content.outcome,
        winds=arrays.get("winds"),
        drawn=content.drawn,
        source=content.source,
        seed=content.seed,
        world=content.world,
        number=content.episode,
    )
