"""The MDP's own point masses behind the simulators' interface."""

from __future__ import annotations

from typing import ClassVar

import numpy as np

from mbn_marl.engine.mdp.failures import KINDS
from mbn_marl.sim3d.simulator import Floats, Mission, Motion, Simulator


class PlaneSimulator(Simulator):
    """Point masses that have every commanded velocity at once (mdp.md, steps 1 and 2).

    A deployment here is the environment's own episode, number for number. ``has_wind`` is false:
    the wind is part of the commands. ``failures`` are of all kinds.
    """

    has_wind: ClassVar[bool] = False
    failures: ClassVar[tuple[str, ...]] = tuple(KINDS)

    def reset(self, mission: Mission) -> None:
        """Put the point masses at the starts of ``mission``."""
        self._tau = mission.starts.dtype.type(mission.tau)
        self._positions = mission.starts.copy()
        self._velocities = np.zeros_like(self._positions)

    def command(self, velocities: Floats) -> None:
        """Take ``velocities``, (n, 2) in units/step."""
        self._velocities = velocities.astype(self._positions.dtype)

    def step(self) -> None:
        """Move: ``p' = p + v tau``."""
        self._positions = self._positions + self._velocities * self._tau

    def motion(self) -> Motion:
        """Return the point masses now; fresh arrays."""
        heights = np.zeros(len(self._positions))
        return Motion(self._positions.copy(), self._velocities.copy(), heights)

    def spray(self, roi: int) -> None:
        """Show nothing of ``roi``, 0 to m - 1."""

    def close(self) -> None:
        """Free nothing: there is nothing to free."""
