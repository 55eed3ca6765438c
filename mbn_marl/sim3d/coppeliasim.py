"""CoppeliaSim behind the simulators' interface, through its ZeroMQ remote API."""

from __future__ import annotations

from collections.abc import Callable
from time import monotonic
from typing import Any, ClassVar

import numpy as np

from mbn_marl.errors import SimulatorError
from mbn_marl.sim3d.coppelia_link import CoppeliaLink
from mbn_marl.sim3d.coppelia_scene import CoppeliaScene, Vehicle
from mbn_marl.sim3d.cornfield import grow
from mbn_marl.sim3d.simulator import Floats, Mission, Motion, Scale, Simulator

QUADCOPTER = "models/robots/mobile/Quadcopter.ttm"
"""The quadcopter that CoppeliaSim ships with."""

_LEASH = 1.0
"""Metres that a target may be ahead of its vehicle: one that is held up must not store up more."""


class CoppeliaSimulator(Simulator):
    """Quadcopters in a running CoppeliaSim, whose own script flies each to a dummy, its target.

    A command moves the targets: at every step of CoppeliaSim by the commanded velocity. Nothing is
    connected before the first :meth:`reset`.

    Args:
        host: the machine that CoppeliaSim runs on.
        port: of its ZMQ remote API server.
        timeout: seconds, above 0, that CoppeliaSim may take for any answer.
        scale: the size and pace of the MDP in the scene.
        altitude: metres, above 0, at which the vehicles start and fly.
        model: the vehicles' model: a file in CoppeliaSim's folder of resources, or an absolute path
            on its machine; it has to follow an object of its own with the alias ``target``.
    """

    has_wind: ClassVar[bool] = False

    def __init__(
        self,
        host: str = "localhost",
        port: int = 23000,
        *,
        timeout: float = 10.0,
        scale: Scale | None = None,
        altitude: float = 0.35,
        model: str = QUADCOPTER,
    ) -> None:
        self._place = (host, port, timeout)
        self._scale = scale or Scale()
        self._altitude = altitude
        self._model = model
        self._link: CoppeliaLink | None = None
        self._scene: CoppeliaScene | None = None

    def reset(self, mission: Mission) -> None:
        """Build the scene of ``mission`` by API calls, and start the simulation in stepped mode.

        Raises:
            ConfigError: port or timeout are out of their range.
            SimulatorError: CoppeliaSim does not answer, is already simulating something, refuses a
                call, or its time step does not divide the MDP's; nothing is left in its scene.
            ImportError: if its remote API client is not installed.
        """
        try:
            self._clear()
            self._link = self._link or CoppeliaLink(*self._place)
            self._build(self._link, mission)
        except BaseException:
            self.close()
            raise

    def command(self, velocities: Floats) -> None:
        """Let the vehicles track these velocities, (n, 2) units/step, from now on."""
        self._velocities = np.asarray(velocities, np.float64) * self._scale.speed
        lead = self._targets - self._bodies[:, :2]
        length = np.linalg.norm(lead, axis=1, keepdims=True)
        self._targets = self._bodies[:, :2] + lead * np.minimum(1.0, _LEASH / np.maximum(length, _LEASH))

    def step(self) -> None:
        """Simulate one step of the MDP: as many steps of CoppeliaSim as it lasts.

        Raises:
            SimulatorError: CoppeliaSim does not answer, or somebody stopped the simulation.
        """
        link = self._running()
        for _ in range(self._substeps):
            self._targets = self._targets + self._velocities * self._time_step
            for vehicle, (x, y) in zip(self._vehicles, self._targets, strict=True):
                link.call("setObjectPosition", vehicle.target, [x, y, self._altitude])
            link.call("step")
        before, time = self._time, link.call("getSimulationTime")
        if time <= before:
            raise SimulatorError("CoppeliaSim: the simulation was stopped or paused by hand")
        self._time = time
        ...
