"""How a trained policy stands wind: fresh episodes at several wind speeds."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from baselines.evaluation.evaluate import Evaluation, evaluate, is_one_episode
from baselines.evaluation.intervals import mean_interval, share_interval
from baselines.evaluation.policy import Policy
from mbn_marl.episode import Episode
from mbn_marl.errors import ConfigError
from mbn_marl.field import Field
from mbn_marl.render import figures

MOST_SPEEDS = 100


def parse_speeds(text: str) -> list[float]:
    """Read wind speeds from numbers between commas; ``..`` is even steps up to the next one.

    ``0,0.1,..,0.5`` is ``0,0.1,0.2,0.3,0.4,0.5``.

    Raises:
        ConfigError: a word is no number or negative, or ``..`` does not lie between two numbers
            before it and a number after it that the steps reach.
    """
    speeds: list[float] = []
    words = [word.strip() for word in text.split(",")]
    try:
        for before, word in itertools.pairwise(["", *words]):
            if word != "..":
                speed = _speed(word)
                speeds += [*(_between(speeds, speed) if before == ".." else ()), speed]
        if words[-1] == "..":
            raise ValueError("'..' needs a number after it")
        if len(speeds) > MOST_SPEEDS:
            raise ValueError(f"{len(speeds)} speeds; allowed: up to {MOST_SPEEDS}")
    except ValueError as error:
        problem = f"wind_speeds {text!r}: {error}; for example 0,0.1,..,0.5"
        raise ConfigError("wind", [problem]) from None
    return speeds


def _speed(word: str) -> float:
    try:
        speed = float(word)
    except ValueError:
        raise ValueError(f"{word!r} is no number") from None
    if not 0.0 <= speed < float("inf"):
        raise ValueError(f"{word} is no speed; allowed: 0 and above")
    return speed


def _between(before: Sequence[float], end: float) -> list[float]:
    """The speeds in the place of ``..``."""
    if len(before) < 2:
        raise ValueError("'..' needs two numbers before it")
    start, step = before[-1], before[-1] - before[-2]
    count = round((end - start) / step) if step else 0
    if not 1 <= count <= MOST_SPEEDS or abs(start + count * step - end) > 1e-9:
        raise ValueError(f"even steps of {step:g} from {start:g} do not reach {end:g}")
    return [round(start + number * step, 12) for number in range(1, count)]


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
    """Evaluate at every speed (units/step per step), with sampled and with mean actions.

    The wind replaces that of the settings; its ``angle`` is in degrees from +x. An evaluation has
    one episode where all would be the same.

    Returns:
        JSON values, an entry for every speed and way to act: see :func:`with_intervals`; and, by
        its wind in words, the first of the evaluated episodes with mean actions at each speed.
    """
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
    """An evaluation as JSON values, with 95 % intervals over its episodes.

    ``success_interval`` is Wilson's; ``return_interval`` and ``makespan_interval`` are bootstrap
    intervals of the mean, the latter over successful episodes. ``one_episode`` has none.
    """
    makespans = evaluation.makespans
    intervals = {
        "success_interval": share_interval(evaluation.successes),
        "return_interval": mean_interval(evaluation.returns),
        "makespan_interval": mean_interval(makespans) if makespans else None,
    }
    return {
        **evaluation.to_json(),
        **{
            name: None if interval is None or one_episode else interval._asdict()
            for name, interval in intervals.items()
        },
    }


def write_panels(episodes: Mapping[str, Episode], path: Path) -> None:
    """Draw episodes side by side; raise MbnError unless ``path`` ends in png, pdf or svg."""
    lasts = {name: episode.snapshot(episode.steps) for name, episode in episodes.items()}
    figures.save(figures.trajectory_panels(lasts), path)
