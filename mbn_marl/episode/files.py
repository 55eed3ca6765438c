"""The file format ``mbn-episode/1``, which ``docs/replay.md`` describes: save and load episodes.

Arrays are base64 of their bytes, so that they are exact and small.
"""

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
from mbn_marl.config import MAX_ROBOTS, MAX_ROIS, NavigationConfig, describe, make_config
from mbn_marl.engine import REWARD_TERMS
from mbn_marl.episode.episode import Episode, Outcome
from mbn_marl.errors import EpisodeError, MbnError
from mbn_marl.files import replacing
from mbn_marl.version import __version__

FORMAT: Final = "mbn-episode/1"
EXPECTED = f"an episode in the format {FORMAT}, as `mbn render -o episode.json` writes it"
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
    source: str = Field(max_length=MAX_SOURCE, description="The name of what acted.")
    seed: int | None = Field(description="Of the world and of what acted.")
    world: int = Field(default=0, ge=0, description="The number of the world.")
    episode: int = Field(default=0, ge=0, description="Its number since the seed was set.")
    robots: int = Field(ge=1, le=MAX_ROBOTS, description="n.")
    steps: int = Field(ge=0, description="T.")
    outcome: Outcome = Field(description="How it ended.")
    team_return: float = Field(description="Sum of the centralised rewards.")
    wind: tuple[float, float] = Field(description="Speed (units/step per step), angle (degrees).")
    field: dict[str, Any] = Field(description="As in a field file of the format mbn-field/1.")
    config: dict[str, Any] = Field(
        description="Every setting of NavigationConfig; of the wind the range, if it was drawn."
    )
    visits: Annotated[list[int | None], Len(1, MAX_ROIS)] = Field(
        description="The step in which each ROI was visited, from 1 on; null for never."
    )
    positions: PackedArray = Field(description="(T + 1, n, 2), units, from the reset on.")
    headings: PackedArray | None = Field(
        default=None,
        description="(T + 1, n), radians, NaN for a robot without one; null if none has.",
    )
    winds: PackedArray | None = Field(
        default=None,
        description="(T + 1, 2), units/step, of wind and gust in the next step; null without.",
    )
    drawn: dict[str, float] = Field(
        default_factory=dict, description="The numbers that the episode has drawn, by name."
    )
    failed: Annotated[list[int | None], Len(1, MAX_ROBOTS)] | None = Field(
        default=None,
        description="The step in which each robot failed, as in visits; null if none did.",
    )
    actions: PackedArray = Field(description="(T, n, 2), in [-1, 1].")
    rewards: Rewards


def save_episode(episode: Episode, path: str | Path) -> Path:
    """Write ``episode`` to ``path`` as JSON, atomically, and return ``path``.

    Raises:
        MbnError: the name does not end in ``.json``.
        OSError: the file cannot be written.
    """
    path = Path(path)
    if path.suffix.lower() != ".json":
        raise MbnError(f"{path}: the file name has to end in .json")
    document = to_file(episode).model_dump(mode="json")
    text = json.dumps(document, ensure_ascii=False, separators=(",", ":"))
    with replacing(path) as temporary:
        temporary.write_text(text + "\n", encoding="utf-8")
    return path


def load_episode(path: str | Path) -> Episode:
    """Load the episode at ``path`` without replaying it (see :func:`check_episode`).

    Raises:
        EpisodeError: naming the file and all its problems.
        OSError: the file cannot be read.
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
    """Return the content of the file of ``episode``."""
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
    """Return the episode in the file ``name``; raise ``EpisodeError`` with what does not fit."""
    field, config = _place(content, name)
    steps, robots, rois = content.steps, content.robots, len(field.rois)
    terms, known = content.rewards.terms, list(REWARD_TERMS)
    arrays: dict[str, Any] = {}
    problems = []
    packed: dict[str, tuple[PackedArray | CodedArray, tuple[int, ...]]] = {
        "positions": (content.positions, (steps + 1, robots, 2)),
        "actions": (content.actions, (steps, robots, 2)),
        "rewards.robots": (content.rewards.robots, (steps, robots, len(terms))),
        "rewards.team": (content.rewards.team, (steps,)),
    }
    optional = {"headings": (content.headings, robots), "winds": (content.winds, 2)}
    packed |= {part: (array, (steps + 1, k)) for part, (array, k) in optional.items() if array}
    for part, (array, shape) in packed.items():
        try:
            found = arrays[part] = array.unpack()
        except ValueError as error:
            problems.append(f"{part}: {error}")
            continue
        if found.shape != shape:
            problems.append(f"{part}: shape {found.shape}; allowed: {shape}")
        wrong = np.isinf(found) if part == "headings" else ~np.isfinite(found)
        expected = "float64" if part == "winds" else config.dtype
        exact = found.dtype == expected and not wrong.any()
        if not (exact or part.startswith("rewards")):
            as_in = "" if part == "winds" else " as in config"
            problems.append(f"{part}: allowed: finite numbers, {expected}{as_in}")
    if len(set(terms)) < len(terms) or not set(terms) <= set(known):
        problems.append(f"rewards.terms: {terms}; allowed: each at most once of {known}")
    if set(content.drawn) != set(config.drawn):
        problems.append(f"drawn: {sorted(content.drawn)}; allowed: {sorted(config.drawn)}")
    if config.n_robots != robots:
        problems.append(f"config.n_robots: {config.n_robots}; allowed: {robots}, as in robots")
    failed = content.failed or [None] * robots
    problems += _step_problems("visits", content.visits, steps, rois, "ROI")
    problems += _step_problems("failed", failed, steps, robots, "robot")
    if problems:
        raise EpisodeError(name, problems)
    own_terms = np.zeros((steps, robots, len(known)))  # of those that the file does not know: 0
    own_terms[..., list(map(known.index, terms))] = arrays["rewards.robots"]
    return Episode(
        field=field,
        config=config,
        actions=arrays["actions"],
        positions=arrays["positions"],
        headings=arrays.get("headings", np.full((steps + 1, robots), np.nan, config.dtype)),
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


def _step_problems(
    part: str, given: list[int | None], steps: int, count: int, what: str
) -> list[str]:
    """Return what is wrong with the steps in which something happened to each of ``count``."""
    problems = []
    if len(given) != count:
        problems.append(f"{part}: {len(given)}; allowed: {count}, one for each {what}")
    if not all(step is None or 1 <= step <= steps for step in given):
        problems.append(f"{part}: allowed: null, or a step from 1 to {steps}")
    return problems


def _place(content: EpisodeFile, name: str) -> tuple[fields.Field, NavigationConfig]:
    """Return the field and the configuration in the file ``name``."""
    part = "field"
    try:
        field = fields.Field(**content.field)
        part = "config"
        return field, make_config({"wind": content.wind, **content.config})
    except (TypeError, MbnError) as error:
        raise EpisodeError(name, [f"{part}: {error}"]) from None
