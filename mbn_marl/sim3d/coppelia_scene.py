"""A cornfield and its vehicles in CoppeliaSim, made by calls of its API: no scene file."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import shapely
from numpy.typing import NDArray

from mbn_marl.errors import SimulatorError
from mbn_marl.render import style
from mbn_marl.sim3d import scene
from mbn_marl.sim3d.coppelia_link import CoppeliaLink
from mbn_marl.sim3d.plants import Mesh, corn, corn_rows, weed
from mbn_marl.sim3d.simulator import Mission

Array = NDArray[np.float64]

_THIN = 0.05  # metres: how thick walls and the soil are
_FLAT = 0.008  # metres above the soil: the line round the field, and the areas to be sprayed
_ABOVE_FLOOR = 0.002  # metres, at which the soil covers the floor of CoppeliaSim's empty scene
_MARGIN = 2.0  # metres of soil on each side of the field
_PATH_WIDTH, _PATH_ITEMS = 3.0, 10_000  # pixels; the lines that a path holds, then the oldest go


class Follower(NamedTuple):
    """The handles of a vehicle, of the target that it follows, and of its path's drawing."""

    body: int
    target: int
    path: int


class CoppeliaScene:
    """The objects that one reset makes in CoppeliaSim while no simulation runs.

    Its methods raise :class:`~mbn_marl.errors.SimulatorError` where CoppeliaSim refuses a call.
    """

    def __init__(self, link: CoppeliaLink) -> None:
        self._link = link
        self._objects: list[int] = []
        self._drawings: list[int] = []

    def plant(self, mission: Mission, frame: scene.Frame) -> None:
        """Make soil, corn, a line round the field, weeds, and walls along the edges of holes."""
        self._weeds: list[int] = []
        self._areas: list[int] = []
        ground = frame.ground(mission)
        width, depth = (frame.size + 2.0 * _MARGIN).tolist()
        place = (0.0, 0.0, _ABOVE_FLOOR - _THIN / 2)
        self._block("soil", (width, depth, _THIN), place, scene.SOIL, solid=True)
        places = corn_rows(ground)
        if len(places):
            self._mesh("corn", corn(places), scene.LEAF_GREEN)
        self._beams("boundary", ground.exterior, (scene.BOUNDARY_WIDTH, _FLAT), scene.CHALK)
        stone, wall = scene.rgba(style.FAINT_INK), (_THIN, scene.OBSTACLE_HEIGHT)
        for hole in ground.interiors:
            self._beams("obstacle", hole, wall, stone, solid=True)
        side, leaves = 2.0 * mission.roi_radius * frame.metres, weed()
        for x, y in frame.to_metres(mission.field.rois).tolist():
            size, place = (side, side, _FLAT), (x, y, _FLAT / 2)
            self._areas.append(self._block("area", size, place, scene.AREA, kind="cylinder"))
            here = Mesh(leaves.vertices + np.array([x, y, 0.0]), leaves.faces)
            self._weeds.append(self._mesh("weed", here, scene.WEED))

    def add_vehicle(self, model: str, place: Sequence[float]) -> Follower:
        """Load a vehicle that follows a dummy, at a ``place`` (x, y, z) in metres.

        Raises:
            SimulatorError: there is no such model, or it has no object ``target``.
        """
        call, constant = self._link.call, self._link.constant
        folder = call("getStringParam", constant("stringparam_resourcesdir"))
        absolute = model.startswith("/") or model[1:2] == ":"
        body = self._make("loadModel", model if absolute else f"{folder}/{model}")
        # The model's script takes the target out of the tree when the simulation starts.
        tree = call("getObjectsInTree", body)
        self._objects += [handle for handle in tree if handle != body]
        targets = [handle for handle in tree if call("getObjectAlias", handle) == "target"]
        if not targets:
            raise SimulatorError(f"{model}: the model has no object 'target' to follow")
        call("setObjectPosition", body, list(place))
        call("setObjectPosition", targets[0], list(place))
        kind = constant("drawing_lines") | constant("drawing_cyclic")
        colour = [part / 255.0 for part in style.rgb(style.robot_colour(len(self._drawings)))]
        path = call("addDrawingObject", kind, _PATH_WIDTH, 0.0, -1, _PATH_ITEMS, colour)
        self._drawings.append(path)
        return Follower(body, targets[0], path)

    def spray(self, roi: int) -> None:
        """Let the weed at an ROI, 0 to m - 1, wither, and show its area as sprayed."""
        self._paint(self._weeds[roi], scene.SPRAYED_WEED)
        self._paint(self._areas[roi], scene.SPRAYED_AREA)

    def remove(self) -> None:
        """Remove everything that was made and still exists; no simulation may be running."""
        for drawing in self._drawings:
            self._link.call("removeDrawingObject", drawing)
        if there := [handle for handle in self._objects if self._link.call("isHandle", handle)]:
            self._link.call("removeObjects", there)
        self._drawings, self._objects = [], []

    def _beams(
        self,
        name: str,
        ring: shapely.LinearRing,
        profile: tuple[float, float],
        colour: str,
        *,
        solid: bool = False,
    ) -> None:
        """Make a cuboid on the ground along each edge of a ring, ``profile`` wide and high."""
        for length, middle, angle in scene.edges(ring):
            size, place = (length, *profile), (*middle, profile[1] / 2)
            beam = self._block(name, size, place, colour, solid=solid)
            self._link.call("setObjectOrientation", beam, [0.0, 0.0, angle])

    def _block(
        self,
        name: str,
        size: Sequence[float],
        place: Sequence[float],
        colour: str,
        *,
        kind: str = "cuboid",
        solid: bool = False,
    ) -> int:
        """Make a primitive shape, centred at ``place``."""
        shape = self._link.constant(f"primitiveshape_{kind}")
        block = self._make("createPrimitiveShape", shape, list(size), 0)
        self._link.call("setObjectPosition", block, list(place))
        return self._dress(block, name, colour, solid=solid)

    def _mesh(self, name: str, mesh: Mesh, colour: str) -> int:
        """Make a shape of triangles, where they are."""
        vertices, faces = mesh.vertices.ravel().tolist(), mesh.faces.ravel().tolist()
        return self._dress(self._make("createShape", 0, 0.0, vertices, faces), name, colour)

    def _make(self, function: str, *arguments: object) -> int:
        """Call what makes an object, and remember that."""
        self._objects.append(self._link.call(function, *arguments))
        return self._objects[-1]

    def _dress(self, shape: int, name: str, colour: str, *, solid: bool = False) -> int:
        """Make it a shape that never moves, and that vehicles run into if it is solid."""
        self._link.call("setObjectAlias", shape, f"mbn_{name}")
        for flag, value in (("static", 1), ("respondable", int(solid))):
            parameter = self._link.constant(f"shapeintparam_{flag}")
            self._link.call("setObjectInt32Param", shape, parameter, value)
        self._paint(shape, colour)
        return shape

    def _paint(self, shape: int, colour: str) -> None:
        """Give a shape a colour as MJCF has it; what CoppeliaSim calls transparency is opacity."""
        red, green, blue, *opacity = map(float, colour.split())
        parts = {"ambient_diffuse": [red, green, blue], "transparency": opacity or [1.0]}
        for component, value in parts.items():
            part = self._link.constant(f"colorcomponent_{component}")
            self._link.call("setShapeColor", shape, "", part, value)
