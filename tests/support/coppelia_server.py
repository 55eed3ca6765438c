"""A stand-in for CoppeliaSim: its remote API's protocol, version 2, over a scene of its own.

It speaks what the add-on "ZMQ remote API server" speaks: CBOR over a ZeroMQ REP socket, clients
told apart by their uuid, answers ``ret`` or ``err``, and ``_*wait*_`` against ``_*executed*_``
while a step is being simulated. Behind it is a scene of shapes without physics, whose quadcopters
follow their targets by the law of the script in CoppeliaSim's own quadcopter, linearised: they
accelerate by 0.2 / s^2 of the way to the target and by 2 / s of its velocity relative to theirs.
They react 0.3 s late, as the real one was seen to lag behind that law.
"""

from __future__ import annotations

import re
import socket
import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any, Self

import cbor
import numpy as np
import zmq

RESOURCES = "/opt/CoppeliaSim"
MODEL = f"{RESOURCES}/models/robots/mobile/Quadcopter.ttm"
TIME_STEP = 0.05
LATE = 6
"""Time steps, 0.3 s, by which a vehicle reacts late."""

STOPPED, PAUSED, RUNNING, STOPPING = 0, 8, 17, 22
CONSTANTS = {
    "colorcomponent_ambient_diffuse": 0,
    "colorcomponent_transparency": 4,
    "drawing_cyclic": 0x80,
    "drawing_lines": 1,
    "primitiveshape_cuboid": 3,
    "primitiveshape_cylinder": 5,
    "shapeintparam_respondable": 3004,
    "shapeintparam_static": 3003,
    "simulation_stopped": STOPPED,
    "stringparam_resourcesdir": 34,
}
FLAGS = {
    CONSTANTS["shapeintparam_static"]: "static",
    CONSTANTS["shapeintparam_respondable"]: "solid",
}


class RefusalError(Exception):
    """What CoppeliaSim answers to a wrong call."""


@dataclass
class Thing:
    """An object of the scene."""

    alias: str
    place: np.ndarray = field(default_factory=lambda: np.zeros(3))
    parent: int = -1
    size: tuple[float, ...] = ()
    kind: int = -1
    turn: float = 0.0
    colour: tuple[float, ...] | None = None
    opacity: float = 1.0
    flags: dict[str, int] = field(default_factory=dict)
    velocity: np.ndarray = field(default_factory=lambda: np.zeros(3))
    target: int = -1
    seen: list[np.ndarray] = field(default_factory=list)


@dataclass
class Client:
    """What the server knows of a client."""

    stepping: int = 0
    waits: int = 0


