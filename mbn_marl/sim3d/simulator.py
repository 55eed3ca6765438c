"""The interface of every simulator to the deployment, in the units of the MDP."""

from __future__ import annotations

from abc import abstractmethod
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from mbn_marl.engine.mdp.failures import KINDS
from mbn_marl.errors import ConfigError
from mbn_marl.field import Field

Floats = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Scale:
    """The size and the pace of the MDP in a simulator's world; a ``ConfigError`` if not above 0."""

    metres: float = 0.1  #: of one unit
    seconds: float = 1.0  #: of one unit of the MDP's time; a step lasts ``tau`` times as long

    def __post_init__(self) -> None:
        wrong = {name: value for name, value in vars(self).items() if not 0.0 < value < np.inf}
        if wrong:
            allowed = "allowed: a finite number above 0"
            raise ConfigError("scale", [f"{name}: {wrong[name]!r}; {allowed}" for name in wrong])

    @property
    def speed(self) -> float:
        """Metres per second of one unit/step."""
        return self.metres / self.seconds

    def acceleration(self, tau: float) -> float:
        """Metres per second squared of one unit/step per step of ``tau``."""
        return self.speed / (tau * self.seconds)


@dataclass(frozen=True, eq=False)
class Mission:
    """The field and the starts, at rest, that a simulator is reset to."""

    field: Field  #: with m ROIs
    starts: Floats  #: (n, 2), units
    wind: tuple[float, float] = (0.0, 0.0)  #: it adds to a free body at rest in a step, units/step
    tau: float = 1.0  #: the MDP's time of one step
    roi_radius: float = 10.0  #: rho, units


@dataclass(frozen=True, eq=False)
class Motion:
    """The vehicles at one moment."""

    positions: Floats  #: (n, 2), units
    velocities: Floats  #: (n, 2), units/step
    heights: Floats  #: (n,), metres above the ground, >= 0


class Simulator(AbstractContextManager["Simulator"]):
    """Vehicles in a field, in a ``with`` block or closed by hand.

    After a :meth:`reset`, each step is :meth:`fail` for each vehicle that fails in it,
    :meth:`command`, :meth:`step` and :meth:`motion`. All raise ``MbnError`` on trouble.
    """

    has_wind: ClassVar[bool] = True  #: the wind acts on its bodies; else it is in the commands
    external: ClassVar[bool] = False  #: another program, whose processor time is not known here
    failures: ClassVar[tuple[str, ...]] = ("brake", "coast")  #: that its vehicles can have
    speed_limit: float | None = None  #: the vehicles' own, per axis, units/step

    @abstractmethod
    def reset(self, mission: Mission) -> None:
        """Build the scene of ``mission``; after an error nothing is left running."""

    @abstractmethod
    def command(self, velocities: Floats) -> None:
        """Let the vehicles track ``velocities``, (n, 2) in units/step, from now on."""

    def fail(self, robot: int, kind: str) -> None:
        """Let a vehicle fail for good; its later commands are those of failures.md."""

    @abstractmethod
    def step(self) -> None:
        """Simulate one step of the MDP."""

    @abstractmethod
    def motion(self) -> Motion:
        """Return the vehicles now; fresh arrays."""

    def spray(self, roi: int) -> None:
        """Show that the weed at an ROI, 0 to m - 1, has been sprayed."""

    def abandon(self) -> None:
        """Leave nothing of a mission that an error has ended, while that is handled."""

    def close(self) -> None:
        """Free what the simulator holds; closing twice does no harm."""

    def __exit__(self, *_: object) -> None:
        self.close()


class PlaneSimulator(Simulator):
    """Point masses (mdp.md, steps 1 and 2): a deployment is the environment's episode."""

    has_wind: ClassVar[bool] = False
    failures: ClassVar[tuple[str, ...]] = tuple(KINDS)

    def reset(self, mission: Mission) -> None:
        self._tau = mission.starts.dtype.type(mission.tau)
        self._positions = mission.starts.copy()
        self._velocities = np.zeros_like(self._positions)

    def command(self, velocities: Floats) -> None:
        self._velocities = velocities.astype(self._positions.dtype)

    def step(self) -> None:
        self._positions = self._positions + self._velocities * self._tau

    def motion(self) -> Motion:
        heights = np.zeros(len(self._positions))
        return Motion(self._positions.copy(), self._velocities.copy(), heights)
