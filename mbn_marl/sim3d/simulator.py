"""The interface of every simulator to the deployment, in the units of the MDP."""

from __future__ import annotations

from abc import abstractmethod
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from mbn_marl.errors import ConfigError
from mbn_marl.field import Field

Floats = NDArray[np.floating[Any]]


@dataclass(frozen=True)
class Scale:
    """How large and how slow the MDP is in the world of a simulator.

    Attributes:
        metres: of one unit, above 0.
        seconds: of one unit of the MDP's time, above 0: a step lasts ``tau`` times as long.

    Raises:
        ConfigError: a number is not above 0.
    """

    metres: float = 0.1
    seconds: float = 1.0

    def __post_init__(self) -> None:
        """Check the numbers."""
        allowed = "allowed: a finite number above 0"
        wrong = {name: value for name, value in vars(self).items() if not 0.0 < value < np.inf}
        if wrong:
            problems = [f"{name}: {value!r}; {allowed}" for name, value in wrong.items()]
            raise ConfigError("scale", problems)

    @property
    def speed(self) -> float:
        """Metres per second of one unit/step."""
        return self.metres / self.seconds

    def acceleration(self, tau: float) -> float:
        """Metres per second squared of one unit/step per step of ``tau``."""
        return self.speed / (tau * self.seconds)


@dataclass(frozen=True, eq=False)
class Mission:
    """Where a simulator is reset to.

    Attributes:
        field: with m ROIs.
        starts: (n, 2), units: where the robots start, at rest.
        wind: ``(x, y)``, the velocity that the wind adds to a free body at rest in a step,
            units/step.
        tau: the MDP's time of one step.
        roi_radius: rho, units.

    Source:
        The symbols are those of Choton, Woods, Hsu, section 3.
    """

    field: Field
    starts: Floats
    wind: tuple[float, float] = (0.0, 0.0)
    tau: float = 1.0
    roi_radius: float = 10.0


@dataclass(frozen=True, eq=False)
class Motion:
    """The vehicles at one moment.

    Attributes:
        positions: (n, 2), units.
        velocities: (n, 2), units/step.
        heights: (n,), metres above the ground, >= 0.
    """

    positions: Floats
    velocities: Floats
    heights: Floats


class Simulator(AbstractContextManager["Simulator"]):
    """Vehicles in a field, in a ``with`` block or closed by hand.

    A mission is a :meth:`reset`, and in each step :meth:`fail` for each vehicle that fails in it,
    :meth:`command`, :meth:`step`, :meth:`motion`.

    Attributes:
        has_wind: whether the wind acts on its bodies. If not, the wind is part of the commands.
        external: whether it is another program, whose processor time is not known here.
        failures: the kinds of failure that its vehicles can have.
        speed_limit: the vehicles' own limit per axis, units/step; ``None`` for none but the MDP's.
    """

    has_wind: ClassVar[bool] = True
    external: ClassVar[bool] = False
    failures: ClassVar[tuple[str, ...]] = ("brake", "coast")
    speed_limit: float | None = None

    @abstractmethod
    def reset(self, mission: Mission) -> None:
        """Build the scene of ``mission``, with the vehicles at rest at their starts.

        Raises:
            MbnError: the simulator cannot be used; nothing is left running.
        """

    @abstractmethod
    def command(self, velocities: Floats) -> None:
        """Let the vehicles track ``velocities``, (n, 2) in units/step, from now on."""

    def fail(self, robot: int, kind: str) -> None:
        """Let vehicle ``robot``, 0 to n - 1, fail in a ``kind`` of ``failures``, for good.

        Its commands are those of mdp.md, "Failures", from the next one on. One that brakes may do
        more once its command is to stand: land, and switch off.
        """

    @abstractmethod
    def step(self) -> None:
        """Simulate one step of the MDP."""

    @abstractmethod
    def motion(self) -> Motion:
        """Return the vehicles now; fresh arrays."""

    @abstractmethod
    def spray(self, roi: int) -> None:
        """Show that the weed at ROI ``roi``, 0 to m - 1, has been sprayed."""

    @abstractmethod
    def close(self) -> None:
        """Free what the simulator holds; closing twice does no harm."""

    def __exit__(self, *_: object) -> None:
        self.close()
