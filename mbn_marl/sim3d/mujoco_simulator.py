"""The MuJoCo backend: vehicles with motors and controllers in a cornfield, in wind."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from mbn_marl.errors import ConfigError
from mbn_marl.sim3d.balancer import Balancer
from mbn_marl.sim3d.film import Film, load_mujoco
from mbn_marl.sim3d.quadrotor import Quadrotor
from mbn_marl.sim3d.scene import SPRAYED, STONE, Frame, build_scene
from mbn_marl.sim3d.simulator import Floats, Mission, Motion, Scale, Simulator
from mbn_marl.sim3d.vehicle import Array, Senses, Vehicle

VEHICLES: Mapping[str, type[Vehicle]] = {"quadrotor": Quadrotor, "balancer": Balancer}
CONTROL_PERIOD = 0.01  # seconds between two runs of the controllers, at most
SUBSTEPS = 2  # steps of the physics in a control period
HOLDING_GAIN = 0.5  # 1/s: the velocity of a parked vehicle per distance from its place


class MujocoSimulator(Simulator):
    """Vehicles with dynamics in MuJoCo.

    Wind is moving air of 1.2 kg/m^3. Its speed is such that it accelerates a free vehicle at rest
    by just what the MDP's wind would add to its velocity in a step.

    Args:
        vehicle: ``"quadrotor"``, ``"balancer"``, or a vehicle.
        scale: of the world.
        film: films the first mission; ``None`` for no film.
    """

    def __init__(
        self,
        vehicle: str | Vehicle = "quadrotor",
        *,
        scale: Scale | None = None,
        film: Film | None = None,
    ) -> None:
        if isinstance(vehicle, str):
            if vehicle not in VEHICLES:
                problem = f"vehicle: {vehicle!r}; allowed: {', '.join(VEHICLES)}"
                raise ConfigError("simulator", [problem])
            vehicle = VEHICLES[vehicle]()
        self._mujoco = load_mujoco()
        self.vehicle, self.scale, self._film = vehicle, scale or Scale(), film
        self.speed_limit = vehicle.speed_limit

    def reset(self, mission: Mission) -> None:
        duration, robots = mission.tau * self.scale.seconds, range(len(mission.starts))
        self._periods = max(1, math.ceil(duration / CONTROL_PERIOD - 1e-9))
        self._frame = Frame(mission, self.scale.metres)
        scene = build_scene(self._frame, self.vehicle, duration / self._periods / SUBSTEPS)
        self.model: Any = self._mujoco.MjModel.from_xml_string(scene)
        self.data: Any = self._mujoco.MjData(self.model)
        joints = [self.model.joint(f"robot_{index}") for index in robots]
        self._places = np.array([joint.qposadr[0] + np.arange(7) for joint in joints])
        self._speeds = np.array([joint.dofadr[0] + np.arange(6) for joint in joints])
        self._commands, self._stops = np.zeros((2, len(robots), 2))
        self._braking, self._parked = np.zeros((2, len(robots)), np.bool_)
        resting = np.tile(self.vehicle.resting, len(robots))
        self.data.ctrl[:] = resting
        self.data.act[:] = resting[: self.model.na]
        self._blow(np.asarray(mission.wind) * self.scale.acceleration(mission.tau))
        self._mujoco.mj_forward(self.model, self.data)
        if self._film is not None:
            self._film.begin(self.model, self.data, self._places[:, :2])

    def _blow(self, acceleration: Array) -> None:
        """Let the wind accelerate a free vehicle at rest by ``acceleration`` (2,), m/s^2."""
        size = float(np.linalg.norm(acceleration))
        if size == 0.0:
            return
        direction = np.append(acceleration / size, 0.0)
        self.model.opt.wind[:] = direction
        self._mujoco.mj_forward(self.model, self.data)
        drag = float(self.data.qfrc_fluid[self._speeds[0, :3]] @ direction)
        # Drag grows with the square of the wind's speed.
        self.model.opt.wind[:] = direction * math.sqrt(size * self.vehicle.mass / drag)

    def command(self, velocities: Floats) -> None:
        self._commands = velocities.astype(float) * self.scale.speed
        stopped = self._braking & ~self._parked & ~velocities.any(axis=1)
        self._stops[stopped] = self.senses().positions[stopped, :2]
        self._parked |= stopped

    def fail(self, robot: int, kind: str) -> None:
        """Paint a vehicle grey. One that brakes parks once its command is to stay."""
        self._braking[robot] = kind == "brake"
        roots = self.model.body_rootid[self.model.geom_bodyid]
        own = roots == self.model.body(f"robot_{robot}").id
        self.model.geom_rgba[own] = np.array(STONE.split(), float)

    def step(self) -> None:
        for _ in range(self._periods):
            senses, parked = self.senses(), self._parked
            back = HOLDING_GAIN * (self._stops - senses.positions[:, :2])
            commands = np.where(parked[:, None], back, self._commands)
            self.data.ctrl[:] = self.vehicle.control(senses, commands, parked).ravel()
            self._mujoco.mj_step(self.model, self.data, SUBSTEPS)
            if self._film is not None:
                self._film.look()

    def senses(self) -> Senses:
        places, speeds = self.data.qpos[self._places], self.data.qvel[self._speeds]
        rotations = np.empty((len(places), 9))
        for matrix, place in zip(rotations, places, strict=True):
            self._mujoco.mju_quat2Mat(matrix, place[3:])
        return Senses(places[:, :3], speeds[:, :3], rotations.reshape(-1, 3, 3), speeds[:, 3:])

    def motion(self) -> Motion:
        senses = self.senses()
        return Motion(
            self._frame.to_units(senses.positions[:, :2]),
            senses.velocities[:, :2] / self.scale.speed,
            senses.positions[:, 2].copy(),
        )

    def spray(self, roi: int) -> None:
        for name, colour in SPRAYED.items():
            self.model.geom(f"{name}_{roi}").rgba[:] = np.array(colour.split(), float)

    def close(self) -> None:
        if self._film is not None:
            self._film.close()

    def abandon(self) -> None:
        if self._film is not None:
            self._film.discard()
