"""A cornfield and its vehicles in CoppeliaSim, made by calls of its API: no scene file."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from mbn_marl.errors import SimulatorError
from mbn_marl.sim3d.coppelia_link import CoppeliaLink
from mbn_marl.sim3d.cornfield import Cornfield

Colour = tuple[float, float, float]
"""Red, green and blue, 0 to 1."""

SOIL: Colour = (0.45, 0.34, 0.22)
CORN: Colour = (0.35, 0.60, 0.20)
FENCE: Colour = (0.95, 0.80, 0.25)
OBSTACLE: Colour = (0.40, 0.40, 0.45)
WEED: Colour = (0.80, 0.15, 0.15)
SPRAYED: Colour = (0.15, 0.35, 0.85)
PATHS: tuple[Colour, ...] = (
    (0.00, 0.45, 0.70),
    (0.84, 0.37, 0.00),
    (0.00, 0.62, 0.45),
    (0.80, 0.47, 0.65),
)
"""Of the vehicles' paths, over again from the fifth vehicle on."""

_THIN = 0.05
"""Metres: what is a line on the map."""
_MARGIN = 2.0
"""Metres of soil around the arena."""
_PATH_WIDTH = 3.0
"""Pixels."""
_PATH_ITEMS = 10_000
"""Lines that a path holds; then the oldest go."""
_TARGET = "target"
"""The alias of the dummy that CoppeliaSim's quadcopter flies to."""


@dataclass(frozen=True)
class Vehicle:
    """The handles of a vehicle.

    Attributes:
        body: its base.
        target: what it follows.
        path: the drawing object that shows where it has been.
    """

    body: int
    target: int
    path: int


class CoppeliaScene:
    """What one reset makes in CoppeliaSim, so that all of it can be removed again.

    Args:
        link: to CoppeliaSim, with no simulation running.
    """

    def __init__(self, link: CoppeliaLink) -> None:
        self._link = link
        self._objects: list[int] = []
        self._drawings: list[int] = []
        self._weeds: list[int] = []

    def plant(self, cornfield: Cornfield) -> None:
        """Make the soil, the fence, the corn, the weeds, and a wall along every edge of a hole.

        Args:
            cornfield: in metres, the origin in its middle.

        Raises:
            SimulatorError: CoppeliaSim refuses a call.
        """
        width, depth = cornfield.size
        soil = (width + _MARGIN, depth + _MARGIN, _THIN)
        self._shape("soil", "cuboid", soil, (0.0, 0.0, -_THIN / 2), SOIL, solid=True)
        for ends in cornfield.fence:
            self._beam("fence", ends, _THIN, FENCE)
        for ends in cornfield.rows:
            self._beam("corn", ends, 0.2, CORN)
        for corners in cornfield.obstacles:
            for ends in zip(corners, np.roll(corners, -1, axis=0), strict=True):
                self._beam("obstacle", np.array(ends), 1.0, OBSTACLE, solid=True)
        for x, y in cornfield.weeds:
            weed = self._shape("weed", "cylinder", (0.3, 0.3, 0.1), (x, y, 0.05), WEED)
            self._weeds.append(weed)

    def add_vehicle(self, model: str, place: Sequence[float]) -> Vehicle:
        """Load a vehicle that follows a dummy.

        Args:
            model: the model's file, from CoppeliaSim's folder of resources on; or an absolute
                path on its machine.
            place: ``(x, y, z)``, metres.

        Raises:
            SimulatorError: there is no such model, or it has no object ``target``.
        """
        call, constant = self._link.call, self._link.constant
        folder = call("getStringParam", constant("stringparam_resourcesdir"))
        absolute = model.startswith("/") or model[1:2] == ":"
        body = call("loadModel", model if absolute else f"{folder}/{model}")
        # The model's script takes the target out of the tree when the simulation starts.
        tree = call("getObjectsInTree", body)
        self._objects += tree
        targets = [handle for handle in tree if call("getObjectAlias", handle) == _TARGET]
        if not targets:
            raise SimulatorError(f"{model}: the model has no object {_TARGET!r} to follow")
        call("setObjectPosition", body, list(place))
        call("setObjectPosition", targets[0], list(place))
        kind = constant("drawing_lines") | constant("drawing_cyclic")
        colour = list(PATHS[len(self._drawings) % len(PATHS)])
        path = call("addDrawingObject", kind, _PATH_WIDTH, 0.0, -1, _PATH_ITEMS, colour)
        self._drawings.append(path)
        return Vehicle(body, targets[0], path)

    def spray(self, weed: int) -> None:
        """Give a weed, counted from 0, the colour of a sprayed one."""
        self._paint(self._weeds[weed], SPRAYED)

    def remove(self) -> None:
        """Remove everything that was made and is still there; no simulation may be running.

        Raises:
            SimulatorError: CoppeliaSim refuses a call.
        """
        for drawing in self._drawings:
            self._link.call("removeDrawingObject", drawing)
        there = [handle for handle in self._objects if self._link.call("isHandle", handle)]
        if there:
            self._link.call("removeObjects", there)
        self._drawings, self._objects, self._weeds = [], [], []

    def _beam(
        self,
        name: str,
        ends: npt.NDArray[np.float64],
        height: float,
        colour: Colour,
        *,
        solid: bool = False,
    ) -> None:
        """A cuboid on the ground from one end to the other."""
        (x, y), (dx, dy) = ends.mean(axis=0), ends[1] - ends[0]
        size = (math.hypot(dx, dy), _THIN, height)
        beam = self._shape(name, "cuboid", size, (x, y, height / 2), colour, solid=solid)
        self._link.call("setObjectOrientation", beam, [0.0, 0.0, math.atan2(dy, dx)])

    def _shape(
        self,
        name: str,
        primitive: str,
        size: Sequence[float],
        place: Sequence[float],
        colour: Colour,
        *,
        solid: bool = False,
    ) -> int:
        """A shape that never moves, and that vehicles run into if it is solid."""
        call, constant = self._link.call, self._link.constant
        kind = constant(f"primitiveshape_{primitive}")
        shape: int = call("createPrimitiveShape", kind, [float(side) for side in size], 0)
        self._objects.append(shape)
        call("setObjectAlias", shape, f"mbn_{name}")
        call("setObjectInt32Param", shape, constant("shapeintparam_static"), 1)
        call("setObjectInt32Param", shape, constant("shapeintparam_respondable"), int(solid))
        call("setObjectPosition", shape, [float(value) for value in place])
        self._paint(shape, colour)
        return shape

    def _paint(self, shape: int, colour: Colour) -> None:
        component = self._link.constant("colorcomponent_ambient_diffuse")
        self._link.call("setShapeColor", shape, "", component, list(colour))
