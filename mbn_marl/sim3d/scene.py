"""The cornfield that both simulators show, and its MJCF with vehicles at the starts."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from typing import Any, NamedTuple
from xml.etree import ElementTree
from xml.etree.ElementTree import Element

import numpy as np
import shapely
from numpy.typing import NDArray

from mbn_marl.render import style
from mbn_marl.sim3d.simulator import Mission
from mbn_marl.sim3d.vehicle import GRAVITY, Array, Vehicle, add


def rgba(colour: str, alpha: float = 1.0) -> str:
    return " ".join(f"{channel / 255.0:.4g}" for channel in style.rgb(colour)) + f" {alpha:g}"


SOIL, DARK_SOIL, LEAF_GREEN = "0.42 0.33 0.24", "0.34 0.26 0.19", "0.36 0.6 0.22 1"
CHALK, STONE = "0.95 0.95 0.93 1", rgba(style.FAINT_INK)
WEED, AREA = "0.62 0.12 0.5 1", rgba(style.ORANGE, 0.35)
SPRAYED = {"weed": "0.45 0.42 0.36 1", "area": rgba(style.ROI_VISITED, 0.45)}

OBSTACLE_HEIGHT, BOUNDARY_WIDTH, BOUNDARY_HEIGHT = 0.8, 0.06, 0.008  # metres
ROW_SPACING, PLANT_SPACING = 0.75, 0.25  # metres, as corn is sown; further apart in large fields
MOST_PLANTS = 1500
CORN_HEIGHT = 0.22  # metres: the vehicles fly above it
# A leaf that points along +x: base, bend and tip in metres; z in heights of the plant.
LEAF = np.array([[0.0, -0.012, 0.0], [0.0, 0.012, 0.0], [0.07, 0.0, 1.0], [0.16, 0.0, 0.7]])
LEAF_FACES = np.array([[0, 1, 2], [0, 2, 1], [1, 3, 2], [1, 2, 3]])  # both sides of each triangle

AIR_DENSITY = 1.2  # kg/m^3
FIELD_OF_VIEW = 40.0  # of the cameras, degrees from the bottom to the top
PICTURE = (960, 720)  # pixels


Mesh = tuple[Array, NDArray[np.intp]]  # vertices (k, 3) in metres, triangles (f, 3)


class Prop(NamedTuple):
    """A part of the scenery, which never moves and stops nothing: a mesh, a box or a cylinder."""

    name: str
    colour: str  # as MJCF has it
    # Of the middle or the mesh's origin, metres.
    place: tuple[float, float, float] = (0.0, 0.0, 0.0)
    size: tuple[float, float, float] = (0.0, 0.0, 0.0)  # along x, y, z, metres
    turn: float = 0.0  # about z, radians
    kind: str = "cuboid"
    mesh: Mesh | None = None


class Frame:
    """A mission in metres; the origin is the middle of the field."""

    def __init__(self, mission: Mission, metres: float) -> None:
        field = mission.field
        low, high = field.vertices.min(axis=0), field.vertices.max(axis=0)
        self.middle: Array = (low + high) / 2.0
        self.metres, self.name = metres, field.name
        self.size: Array = (high - low) * metres
        self.ground: shapely.Polygon = shapely.transform(field.polygon, self.to_metres)
        self.rois, self.starts = self.to_metres(field.rois), self.to_metres(mission.starts)
        self.roi_radius = max(mission.roi_radius * metres, 1e-3)

    def to_metres(self, points: NDArray[np.floating]) -> Array:
        return (np.asarray(points, float) - self.middle) * self.metres

    def to_units(self, points: Array) -> Array:
        return points / self.metres + self.middle


def scenery(frame: Frame) -> Iterator[Prop]:
    """Yield the line round the field, the corn, and a weed on the area from which it is sprayed."""
    for number, (length, (x, y), turn) in enumerate(edges(frame.ground.exterior)):
        size, place = (length, BOUNDARY_WIDTH, BOUNDARY_HEIGHT), (x, y, BOUNDARY_HEIGHT / 2.0)
        yield Prop(f"boundary_{number}", CHALK, place, size, turn)
    crop, side = corn(frame.ground), 2.0 * frame.roi_radius
    weed = _plants(np.zeros((1, 2)), np.zeros(1), np.array([0.1]), leaves=9, width=2.0)
    if len(crop[1]):
        yield Prop("corn", LEAF_GREEN, mesh=crop)
    for roi, (x, y) in enumerate(frame.rois.tolist()):
        yield Prop(f"weed_{roi}", WEED, (x, y, 0.0), mesh=weed)
        yield Prop(f"area_{roi}", AREA, (x, y, 0.006), (side, side, 0.004), kind="cylinder")


def edges(ring: shapely.LinearRing) -> Iterator[tuple[float, tuple[float, float], float]]:
    """Yield each edge of a ring: its length, its middle ``(x, y)``, and its angle in radians."""
    for (ax, ay), (bx, by) in itertools.pairwise(ring.coords):
        middle = ((ax + bx) / 2.0, (ay + by) / 2.0)
        yield math.hypot(bx - ax, by - ay), middle, math.atan2(by - ay, bx - ax)


def corn(ground: shapely.Polygon) -> Mesh:
    wider = max(1.0, (ground.area / (ROW_SPACING * PLANT_SPACING * MOST_PLANTS)) ** 0.5)
    left, bottom, right, top = ground.bounds
    rows = np.arange(left, right, ROW_SPACING * wider) + ROW_SPACING * wider / 2.0
    along = np.arange(bottom, top, PLANT_SPACING * wider)
    grid = np.stack(np.meshgrid(rows, along), axis=-1).reshape(-1, 2)
    places = grid[shapely.contains_xy(ground, grid)]
    random = np.random.default_rng(0)
    turns = random.uniform(0.0, np.pi, len(places))
    heights = CORN_HEIGHT * random.uniform(0.7, 1.0, len(places))
    return _plants(places, turns, heights, leaves=4, width=1.0)


def _plants(places: Array, turns: Array, heights: Array, leaves: int, width: float) -> Mesh:
    angles = turns[:, None] + np.arange(leaves) * 2.0 * np.pi / leaves
    cos, sin = np.cos(angles)[..., None], np.sin(angles)[..., None]
    x, y, z = LEAF[:, 0] * width, LEAF[:, 1] * width, LEAF[:, 2]
    points = np.empty((*angles.shape, len(LEAF), 3))
    points[..., 0] = places[:, 0, None, None] + cos * x - sin * y
    points[..., 1] = places[:, 1, None, None] + sin * x + cos * y
    points[..., 2] = heights[:, None, None] * z
    faces = LEAF_FACES + len(LEAF) * np.arange(angles.size)[:, None, None]
    return points.reshape(-1, 3), faces.reshape(-1, 3)


# All scenes share physics, light, the classes of geoms, soil, sky and sun.
_COMMON = f"""
<mujoco>
  <compiler angle="degree" inertiafromgeom="auto"/>
  <option gravity="0 0 {-GRAVITY}" density="{AIR_DENSITY}" integrator="implicitfast"/>
  <visual>
    <global offwidth="{PICTURE[0]}" offheight="{PICTURE[1]}"
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


