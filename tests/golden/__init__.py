"""Reads the golden episodes; README.md says what they are."""

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_FOLDER = Path(__file__).parent
_INDEX = json.loads((_FOLDER / "traces.json").read_text(encoding="utf-8"))

FIELDS: dict[str, dict[str, Any]] = _INDEX["fields"]
"""Name -> vertices, rois, starts: lists of (x, y) in arena units."""


@dataclass(frozen=True)
class Episode:
    """One recorded episode of T steps.

    Attributes:
        id: its name. field: a key of :data:`FIELDS`. n_robots: team size n.
        wind: speed (units/step per step) and angle (degrees).
        actions: (T, n, 2) float32. rewards: (T,) float64, the team's. terminated: (T,) bool.
        positions, velocities: (T+1, n, 2) float64, the reset state first. codes: (T+1,) int64.
        episode_return: sum of the rewards.
    """

    id: str
    field: str
    n_robots: int
    wind: tuple[float, float]
    actions: NDArray[np.float32]
    rewards: NDArray[np.float64]
    terminated: NDArray[np.bool_]
    positions: NDArray[np.float64]
    velocities: NDArray[np.float64]
    codes: NDArray[np.int64]
    episode_return: float


def load_episodes() -> list[Episode]:
    """All 107 episodes, in the order of their ids."""
    with np.load(_FOLDER / "traces.npz") as arrays:
        return [
            Episode(
                id=row["id"],
                field=row["field"],
                n_robots=row["robots"],
                wind=(row["wind_speed"], row["wind_angle_deg"]),
                actions=arrays[f"{row['id']}/actions"],
                rewards=arrays[f"{row['id']}/rewards"],
                terminated=arrays[f"{row['id']}/terminated"],
                positions=arrays[f"{row['id']}/positions"],
                velocities=arrays[f"{row['id']}/velocities"],
                codes=arrays[f"{row['id']}/roi_code"],
                episode_return=row["episode_return"],
            )
            for row in _INDEX["traces"]
        ]
