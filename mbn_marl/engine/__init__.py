"""The engine: many worlds of the MDP at once, compiled by Numba."""

from mbn_marl.engine.batch import BatchEngine, FieldLike
from mbn_marl.engine.kernels import INFO_COLUMNS
from mbn_marl.engine.measured import Command, MeasuredWorld
from mbn_marl.engine.observation import Entry
from mbn_marl.engine.rewards import REWARD_TERMS
from mbn_marl.engine.snapshot import Snapshot

__all__ = [
    "INFO_COLUMNS",
    "REWARD_TERMS",
    "BatchEngine",
    "Command",
    "Entry",
    "FieldLike",
    "MeasuredWorld",
    "Snapshot",
]
