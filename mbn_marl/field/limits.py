"""The limits of a field that are not settings of the MDP."""

from __future__ import annotations

from mbn_marl.config import NavigationConfig

SAFETY_DISTANCE: float = NavigationConfig.model_fields["safety_distance"].default
"""Starts closer than this (in units) would be a collision at the reset."""
ROI_RADIUS: float = NavigationConfig.model_fields["roi_radius"].default
MAX_COORDINATE = 1e6
"""The longest side of an arena, in units: beyond it float32 positions are 1/8 apart or more."""
MAX_VERTICES = 500  # corners of the outline and all holes together
MAX_HOLES = 64
MAX_NAME = 64
NAME_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9_.-]*$"
"""Names are restricted because they become parts of environment ids and paths."""
