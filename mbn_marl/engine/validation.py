"""Check that settings, fields and starts fit together, before an engine is built."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import Any, Literal, TypeGuard, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray
from shapely import Point

from mbn_marl.config import LIMITS, MAX_ROBOTS, NavigationConfig
from mbn_marl.engine.constants import AUTORESET_MODES
from mbn_marl.engine.tables import FieldSource, Sizes, sizes_of
from mbn_marl.errors import ConfigError, unknown
from mbn_marl.field import Field, FieldSampler
from mbn_marl.field.generator.layout import MILLI, STARTS_APART

# The least distance of starts that are drawn, units.
SPACING = STARTS_APART / MILLI
Autoreset = bool | Literal["disabled", "same_step", "next_step"]
Device = Literal["cpu", "cuda"]

MOST_WORLDS = 2**31 - 1
# Units by which a start that was once rounded to float32 may miss what is allowed.
ROUNDING = 1e-3


def autoreset_mode(value: Autoreset) -> str:
    return ("same_step" if value else "disabled") if isinstance(value, bool) else value


def argument_problems(
    num_worlds: int,
    threads: int | None,
    device: str,
    autoreset: Autoreset,
    keys: Mapping[str, int],
) -> list[str]:
    problems = [one for name, key in keys.items() for one in _number_problems(name, key)]
    if device not in get_args(Device):
        problems.append(f"device: {device!r}; allowed: {', '.join(map(repr, get_args(Device)))}")
    if not (_positive(num_worlds) and num_worlds <= MOST_WORLDS):
        allowed = f"an integer from 1 to {MOST_WORLDS:,}, if memory is large enough"
        problems.append(f"num_worlds: {num_worlds!r}; allowed: {allowed}")
    if threads is not None and not _positive(threads):
        problems.append(f"threads: {threads!r}; allowed: None or an integer of at least 1")
    if autoreset_mode(autoreset) not in AUTORESET_MODES:
        allowed = ", ".join(map(repr, (True, False, *AUTORESET_MODES)))
        problems.append(f"autoreset: {autoreset!r}; allowed: {allowed}")
    return problems


def setup_problems(
    source: FieldSource,
    config: NavigationConfig,
    n: int,
    num_worlds: int,
    starts: NDArray[Any] | None,
) -> list[str]:
    problems = []
    for name in ("dynamics", *LIMITS):
        if (count := len(config.of_each(name, n))) != n:
            problems.append(f"{name}: {count} values; allowed: one for all robots, or {n} of them")
    problems += _failure_problems(config, n)
    if isinstance(source, FieldSampler):
        problems += _sampler_problems(source, config, n, starts)
    else:
        if _positive(num_worlds) and len(source) > num_worlds:
            problems.append(f"field: {len(source)} fields; allowed: up to {num_worlds}, the worlds")
        problems += _fields_problems(source, config, n, starts)
    return problems


def _fields_problems(
    fields: Sequence[Field], config: NavigationConfig, n: int, starts: NDArray[Any] | None
) -> list[str]:
    problems = [] if fields else ["field: an empty sequence; allowed: at least one field"]
    if starts is not None and (wrong := _given_starts_problems(starts, config, n)):
        problems, starts = [*problems, *wrong], None
    for field in fields:
        team = n if config.n_robots or starts is not None else len(field.starts)
        problems += field_problems(field, config, team, fields[0].arena, starts)
    return [*dict.fromkeys(problems)]


def _failure_problems(config: NavigationConfig, n: int) -> list[str]:
    if config.failures is None:
        return []
    rate, at, most = config.failures.rate, config.failures.at, config.failures.most
    problems = [f"failures.at: robot {i}; allowed: 0 to {n - 1}" for i in at if i >= n]
    steps = {f"at.{i}": step for i, step in at.items()}
    if config.failures.between:
        steps["between"] = config.failures.between[0]
    problems += [
        f"failures.{place}: step {step}; allowed: 1 to {config.max_steps}, max_steps"
        for place, step in steps.items()
        if step > config.max_steps
    ]
    if most is not None and most > n:
        problems.append(f"failures.most: {most}; allowed: 0 to {n}, the size of the team")
    if rate and (most == 0 or (most is None and n == 1)):
        found = "0" if most == 0 else "None, 0 for one robot"
        problems.append(f"failures.most: {found}; allowed with a rate: 1 to {n}")
    return problems


def set_field_problems(
    field: Field,
    sizes: Sizes,
    config: NavigationConfig,
    teams_vary: bool,
    starts: NDArray[Any] | None,
) -> list[str]:
    n = sizes.robots
    if starts is not None and (wrong := _given_starts_problems(starts, config, n)):
        return wrong
    team = len(field.starts) if teams_vary and starts is None else n
    problems = field_problems(field, config, team, sizes.arena, starts)
    if len(field.rois) > sizes.rois:
        allowed = f"at most {sizes.rois}, those that observations have entries for"
        problems.append(f"field: {field.name} has {len(field.rois)} ROIs; allowed: {allowed}")
    if field.roi_kinds and not sizes.kinds:
        problems.append(f"field: {field.name} has kinds; allowed: with fields that had some before")
    if team > n:
        problems.append(f"field: {field.name} has {team} starts; allowed: at most {n}")
    return problems


def set_sampler_problems(
    sampler: FieldSampler, sizes: Sizes, config: NavigationConfig, teams_vary: bool
) -> list[str]:
    new, robots = sizes_of(sampler), sizes.robots
    least = 1 if teams_vary else robots
    problems = [
        f"sampler: {found} {name}; allowed: at most {most}, as at first"
        for name, found, most in (
            ("edges", new.edges, sizes.edges),
            ("ROIs", new.rois, sizes.rois),
            ("robots", new.robots, robots),
        )
        if found > most
    ]
    if new.fewest_robots < least:
        problems.append(f"sampler: {new.fewest_robots} robots; allowed: {robots}, as at first")
    if new.arena != sizes.arena:
        problems.append(f"sampler: arena {new.arena}; allowed: {sizes.arena}")
    return problems + _decoy_problems(config, sampler.rois[0], "the sampler")


REAL = "fiu"  # kinds of NumPy's real number types


def as_array(value: Any) -> NDArray[Any]:
    """Return an array; a tensor without its graph, bfloat16 as float32."""
    if isinstance(value, np.ndarray) or not hasattr(value, "detach"):
        return np.asarray(value)
    tensor = value.detach().cpu()
    return np.asarray(tensor.float() if str(tensor.dtype) == "torch.bfloat16" else tensor)


def option_problems(options: object, allowed: Sequence[str]) -> list[str]:
    if options is None:
        return []
    if not isinstance(options, Mapping):
        return [f"options: {type(options).__name__}; allowed: a dict, or None"]
    return [
        f"options: {name!r}: {unknown('option', str(name), allowed)}"
        for name in options
        if name not in (*allowed, "options")  # PettingZoo's own tests give {"options": 1}
    ]


def reset_problems(seed: object, episode: object) -> list[str]:
    problems = [] if seed is None else _number_problems("seed", seed)
    problems += _number_problems("episode", episode)
    if seed is None and not problems and episode != 0:
        problems.append(f"episode: {episode!r} without a seed; allowed: with one, or 0")
    return problems


def _number_problems(name: str, value: object) -> list[str]:
    if _whole(value) and 0 <= int(value) < 2**63:
        return []
    return [f"{name}: {value!r}; allowed: an integer from 0 to 2**63 - 1"]


def _whole(value: object) -> TypeGuard[int | np.integer[Any]]:
    return isinstance(value, int | np.integer) and not isinstance(value, bool)


def _positive(value: object) -> bool:
    return _whole(value) and int(value) >= 1


def _given_starts_problems(starts: NDArray[Any], config: NavigationConfig, n: int) -> list[str]:
    if starts.shape != (n, 2) or starts.dtype.kind not in REAL:
        wrong = f"shape {starts.shape} of {starts.dtype}"
        return [f"starts: {wrong}; allowed: finite numbers of shape ({n}, 2)"]
    bad = np.flatnonzero(~np.isfinite(starts).all(axis=1)).tolist()
    if bad:
        return [f"starts[{i}]: {starts[i].tolist()}; allowed: finite numbers" for i in bad]
    if config.random_starts:
        return ["starts: allowed without random_starts"]
    return []


def _sampler_problems(
    sampler: FieldSampler, config: NavigationConfig, n: int, starts: NDArray[Any] | None
) -> list[str]:
    problems = [] if starts is None else ["starts: allowed with given fields"]
    if n < sampler.robots[1]:
        allowed = f"at least {sampler.robots[1]}, the most that the sampler draws"
        problems.append(f"n_robots: {n}; allowed: {allowed}")
    if (distance := config.at_most().safety_distance) > SPACING:
        allowed = f"at most {SPACING:g}, the least distance of starts that are drawn"
        problems.append(f"safety_distance: {distance}; allowed: {allowed}")
    return problems + _decoy_problems(config, sampler.rois[0], "the sampler")


def _decoy_problems(config: NavigationConfig, rois: int, source: str) -> list[str]:
    problems, empty, allowed = [], config.empty_rois, f"at most {rois - 1}, all but one ROI"
    if config.decoy_range[1] >= rois:
        problems.append(f"decoys: {config.decoys}; allowed: {allowed} of {source}")
    if len(empty) >= rois or max(empty, default=0) >= rois:
        problems.append(f"empty_rois: {empty}; allowed: {allowed}, numbered from 0, of {source}")
    return problems


def as_starts(starts: ArrayLike | None) -> NDArray[Any] | None:
    try:
        return None if starts is None else as_array(starts)
    except ValueError as error:
        raise ConfigError("starts", [f"starts: {error}; allowed: (n, 2) numbers"]) from None


def field_problems(
    field: Field,
    config: NavigationConfig,
    n: int,
    arena: tuple[float, float],
    given_starts: NDArray[Any] | None,
) -> list[str]:
    """Return why this field does not fit this configuration; warn if an ROI covers it."""
    decoys = _decoy_problems(config, len(field.rois), field.name)
    # Given starts may be those of an episode that drew the least safety distance.
    lowest = config.with_drawn({name: ends.low for name, ends in config.drawn.items()})
    config = config.at_most() if given_starts is None else lowest
    problems = []
    sides = np.ptp(field.vertices, axis=0)
    if np.hypot(*sides) <= config.roi_radius:
        small = f"{field.name}: {sides[0]:.3g} x {sides[1]:.3g} units, smaller than an ROI's radius"
        warnings.warn(f"{small}; 'mbn fields --from' reads a map in degrees", stacklevel=2)
    room = int(field.polygon.area / (2 * max(config.safety_distance, 1.0)) ** 2)
    room = 0 if field.roi_kinds else min(room, MAX_ROBOTS)  # more robots than starts have no kind
    random = config.random_starts and n <= room
    if (given_starts is None or field.roi_kinds) and n > len(field.starts) and not random:
        allowed = f"1 to {len(field.starts)}, the starts of {field.name}"
        allowed += f", or to {room} with random_starts" if room > len(field.starts) else ""
        problems.append(f"n_robots: {n}; allowed: {allowed}")
    for j in np.flatnonzero(~field.mine[:n].any(axis=0)).tolist():
        kind = f"one of kind {field.roi_kinds[j]}, for rois[{j}] of {field.name}"
        problems.append(f"n_robots: {n} robots; allowed: with {kind}")
    if field.arena != arena:
        problems.append(f"field: {field.name} has arena {field.arena}; allowed: {arena}")
    starts = field.starts[:n] if given_starts is None else given_starts.astype(np.float64)
    for i in range(len(starts)):
        if given_starts is not None and field.polygon.distance(Point(starts[i])) > ROUNDING:
            problems.append(f"starts[{i}]: {starts[i].tolist()}; allowed: in {field.name}")
        for j in range(i):
            apart = float(np.hypot(*(starts[i] - starts[j])))
            if apart < config.safety_distance - (0.0 if given_starts is None else ROUNDING):
                problems.append(
                    f"safety_distance: {config.safety_distance}; allowed: at most {apart:g}, "
                    f"the distance of starts {j} and {i} of {field.name}"
                )
    return problems + decoys
