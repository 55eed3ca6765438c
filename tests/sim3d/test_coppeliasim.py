"""The CoppeliaSim backend, through the official client, against a server of the same protocol."""

from __future__ import annotations

import json
import re
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely

pytest.importorskip("coppeliasim_zmqremoteapi_client", reason="needs mbn_marl[sim3d]")


from baselines.cli import main
from baselines.policies.classical import make_classical
from mbn_marl.errors import SimulatorError
from mbn_marl.field import Field
from mbn_marl.sim3d import Mission, Scale, deploy
from mbn_marl.sim3d.coppelia_link import _PatientSocket
from mbn_marl.sim3d.coppeliasim import CoppeliaSimulator
from mbn_marl.sim3d.scene import AREA, SPRAYED_AREA, SPRAYED_WEED, WEED
from tests.support.coppelia_server import LATE, RUNNING, STOPPED, CoppeliaServer, free_port
from tests.support.field_cases import square
from tests.support.pages import Block, check_command, commands_of

pytestmark = pytest.mark.slow
PAGE = Path(__file__).parents[2] / "docs" / "coppeliasim.md"


def orchard() -> Field:
    """Two robots, a hole between them and most ROIs; its middle is (50, 50)."""
    return square(rois=[(90.0, 90.0), (90.0, 10.0), (50.0, 80.0)])


def connect(server: CoppeliaServer, **changes: Any) -> CoppeliaSimulator:
    return CoppeliaSimulator("127.0.0.1", server.port, **({"timeout": 2.0} | changes))


def mission(field: Field | None = None) -> Mission:
    field = field or orchard()
    return Mission(field, field.starts.astype(np.float32))


def left(server: CoppeliaServer) -> tuple[list[str], int, int]:
    """What is in the scene, and whether it is simulated."""
    things = [thing.alias for thing in server.things.values()]
    return things, len(server.drawings), server.state


EMPTY = (["Floor"], 0, STOPPED)


def colours(server: CoppeliaServer) -> list[tuple[bool, bool]]:
    """Return of every weed and its area whether it has the colour of a sprayed one."""

    def painted(alias: str, fresh: str, sprayed: str) -> list[bool]:
        known = {tuple(map(float, text.split())): text == sprayed for text in (fresh, sprayed)}
        return [known[*(thing.colour or ()), thing.opacity] for thing in server.named(alias)]

    weeds, areas = painted("mbn_weed", WEED, SPRAYED_WEED), painted("mbn_area", AREA, SPRAYED_AREA)
    return list(zip(weeds, areas, strict=True))


# An episode


def test_a_policy_sprays_every_weed_of_a_field_with_a_hole(server: CoppeliaServer) -> None:
    field = orchard()
    with connect(server) as simulator:
        done = deploy(make_classical("greedy", field, {}), field, {}, simulator)
        assert done.success
        assert colours(server) == [(True, True)] * 3
        steps = done.episode.steps
        assert server.steps == 20 * steps
        assert [len(items) for items in server.drawings.values()] == [steps, steps]
        paths = np.array(list(server.drawings.values()))
    assert field.polygon.buffer(0.5).covers(shapely.linestrings(done.episode.positions[:, 0]))
    assert (done.episode.visits > 0).all()
    assert 0.0 < done.tracking_error < 1.0
    drawn = paths[:, :, 3:5].transpose(1, 0, 2) / 0.1 + 50.0
    assert drawn == pytest.approx(done.episode.positions[1:], abs=1e-4)
    assert left(server) == EMPTY