def build_scene(frame: Frame, vehicle: Vehicle, timestep: float) -> str:
    """Return the MJCF of a mission with a ``vehicle`` at each start; ``timestep`` in seconds."""
    # Robot i is the body ``robot_i``, ROI j the geoms ``weed_j`` and ``area_j``.
    root = ElementTree.fromstring(_COMMON)
    root.set("model", frame.name)
    part = {child.tag: child for child in root}
    part["option"].set("timestep", f"{timestep:.9g}")
    part["statistic"].set("extent", f"{frame.size.max():.9g}")
    assets, world, actuator = part["asset"], part["worldbody"], part["actuator"]
    _add_obstacles(assets, world, frame.ground)
    meshes = set()
    for prop in scenery(frame):
        shape: dict[str, Any] = {"type": "box", "size": np.array(prop.size) / 2.0}
        if prop.mesh is not None:
            name = prop.name.partition("_")[0]
            shape = {"type": "mesh", "mesh": name}
            if name not in meshes:  # leaves have no volume: their inertia is that of a shell
                vertices, faces = prop.mesh
                add(assets, "mesh", name=name, vertex=vertices, face=faces, inertia="shell")
                meshes.add(name)
        elif prop.kind == "cylinder":
            shape = {"type": "cylinder", "size": shape["size"][1:]}
        shape |= {"pos": prop.place, "euler": (0, 0, math.degrees(prop.turn))}
        add(world, "geom", class_="scenery", name=prop.name, rgba=prop.colour, **shape)
    _add_cameras(world, frame)
    for index, (x, y) in enumerate(frame.starts):
        name = f"robot_{index}"
        body = add(world, "body", name=name, pos=(x, y, vehicle.height))
        add(body, "freejoint", name=name)
        vehicle.add_body(body, name, rgba(style.robot_colour(index)))
        if index == 0:
            look = {"pos": (-1.6, 0, 0.9), "xyaxes": (0, -1, 0, 0.45, 0, 1)}
            add(body, "camera", name="chase", mode="trackcom", **look)
        vehicle.add_motors(actuator, name)
    return ElementTree.tostring(root, encoding="unicode")


def _add_obstacles(assets: Element, world: Element, ground: shapely.Polygon) -> None:
    holes = shapely.MultiPolygon([shapely.Polygon(ring) for ring in ground.interiors])
    for number, triangle in enumerate(shapely.constrained_delaunay_triangles(holes).geoms):
        base = np.array(triangle.exterior.coords[:3])
        prism = np.vstack([np.column_stack([base, np.full(3, z)]) for z in (0.0, OBSTACLE_HEIGHT)])
        name = f"obstacle_{number}"
        add(assets, "mesh", name=name, vertex=prism)
        add(world, "geom", name=name, mesh=name, type="mesh", rgba=STONE, conaffinity=1)


def _add_cameras(world: Element, frame: Frame) -> None:
    x, y = frame.size / 2.0
    tall = 0.92 * math.tan(math.radians(FIELD_OF_VIEW / 2.0))  # half the picture, a metre away
    wide = tall * 4.0 / 3.0
    place = (0, 0, max(y / tall, x / wide))
    add(world, "camera", name="top", pos=place, xyaxes=(1, 0, 0, 0, 1, 0))
    cos, sin = math.cos(math.radians(40.0)), math.sin(math.radians(40.0))
    far = y * cos + max(y * sin / tall, x / wide)  # so that the near corners are just in sight
    place = (0, -far * cos, far * sin)
    add(world, "camera", name="field", pos=place, xyaxes=(1, 0, 0, 0, sin, cos))
