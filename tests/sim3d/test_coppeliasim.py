"""The CoppeliaSim backend, through the official client, against a server of the same protocol."""

import re
import sys
import time
from typing import Any
from unittest.mock import Mock

import cbor
import numpy as np
import pytest
import shapely

from baselines.policies.classical import make_classical
from mbn_marl.errors import ConfigError, SimulatorError
from mbn_marl.field import Field
from mbn_marl.sim3d import Mission, Scale, deploy
from mbn_marl.sim3d.coppelia_link import CoppeliaLink, _PatientSocket
from mbn_marl.sim3d.coppeliasim import CoppeliaSimulator
from mbn_marl.sim3d.scene import SPRAYED
from tests.support.coppelia_server import RUNNING, STOPPED, CoppeliaServer, free_port
from tests.support.field_cases import square
from tests.support.pages import ROOT, Block, check_command, commands_of

pytestmark = pytest.mark.slow
PAGE = ROOT / "docs" / "coppeliasim.md"
SHORT = 0.3  # seconds that a server has here to answer which will not
# Two robots, a hole between them and most ROIs; the middle is (50, 50).
ORCHARD = square(rois=[(90.0, 90.0), (90.0, 10.0), (50.0, 80.0)])
EMPTY = (["Floor"], 0, STOPPED)


@pytest.fixture
def server():
    with CoppeliaServer() as running:
        yield running


def mission(field: Field = ORCHARD) -> Mission:
    return Mission(field, field.starts.astype(np.float32))


def connect(server: CoppeliaServer, **changes: Any) -> CoppeliaSimulator:
    return CoppeliaSimulator("127.0.0.1", server.port, **({"timeout": 2.0} | changes))


def begun(server: CoppeliaServer, field: Field = ORCHARD, **changes: Any) -> CoppeliaSimulator:
    simulator = connect(server, **changes)
    simulator.reset(mission(field))
    return simulator


def left(server: CoppeliaServer) -> tuple[list[str], int, int]:
    """The objects of the scene, and whether it is simulated."""
    things = [thing.alias for thing in server.things.values()]
    return things, len(server.drawings), server.state


def sprayed(server: CoppeliaServer) -> list[bool]:
    """Return for each weed, then each area, whether it has the colour of a sprayed one."""
    return [
        (*(one.colour or ()), one.opacity) == tuple(map(float, SPRAYED[name].split()))
        for name in ("weed", "area")
        for one in server.named(f"mbn_{name}")
    ]


def places(server: CoppeliaServer, alias: str) -> np.ndarray:
    return np.array([thing.place for thing in server.named(alias)])


FOREVER = cbor.dumps({"func": "_*wait*_", "args": []})


@pytest.mark.parametrize(
    ("answer", "message"),
    [
        pytest.param(b"", "no answer.*within 0.3 s.*refused.*running", id="nobody"),
        pytest.param(b"\x5b" + b"\xff" * 8, "none of its remote API", id="huge"),
        pytest.param(FOREVER, "no answer", id="wait for ever"),
        pytest.param(cbor.dumps({"ret": [{}]}), "no simulation", id="no functions"),
        pytest.param(cbor.dumps({"err": "a_=NL=_b"}), "refuses sim: a\nb", id="refusal"),
    ],
)
def test_wrong_server_is_an_error_in_time(server, answer, message):
    server.answer, port = answer, server.port if answer else free_port()
    begin = time.monotonic()
    with pytest.raises(SimulatorError, match=f"(?s)127.0.0.1:{port}.*{message}"):
        CoppeliaSimulator("127.0.0.1", port, timeout=SHORT).reset(mission())
    assert time.monotonic() - begin < SHORT + 5.0


@pytest.mark.parametrize("ending", ["die", "endless step", "endless stop"])
def test_server_that_goes_away_is_an_error_in_time(server, ending):
    simulator = begun(server, timeout=10.0)
    simulator.step()
    simulator._link.timeout = SHORT  # only now, however busy the machine is
    server.endless = ending == "endless step"
    if ending == "die":
        server.die()
    if ending == "endless stop":
        server.winding_down = 10**9
    begin = time.monotonic()
    with pytest.raises(SimulatorError, match=r"(stop|no answer).* within 0\.3 s"), simulator:
        if ending != "endless stop":
            simulator.step()
    assert time.monotonic() - begin < SHORT + 5.0
    for method in (simulator.step, simulator.motion, lambda: simulator.spray(0)):
        with pytest.raises(SimulatorError, match="reset"):
            method()


