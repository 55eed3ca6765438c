"""A connection to CoppeliaSim in which every call ends, with an answer or with an error."""

from __future__ import annotations

import socket
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from time import monotonic
from typing import Any

from mbn_marl.errors import ConfigError, SimulatorError, load

_HINT = "is CoppeliaSim running, with its ZMQ remote API server on this port?"
_PROBE = 1.0  # seconds that finding out why nobody answers may take


class CoppeliaLink:
    # CoppeliaSim's official client would wait for ever. Here any call may take ``timeout`` seconds.
    # If one gets no usable answer, the link is ``lost``, and closed. If Ctrl-C cuts one short, it
    # is ``interrupted``, and has to connect again.
    def __init__(self, host: str, port: int, timeout: float) -> None:
        problems = []
        if not 1 <= port <= 65535:
            problems.append(f"port: {port}; allowed: 1 to 65535")
        if not 0.0 < timeout < float("inf"):
            problems.append(f"timeout: {timeout:g}; allowed: a finite number of seconds above 0")
        if problems:
            raise ConfigError("CoppeliaSim", problems)
        self._place, self.timeout = (host, port), timeout
        self._address = f"CoppeliaSim at {host}:{port}"
        self.connect()

    def call(self, name: str, *arguments: object) -> Any:
        """Return ``sim.<name>(*arguments)``: ``None``, a value, or a tuple of several."""
        with self._exchange(f"sim.{name}"):
            return self._client.call(f"sim.{name}", arguments)

    def constant(self, name: str) -> Any:
        if not hasattr(self._sim, name):
            raise SimulatorError(f"{self._address}: it does not know sim.{name}")
        return getattr(self._sim, name)

    def connect(self) -> None:
        self._client = self._new_client()
        self._client.socket = self._socket = _PatientSocket(self._client.socket)
        self.lost = self.interrupted = False
        with self._exchange("sim", opening=True):
            self._sim = self._client.require("sim")
        if not (hasattr(self._sim, "setStepping") and hasattr(self._sim, "startSimulation")):
            self.close()
            raise SimulatorError(f"{self._address}: what answers has no simulation to step")

    def close(self) -> None:
        """Drop the connection without telling CoppeliaSim and without waiting."""
        self.lost = True
        self._socket.close()
        self._client.context.term()

    def _new_client(self) -> Any:
        client = load("coppeliasim_zmqremoteapi_client", "sim3d")
        zmq = load("zmq", "sim3d")
        main = vars(sys.modules["__main__"])
        kept = {name: main[name] for name in main.keys() & {"require"}}
        try:
            return client.RemoteAPIClient(*self._place, verbose=0)
        except zmq.ZMQError as error:
            raise SimulatorError(f"{self._address}: {error}") from error
        finally:  # the client puts a function of this name into the user's script
            main.pop("require", None)
            main.update(kept)

    @contextmanager
    def _exchange(self, what: str, *, opening: bool = False) -> Iterator[None]:
        if self.lost or self.interrupted:
            raise SimulatorError(f"{self._address}: the connection is closed")
        self._socket.deadline = monotonic() + self.timeout
        try:
            yield
        except TimeoutError:
            self.close()
            raise SimulatorError(self._silence(what, opening)) from None
        except Exception as error:
            refused = type(error) is Exception  # the client raises no subclass for a refused call
            if opening or not refused:
                self.close()
            if refused:
                reason = str(error).replace("_=NL=_", "\n").replace("_=TB=_", "\t")
                raise SimulatorError(f"{self._address} refuses {what}: {reason}") from None
            raise SimulatorError(
                f"{self._address}: the answer to {what} is none of its remote API "
                f"({type(error).__name__}: {error}); {_HINT}"
            ) from error
        except BaseException:
            self.interrupted = True
            raise

    def _silence(self, what: str, opening: bool) -> str:
        waited = f"{self._address}: no answer to {what} within {self.timeout:g} s"
        if not opening:
            return f"{waited}; it has stopped, hangs, or needs a longer timeout"
        try:
            socket.create_connection(self._place, min(_PROBE, self.timeout)).close()
        except OSError as error:
            return f"{waited} ({error.strerror or error}); {_HINT}"
        return f"{waited}: something listens there, but does not speak its protocol; {_HINT}"


class _PatientSocket:
    """The client's socket, whose ``recv`` raises ``TimeoutError`` at a ``deadline``."""

    def __init__(self, socket: Any) -> None:
        socket.linger = 0
        self._socket, self.deadline = socket, 0.0
        self.send, self.close = socket.send, socket.close

    def recv(self) -> Any:
        left = self.deadline - monotonic()
        if left <= 0 or not self._socket.poll(1000 * left):
            raise TimeoutError
        return self._socket.recv()
