"""A stand-in for CoppeliaSim: its remote API's protocol, version 2, and a scene without physics."""

import socket
import threading
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Self

import cbor
import numpy as np
import zmq

RESOURCES = "/opt/CoppeliaSim"
MODEL = f"{RESOURCES}/models/robots/mobile/Quadcopter.ttm"
TIME_STEP = 0.05
LATE = 6  # time steps, 0.3 s, by which a vehicle reacts late

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
FLAGS = {3003: "static", 3004: "solid"}


class RefusalError(Exception):
    """The answer to a wrong call."""


def refuse(wrong: object, message: str) -> None:
    if wrong:
        raise RefusalError(message)


def floats(values: Any, count: int) -> np.ndarray:
    refuse(not isinstance(values, list) or len(values) != count, f"expected {count} numbers")
    right = all(type(value) is float and np.isfinite(value) for value in values)
    refuse(not right, "expected finite numbers")
    return np.array(values)


@dataclass
class Thing:
    alias: str
    place: np.ndarray = field(default_factory=lambda: np.zeros(3))
    parent: int = -1
    size: Sequence[float] = ()
    colour: tuple[float, ...] | None = None
    opacity: float = 1.0
    flags: dict[str, int] = field(default_factory=dict)
    velocity: np.ndarray = field(default_factory=lambda: np.zeros(3))
    target: int = -1
    seen: list[np.ndarray] = field(default_factory=list)


@dataclass
class Client:
    stepping: int = 0
    waits: int = 0


