"""MuJoCo: vehicles with dynamics, their scene, the policies that fly them, and the film."""

import json
import math
import os
import subprocess
import sys
from types import SimpleNamespace
from typing import Any

import imageio_ffmpeg
import numpy as np
import pytest

from baselines.cli import main
from baselines.policies.classical import make_classical
from mbn_marl.errors import ConfigError
from mbn_marl.field import Field, save_field
from mbn_marl.sim3d import Mission, PlaneSimulator, Scale, deploy, quadrotor
from mbn_marl.sim3d.film import Film, load_mujoco
from mbn_marl.sim3d.mujoco_simulator import MujocoSimulator
from mbn_marl.sim3d.scene import SPRAYED, STONE
from tests.support.missions import BEND, SMALL

pytestmark = pytest.mark.slow


def begun(vehicle: Any = "quadrotor", field: Field = SMALL, **changes: Any) -> MujocoSimulator:
    simulator = MujocoSimulator(vehicle, scale=changes.pop("scale", None))
    simulator.reset(Mission(field, field.starts, **changes))
    return simulator


def drive(simulator: MujocoSimulator, velocities: Any, steps: int = 1) -> None:
    simulator.command(np.broadcast_to(np.array(velocities), (2, 2)))
    for _ in range(steps):
        simulator.step()


@pytest.mark.parametrize(
    ("vehicle", "steps", "most", "limit"),
    [("quadrotor", 1, 0.05, None), ("balancer", 6, 0.15, 2.0)],
)
def test_vehicle_moves_as_commanded_and_stays_up(vehicle, steps, most, limit):
    simulator = begun(vehicle)
    assert simulator.speed_limit == limit
    for velocity in ((1.0, 0.0), (0.0, -1.5), (0.0, 0.0)):
        drive(simulator, velocity, steps)
        motion = simulator.motion()
        assert np.abs(motion.velocities - velocity).max() < most  # units/step
        assert vehicle == "balancer" or np.abs(motion.heights - 0.35).max() < 0.02
        assert simulator.senses().rotations[:, 2, 2].min() > np.cos(np.radians(15.0))


def test_wind_moves_a_free_body_as_it_moves_a_point_mass(monkeypatch):
    monkeypatch.setattr(quadrotor, "VELOCITY_GAIN", 0.0)  # it holds its height and drifts
    wind = 0.2 * np.array([math.cos(math.radians(30)), math.sin(math.radians(30))])
    simulator = begun(wind=tuple(wind), scale=Scale(0.2, 0.5))
    simulator.step()
    gained = simulator.motion().velocities
    np.testing.assert_allclose(gained, [wind, wind], rtol=0.1)


def test_obstacle_stops_a_quadrotor():
    field = Field(SMALL.vertices, SMALL.rois, [(190, 200), (380, 120)], [BEND])
    simulator = begun(field=field)
    drive(simulator, (1.0, 0.0), 25)
    free = simulator.motion().positions
    assert free[1, 0] > 400.0  # nothing in its way
    assert free[0, 0] < 202.0  # the block begins at 200


@pytest.mark.parametrize(("vehicle", "height"), [("quadrotor", 0.055), ("balancer", 0.1)])
def test_vehicle_that_brakes_stands_where_it_stopped(vehicle, height):
    """A quadrotor lands there. Wind does not move it; the other one flies."""
    simulator = begun(vehicle, wind=(0.3, 0.2))
    drive(simulator, (1.5, 0.0), 4)
    simulator.fail(0, "brake")
    for speed in (1.0, 0.5):
        drive(simulator, [(speed, 0.0), (-1.0, 0.0)])
    stopped = simulator.motion().positions[0]
    for _ in range(12):
        drive(simulator, [(0.0, 0.0), (-1.0, 0.0)])
    after = simulator.motion()
    assert after.heights[0] == pytest.approx(height, abs=0.002)
    assert np.linalg.norm(after.positions[0] - stopped) < 1.0  # of a unit
    assert np.linalg.norm(after.velocities[0]) < 0.02
    assert after.velocities[1, 0] < -0.5
    parts = simulator.model.body_rootid[simulator.model.geom_bodyid]
    robot = simulator.model.body("robot_0").id
    stone = (simulator.model.geom_rgba == np.array(STONE.split(), np.float32)).all(axis=1)
    assert stone[parts == robot].any()