@pytest.mark.all
def test_the_command_flies_one_field_after_another(
    server: CoppeliaServer, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    fields, place = ["field_03", "field_04"], ["--host", "127.0.0.1", "--port", str(server.port)]
    numbers = tmp_path / "numbers.json"
    words = ["deploy", "greedy", "--field", *fields, "--sim", "coppeliasim", *place]
    assert main([*words, "--json", str(numbers)]) == 0
    assert capsys.readouterr().out.count("success") == 2
    rows = json.loads(numbers.read_text())["deployments"]
    assert [row["times_real_time"] for row in rows] == [None, None], "it is another program"
    assert left(server) == EMPTY


def test_the_command_names_what_is_missing(capsys: pytest.CaptureFixture[str]) -> None:
    port = str(free_port())
    words = ["deploy", "greedy", "--field", "field_03", "--sim", "coppeliasim", "--port", port]
    assert main([*words, "--timeout", "0.3"]) != 0
    said = " ".join(capsys.readouterr().err.split())
    assert f"CoppeliaSim at localhost:{port}: no answer" in said
    assert main([*words, "--vehicle", "balancer"]) != 0
    assert "allowed with coppeliasim: quadrotor" in " ".join(capsys.readouterr().err.split())


def test_weeds_change_one_by_one(server: CoppeliaServer) -> None:
    with connect(server) as simulator:
        simulator.reset(mission())
        simulator.spray(1)
        assert colours(server) == [(False, False), (True, True), (False, False)]


def test_a_step_is_a_step_and_no_more(server: CoppeliaServer) -> None:
    with connect(server) as simulator:
        simulator.reset(mission())
        assert server.steps == 0
        for done in (1, 2, 3):
            simulator.command(np.zeros((2, 2)))
            simulator.step()
            time.sleep(0.02)  # a server without stepping would go on
            assert server.steps == 20 * done


@pytest.mark.parametrize(("seconds", "steps"), [(0.05, 1), (0.5, 10), (1.0, 20)])
def test_a_step_lasts_as_the_scale_says(server: CoppeliaServer, seconds: float, steps: int) -> None:
    with connect(server, scale=Scale(seconds=seconds)) as simulator:
        simulator.reset(mission())
        simulator.step()
        assert server.steps == steps


def test_vehicles_track_the_commanded_velocities(server: CoppeliaServer) -> None:
    field = square()
    wanted = np.array([[1.0, -0.5], [0.0, 2.0]])
    with connect(server, scale=Scale(metres=0.2, seconds=0.5)) as simulator:
        simulator.reset(mission(field))
        begin = simulator.motion()
        assert begin.positions == pytest.approx(field.starts)
        assert not begin.velocities.any()
        for _ in range(40):
            simulator.command(wanted)
            simulator.step()
        motion = simulator.motion()
        targets = np.array([target.place[:2] for target in server.named("target")])
    assert motion.velocities == pytest.approx(wanted, abs=0.05)
    assert motion.heights == pytest.approx([0.35, 0.35])
    assert targets == pytest.approx((field.starts + 40 * wanted - 50.0) * 0.2)
    assert motion.positions == pytest.approx(field.starts + 40 * wanted, abs=2.0)


def test_a_vehicle_that_brakes_lands_where_it_stops(server: CoppeliaServer) -> None:
    with connect(server) as simulator:
        simulator.reset(mission(square()))
        simulator.fail(0, "brake")
        for speed, height in ((1.0, 0.35), (0.0, 0.15), (0.0, 0.0), (0.0, 0.0)):
            simulator.command(np.array([[speed, 0.0], [1.0, 0.0]]))
            simulator.step()
            targets = np.array([target.place for target in server.named("target")])
            assert targets[:, 2] == pytest.approx([height, 0.35])
            assert targets[0, 0] == pytest.approx(-4.0 + 0.1)
        for _ in range(6):
            simulator.step()
        motion = simulator.motion()
    assert motion.heights == pytest.approx([0.0, 0.35], abs=0.01)
    assert motion.positions[0] == pytest.approx(square().starts[0] + (1.0, 0.0), abs=0.1)


def test_the_stand_in_reacts_late_as_the_real_quadcopter_does(server: CoppeliaServer) -> None:
    with connect(server, scale=Scale(seconds=0.05)) as simulator:
        simulator.reset(mission())
        simulator.command(np.full((2, 2), 5.0))
        moved = []
        for _ in range(LATE + 2):
            simulator.step()
            moved.append(bool(simulator.motion().velocities.any()))
    assert moved == [False] * LATE + [True] * 2


def test_a_target_does_not_run_away_from_a_vehicle_that_is_held_up(server: CoppeliaServer) -> None:
    server.frozen = True
    with connect(server) as simulator:
        simulator.reset(mission())
        for _ in range(10):
            simulator.command(np.array([[3.0, 4.0], [0.0, 0.0]]))
            simulator.step()
        body, target = server.named("Quadcopter")[0], server.named("target")[0]
        lead = target.place - body.place
        assert np.linalg.norm(lead) == pytest.approx(1.0 + 0.5)  # the leash, and a step
        assert lead[1] / lead[0] == pytest.approx(4 / 3)


# The scene


def test_the_scene_is_the_field(server: CoppeliaServer) -> None:
    field = orchard()
    with connect(server) as simulator:
        simulator.reset(mission(field))
        (soil,) = server.named("mbn_soil")
        assert soil.place[2] + soil.size[2] / 2 == pytest.approx(0.002)  # above CoppeliaSim's floor
        sides = {alias: server.named(f"mbn_{alias}") for alias in ("boundary", "obstacle")}
        for alias, side in (("boundary", 10.0), ("obstacle", 2.0)):
            things, half = sides[alias], side / 2
            assert [thing.size[0] for thing in things] == pytest.approx([side] * 4)
            places = {tuple(np.round(thing.place[:2], 9)) for thing in things}
            assert places == {(0.0, -half), (half, 0.0), (0.0, half), (-half, 0.0)}
            upright = {bool(thing.place[0]): abs(round(np.sin(thing.turn))) for thing in things}
            assert upright == {False: 0, True: 1}
            bottoms = [thing.place[2] - thing.size[2] / 2 for thing in things]
            assert bottoms == pytest.approx([0.0] * 4)
        scenery = [thing for thing in server.things.values() if thing.alias.startswith("mbn_")]
        assert {thing.flags["static"] for thing in scenery} == {1}
        solid = {thing.alias for thing in scenery if thing.flags["solid"]}
        assert solid == {"mbn_soil", "mbn_obstacle"}
        (corn,) = server.named("mbn_corn")
        assert all(9.0 < side < 10.5 for side in corn.size[:2])
        assert corn.size[2] < 0.35
        assert [area.size[0] for area in server.named("mbn_area")] == pytest.approx([2.0] * 3)
        for alias in ("mbn_weed", "mbn_area"):
            places = np.array([thing.place[:2] for thing in server.named(alias)])
            assert places == pytest.approx((field.rois - 50.0) * 0.1, abs=0.05)
        for alias in ("Quadcopter", "target"):
            places = np.array([thing.place for thing in server.named(alias)])
            assert places == pytest.approx(np.array([[-4.0, -4.0, 0.35], [-4.0, 4.0, 0.35]]))


def test_a_second_reset_builds_it_again(server: CoppeliaServer) -> None:
    with connect(server) as simulator:
        simulator.reset(mission())
        before = left(server)
        simulator.spray(0)
        simulator.command(np.ones((2, 2)))
        simulator.step()
        simulator.reset(mission())
        assert left(server) == before
        assert not any(map(any, colours(server)))
        assert server.steps == 0
        assert simulator.motion().positions == pytest.approx(orchard().starts)
        simulator.step()
        assert server.steps == 20
    assert left(server) == EMPTY


# The end


def test_closing_stops_and_removes_everything(server: CoppeliaServer) -> None:
    simulator = connect(server)
    simulator.close()
    assert server.calls == []
    simulator.reset(mission())
    simulator.step()
    assert server.state == RUNNING
    simulator.close()
    assert left(server) == EMPTY
    called = len(server.calls)
    simulator.close()
    assert len(server.calls) == called
    with pytest.raises(SimulatorError, match="reset"):
        simulator.step()


@pytest.mark.parametrize("kind", ["stops_at", "pauses_at"])
@pytest.mark.parametrize("at", [27, 39])
def test_a_stop_or_pause_by_hand_is_an_error_in_its_step(
    server: CoppeliaServer, kind: str, at: int
) -> None:
    """A step is 20 of the simulator: both happen in the second."""
    setattr(server, kind, at)
    with connect(server) as simulator:
        simulator.reset(mission())
        simulator.step()
        with pytest.raises(SimulatorError, match="by hand"):
            simulator.step()
    assert left(server) == EMPTY
    assert not any(client.stepping for client in server.clients.values())


def test_a_stop_at_the_end_of_a_step_is_an_error_in_it(server: CoppeliaServer) -> None:
    server.stops_at = 20  # it has put all vehicles back to where they started
    with connect(server) as simulator:
        simulator.reset(mission())
        with pytest.raises(SimulatorError, match="by hand"):
            simulator.step()


def test_a_broken_off_call_leaves_nothing_behind(
    server: CoppeliaServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupt(_: object) -> bytes:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt), connect(server) as simulator:
        simulator.reset(mission())
        with monkeypatch.context() as patch:
            patch.setattr(_PatientSocket, "recv", interrupt)
            simulator.step()
    assert left(server) == EMPTY


def test_a_running_simulation_is_left_alone(server: CoppeliaServer) -> None:
    server.state = RUNNING
    with pytest.raises(SimulatorError, match="simulating something already"):
        connect(server).reset(mission())
    assert left(server) == (["Floor"], 0, RUNNING)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"model": "models/dragon.ttm"},
            "file could not be opened: /opt/CoppeliaSim/models/dragon",
        ),
        ({"model": "/home/me/dragon.ttm"}, "file could not be opened: /home/me/dragon"),
        ({"scale": Scale(seconds=0.33)}, "lasts 0.33 s.*time steps of 0.05 s"),
        ({"scale": Scale(seconds=0.01)}, "lasts 0.01 s.*time steps of 0.05 s"),
    ],
)
def test_a_failed_reset_leaves_nothing_behind(
    server: CoppeliaServer, changes: dict[str, Any], message: str
) -> None:
    with pytest.raises(SimulatorError, match=message):
        connect(server, **changes).reset(mission())
    assert left(server) == EMPTY


@pytest.mark.all
def test_the_page_does_what_it_shows(
    server: CoppeliaServer, capsys: pytest.CaptureFixture[str]
) -> None:
    blocks = dict(
        re.findall(r"```{code-block} (\w+)\n(.*?)```", PAGE.read_text("utf-8"), re.DOTALL)
    )
    for words in commands_of(Block("sh", blocks["sh"])):
        check_command(words)
    code = blocks["python"]
    assert "23000" in code
    exec(compile(code.replace("23000", str(server.port)), str(PAGE), "exec"), {})
    assert capsys.readouterr().out.startswith("True ")
    assert left(server) == EMPTY