class CoppeliaServer:
    """A server on a free port of this machine, in a thread; a test sets what goes wrong."""

    def __init__(self) -> None:
        self._context = zmq.Context()
        self._socket = self._context.socket(zmq.REP)
        self._socket.linger = 0
        self.port = self._socket.bind_to_random_port("tcp://127.0.0.1")
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._next, self._kept = 100, dict[int, np.ndarray]()
        self.clients: dict[str, Client] = {}
        self.things: dict[int, Thing] = {1: Thing("Floor")}
        self.drawings: dict[int, list[list[float]]] = {}  # the items of drawing objects
        self.state, self.steps = STOPPED, 0
        self.answer = b""  # to every request, in place of the right one
        self.silent = self.endless = False  # no request is answered any more, a step never ends
        self.stops_at = self.pauses_at = 0  # the step after which somebody does so by hand
        self.winding_down = 3  # passes that a simulation takes to stop

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        if not self._stop.is_set():
            self.die()

    def die(self) -> None:
        self._stop.set()
        self._thread.join()
        self._socket.close()
        self._context.term()

    def named(self, alias: str) -> list[Thing]:
        things = self.things.values()
        return [thing for thing in things if thing.alias.rstrip("0123456789_") == alias]

    def _serve(self) -> None:
        while not self._stop.is_set():
            if self._socket.poll(1) and not self.silent:
                request = cbor.loads(self._socket.recv())
                self._socket.send(self.answer or cbor.dumps(self._answer(request)))
            stepped = any(client.stepping for client in self.clients.values())
            if self.state in (RUNNING, STOPPING) and not stepped:
                self._advance()

    def _answer(self, request: dict[str, Any]) -> dict[str, Any]:
        client = self.clients.get(request["uuid"])
        if client is None:
            if (request["ver"], request["lang"]) != (2, "python"):
                return {"err": "wrong version"}
            client = self.clients[request["uuid"]] = Client()
        name, arguments = request["func"].removeprefix("sim."), request["args"]
        assert request["argsL"] == len(arguments)
        functions = {one: getattr(self, one) for one in vars(CoppeliaServer) if one != one.lower()}
        if name == "zmqRemoteApi.require":
            return {"ret": []}
        if name == "zmqRemoteApi.info":
            known = {one: {"func": {}} for one in (*functions, "step", "setStepping")}
            return {"ret": [known | {one: {"const": value} for one, value in CONSTANTS.items()}]}
        if name == "_*executed*_":
            return self._wait(client)
        if name == "step":
            client.waits = 2
            return self._wait(client)
        if name == "setStepping":
            before = client.stepping
            client.stepping = before + 1 if arguments[0] else max(0, before - 1)
            return {"ret": [before]}
        if name not in functions:
            return {"err": f"No such function: sim.{name}"}
        try:
            return {"ret": functions[name](*arguments) or []}
        except RefusalError as error:
            return {"err": f"in function 'sim.{name}':_=NL=_{error}"}

    def _wait(self, client: Client) -> dict[str, Any]:
        if client.waits or self.endless:
            client.waits -= 1
            return {"func": "_*wait*_", "args": []}
        if self.state == RUNNING and client.stepping:
            self._advance()
        return {"ret": []}

    def _advance(self) -> None:
        if self.state == STOPPING:
            self._passes += 1
            if self._passes >= self.winding_down:
                for handle in self._kept.keys() & self.things.keys():
                    self.things[handle].place = self._kept[handle]
                self.state = STOPPED
            return
        for thing in self.things.values():
            if thing.target < 0:
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

    def startSimulation(self) -> None:
        self.state, self.steps = RUNNING, 0
        self._kept = {handle: thing.place for handle, thing in self.things.items()}

    def stopSimulation(self) -> None:
        if self.state != STOPPED:
            self.state, self._passes = STOPPING, 0
        for client in self.clients.values():
            client.stepping = 0

    def getSimulationState(self) -> list[Any]:
        return [self.state]

    def getSimulationTime(self) -> list[Any]:
        return [self.steps * TIME_STEP]

    def getSimulationTimeStep(self) -> list[Any]:
        return [TIME_STEP]

    def _add(self, thing: Thing) -> list[Any]:
        refuse(self.state != STOPPED, "this stand-in makes objects only while nothing is simulated")
        self._next += 1
        self.things[self._next] = thing
        return [self._next]

    def _thing(self, handle: Any) -> Thing:
        refuse(type(handle) is not int or handle not in self.things, "object does not exist")
        return self.things[handle]

    def createPrimitiveShape(self, kind: int, sizes: object, options: int) -> list[Any]:
        size = floats(sizes, 3)
        refuse(kind not in (3, 5) or options or not (size > 0).all(), "wrong kind, options or size")
        return self._add(Thing("Shape", size=tuple(size)))

    def createShape(self, options: int, shading: float, vertices: Any, indices: Any) -> list[Any]:
        points = floats(vertices, len(vertices)).reshape(-1, 3)
        whole = len(indices) % 3 == 0 and set(indices) <= set(range(len(points)))
        refuse(options or shading or not whole, "wrong options, shading angle or indices")
        low, high = points.min(axis=0), points.max(axis=0)
        return self._add(Thing("Shape", place=(low + high) / 2, size=tuple(high - low)))

    def loadModel(self, filename: str) -> list[Any]:
        refuse(filename != MODEL, f"file could not be opened: {filename}")
        (body,) = self._add(Thing("Quadcopter"))
        (self.things[body].target,) = self._add(Thing("target", parent=body))
        for alias in ("base", "propeller", "script"):
            self._add(Thing(alias, parent=body))
        return [body]

    def getObjectsInTree(self, base: int) -> list[Any]:
        self._thing(base)
        return [[base, *(h for h, thing in self.things.items() if thing.parent == base)]]

    def getObjectAlias(self, handle: int) -> list[Any]:
        return [self._thing(handle).alias]

    def setObjectAlias(self, handle: int, alias: str) -> None:
        self._thing(handle).alias = alias

    def setObjectInt32Param(self, handle: int, parameter: int, value: int) -> None:
        self._thing(handle).flags[FLAGS[parameter]] = value

    def setObjectPosition(self, handle: int, place: object) -> None:
        thing, place = self._thing(handle), floats(place, 3)
        for child in self.things.values():
            if child.parent == handle:
                child.place = child.place + place - thing.place
        thing.place = place

    def setObjectOrientation(self, handle: int, angles: object) -> None:
        self._thing(handle)
        floats(angles, 3)

    def setShapeColor(self, handle: int, name: str, component: int, colour: object) -> None:
        refuse(name or component not in (0, 4), "wrong name or component")
        if component:
            self._thing(handle).opacity = float(floats(colour, 1)[0])
        else:
            self._thing(handle).colour = tuple(floats(colour, 3))

    def getObjectPosition(self, handle: int) -> list[Any]:
        return [self._thing(handle).place.tolist()]

    def getObjectVelocity(self, handle: int) -> list[Any]:
        return [self._thing(handle).velocity.tolist(), [0.0, 0.0, 0.0]]

    def getStringParam(self, parameter: int) -> list[Any]:
        refuse(parameter != CONSTANTS["stringparam_resourcesdir"], "invalid parameter")
        return [RESOURCES]

    def isHandle(self, handle: int) -> list[Any]:
        return [handle in self.things]

    def removeObjects(self, handles: list[int]) -> None:
        for handle in handles:
            self._thing(handle)
            del self.things[handle]

    def addDrawingObject(self, *arguments: Any) -> list[Any]:
        kind, size, tolerance, parent, most, colour = arguments
        right = (kind, tolerance, parent) == (0x81, 0.0, -1) and size > 0 and most > 0
        refuse(not right or not floats(colour, 3).size, "wrong arguments")
        self._next += 1
        self.drawings[self._next] = []
        return [self._next]

    def addDrawingObjectItem(self, handle: int, item: object) -> list[Any]:
        refuse(handle not in self.drawings, "drawing object does not exist")
        self.drawings[handle].append(floats(item, 6).tolist())
        return [1]

    def removeDrawingObject(self, handle: int) -> None:
        refuse(handle not in self.drawings, "drawing object does not exist")
        del self.drawings[handle]


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        return int(listener.getsockname()[1])
