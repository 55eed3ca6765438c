"""A quadrotor of 1 kg that flies at a commanded velocity."""

from __future__ import annotations

from typing import ClassVar
from xml.etree.ElementTree import Element

import numpy as np

from mbn_marl.sim3d.vehicle import GRAVITY, Array, Flags, Senses, Vehicle, add, add_air_shape

MASS = 1.0  # kg
INERTIA = np.array([0.008, 0.008, 0.014])  # about the centre, kg m^2: a disc of 0.18 m
INERTIA_STEPS = INERTIA[[2, 0, 1]] - INERTIA[[1, 2, 0]]  # for ``w x J w`` of the body rates
ARM = 0.15  # of each rotor's offset along x and along y, metres
REACTION = 0.016  # torque about the rotor's axis per thrust, metres
FULL_THRUST = 6.0  # of one rotor, N; hovering takes 2.45
ROTOR_LAG = 0.02  # time constant of a rotor's thrust, seconds
# The place of each rotor along x and y, in arms, and the sign of its reaction.
ROTORS = ((1, 1, -1), (1, -1, 1), (-1, -1, -1), (-1, 1, 1))
HOVER = MASS * GRAVITY / len(ROTORS)

HEIGHT = 0.35  # metres above the ground, as in the paper
VELOCITY_GAIN = 4.0  # 1/s: acceleration per error of the horizontal velocity
HEIGHT_GAIN, CLIMB_GAIN = 9.0, 6.0  # of the vertical acceleration, 1/s^2 and 1/s: no overshoot
ATTITUDE_RATE, DAMPING = 16.0, 0.9  # rad/s and a ratio: the attitude is a second-order system
STEEPEST = 3.0  # m/s^2, the most horizontal acceleration: a tilt of 17 degrees
SINKING = 0.2  # m/s, of one that lands
LANDED = 0.06  # metres above the ground, below which it has landed: it rests on its battery


class Quadrotor(Vehicle):
    """Four rotors, and a cascade for velocity v, height z, attitude R and body rates w.

    - velocity: ``a = k_v (v_command - v)`` along x and y, ``a_z = k_z (0.35 - z) - k_c v_z``, and
      ``k_c (-0.2 - v_z)`` of one that lands;
    - attitude: the rotors' axis ``b = (a + g) / |a + g|``, heading along +x; the total thrust is
      ``m (a + g) . R e_z``;
    - torque: ``J (-s^2 e_R - 2 d s w) + w x J w``, ``e_R`` half the skew part of ``R_d^T R``.

    The attitude error is that of Lee, Leok, McClamroch, *Geometric tracking control of a quadrotor
    UAV on SE(3)*, 2010. Inverting the mixing matrix gives the thrusts of the rotors.
    """

    height: ClassVar[float] = HEIGHT
    mass: ClassVar[float] = MASS
    resting: ClassVar[tuple[float, ...]] = (HOVER,) * len(ROTORS)

    def __init__(self) -> None:
        x, y, turn = np.array(ROTORS, float).T
        mixing = np.array([np.ones(len(ROTORS)), y * ARM, -x * ARM, turn * REACTION])
        self._unmix = np.linalg.inv(mixing)

    def add_body(self, body: Element, name: str, colour: str) -> None:
        add(body, "inertial", pos=(0, 0, 0), mass=MASS, diaginertia=INERTIA)
        add_air_shape(body, 0.0, 0.2, 0.06)
        dark = "0.15 0.17 0.2 1"
        add(body, "geom", class_="part", type="ellipsoid", size=(0.09, 0.07, 0.035), rgba=colour)
        add(body, "geom", class_="part", type="box", pos=(0, 0, -0.04), size=(0.05, 0.03, 0.015))
        for x, y, _ in ROTORS[:2]:
            ends = (-x * ARM, -y * ARM, 0.01, x * ARM, y * ARM, 0.01)
            add(body, "geom", class_="part", type="capsule", fromto=ends, size=0.008, rgba=dark)
        for number, (x, y, _) in enumerate(ROTORS):
            place = (x * ARM, y * ARM, 0.03)
            disc = colour[:-1] + "0.55" if x > 0 else "0.75 0.77 0.8 0.55"
            for size, rgba in (((0.1, 0.004), disc), ((0.012, 0.02), dark)):
                shape = {"type": "cylinder", "pos": place, "size": size, "rgba": rgba}
                add(body, "geom", class_="part", **shape)
            add(body, "site", name=f"{name}_rotor_{number}", pos=place)

    def add_motors(self, actuator: Element, name: str) -> None:
        for number, (_, _, turn) in enumerate(ROTORS):
            lag = {"dyntype": "filterexact", "dynprm": ROTOR_LAG, "ctrlrange": (0, FULL_THRUST)}
            gear = (0, 0, 1, 0, 0, turn * REACTION)
            add(actuator, "general", site=f"{name}_rotor_{number}", gear=gear, **lag)

    def control(self, senses: Senses, commands: Array, parked: Flags) -> Array:
        """Return the thrusts of the rotors (n, 4), N."""
        level = VELOCITY_GAIN * (commands - senses.velocities[:, :2])
        level *= STEEPEST / np.maximum(np.linalg.norm(level, axis=1, keepdims=True), STEEPEST)
        climb = HEIGHT_GAIN * (HEIGHT - senses.positions[:, 2])
        climb[parked] = -CLIMB_GAIN * SINKING
        climb -= CLIMB_GAIN * senses.velocities[:, 2]
        push = np.column_stack([level, climb + GRAVITY])
        thrust = MASS * np.einsum("ni,ni->n", push, senses.rotations[:, :, 2])
        relative = wanted_attitude(push).transpose(0, 2, 1) @ senses.rotations
        skew = (relative - relative.transpose(0, 2, 1)) / 2.0
        error, rates = skew[:, (2, 0, 1), (1, 2, 0)], senses.rates
        turning = -(ATTITUDE_RATE**2) * error - 2.0 * DAMPING * ATTITUDE_RATE * rates
        gyroscopic = INERTIA_STEPS * rates[:, (1, 2, 0)] * rates[:, (2, 0, 1)]
        torque = INERTIA * turning + gyroscopic
        thrusts = np.column_stack([thrust, torque]) @ self._unmix.T
        thrusts[parked & (senses.positions[:, 2] < LANDED)] = 0.0
        return thrusts


def wanted_attitude(push: Array) -> Array:
    """Return rotations (n, 3, 3) with z along ``push`` (n, 3) and the heading along +x."""
    up = push / np.linalg.norm(push, axis=1, keepdims=True)
    x, y, z = up.T
    level = np.hypot(y, z)
    wanted = np.empty((len(push), 3, 3))
    wanted[:, :, 0] = np.stack([level, -x * y / level, -x * z / level], axis=1)
    wanted[:, :, 1] = np.stack([np.zeros_like(x), z / level, -y / level], axis=1)
    wanted[:, :, 2] = up
    return wanted