class CoppeliaServer:
    """A server on a free port of this machine, in a thread of its own.

    Attributes:
        things: the objects in the scene, by their handles.
        drawings: the items of the drawing objects, by their handles.
        steps: simulated since the last start.
        calls: the functions called, in order.
        silent: no request is answered any more.
        endless: a step never comes to its end.
        frozen: no vehicle moves.
        stops_at: the step after which somebody stops the simulation by hand.
        pauses_at: the step after which somebody pauses it by hand.
        winding_down: how many more passes a simulation takes to stop.
        clients: by their uuid.
    """

    def __init__(self) -> None:
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.REP)
        self._socket.setsockopt(zmq.LINGER, 0)
        self.port = self._socket.bind_to_random_port("tcp://127.0.0.1")
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self.clients: dict[str, Client] = {}
        self._next = 100
        self._kept: dict[int, np.ndarray] = {}
        self.things: dict[int, Thing] = {1: Thing("Floor")}
        self.drawings: dict[int, list[list[float]]] = {}
        self.state = STOPPED
        self.steps = 0
        self.calls: list[str] = []
        self.silent = False
        self.endless = False
        self.frozen = False
        self.stops_at = self.pauses_at = 0
        self.winding_down = 3
        self._functions: dict[str, Callable[..., list[Any]]] = {
            name: getattr(self, name)
            for name in vars(CoppeliaServer)
            if re.search("[a-z][A-Z]", name)
        }

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.die()

    def die(self) -> None:
        """Go, without a word to anybody."""
        if self._stop.is_set():
            return
        self._stop.set()
        self._thread.join()
        self._socket.close()
        self._context.term()

    def named(self, alias: str) -> list[Thing]:
        """The objects of this alias."""
        return [thing for thing in self.things.values() if thing.alias == alias]

    # The protocol

    def _serve(self) -> None:
        while not self._stop.is_set():
            if self._socket.poll(1) and not self.silent:
                request = cbor.loads(self._socket.recv())
                self._socket.send(cbor.dumps(self._answer(request)))
            if self.state in (RUNNING, STOPPING) and not any(
                c.stepping for c in self.clients.values()
            ):
                self._advance()

    def _answer(self, request: dict[str, Any]) -> dict[str, Any]:
        new = request["uuid"] not in self.clients
        if new and (request["ver"], request["lang"]) != (2, "python"):
            return {"err": "wrong version"}
        client = self.clients.setdefault(request["uuid"], Client())
        name, arguments = request["func"], request["args"]
        assert request["argsL"] == len(arguments)
        if name == "zmqRemoteApi.require":
            return {"ret": []}
        if name == "zmqRemoteApi.info":
            functions = [*self._functions, "setStepping", "step"]
            offered: dict[str, Any] = {function: {"func": {}} for function in functions}
            offered |= {constant: {"const": value} for constant, value in CONSTANTS.items()}
            return {"ret": [offered]}
        if name == "_*executed*_":
            return self._wait(client)
        self.calls.append(name.removeprefix("sim."))
        if name == "sim.step":
            client.waits = 2
            return self._wait(client)
        if name == "sim.setStepping":
            before = client.stepping
            client.stepping = before + 1 if arguments[0] else max(0, before - 1)
            return {"ret": [before]}
        function = self._functions.get(name.removeprefix("sim."))
        if function is None:
            return {"err": f"No such function: {name}"}
        try:
            return {"ret": function(*arguments)}
        except RefusalError as error:
            return {"err": f"in function '{name}':_=NL=_{error}"}

    def _wait(self, client: Client) -> dict[str, Any]:
        if client.waits or self.endless:
            client.waits -= 1
            return {"func": "_*wait*_", "args": []}
        if self.state == RUNNING and client.stepping:
            self._advance()
        return {"ret": []}

    # The simulation

    def _advance(self) -> None:
        if self.state == STOPPING:
            self._passes += 1
            if self._passes >= self.winding_down:
                for handle in self._kept.keys() & self.things.keys():
                    self.things[handle].place = self._kept[handle]
                self.state = STOPPED
            return
        for thing in self.things.values():
            if thing.target < 0 or self.frozen:
                continue
            target = self.things[thing.target]
            if not self.steps:
                target.parent, thing.seen = -1, [thing.place] * (LATE + 2)
            thing.seen = [*thing.seen[1:], target.place]
            before, seen = thing.seen[:2]
            pull = 0.2 * (seen - thing.place) + 2.0 * ((seen - before) / TIME_STEP - thing.velocity)
            thing.velocity = thing.velocity + pull * TIME_STEP
            thing.place = thing.place + thing.velocity * TIME_STEP
        self.steps += 1
        if self.steps in (self.stops_at, self.pauses_at):
            self.state = STOPPED if self.steps == self.stops_at else PAUSED

    def startSimulation(self) -> list[Any]:
        self.state, self.steps = RUNNING, 0
        self._kept = {handle: thing.place for handle, thing in self.things.items()}
        return []

    def stopSimulation(self) -> list[Any]:
        if self.state != STOPPED:
            self.state, self._passes = STOPPING, 0
        for client in self.clients.values():
            client.stepping = 0
        return []

    def getSimulationState(self) -> list[Any]:
        return [self.state]

    def getSimulationTime(self) -> list[Any]:
        return [self.steps * TIME_STEP]

    def getSimulationTimeStep(self) -> list[Any]:
        return [TIME_STEP]

    # The scene

    def _add(self, thing: Thing) -> int:
        if self.state != STOPPED:
            raise RefusalError("this stand-in makes objects only while nothing is simulated")
        self._next += 1
        self.things[self._next] = thing
        return self._next

    def _thing(self, handle: object) -> Thing:
        if type(handle) is not int or handle not in self.things:
            raise RefusalError("object does not exist")
        return self.things[handle]

    @staticmethod
    def _floats(values: object, count: int) -> np.ndarray:
        if not (isinstance(values, list) and len(values) == count):
            raise RefusalError(f"expected {count} numbers")
        if not all(type(value) is float and np.isfinite(value) for value in values):
            raise RefusalError("expected finite numbers")
        return np.array(values)

    def createPrimitiveShape(self, kind: int, sizes: object, options: int) -> list[Any]:
        size = self._floats(sizes, 3)
        if kind not in (3, 5) or options or not (size > 0).all():
            raise RefusalError("wrong kind, options or size")
        return [self._add(Thing("Shape", size=tuple(size), kind=kind))]

    def createShape(
        self, options: int, shading: float, vertices: object, indices: list[int]
    ) -> list[Any]:
        """Of triangles, whose middle is the place of the shape."""
        points = self._floats(vertices, len(list(vertices))).reshape(-1, 3)
        if options or shading or len(indices) % 3 or not set(indices) <= set(range(len(points))):
            raise RefusalError("wrong options, shading angle or indices")
        low, high = points.min(axis=0), points.max(axis=0)
        return [self._add(Thing("Shape", place=(low + high) / 2, size=tuple(high - low)))]

    def loadModel(self, filename: str) -> list[Any]:
        if filename != MODEL:
            raise RefusalError(f"file could not be opened: {filename}")
        body = self._add(Thing("Quadcopter"))
        target = self._add(Thing("target", parent=body))
        for alias in ("base", "propeller", "script"):
            self._add(Thing(alias, parent=body))
        self.things[body].target = target
        return [body]

    def getObjectsInTree(self, base: int) -> list[Any]:
        self._thing(base)
        return [[base, *(h for h, thing in self.things.items() if thing.parent == base)]]

    def getObjectAlias(self, handle: int) -> list[Any]:
        return [self._thing(handle).alias]

    def setObjectAlias(self, handle: int, alias: str) -> list[Any]:
        self._thing(handle).alias = alias
        return []

    def setObjectInt32Param(self, handle: int, parameter: int, value: int) -> list[Any]:
        self._thing(handle).flags[FLAGS[parameter]] = value
        return []

    def setObjectPosition(self, handle: int, place: object) -> list[Any]:
        """The children go with it."""
        thing, place = self._thing(handle), self._floats(place, 3)
        for child in self.things.values():
            if child.parent == handle:
                child.place = child.place + place - thing.place
        thing.place = place
        return []

    def setObjectOrientation(self, handle: int, angles: object) -> list[Any]:
        self._thing(handle).turn = float(self._floats(angles, 3)[2])
        return []

    def setShapeColor(self, handle: int, name: str, component: int, colour: object) -> list[Any]:
        if name or component not in (0, 4):
            raise RefusalError("wrong name or component")
        if component:
            self._thing(handle).opacity = float(self._floats(colour, 1)[0])
        else:
            self._thing(handle).colour = tuple(self._floats(colour, 3))
        return []

    def getObjectPosition(self, handle: int) -> list[Any]:
        return [self._thing(handle).place.tolist()]

    def getObjectVelocity(self, handle: int) -> list[Any]:
        return [self._thing(handle).velocity.tolist(), [0.0, 0.0, 0.0]]

    def getStringParam(self, parameter: int) -> list[Any]:
        if parameter != CONSTANTS["stringparam_resourcesdir"]:
            raise RefusalError("invalid parameter")
        return [RESOURCES]

    def isHandle(self, handle: int) -> list[Any]:
        return [handle in self.things]

    def removeObjects(self, handles: list[int]) -> list[Any]:
        for handle in handles:
            self._thing(handle)
        for handle in handles:
            del self.things[handle]
        return []

    def addDrawingObject(
        self, kind: int, size: float, tolerance: float, parent: int, most: int, colour: object
    ) -> list[Any]:
        if (kind, tolerance, parent) != (0x81, 0.0, -1) or not (size > 0 and most > 0):
            raise RefusalError("wrong arguments")
        self._floats(colour, 3)
        self._next += 1
        self.drawings[self._next] = []
        return [self._next]

    def addDrawingObjectItem(self, handle: int, item: object) -> list[Any]:
        if handle not in self.drawings:
            raise RefusalError("drawing object does not exist")
        self.drawings[handle].append(self._floats(item, 6).tolist())
        return [1]

    def removeDrawingObject(self, handle: int) -> list[Any]:
        if handle not in self.drawings:
            raise RefusalError("drawing object does not exist")
        del self.drawings[handle]
        return []


def free_port() -> int:
    """Return a port of this machine on which nobody listens."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return int(listener.getsockname()[1])
