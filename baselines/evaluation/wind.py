"""How a trained policy stands wind: fresh episodes at several wind speeds."""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from baselines.evaluation.evaluate import Evaluation, evaluate
from baselines.evaluation.intervals import mean_interval, share_interval
from baselines.evaluation.policy import Policy
from baselines.evaluation.rollout import record_episode
from mbn_marl.errors import ConfigError
from mbn_marl.field import Field

MOST_SPEEDS = 100


def parse_speeds(text: str) -> list[float]:
    """Wind speeds from numbers between commas; ``..`` goes on in even steps up to the next one.

    ``0,0.1,..,0.5`` is ``0,0.1,0.2,0.3,0.4,0.5``.

    Raises:
        ConfigError: a word is no number or negative, or ``..`` does not lie between two numbers
            before it and a number after it that the steps reach.
    """
    speeds: list[float] = []
    words = [word.strip() for word in text.split(",")]
    for index, word in enumerate(words):
        if word == "..":
            continue
        try:
            speed = float(word)
        except ValueError:
            raise _problem(text, f"{word!r} is no number") from None
        if not 0.0 <= speed < float("inf"):
            raise _problem(text, f"{word} is no speed; allowed: 0 and above")
        if index and words[index - 1] == "..":
            speeds += _between(text, speeds, speed)
        speeds.append(speed)
    if words[-1] == "..":
        raise _problem(text, "'..' needs a number after it")
    if len(speeds) > MOST_SPEEDS:
        raise _problem(text, f"{len(speeds)} speeds; allowed: up to {MOST_SPEEDS}")
    return speeds


def _between(text: str, before: Sequence[float], end: float) -> list[float]:
    """The speeds that ``..`` stands for."""
    if len(before) < 2:
        raise _problem(text, "'..' needs two numbers before it")
    start, step = before[-1], before[-1] - before[-2]
    count = round((end - start) / step) if step else 0
    if not 1 <= count <= MOST_SPEEDS or abs(start + count * step - end) > 1e-9:
        raise _problem(text, f"even steps of {step:g} from {start:g} do not reach {end:g}")
    return [round(start + number * step, 12) for number in range(1, count)]


def _problem(text: str, what: str) -> ConfigError:
    return ConfigError("wind", [f"wind_speeds {text!r}: {what}; for example 0,0.1,..,0.5"])


def evaluate_in_wind(
    policy: Policy,
    field: Field,
    settings: Mapping[str, Any],
    speeds: Sequence[float],
    angle: float,
    *,
    episodes: int,
    seed: int,
) -> list[dict[str, Any]]:
    """Evaluate at every speed, with sampled and with mean actions.

    Args:
        policy: what acts.
        field: where.
        settings: of the environment; its wind is replaced.
        speeds: units/step per step.
        angle: of the wind, degrees from +x.
        episodes: of every evaluation.
        seed: of the episodes.

    Returns:
        JSON values, an entry for every speed and way to act: see :func:`with_intervals`.
    """
    return [
        {
            "wind_speed": speed,
            "wind_angle": angle,
            **with_intervals(
                evaluate(
                    policy,
                    field,
                    {**settings, "wind": (speed, angle)},
                    episodes=episodes,
                    deterministic=deterministic,
                    seed=seed,
                )
            ),
        }
        for speed, deterministic in itertools.product(speeds, (False, True))
    ]


def with_intervals(evaluation: Evaluation) -> dict[str, Any]:
    """An evaluation as JSON values, with 95 % intervals over its episodes.

    ``success_interval`` is Wilson's; ``return_interval`` and ``makespan_interval`` are bootstrap
    intervals of the mean, the latter over successful episodes and ``None`` without any.
    """
    lengths = [
        float(steps)
        for steps, success in zip(evaluation.steps, evaluation.successes, strict=True)
        if success
    ]
    return {
        **evaluation.to_json(),
        "success_interval": asdict(share_interval(evaluation.successes)),
        "return_interval": asdict(mean_interval(evaluation.returns)),
        "makespan_interval": asdict(mean_interval(lengths)) if lengths else None,
    }


def write_panels(
    policy: Policy,
    field: Field,
    settings: Mapping[str, Any],
    speeds: Sequence[float],
    angle: float,
    path: Path,
) -> None:
    """Draw an episode with mean actions at every speed, side by side.

    Raises:
        MbnError: ``path`` does not end in png, pdf or svg.
    """
    from mbn_marl.render import figures

    episodes = {
        f"wind {speed:g}": record_episode(policy, field, {**settings, "wind": (speed, angle)})
        for speed in speeds
    }
    lasts = {name: episode.snapshot(episode.steps) for name, episode in episodes.items()}
    figures.save(figures.trajectory_panels(lasts), path)
