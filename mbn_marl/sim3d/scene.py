"""The MJCF of a cornfield: any field with its weeds and obstacles, and vehicles at the starts."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
import shapely
from numpy.typing import NDArray

from mbn_marl.render import style
from mbn_marl.sim3d.plants import Mesh, corn, corn_rows, weed
from mbn_marl.sim3d.simulator import Mission
from mbn_marl.sim3d.vehicle import GRAVITY, Vehicle, add

SOIL, DARK_SOIL, LEAF_GREEN = "0.42 0.33 0.24", "0.34 0.26 0.19", "0.36 0.6 0.22 1"
CHALK = "0.95 0.95 0.93 1"
OBSTACLE_HEIGHT, BOUNDARY_WIDTH = 0.8, 0.06  # and of the line round the field, metres
AIR_DENSITY = 1.2  # kg/m^3
FIELD_OF_VIEW = 40.0  # of the cameras, degrees from the bottom to the top
CAMERAS = ("field", "top", "chase")
"""Across the whole field, from above, and behind the first robot."""
LARGEST_PICTURE = (1920, 1080)

Array = NDArray[np.float64]


class Frame:
    """The map from the field's units to the world's ``metres``; the origin is its middle."""

    def __init__(self, mission: Mission, metres: float) -> None:
        low, high = mission.field.vertices.min(axis=0), mission.field.vertices.max(axis=0)
        self.middle: Array = (low + high) / 2.0
        self.metres = metres
        self.size: Array = (high - low) * metres

    def ground(self, mission: Mission) -> shapely.Polygon:
        """Return the field with its holes, in metres."""
        return shapely.transform(mission.field.polygon, self.to_metres)

    def to_metres(self, points: NDArray[np.floating]) -> Array:
        """Return points (k, 2) in units as metres."""
        return (np.asarray(points, float) - self.middle) * self.metres

    def to_units(self, points: Array) -> Array:
        """Return points (k, 2) in metres as units."""
        return points / self.metres + self.middle


# What all scenes share: physics, light, the classes of geoms, soil, sky and sun.
_COMMON = f"""
<mujoco>
  <compiler angle="degree" inertiafromgeom="auto"/>
  <option gravity="0 0 {-GRAVITY}" density="{AIR_DENSITY}" integrator="implicitfast"/>
  <visual>
    <global offwidth="{LARGEST_PICTURE[0]}" offheight="{LARGEST_PICTURE[1]}"
            fovy="{FIELD_OF_VIEW}"/>
    <headlight ambient="0.45 0.45 0.45" diffuse="0.25 0.25 0.25" specular="0 0 0"/>
    <quality offsamples="0"/>
    <map znear="0.005" zfar="20"/>
  </visual>
  <statistic center="0 0 0"/>
  <default>
    <default class="scenery"><geom contype="0" conaffinity="0" group="1"/></default>
    <default class="air">
      <geom contype="0" conaffinity="0" group="4" mass="0" type="ellipsoid"
            fluidshape="ellipsoid" fluidcoef="0.5 0.25 1.5 0 0"/>
    </default>
    <default class="part">
      <geom contype="0" conaffinity="1" mass="0" rgba="0.25 0.28 0.32 1"/>
    </default>
    <default class="wheel">
      <geom contype="1" conaffinity="1" friction="1 0.01 0.001" rgba="0.12 0.12 0.13 1"/>
    </default>
  </default>
  <asset>
    <texture type="skybox" builtin="gradient" rgb1="0.75 0.85 0.95" rgb2="0.95 0.97 1"
             width="64" height="384"/>
    <texture name="soil" type="2d" builtin="flat" rgb1="{SOIL}" mark="random"
             markrgb="{DARK_SOIL}" random="0.25" width="256" height="256"/>
    <material name="soil" texture="soil" texrepeat="0.4 0.4" texuniform="true" specular="0"
              shininess="0"/>
  </asset>
  <worldbody>
    <light directional="true" dir="0.3 0.4 -1" pos="0 0 10" diffuse="0.6 0.6 0.57"
           specular="0.1 0.1 0.1" castshadow="false"/>
    <geom name="ground" type="plane" size="0 0 0.1" material="soil" contype="1" conaffinity="1"/>
  </worldbody>
  <actuator/>
