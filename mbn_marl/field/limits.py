"""The limits of a field that are not settings of the MDP."""

from __future__ import annotations

from mbn_marl.config import NavigationConfig

SAFETY_DISTANCE: float = NavigationConfig.model_fields["safety_distance"].default
"""Starts closer than this (strictly, in units) would be a collision at reset."""

MAX_COORDINATE = 1e6
"""The longest side of an arena, in units: beyond it float32 positions get coarser than 1/16."""

MAX_VERTICES = 500
"""Corners of the outline and all holes together."""

MAX_HOLES = 64

MAX_NAME = 64
NAME_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9_.-]*$"
"""Names of fields become parts of environment ids and of paths, so they hold nothing else."""
