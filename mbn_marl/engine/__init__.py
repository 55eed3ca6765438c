"""The engine: many worlds of the MDP at once, compiled by Numba."""

from mbn_marl.engine.batch import BatchEngine, FieldLike, Fields
from mbn_marl.engine.kernels import INFO_COLUMNS
from mbn_marl.engine.mdp.observations import Entry
from mbn_marl.engine.mdp.rewards import REWARD_TERMS
from mbn_marl.engine.snapshot import Snapshot
from mbn_marl.engine.tracked_world import Command, TrackedWorld

__all__ = [
    "INFO_COLUMNS",
    "REWARD_TERMS",
    "BatchEngine",
    "Command",
    "Entry",
    "FieldLike",
    "Fields",
    "Snapshot",
    "TrackedWorld",
]
