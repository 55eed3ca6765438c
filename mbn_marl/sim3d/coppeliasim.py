"""CoppeliaSim behind the simulators' interface, through its ZeroMQ remote API."""

from __future__ import annotations

from collections.abc import Sequence
from time import monotonic, sleep
from typing import ClassVar

import numpy as np

from mbn_marl.errors import SimulatorError
from mbn_marl.render import style
from mbn_marl.sim3d.coppelia_link import CoppeliaLink
from mbn_marl.sim3d.quadrotor import HEIGHT, SINKING
from mbn_marl.sim3d.scene import OBSTACLE_HEIGHT, SOIL, SPRAYED, STONE, Frame, Prop, edges, scenery
from mbn_marl.sim3d.simulator import Floats, Mission, Motion, Scale, Simulator
from mbn_marl.sim3d.vehicle import Array

QUADCOPTER = "models/robots/mobile/Quadcopter.ttm"  # ships with CoppeliaSim

_LEASH = 1.0  # metres that a target may be ahead of its vehicle: one held up stores up no more
_POLL = 0.01  # seconds between two looks at a simulation that is coming to its end
_THIN = 0.05  # metres: the thickness of walls and of the soil
_ABOVE_FLOOR = 0.002  # metres, at which the soil covers the floor of CoppeliaSim's empty scene
_MARGIN = 2.0  # metres of soil on each side of the field
_PATH_WIDTH, _PATH_ITEMS = 3.0, 10_000  # pixels; the lines that a path holds, then the oldest go


