"""The vehicles of the MuJoCo backend: a body in MJCF, and a controller for its motors."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import Any, ClassVar, NamedTuple
from xml.etree.ElementTree import Element, SubElement

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
Flags = NDArray[np.bool_]

GRAVITY = 9.81  # metres per second squared


class Senses(NamedTuple):
    """State of n vehicles for their controllers, in the world's frame unless said otherwise."""

    positions: Array  # (n, 3) m
    velocities: Array  # (n, 3) m/s
    rotations: Array  # (n, 3, 3): columns are the body's axes
    rates: Array  # (n, 3) rad/s, in the body's frame


class Vehicle(ABC):
    height: ClassVar[float]  #: of its origin above the ground when it works, metres
    mass: ClassVar[float]  #: of all its parts, kg
    resting: ClassVar[tuple[float, ...]]  #: of each motor, the control that keeps it at rest
    speed_limit: ClassVar[float | None] = None  #: per axis, units/step

    @abstractmethod
    def add_body(self, body: Element, name: str, colour: str) -> None:
        """Fill the MJCF body of the vehicle called ``name``, told apart by its MJCF ``colour``."""

    @abstractmethod
    def add_motors(self, actuator: Element, name: str) -> None:
        """Add the motors of the vehicle called ``name`` to MJCF's actuators."""

    @abstractmethod
    def control(self, senses: Senses, commands: Array, parked: Flags) -> Array:
        """Motor controls (n, motors) that make the velocities ``commands``, (n, 2) m/s."""
        # Those that are ``parked``, (n,), have failed: one that flies lands, and none turns.


def add(parent: Element, tag: str, **attributes: Any) -> Element:
    """Add an MJCF element: numbers and sequences of them become text, ``class_`` is ``class``."""

    def text(value: Any) -> str:
        parts = [value] if isinstance(value, str) else np.atleast_1d(value).ravel().tolist()
        return " ".join(part if isinstance(part, str) else f"{part:.9g}" for part in parts)

    given = {name.rstrip("_"): text(value) for name, value in attributes.items()}
    return SubElement(parent, tag, given)


def add_air_shape(body: Element, centre: float, radius: float, half_height: float) -> None:
    """Give a body its shape for the air: an invisible upright ellipsoid, ``centre`` above it, m."""
    # It is round from above, so that the drag points along the wind; it makes no lift.
    add(body, "geom", class_="air", pos=(0, 0, centre), size=(radius, radius, half_height))