</mujoco>
"""


def build_scene(mission: Mission, frame: Frame, vehicle: Vehicle, timestep: float) -> str:
    """Return the MJCF of a mission with a ``vehicle`` at each start; ``timestep`` in seconds.

    Robot i is the body ``robot_i``, ROI j the geoms ``weed_j`` and ``area_j``.
    """
    root = ElementTree.fromstring(_COMMON)
    root.set("model", mission.field.name)
    part = {child.tag: child for child in root}
    part["option"].set("timestep", f"{timestep:.9g}")
    part["statistic"].set("extent", f"{frame.size.max():.9g}")
    assets, world, actuator = part["asset"], part["worldbody"], part["actuator"]
    ground = frame.ground(mission)
    for length, place, angle in edges(ground.exterior):
        size, turn = (length / 2.0, BOUNDARY_WIDTH / 2.0, 0.004), (0, 0, math.degrees(angle))
        add_scenery(world, "box", pos=(*place, 0.004), size=size, euler=turn, rgba=CHALK)
    _add_obstacles(assets, world, ground)
    places = corn_rows(ground)
    if len(places):
        _add_mesh(assets, "corn", corn(places))
        add_scenery(world, "mesh", mesh="corn", rgba=LEAF_GREEN)
    rois = frame.to_metres(mission.field.rois)
    _add_weeds(assets, world, rois, mission.roi_radius * frame.metres)
    _add_cameras(world, frame)
    for index, (x, y) in enumerate(frame.to_metres(mission.starts)):
        name = f"robot_{index}"
        body = add(world, "body", name=name, pos=(x, y, vehicle.height))
        add(body, "freejoint", name=name)
        vehicle.add_body(body, name, rgba(style.robot_colour(index)))
        if index == 0:
            look = {"pos": (-1.6, 0, 0.9), "xyaxes": (0, -1, 0, 0.45, 0, 1)}
            add(body, "camera", name="chase", mode="trackcom", **look)
        vehicle.add_motors(actuator, name)
    return ElementTree.tostring(root, encoding="unicode")


def rgba(colour: str, alpha: float = 1.0) -> str:
    """Return ``"#RRGGBB"`` as MJCF has it."""
    return " ".join(f"{channel / 255.0:.4g}" for channel in style.rgb(colour)) + f" {alpha:g}"


def edges(ring: shapely.LinearRing) -> Iterator[tuple[float, tuple[float, float], float]]:
    """Yield each edge of a ring: its length, its middle ``(x, y)``, and its angle in radians."""
    for (ax, ay), (bx, by) in itertools.pairwise(ring.coords):
        middle = ((ax + bx) / 2.0, (ay + by) / 2.0)
        yield math.hypot(bx - ax, by - ay), middle, math.atan2(by - ay, bx - ax)


def add_scenery(world: Element, kind: str, **attributes: Any) -> None:
    """Add a geom that nothing runs into."""
    add(world, "geom", class_="scenery", type=kind, **attributes)


def _add_obstacles(assets: Element, world: Element, ground: shapely.Polygon) -> None:
    """Add the holes as solid blocks: a prism for each triangle that they are made of."""
    holes = shapely.MultiPolygon([shapely.Polygon(ring) for ring in ground.interiors])
    triangles = shapely.get_parts(shapely.constrained_delaunay_triangles(holes))
    look = {"type": "mesh", "rgba": rgba(style.FAINT_INK), "conaffinity": 1}
    for number, triangle in enumerate(triangles):
        base = np.array(triangle.exterior.coords[:3])
        prism = np.vstack([np.column_stack([base, np.full(3, z)]) for z in (0.0, OBSTACLE_HEIGHT)])
        name = f"obstacle_{number}"
        add(assets, "mesh", name=name, vertex=prism)
        add(world, "geom", name=name, mesh=name, **look)


def _add_weeds(assets: Element, world: Element, places: Array, radius: float) -> None:
    """Add a weed at each ROI, on the area of a ``radius`` in metres from which it is sprayed."""
    _add_mesh(assets, "weed", weed())
    size = (max(radius, 1e-3), 0.002)
    for index, (x, y) in enumerate(places):
        names = {kind: {"name": f"{kind}_{index}"} for kind in ("weed", "area")}
        add_scenery(world, "mesh", mesh="weed", pos=(x, y, 0), rgba=WEED, **names["weed"])
        place = (x, y, 0.006)
        add_scenery(world, "cylinder", pos=place, size=size, rgba=AREA, **names["area"])


def _add_mesh(assets: Element, name: str, mesh: Mesh) -> None:
    """Add leaves, which have no volume: MuJoCo takes their inertia as that of a shell."""
    add(assets, "mesh", name=name, vertex=mesh.vertices, face=mesh.faces, inertia="shell")


def _add_cameras(world: Element, frame: Frame) -> None:
    """Add one across the field from the south, and one from above, north up."""
    x, y = frame.size / 2.0
    tall = 0.92 * math.tan(math.radians(FIELD_OF_VIEW / 2.0))  # half the picture, a metre away
    wide = tall * 4.0 / 3.0
    place = (0, 0, max(y / tall, x / wide))
    add(world, "camera", name="top", pos=place, xyaxes=(1, 0, 0, 0, 1, 0))
    cos, sin = math.cos(math.radians(40.0)), math.sin(math.radians(40.0))
    far = y * cos + max(y * sin / tall, x / wide)  # so that the near corners are just in sight
    place = (0, -far * cos, far * sin)
    add(world, "camera", name="field", pos=place, xyaxes=(1, 0, 0, 0, sin, cos))


WEED, AREA = "0.62 0.12 0.5 1", rgba(style.ORANGE, 0.35)
SPRAYED_WEED, SPRAYED_AREA = "0.45 0.42 0.36 1", rgba(style.ROI_VISITED, 0.45)
"""The colours of a weed and its area, before and after it was sprayed."""