def test_numbers_out_of_range_and_a_missing_client_are_named(monkeypatch):
    for changes, place in (({"port": 0}, "port: "), ({"timeout": 0.0}, "timeout: ")):
        with pytest.raises(ConfigError, match=place):
            CoppeliaSimulator(**changes).reset(mission())
    monkeypatch.setitem(sys.modules, "coppeliasim_zmqremoteapi_client", None)
    with pytest.raises(ImportError, match=r"\.\[sim3d\]"):
        CoppeliaSimulator().reset(mission())


def test_link_leaves_the_users_script_alone(server, monkeypatch):
    script = sys.modules["__main__"]
    monkeypatch.setattr(script, "require", "mine", raising=False)
    CoppeliaLink("127.0.0.1", server.port, 2.0).close()
    assert vars(script)["require"] == "mine"


def test_link_survives_a_refusal_and_no_more(server):
    link = CoppeliaLink("127.0.0.1", server.port, SHORT)
    with pytest.raises(SimulatorError, match=r"refuses sim\.dance.*No such function"):
        link.call("dance")
    server.silent = True
    with pytest.raises(SimulatorError, match=r"no answer to sim\.getSimulationState"):
        link.call("getSimulationState")
    server.silent = False
    with pytest.raises(SimulatorError, match="connection is closed"):
        link.call("getSimulationState")
    link.connect()
    assert link.call("getSimulationState") == STOPPED
    link.close()


def test_policy_sprays_every_weed_of_a_field_with_a_hole(server):
    with connect(server) as simulator:
        done = deploy(make_classical("greedy", ORCHARD, {}), ORCHARD, {}, simulator)
        assert done.success and done.seconds is None, "it is another program"
        assert sprayed(server) == [True] * 6
        steps = done.episode.steps
        assert server.steps == 20 * steps
        paths = np.array(list(server.drawings.values()))
    assert paths.shape == (2, steps, 6)
    assert ORCHARD.polygon.buffer(0.5).covers(shapely.linestrings(done.episode.positions[:, 0]))
    assert (done.episode.visits > 0).all()
    assert 0.0 < done.tracking_error < 1.0
    drawn = paths[:, :, 3:5].transpose(1, 0, 2) / 0.1 + 50.0
    assert drawn == pytest.approx(done.episode.positions[1:], abs=1e-4)
    assert left(server) == EMPTY


def test_vehicles_track_the_commanded_velocities(server):
    starts, wanted = square().starts, np.array([[1.0, -0.5], [0.0, 2.0]])
    with begun(server, square(), scale=Scale(metres=0.2, seconds=0.5)) as simulator:
        begin = simulator.motion()
        assert begin.positions == pytest.approx(starts)
        assert not begin.velocities.any()
        for _ in range(40):
            simulator.command(wanted)
            simulator.step()
        motion, targets = simulator.motion(), places(server, "target")
        assert server.steps == 40 * 10
    assert motion.velocities == pytest.approx(wanted, abs=0.05)
    assert motion.heights == pytest.approx([0.35, 0.35])
    assert targets[:, :2] == pytest.approx((starts + 40 * wanted - 50.0) * 0.2)
    assert motion.positions == pytest.approx(starts + 40 * wanted, abs=2.0)


def test_vehicle_that_brakes_lands_where_it_stops(server):
    with begun(server, square()) as simulator:
        simulator.fail(0, "brake")
        for speed, height in ((1.0, 0.35), (0.0, 0.15), (0.0, 0.0)):
            simulator.command(np.array([[speed, 0.0], [1.0, 0.0]]))
            simulator.step()
            targets = places(server, "target")
            assert targets[:, 2] == pytest.approx([height, 0.35])
            assert targets[0, 0] == pytest.approx(-4.0 + 0.1)
        for _ in range(7):
            simulator.step()
        motion = simulator.motion()
    assert motion.heights == pytest.approx([0.0, 0.35], abs=0.01)
    assert motion.positions[0] == pytest.approx(square().starts[0] + (1.0, 0.0), abs=0.1)


