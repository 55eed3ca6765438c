"""The information that a policy acts on, as tables name it."""

from collections.abc import Mapping
from typing import Any, Literal

from mbn_marl.config import make_config

Information = Literal["all", "assignment", "own sight", "team", "own"]


def information(settings: Mapping[str, Any], *, centralized: bool = False) -> Information:
    """Return ``assignment`` for a planner's hint, else whether a policy sees far or near.

    With ``knowledge="own"`` it acts on that, or on the knowledge of its ``team``.
    """
    # A centralised policy sees the observations of all robots, and counts as seeing all, but if
    # nothing is seen.
    config = make_config(settings)
    if config.assignment:
        return "assignment"
    if config.knowledge == "own":
        return "team" if centralized else "own"
    near = config.observation in ("local", "lidar_local") and not centralized
    return "own sight" if near or config.dropout == 1.0 else "all"
