"""Evaluate a policy at several wind speeds."""

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from baselines.evaluation.evaluate import Evaluation, evaluate, is_one_episode
from baselines.evaluation.intervals import mean_interval, share_interval
from baselines.policies.policy import Policy
from mbn_marl.episode import Episode
from mbn_marl.errors import ConfigError
from mbn_marl.field import Field
from mbn_marl.render import figures

MOST_SPEEDS = 100
ALLOWED = (
    f"allowed: up to {MOST_SPEEDS} speeds of 0 and above between commas, and '..' for even steps "
    "from two of them to the next; for example 0,0.1,..,0.5"
)


def parse_speeds(text: str) -> list[float]:
    """Read wind speeds: ``0,0.1,..,0.5`` is ``0,0.1,0.2,0.3,0.4,0.5``."""
    speeds: list[float] = []
    words = [word.strip() for word in text.split(",")]
    for before, word in itertools.pairwise(["", *words]):
        if word == ".." and word is not words[-1]:
            continue
        try:
            end = float(word)
            if before == "..":
                start, step = speeds[-1], speeds[-1] - speeds[-2]
                count = round((end - start) / step)
                if not 1 <= count <= MOST_SPEEDS or abs(start + count * step - end) > 1e-9:
                    raise ValueError
                speeds += [round(start + number * step, 12) for number in range(1, count)]
            if not 0.0 <= end < float("inf") or len(speeds) >= MOST_SPEEDS:
                raise ValueError
        except (ValueError, IndexError, ZeroDivisionError, OverflowError):
            place = f"{before},{word}" if before == ".." else repr(word)
            raise ConfigError("wind", [f"wind_speeds {text!r}: {place}; {ALLOWED}"]) from None
        speeds.append(end)
    return speeds


def evaluate_in_wind(
    policy: Policy,
    field: Field,
    settings: Mapping[str, Any],
    speeds: Sequence[float],
    angle: float,
    *,
    episodes: int,
    seed: int,
) -> tuple[list[dict[str, Any]], dict[str, Episode]]:
    """Evaluate at every speed, both ways to act; also return an episode of each, by its wind."""
    rows: list[dict[str, Any]] = []
    drawn: dict[str, Episode] = {}
    for speed, deterministic in itertools.product(speeds, (False, True)):
        world = {**settings, "wind": (speed, angle)}
        one = is_one_episode(policy, world, deterministic=deterministic)
        evaluation = evaluate(
            *(policy, field, world),
            episodes=1 if one else episodes,
            deterministic=deterministic,
            seed=seed,
            record=[0] if deterministic else [],
        )
        wind = {"wind_speed": speed, "wind_angle": angle}
        rows.append({**wind, **with_intervals(evaluation, one_episode=one)})
        drawn.update({f"wind {speed:g}": episode for episode in evaluation.recorded})
    return rows, drawn


def with_intervals(evaluation: Evaluation, *, one_episode: bool) -> dict[str, Any]:
    """An evaluation as JSON values, with 95 % intervals unless it is of ``one_episode``."""
    makespans = evaluation.makespans
    intervals = {
        "success_interval": share_interval(evaluation.successes),
        "return_interval": mean_interval(evaluation.returns),
        "makespan_interval": mean_interval(makespans) if makespans else None,
    }
    shown = {
        name: None if interval is None or one_episode else interval._asdict()
        for name, interval in intervals.items()
    }
    return {**evaluation.to_json(), **shown}


def write_panels(episodes: Mapping[str, Episode], path: Path) -> None:
    lasts = {name: episode.snapshot(episode.steps) for name, episode in episodes.items()}
    figures.save(figures.trajectory_panels(lasts), path)