def test_scene_is_the_field(server):
    with begun(server) as simulator:
        for alias, side in (("boundary", 10.0), ("obstacle", 2.0)):
            things, half = server.named(f"mbn_{alias}"), side / 2
            assert [thing.size[0] for thing in things] == pytest.approx([side] * 4)
            middles = {tuple(np.round(thing.place[:2], 9)) for thing in things}
            assert middles == {(0.0, -half), (half, 0.0), (0.0, half), (-half, 0.0)}
        solid = {thing.alias for thing in server.things.values() if thing.flags.get("solid")}
        assert solid == {"mbn_soil", "mbn_obstacle"}
        for alias in ("mbn_weed", "mbn_area"):
            spots = (ORCHARD.rois - 50.0) * 0.1
            assert places(server, alias)[:, :2] == pytest.approx(spots, abs=0.05)
        for alias in ("Quadcopter", "target"):
            starts = np.array([[-4.0, -4.0, 0.35], [-4.0, 4.0, 0.35]])
            assert places(server, alias) == pytest.approx(starts)
        simulator.spray(1)
        assert sprayed(server) == [False, True, False] * 2


def test_second_reset_builds_it_again(server):
    with begun(server) as simulator:
        before = left(server)
        simulator.spray(0)
        simulator.step()
        simulator.reset(mission())
        assert left(server) == before
        assert not any(sprayed(server))
        assert simulator.motion().positions == pytest.approx(ORCHARD.starts)
        simulator.step()
        assert server.steps == 20
    simulator.close()
    assert left(server) == EMPTY


@pytest.mark.parametrize(("kind", "at"), [("stops_at", 40), ("pauses_at", 27)])
def test_stop_or_pause_by_hand_is_an_error_in_its_step(server, kind, at):
    """A step is 20 of the simulator: all happen in the second, one stop at its very end."""
    setattr(server, kind, at)
    with begun(server) as simulator:
        simulator.step()
        with pytest.raises(SimulatorError, match="by hand"):
            simulator.step()
    assert left(server) == EMPTY
    assert not any(client.stepping for client in server.clients.values())


def test_broken_off_call_leaves_nothing_behind(server, monkeypatch):
    with pytest.raises(KeyboardInterrupt), begun(server) as simulator, monkeypatch.context() as now:
        now.setattr(_PatientSocket, "recv", Mock(side_effect=KeyboardInterrupt))
        try:
            simulator.step()
        finally:
            now.undo()
    assert left(server) == EMPTY


def test_running_simulation_is_left_alone(server):
    server.state = RUNNING
    with pytest.raises(SimulatorError, match="simulating something already"):
        connect(server).reset(mission())
    assert left(server) == (["Floor"], 0, RUNNING)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"model": "models/dragon.ttm"}, "/opt/CoppeliaSim/models/dragon"),
        ({"model": "/home/me/dragon.ttm"}, "opened: /home/me/dragon"),
        ({"scale": Scale(seconds=0.33)}, "lasts 0.33 s.*time steps of 0.05 s"),
    ],
)
def test_failed_reset_leaves_nothing_behind(server, changes, message):
    with pytest.raises(SimulatorError, match=message):
        connect(server, **changes).reset(mission())
    assert left(server) == EMPTY


@pytest.mark.all
def test_page_does_what_it_shows(server, capsys):
    text = PAGE.read_text("utf-8")
    blocks = dict(re.findall(r"```{code-block} (\w+)\n(.*?)```", text, re.DOTALL))
    for words in commands_of(Block("sh", blocks["sh"])):
        check_command(words)
    code = blocks["python"]
    assert "23000" in code
    exec(compile(code.replace("23000", str(server.port)), str(PAGE), "exec"), {})
    assert capsys.readouterr().out.startswith("True ")
    assert left(server) == EMPTY