def test_policy_of_the_plane_flies():
    ideal = deploy(make_classical("greedy", SMALL, {}), SMALL, {}, PlaneSimulator())
    with MujocoSimulator() as simulator:
        real = deploy(make_classical("greedy", SMALL, {}), SMALL, {}, simulator)
    assert ideal.success and real.success
    assert 0.9 * ideal.makespan <= real.makespan <= 1.3 * ideal.makespan
    assert 0.01 < real.tracking_error < 0.3  # units
    assert real.separation > 10.0
    assert ideal.tracking_error < 1e-4
    gaps = [math.dist(*moment) for moment in real.episode.positions.tolist()]
    assert real.separation == pytest.approx(min(gaps))


def test_scene_has_what_the_field_has():
    simulator = begun()
    names = [simulator.model.geom(k).name for k in range(simulator.model.ngeom)]
    assert [name for name in names if name.startswith("weed")] == ["weed_0", "weed_1", "weed_2"]
    assert sum(name.startswith("obstacle") for name in names) == len(BEND) - 2
    np.testing.assert_allclose(simulator.model.geom("weed_1").pos[:2], (10.0, 5.0))
    np.testing.assert_allclose(simulator.motion().positions, SMALL.starts)
    simulator.spray(1)
    green = np.array(SPRAYED["weed"].split(), np.float32)
    shown = [np.array_equal(simulator.model.geom(f"weed_{k}").rgba, green) for k in range(3)]
    assert shown == [False, True, False]


def test_unknown_names_and_a_missing_mujoco_are_errors(monkeypatch):
    with pytest.raises(ConfigError, match="quadrotor, balancer"):
        MujocoSimulator("helicopter")
    with pytest.raises(ConfigError, match="camera: "):
        Film("film.mp4", "side")
    monkeypatch.setitem(sys.modules, "mujoco", None)
    with pytest.raises(ImportError, match=r"\.\[sim3d\]"):
        MujocoSimulator()


@pytest.fixture
def opengl():
    mujoco = load_mujoco()
    try:
        mujoco.Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 16, 16).close()
    except Exception:  # each platform's OpenGL raises its own
        pytest.skip("no OpenGL without a display (Debian: libegl1 libgl1)")


@pytest.mark.all
@pytest.mark.usefixtures("opengl")
def test_drawing_does_not_depend_on_who_loads_mujoco_first():
    code = """
import warnings; warnings.simplefilter("ignore")
import mujoco
from mbn_marl.sim3d.film import load_mujoco
load_mujoco().Renderer(mujoco.MjModel.from_xml_string("<mujoco/>"), 16, 16).close()
"""
    free = {name: value for name, value in os.environ.items() if name != "MUJOCO_GL"}
    subprocess.run([sys.executable, "-c", code], check=True, env=free)


def test_a_mission_that_fails_leaves_no_film(tmp_path):
    film = Film(tmp_path / "film.mp4")
    film._renderer = SimpleNamespace(close=lambda: None)
    film._writer.add(np.zeros((64, 64, 3), np.uint8))
    simulator = MujocoSimulator(film=film)
    with pytest.raises(RuntimeError, match="lost"):
        try:
            raise RuntimeError("lost")
        except RuntimeError:
            simulator.abandon()
            raise
    simulator.close()
    assert not [*tmp_path.iterdir()]


@pytest.mark.all
@pytest.mark.usefixtures("opengl")
def test_film_shows_the_mission(tmp_path):
    field = Field([(0, 0), (60, 0), (60, 45), (0, 45)], [(30, 22)], [(15, 20)], name="yard")
    save_field(field, tmp_path / "yard.yaml")
    video, numbers = tmp_path / "mission.mp4", tmp_path / "numbers.json"
    command = ["deploy", "greedy", "--field", str(tmp_path / "yard.yaml"), "--json", str(numbers)]
    assert main([*command, "--video", str(video), "--camera", "top"]) == 0
    steps = json.loads(numbers.read_text())["deployments"][0]["steps"]
    reader = imageio_ffmpeg.read_frames(str(video))
    width, height = next(reader)["size"]
    frames = [np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in reader]
    assert (width, height) == (960, 720)
    assert len(frames) == 10 * steps + 1 + 20  # 20 a second, at twice the speed; then a rest
    first, *_, last = (frame.astype(int) for frame in frames)
    middle = np.s_[300:330, 500:530]  # on the area of the weed, right of the path
    assert first[middle].mean(axis=(0, 1))[0] > first[middle].mean(axis=(0, 1))[1] + 20  # orange
    assert last[middle].mean(axis=(0, 1))[1] > last[middle].mean(axis=(0, 1))[0] + 20  # green