class CoppeliaSimulator(Simulator):
    """Quadcopters in a running CoppeliaSim, whose own script flies each to a dummy, its target.

    Nothing is connected before the first :meth:`reset`. Methods raise
    :class:`~mbn_marl.errors.SimulatorError` if CoppeliaSim does not answer, or without a reset.

    Args:
        host: the machine that CoppeliaSim runs on.
        port: of its ZMQ remote API server, 1 to 65535.
        timeout: seconds, above 0, that CoppeliaSim may take for any answer.
        scale: of the MDP in the scene.
        model: the vehicles' model: a file in CoppeliaSim's folder of resources, or an absolute path
            on its machine. It has to follow an object in it with the alias ``target``.
    """

    has_wind: ClassVar[bool] = False
    external: ClassVar[bool] = True

    def __init__(
        self,
        host: str = "localhost",
        port: int = 23000,
        *,
        timeout: float = 10.0,
        scale: Scale | None = None,
        model: str = QUADCOPTER,
    ) -> None:
        self._place = (host, port, timeout)
        self._scale, self._model = scale or Scale(), model
        self._connection: CoppeliaLink | None = None
        self._started = False
        self._objects: list[int] = []
        self._paths: list[int] = []
        self._props: dict[str, int] = {}

    def reset(self, mission: Mission) -> None:
        """Connect, build the scene of ``mission``, without its wind, and start stepping it."""
        try:
            if self._connection is None:
                self._connection = CoppeliaLink(*self._place)
            self._clear()
            self._build(mission)
        except BaseException:
            self.close()
            raise

    def _build(self, mission: Mission) -> None:
        if not self._is_stopped():
            raise SimulatorError("CoppeliaSim: it is simulating something already; stop that first")
        self._frame = frame = Frame(mission, self._scale.metres)
        self._targets, count = frame.starts, len(frame.starts)
        self._velocities = np.zeros_like(self._targets)
        self._heights, self._braking = np.full(count, HEIGHT), np.zeros(count, np.bool_)
        width, depth = (frame.size + 2.0 * _MARGIN).tolist()
        place = (0.0, 0.0, _ABOVE_FLOOR - _THIN / 2)
        self._add_prop(Prop("soil", SOIL, place, (width, depth, _THIN)), solid=True)
        for hole in frame.ground.interiors:
            for length, (x, y), turn in edges(hole):
                size, place = (length, _THIN, OBSTACLE_HEIGHT), (x, y, OBSTACLE_HEIGHT / 2)
                self._add_prop(Prop("obstacle", STONE, place, size, turn), solid=True)
        for prop in scenery(frame):
            self._add_prop(prop)
        places = np.column_stack([self._targets, self._heights]).tolist()
        self._vehicles = [self._add_vehicle(robot, place) for robot, place in enumerate(places)]
        self._look()
        self._time_step = self._link.call("getSimulationTimeStep")
        lasting = mission.tau * self._scale.seconds
        self._substeps = round(lasting / self._time_step)
        if not self._substeps or not np.isclose(self._substeps * self._time_step, lasting):
            raise SimulatorError(
                f"CoppeliaSim: a step of the MDP lasts {lasting:g} s, which is no whole number of "
                f"its time steps of {self._time_step:g} s; change one of them"
            )
        self._started = True
        self._link.call("setStepping", True)
        self._link.call("startSimulation")

    def command(self, velocities: Floats) -> None:
        self._velocities = np.asarray(velocities, np.float64) * self._scale.speed
        lead = self._targets - self._bodies[:, :2]
        length = np.linalg.norm(lead, axis=1, keepdims=True)
        self._targets = self._bodies[:, :2] + lead * (_LEASH / np.maximum(length, _LEASH))

    def fail(self, robot: int, kind: str) -> None:
        self._braking[robot] = kind == "brake"

    def step(self) -> None:
        link = self._link
        before, begun = self._bodies, link.call("getSimulationTime")
        for _ in range(self._substeps):
            self._targets = self._targets + self._velocities * self._time_step
            landing = self._braking & ~self._velocities.any(axis=1)
            self._heights[landing] -= SINKING * self._time_step
            self._heights = np.maximum(self._heights, 0.0)
            places = np.column_stack([self._targets, self._heights])
            for (_, target), place in zip(self._vehicles, places.tolist(), strict=True):
                link.call("setObjectPosition", target, place)
            link.call("step")
        lasted = link.call("getSimulationTime") - begun
        if self._is_stopped() or lasted < (self._substeps - 0.5) * self._time_step:
            raise SimulatorError("CoppeliaSim: the simulation was stopped or paused by hand")
        self._look()
        for path, ends in zip(self._paths, np.hstack([before, self._bodies]), strict=True):
            link.call("addDrawingObjectItem", path, ends.tolist())

    def motion(self) -> Motion:
        link = self._link
        speeds = [link.call("getObjectVelocity", body)[0] for body, _ in self._vehicles]
        velocities = np.array(speeds, np.float64)[:, :2] / self._scale.speed
        positions = self._frame.to_units(self._bodies[:, :2])
        return Motion(positions, velocities, self._bodies[:, 2].copy())

    def spray(self, roi: int) -> None:
        for name, colour in SPRAYED.items():
            self._paint(f"{name}_{roi}", colour)

    def close(self) -> None:
        """Stop the simulation, remove what :meth:`reset` made, and disconnect if connected."""
        if self._connection is None:
            return
        link = self._connection
        try:
            if link.interrupted:
                link.connect()
            if not link.lost:
                self._clear()
        finally:
            self._connection, self._started = None, False
            link.close()

    @property
    def _link(self) -> CoppeliaLink:
        if self._connection is None:
            raise SimulatorError("CoppeliaSim: nothing is simulated; allowed: reset() first")
        return self._connection

    def _add_prop(self, prop: Prop, *, solid: bool = False) -> None:
        call, constant = self._link.call, self._link.constant
        if prop.mesh is None:
            kind = constant(f"primitiveshape_{prop.kind}")
            shape = self._make("createPrimitiveShape", kind, list(prop.size), 0)
            call("setObjectPosition", shape, list(prop.place))
            call("setObjectOrientation", shape, [0.0, 0.0, prop.turn])
        else:
            vertices, faces = prop.mesh
            corners = (vertices + prop.place).ravel().tolist()
            shape = self._make("createShape", 0, 0.0, corners, faces.ravel().tolist())
        call("setObjectAlias", shape, f"mbn_{prop.name}")
        for flag, value in (("static", 1), ("respondable", int(solid))):
            call("setObjectInt32Param", shape, constant(f"shapeintparam_{flag}"), value)
        self._props[prop.name] = shape
        self._paint(prop.name, prop.colour)

    def _add_vehicle(self, robot: int, place: Sequence[float]) -> tuple[int, int]:
        call, constant, model = self._link.call, self._link.constant, self._model
        if not (model.startswith("/") or model[1:2] == ":"):
            model = f"{call('getStringParam', constant('stringparam_resourcesdir'))}/{model}"
        body = self._make("loadModel", model)
        # The model's script takes the target out of the tree when the simulation starts.
        tree = call("getObjectsInTree", body)
        self._objects += [handle for handle in tree if handle != body]
        targets = [handle for handle in tree if call("getObjectAlias", handle) == "target"]
        if not targets:
            raise SimulatorError(f"{model}: the model has no object 'target' to follow")
        for handle in (body, targets[0]):
            call("setObjectPosition", handle, list(place))
        kind = constant("drawing_lines") | constant("drawing_cyclic")
        colour = [part / 255.0 for part in style.rgb(style.robot_colour(robot))]
        path = call("addDrawingObject", kind, _PATH_WIDTH, 0.0, -1, _PATH_ITEMS, colour)
        self._paths.append(path)
        return body, targets[0]

    def _make(self, function: str, *arguments: object) -> int:
        self._objects.append(self._link.call(function, *arguments))
        return self._objects[-1]

    def _paint(self, name: str, colour: str) -> None:
        """Give a prop a colour as MJCF has it; CoppeliaSim calls opacity transparency."""
        link, shape = self._link, self._props[name]
        red, green, blue, *opacity = map(float, colour.split())
        parts = {"ambient_diffuse": [red, green, blue], "transparency": opacity or [1.0]}
        for component, value in parts.items():
            part = link.constant(f"colorcomponent_{component}")
            link.call("setShapeColor", shape, "", part, value)

    def _clear(self) -> None:
        link = self._link
        if self._started:
            if not self._is_stopped():
                link.call("stopSimulation")
            deadline = monotonic() + link.timeout
            while not self._is_stopped():
                if monotonic() > deadline:
                    raise SimulatorError(f"CoppeliaSim: it did not stop within {link.timeout:g} s")
                sleep(_POLL)
            link.call("setStepping", False)
            self._started = False
        for path in self._paths:
            link.call("removeDrawingObject", path)
        if there := [handle for handle in self._objects if link.call("isHandle", handle)]:
            link.call("removeObjects", there)
        self._paths, self._objects = [], []

    def _look(self) -> None:
        places = [self._link.call("getObjectPosition", body) for body, _ in self._vehicles]
        self._bodies: Array = np.array(places, np.float64)

    def _is_stopped(self) -> bool:
        stopped = self._link.constant("simulation_stopped")
        return bool(self._link.call("getSimulationState") == stopped)
