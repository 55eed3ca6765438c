"""The link to CoppeliaSim: wrong servers, servers that go away, and what it leaves alone."""

from __future__ import annotations

import http.server
import socket
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import pytest

pytest.importorskip("coppeliasim_zmqremoteapi_client", reason="needs mbn_marl[sim3d]")

import cbor
import zmq

from mbn_marl.errors import ConfigError, SimulatorError
from mbn_marl.sim3d import Mission
from mbn_marl.sim3d.coppelia_link import CoppeliaLink
from mbn_marl.sim3d.coppeliasim import CoppeliaSimulator
from tests.support.coppelia_server import STOPPED, CoppeliaServer, free_port
from tests.support.field_cases import square

SHORT = 0.3
"""Seconds that a server has here to answer which will not."""


def mission() -> Mission:
    return Mission(square(), square().starts)


@contextmanager
def nobody() -> Iterator[int]:
    yield free_port()


@contextmanager
def mute() -> Iterator[int]:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        yield listener.getsockname()[1]


@contextmanager
def web() -> Iterator[int]:
    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_: object) -> None:
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), Quiet) as page:
        thread = threading.Thread(target=page.serve_forever, args=(0.01,))
        thread.start()
        yield page.server_address[1]
        page.shutdown()
        thread.join()


def answering(message: bytes) -> Callable[[], Any]:
    """A ZeroMQ server that answers everything with one message."""

    @contextmanager
    def serve() -> Iterator[int]:
        with zmq.Context() as context, context.socket(zmq.REP) as rep:
            port = rep.bind_to_random_port("tcp://127.0.0.1")
            over = threading.Event()

            def loop() -> None:
                while not over.is_set():
                    if rep.poll(1):
                        rep.recv()
                        rep.send(message)

            thread = threading.Thread(target=loop)
            thread.start()
            yield port
            over.set()
            thread.join()

    return serve


OLD = cbor.dumps({"success": False, "error": "version"})
FOREVER = cbor.dumps({"func": "_*wait*_", "args": []})


@pytest.mark.parametrize(
    ("serve", "message"),
    [
        pytest.param(nobody, "no answer.*within 0.3 s.*refused.*running", id="nobody"),
        pytest.param(mute, "listens there, but does not speak its protocol", id="mute"),
        pytest.param(web, "listens there, but does not speak its protocol", id="web"),
        pytest.param(answering(b""), "none of its remote API", id="empty"),
        pytest.param(answering(b"OK"), "none of its remote API", id="text"),
        pytest.param(answering(b"\x5b" + b"\xff" * 8), "none of its remote API", id="huge"),
        pytest.param(answering(b"\x01"), "none of its remote API", id="number"),
        pytest.param(answering(OLD), "none of its remote API.*'ret'", id="protocol 1"),
        pytest.param(answering(FOREVER), "no answer", id="wait for ever"),
        pytest.param(answering(cbor.dumps({"ret": [{}]})), "no simulation", id="no functions"),
        pytest.param(answering(cbor.dumps({"err": "a_=NL=_b"})), "refuses sim: a\nb", id="refusal"),
    ],
)
def test_a_wrong_server_is_an_error_in_time(serve: Any, message: str) -> None:
    with serve() as port:
        begin = time.monotonic()
        with pytest.raises(SimulatorError, match=f"(?s)127.0.0.1:{port}.*{message}"):
            CoppeliaSimulator("127.0.0.1", port, timeout=SHORT).reset(mission())
        assert time.monotonic() - begin < SHORT + 5.0


def begun(server: CoppeliaServer) -> CoppeliaSimulator:
    """Return a simulator after its reset, that is patient no more, however busy the machine is."""
    simulator = CoppeliaSimulator("127.0.0.1", server.port, timeout=10.0)
    simulator.reset(mission())
    assert simulator._link is not None
    simulator._link.timeout = SHORT
    return simulator


@pytest.mark.parametrize("ending", ["die", "hang", "endless step"])
def test_a_server_that_goes_away_is_an_error_in_time(ending: str) -> None:
    server = CoppeliaServer()
    with server:
        simulator = begun(server)
        simulator.step()
        server.silent, server.endless = ending == "hang", ending == "endless step"
        if ending == "die":
            server.die()
        begin = time.monotonic()
        with pytest.raises(SimulatorError, match=r"no answer to sim\..* within 0.3 s"), simulator:
            simulator.step()
        assert time.monotonic() - begin < SHORT + 5.0
        with pytest.raises(SimulatorError, match="reset"):
            simulator.step()


def test_a_simulation_that_does_not_end_is_an_error_in_time(server: CoppeliaServer) -> None:
    simulator = begun(server)
    server.winding_down = 10**9
    begin = time.monotonic()
    with pytest.raises(SimulatorError, match=r"(stop|no answer).* within 0\.3 s"):
        simulator.close()
    assert time.monotonic() - begin < SHORT + 5.0


def test_numbers_out_of_range_are_named() -> None:
    with pytest.raises(ConfigError, match="port: 0; allowed: 1 to 65535"):
        CoppeliaSimulator(port=0).reset(mission())
    with pytest.raises(ConfigError, match="timeout: 0; allowed"):
        CoppeliaSimulator(timeout=0.0).reset(mission())
    with pytest.raises(ConfigError, match="altitude: -1; allowed"):
        CoppeliaSimulator(altitude=-1.0)


def test_a_missing_client_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "coppeliasim_zmqremoteapi_client", None)
    with pytest.raises(ImportError, match=r"\.\[sim3d\]"):
        CoppeliaSimulator().reset(mission())


# The link


def test_the_link_leaves_the_users_script_alone(
    server: CoppeliaServer, monkeypatch: pytest.MonkeyPatch
) -> None:
    script = sys.modules["__main__"]
    monkeypatch.delattr(script, "require", raising=False)
    before = set(vars(script))
    CoppeliaLink("127.0.0.1", server.port, 2.0).close()
    assert set(vars(script)) == before
    monkeypatch.setattr(script, "require", "mine", raising=False)
    CoppeliaLink("127.0.0.1", server.port, 2.0).close()
    assert vars(script)["require"] == "mine"


def test_the_link_survives_a_refusal_and_no_more(server: CoppeliaServer) -> None:
    link = CoppeliaLink("127.0.0.1", server.port, SHORT)
    with pytest.raises(SimulatorError, match=r"refuses sim\.dance.*No such function"):
        link.call("dance")
    with pytest.raises(SimulatorError, match=r"does not know sim\.tempo"):
        link.constant("tempo")
    assert link.call("getSimulationState") == STOPPED
    server.silent = True
    with pytest.raises(SimulatorError, match=r"no answer to sim\.getSimulationState"):
        link.call("getSimulationState")
    server.silent = False
    with pytest.raises(SimulatorError, match="connection is closed"):
        link.call("getSimulationState")
    link.connect()
    assert link.call("getSimulationState") == STOPPED
    link.close()
