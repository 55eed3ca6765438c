"""Random worlds for property tests: fields, settings and robots that get into every situation."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import shapely
from hypothesis import strategies as st
from numpy.typing import NDArray

from mbn_marl import Failures, Field, load_field
from mbn_marl.config import WITHOUT_RADIUS, RewardProfile, Uniform
from tests.support.oracle import Oracle

BEHAVIOURS = ("seek", "uniform", "lattice", "push", "still")
OWN_WEIGHTS = {"name": "own", "small": 0.3, "medium": 7.0, "large": 11.0, "infinite": 50.0}
APART = 10.0
DISTURBANCES = {
    **{"gust": 0.2, "gust_time": 3.0},
    **{"action_noise": 0.3, "action_loss": 0.3, "action_delay": 2},
    **{"position_noise": 4.0, "velocity_noise": 0.5, "dropout": 0.3},
}

KINDS = Field(
    **load_field("field_03").to_dict()
    | {"roi_kinds": (0, 1, 2, None, 0, 1), "start_kinds": (0, 1, 2), "optimal_makespan": None}
)
ASSIGNED = {"observation": "entities", "assignment": True}
OWN = {
    **{"knowledge": "own", "comm_radius": 60.0, "look_radius": 20.0, "sensing_radius": 50.0},
    **{"comm_delay": 2, "comm_loss": 0.3, "decoys": (0, 2)},
}
DRAWN = {
    **{name: Uniform(0.2 * value, value) for name, value in DISTURBANCES.items()},
    **{"action_delay": 1, "wind": (Uniform(0.0, 0.3), Uniform(-720.0, 720.0))},
    **{"mass": Uniform(0.5, 2.0), "f_max": Uniform(1.0, 3.0), "v_clip": Uniform(3.0, 6.0)},
    **{"tau": Uniform(0.7, 1.2), "roi_radius": Uniform(10.0, 30.0)},
    **{"safety_distance": Uniform(8.0, APART), "turn_max": Uniform(0.1, 3.0)},
    **{"wheelbase": Uniform(0.6, 4.0), "steer_max": Uniform(0.1, 1.2)},
}  # Every number that may be drawn, but the failures'
OWN_DRAWN: dict[str, Any] = {
    **{**DRAWN, **OWN, "observation": "entities", "hidden_rois": True, "dtype": "float64"},
    **{"dynamics": "mixed", "failures": Failures(rate=0.01, kind="vanish")},
}


@dataclass(frozen=True)
class World:
    field: Field
    settings: dict[str, Any]
    behaviours: tuple[str, ...]
    seed: int


@st.composite
def worlds(draw: st.DrawFn, n: int, **settings: Any) -> World:
    """A random world of n robots; nothing here changes the types that the engine compiles."""
    seed, rules = draw(st.integers(0, 2**32 - 1)), draw(st.sampled_from(["released", "formal"]))
    rng = np.random.default_rng(seed)
    field = random_field(
        rng,
        corners=draw(st.integers(3, 9)),
        with_hole=draw(st.booleans()),
        n_rois=draw(st.integers(1, 8)),
        n_starts=n,
    )
    choices = {
        "reward": [rules, RewardProfile(rules=rules, **OWN_WEIGHTS)],
        "wind": [(0.0, 0.0), (0.1, 30.0), (0.3, 217.0)],
        "mass": [1.0, 1.7, tuple(0.5 + 0.3 * k for k in range(n))],
        "f_max": [3.0, 0.5, tuple(2.0 + 0.4 * k for k in range(n))],
        "v_clip": [5.0, tuple(5.5 - 0.7 * k for k in range(n))],
        "tau": [1.0, 0.7],
        "roi_radius": [10.0, 30.0],
        "safety_distance": [APART, 3.0],
        "max_steps": [40, 7, 1000],
        "sensing_radius": [60.0, 17.3],
        "one_hot": [False, True],
    }
    drawn = {name: draw(st.sampled_from(values)) for name, values in choices.items()}
    if settings.get("observation", "relative") in WITHOUT_RADIUS:
        del drawn["sensing_radius"]
    one = st.sampled_from(BEHAVIOURS)
    behaviours = draw(
        st.one_of(one.map(lambda all_: [all_] * n), st.lists(one, min_size=n, max_size=n))
    )
    return World(field, drawn | settings, tuple(behaviours), seed)


def random_field(
    rng: np.random.Generator, *, corners: int, with_hole: bool, n_rois: int, n_starts: int
) -> Field:
    centre = rng.uniform(300.0, 700.0, 2)
    outline = ring(rng, centre, corners, 50.0, 110.0)
    polygon = shapely.Polygon(outline)
    holes = []
    if with_hole:
        room = polygon.boundary.distance(shapely.Point(centre))
        holes.append(ring(rng, centre, 4, 0.2 * room, 0.5 * room))
        polygon = shapely.Polygon(outline, holes)
    inner = polygon.buffer(-0.01)
    return Field(
        vertices=outline,
        holes=holes,
        rois=points_within(rng, inner, n_rois, 0.1),
        starts=points_within(rng, inner, n_starts, APART),
    )


def ring(
    rng: np.random.Generator, centre: NDArray[Any], corners: int, nearest: float, farthest: float
) -> list[tuple[float, float]]:
    angles = (np.arange(corners) + rng.uniform(0.0, 0.45, corners)) * (2 * math.pi / corners)
    radii = rng.uniform(nearest, farthest, corners)
    return [
        (float(centre[0] + r * math.cos(a)), float(centre[1] + r * math.sin(a)))
        for r, a in zip(radii, angles, strict=True)
    ]


def points_within(
    rng: np.random.Generator, area: shapely.Geometry, count: int, apart: float
) -> list[tuple[float, float]]:
    low_x, low_y, high_x, high_y = area.bounds
    points = []
    while len(points) < count:
        x, y = float(rng.uniform(low_x, high_x)), float(rng.uniform(low_y, high_y))
        free = all(math.dist((x, y), other) >= apart for other in points)
        if free and shapely.intersects_xy(area, x, y):
            points.append((x, y))
    return points


class Pilot:
    """Chooses the actions of a world's robots; looks at the oracle to seek ROIs."""

    def __init__(self, world: World, oracle: Oracle) -> None:
        self.behaviours, self.oracle = world.behaviours, oracle
        self.rng = np.random.default_rng(world.seed)
        self.directions = self.rng.uniform(-1.5, 1.5, (len(world.behaviours), 2))

    def actions(self) -> NDArray[np.float32]:
        rows = [self._action(robot) for robot in range(len(self.behaviours))]
        return np.array(rows, np.float32)

    def _action(self, robot: int) -> Any:
        match self.behaviours[robot]:
            case "uniform":
                return self.rng.uniform(-1.2, 1.2, 2)
            case "lattice":
                return self.rng.integers(-1, 2, 2)
            case "push":
                if self.rng.random() < 0.05:
                    self.directions[robot] = self.rng.uniform(-1.5, 1.5, 2)
                return self.directions[robot]
            case "still":
                return np.zeros(2)
            case _:
                return self._toward_roi(robot)

    def _toward_roi(self, robot: int) -> NDArray[Any]:
        body = self.oracle.robots[robot]
        position = np.array([body.x, body.y], float)
        velocity = np.array([body.vx, body.vy], float)
        targets = [
            np.array(roi, float) - position
            for j, roi in enumerate(self.oracle.rois)
            if self.oracle.is_mine(robot, j) and not self.oracle.visited[j]
        ]
        nearest = min(targets, key=np.linalg.norm, default=np.zeros(2))
        return np.clip(nearest / 4.0, -4.0, 4.0) - velocity
