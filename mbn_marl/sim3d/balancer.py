"""A balancing robot on two wheels that drives at a commanded velocity."""

from __future__ import annotations

from typing import ClassVar
from xml.etree.ElementTree import Element

import numpy as np

from mbn_marl.sim3d.vehicle import GRAVITY, Array, Flags, Senses, Vehicle, add, add_air_shape

BODY_MASS, WHEEL_MASS = 3.0, 0.3  # kg
WHEEL_RADIUS, TRACK = 0.1, 0.3  # metres; the track is from wheel to wheel
BODY_CENTRE = 0.15  # of the body's middle above the axle, metres
BODY_HALF = (0.06, 0.1, 0.15)  # half the body's sides, metres
FULL_TORQUE = 2.0  # of a wheel, N m

SPEED_LIMIT = 2.0  # units/step, as in the paper
VELOCITY_GAIN = 1.2  # 1/s: acceleration per error of the forward speed
STEEPEST = 0.15  # rad: the most that it leans to speed up or to brake
LEAN_GAIN, LEAN_RATE_GAIN = 14.0, 2.6  # wheels' torque per lean error, N m/rad; its rate, N m s/rad
HEADING_GAIN, FASTEST_TURN = 4.0, 4.0  # rate of turn per heading error, 1/s; its limit, rad/s
TURN_GAIN = 0.15  # N m s/rad: difference of the wheels' torques per error of the rate of turn
STILL = 1e-3  # m/s: a command below this has no direction to turn to


class Balancer(Vehicle):
    """Two wheels below a body that falls by itself; a cascade for speed v, lean t, heading h.

    - heading: ``r = k_h (h_command - h)``, to the command or, if that is nearer, against it;
    - speed: lean to ``t_d = k_v (v_command . h - v) / g``;
    - torque of both wheels ``k_t (t - t_d) + k_r t'``: they run under the body as it falls; their
      difference is ``k_d (r - h')``.
    """

    height: ClassVar[float] = WHEEL_RADIUS
    mass: ClassVar[float] = BODY_MASS + 2.0 * WHEEL_MASS
    resting: ClassVar[tuple[float, ...]] = (0.0, 0.0)
    speed_limit: ClassVar[float | None] = SPEED_LIMIT

    def add_body(self, body: Element, name: str, colour: str) -> None:
        add_air_shape(body, BODY_CENTRE, 0.1, 0.15)
        place = (0, 0, BODY_CENTRE)
        solid = {"size": BODY_HALF, "mass": BODY_MASS, "rgba": colour}
        add(body, "geom", class_="part", type="box", pos=place, **solid)
        add(body, "geom", class_="part", type="box", pos=(0.06, 0, 0.22), size=(0.004, 0.07, 0.05))
        for side, across in (("left", TRACK / 2.0), ("right", -TRACK / 2.0)):
            wheel = add(body, "body", name=f"{name}_{side}", pos=(0, across, 0))
            add(wheel, "joint", name=f"{name}_{side}", type="hinge", axis=(0, 1, 0))
            disc = {"size": (WHEEL_RADIUS, 0.02), "euler": (90, 0, 0), "mass": WHEEL_MASS}
            add(wheel, "geom", class_="wheel", type="cylinder", **disc)

    def add_motors(self, actuator: Element, name: str) -> None:
        for side in ("left", "right"):
            torques = (-FULL_TORQUE, FULL_TORQUE)
            add(actuator, "motor", joint=f"{name}_{side}", gear=1, ctrlrange=torques)

    def control(self, senses: Senses, commands: Array, parked: Flags) -> Array:
        """Return the torques of left and right wheels (n, 2), N m."""
        heading = np.arctan2(senses.rotations[:, 1, 0], senses.rotations[:, 0, 0])
        ahead = np.column_stack([np.cos(heading), np.sin(heading)])
        up = senses.rotations[:, :, 2]
        lean = np.arctan2((up[:, :2] * ahead).sum(axis=1), up[:, 2])
        speed = (senses.velocities[:, :2] * ahead).sum(axis=1)
        wanted_speed = (commands * ahead).sum(axis=1)
        wanted_lean = np.clip(VELOCITY_GAIN * (wanted_speed - speed) / GRAVITY, -STEEPEST, STEEPEST)
        both = LEAN_GAIN * (lean - wanted_lean) + LEAN_RATE_GAIN * senses.rates[:, 1]
        error = np.arctan2(commands[:, 1], commands[:, 0]) - heading
        # It drives backwards as well as forwards, so that the nearer of both directions will do.
        error = (error + np.pi / 2.0) % np.pi - np.pi / 2.0
        error[parked | (np.linalg.norm(commands, axis=1) < STILL)] = 0.0
        turns = np.clip(HEADING_GAIN * error, -FASTEST_TURN, FASTEST_TURN)
        turn = TURN_GAIN * (turns - senses.rates[:, 2])
        return np.column_stack([both - turn, both + turn]) / 2.0
