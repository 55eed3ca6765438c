"""Off the plane: policies that fly and drive vehicles with dynamics of their own.

Importing this package loads no simulator: each is loaded by the class that uses it.
"""

from mbn_marl.sim3d.deployment import Deployment, deploy
from mbn_marl.sim3d.plane import PlaneSimulator
from mbn_marl.sim3d.simulator import Mission, Motion, Scale, Simulator

__all__ = [
    "Deployment",
    "Mission",
    "Motion",
    "PlaneSimulator",
    "Scale",
    "Simulator",
    "deploy",
]
