"""Policies off the plane, on vehicles with dynamics. A simulator is loaded by its own class."""

from mbn_marl.sim3d.deployment import Deployment, deploy
from mbn_marl.sim3d.simulator import Mission, Motion, PlaneSimulator, Scale, Simulator

__all__ = ["Deployment", "Mission", "Motion", "PlaneSimulator", "Scale", "Simulator", "deploy"]
