"""CoppeliaSim behind the simulators' interface, through its ZeroMQ remote API."""

from __future__ import annotations

from time import monotonic, sleep
from typing import ClassVar

import numpy as np
from numpy.typing import NDArray

from mbn_marl.errors import ConfigError, SimulatorError
from mbn_marl.sim3d.coppelia_link import CoppeliaLink
from mbn_marl.sim3d.coppelia_scene import CoppeliaScene, Follower
from mbn_marl.sim3d.quadrotor import HEIGHT
from mbn_marl.sim3d.scene import Frame
from mbn_marl.sim3d.simulator import Floats, Mission, Motion, Scale, Simulator

Array = NDArray[np.float64]

QUADCOPTER = "models/robots/mobile/Quadcopter.ttm"  # ships with CoppeliaSim

_SINKING = 0.2  # metres per second, of the target of a vehicle that lands
_LEASH = 1.0  # metres that a target may be ahead of its vehicle: one held up stores up no more
_POLL = 0.01  # seconds between two looks at a simulation that is coming to its end


class CoppeliaSimulator(Simulator):
    """Quadcopters in a running CoppeliaSim, whose own script flies each to a dummy, its target.

    A command moves the targets: in every step of CoppeliaSim by the commanded velocity; that of a
    vehicle that has failed by braking sinks to the ground where it is to stand. Nothing is
    connected before the first :meth:`reset`. Every method but :meth:`command` and :meth:`fail`
    raises :class:`~mbn_marl.errors.SimulatorError` if CoppeliaSim does not answer, and all that
    need a :meth:`reset` do so without one.

    Args:
        host: the machine that CoppeliaSim runs on.
        port: of its ZMQ remote API server, 1 to 65535.
        timeout: seconds, above 0, that CoppeliaSim may take for any answer.
        scale: the size and pace of the MDP in the scene.
        altitude: at which the vehicles start and fly, metres, > 0.
        model: the vehicles' model: a file in CoppeliaSim's folder of resources, or an absolute path
            on its machine. It has to follow an object of its own with the alias ``target``.

    Raises:
        ConfigError: the altitude is out of its range.
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
        altitude: float = HEIGHT,
        model: str = QUADCOPTER,
    ) -> None:
        if not 0.0 < altitude < np.inf:
            allowed = "a finite number of metres above 0"
            raise ConfigError("CoppeliaSim", [f"altitude: {altitude:g}; allowed: {allowed}"])
        self._place = (host, port, timeout)
        self._scale, self._altitude, self._model = scale or Scale(), altitude, model
        self._link: CoppeliaLink | None = None
        self._started = False
        self._vehicles: list[Follower] = []
        self._targets: Array = np.zeros((0, 2))
        self._velocities: Array = np.zeros((0, 2))
        self._heights: Array = np.zeros(0)
        self._braking = np.zeros(0, np.bool_)
        self._bodies: Array = np.zeros((0, 3))

    def reset(self, mission: Mission) -> None:
        """Build the scene of ``mission``, without its wind, and start stepping the simulation.

        Raises:
            ConfigError: port or timeout are out of their range.
            SimulatorError: CoppeliaSim does not answer, is already simulating something, refuses a
                call, or its time step does not divide the MDP's; nothing is left in its scene.
            ImportError: if its remote API client is not installed.
        """
        try:
            if self._link is None:
                self._link = CoppeliaLink(*self._place)
                self._scene = CoppeliaScene(self._link)
            self._clear(self._link)
            self._build(self._link, mission)
            self._start(self._link, mission.tau * self._scale.seconds)
        except BaseException:
            self.close()
            raise

    def command(self, velocities: Floats) -> None:
        """Let the vehicles track ``velocities``, (n, 2) in units/step, from now on."""
        self._velocities = np.asarray(velocities, np.float64) * self._scale.speed
        lead = self._targets - self._bodies[:, :2]
        length = np.linalg.norm(lead, axis=1, keepdims=True)
        self._targets = self._bodies[:, :2] + lead * (_LEASH / np.maximum(length, _LEASH))

    def fail(self, robot: int, kind: str) -> None:
        """Let vehicle ``robot`` land where its command is to stand, if it brakes."""
        self._braking[robot] = kind == "brake"

    def step(self) -> None:
        """Simulate one step of the MDP: as many steps of CoppeliaSim as it lasts.

        Raises:
            SimulatorError: also if the simulation was stopped or paused manually in this step or
                before it.
        """
        link = self._running()
        before, begun = self._bodies, link.call("getSimulationTime")
        for _ in range(self._substeps):
            self._targets = self._targets + self._velocities * self._time_step
            landing = self._braking & ~self._velocities.any(axis=1)
            self._heights[landing] -= _SINKING * self._time_step
            self._heights = np.maximum(self._heights, 0.0)
            places = np.column_stack([self._targets, self._heights])
            for vehicle, place in zip(self._vehicles, places.tolist(), strict=True):
                link.call("setObjectPosition", vehicle.target, place)
            link.call("step")
        stopped = link.call("getSimulationState") == link.constant("simulation_stopped")
        lasted = link.call("getSimulationTime") - begun
        if stopped or lasted < (self._substeps - 0.5) * self._time_step:
            raise SimulatorError("CoppeliaSim: the simulation was stopped or paused by hand")
        self._look(link)
        for vehicle, ends in zip(self._vehicles, np.hstack([before, self._bodies]), strict=True):
            link.call("addDrawingObjectItem", vehicle.path, ends.tolist())

    def motion(self) -> Motion:
        """Return the vehicles now; fresh arrays."""
        link = self._running()
        speeds = [link.call("getObjectVelocity", vehicle.body)[0] for vehicle in self._vehicles]
        velocities = np.array(speeds, np.float64)[:, :2] / self._scale.speed
        positions = self._frame.to_units(self._bodies[:, :2])
        return Motion(positions, velocities, self._bodies[:, 2].copy())

    def spray(self, roi: int) -> None:
        """Give the weed at ROI ``roi``, 0 to m - 1, another colour."""
        self._running()
        self._scene.spray(roi)

    def close(self) -> None:
        """Stop the simulation, remove what :meth:`reset` made, and disconnect.

        A connection that was lost before is no error.
        """
        link, self._link = self._link, None
        if link is None:
            return
        try:
            if link.interrupted:
                link.connect()
            if not link.lost:
                self._clear(link)
        finally:
            self._started = False
            link.close()

    def _build(self, link: CoppeliaLink, mission: Mission) -> None:
        if link.call("getSimulationState") != link.constant("simulation_stopped"):
            raise SimulatorError("CoppeliaSim: it is simulating something already; stop that first")
        self._frame = Frame(mission, self._scale.metres)
        self._scene.plant(mission, self._frame)
        self._targets = self._frame.to_metres(mission.starts)
        self._velocities = np.zeros_like(self._targets)
        self._heights = np.full(len(self._targets), self._altitude)
        self._braking = np.zeros(len(self._targets), np.bool_)
        places = [(x, y, self._altitude) for x, y in self._targets.tolist()]
        self._vehicles = [self._scene.add_vehicle(self._model, place) for place in places]
        self._look(link)

    def _start(self, link: CoppeliaLink, lasting: float) -> None:
        """Start the simulation, with ``lasting`` seconds for a step of the MDP."""
        self._time_step = link.call("getSimulationTimeStep")
        self._substeps = round(lasting / self._time_step)
        if not self._substeps or not np.isclose(self._substeps * self._time_step, lasting):
            raise SimulatorError(
                f"CoppeliaSim: a step of the MDP lasts {lasting:g} s, which is no whole number of "
                f"its time steps of {self._time_step:g} s; change one of them"
            )
        self._started = True
        link.call("setStepping", True)
        link.call("startSimulation")

    def _clear(self, link: CoppeliaLink) -> None:
        """Stop the simulation if it was started here, and remove what was made."""
        if self._started:
            stopped, deadline = link.constant("simulation_stopped"), monotonic() + link.timeout
            if link.call("getSimulationState") != stopped:
                link.call("stopSimulation")
            while link.call("getSimulationState") != stopped:
                if monotonic() > deadline:
                    raise SimulatorError(f"CoppeliaSim: it did not stop within {link.timeout:g} s")
                sleep(_POLL)
            link.call("setStepping", False)
            self._started = False
        self._scene.remove()

    def _look(self, link: CoppeliaLink) -> None:
        """Look where the vehicles are now, (n, 3) metres."""
        places = [link.call("getObjectPosition", vehicle.body) for vehicle in self._vehicles]
        self._bodies = np.array(places, np.float64)

    def _running(self) -> CoppeliaLink:
        if self._link is None or not self._started:
            raise SimulatorError("CoppeliaSim: nothing is simulated; allowed: reset() first")
        return self._link
