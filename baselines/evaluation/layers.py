"""A trained network as plain arrays, for programs that have none of the libraries it comes from.

:func:`run_arrays` needs NumPy alone: a robot can take this file along. It runs in torch as well,
where ``xp`` is torch, which is how the other formats are made.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

Activation = Literal["tanh", "relu", "clip"]
Arrays = dict[str, NDArray[Any]]

LIMITS = {"relu": (0.0, None), "clip": (-1.0, 1.0)}
LEAST = 1e-30
"""Added to a sum of weights, which is 0 where no ROI is left."""
SHORT = 1e-6
"""Added to the square of a length, units, so that none is 0."""


@dataclass(frozen=True)
class Layers:
    """k networks, one for each of k groups of rows, from raw observations to mean actions.

    A team's rows are its robots, or the team itself for a network that acts for all. They are
    normalised, ``clip((rows - mean) / scale)``, in the precision of ``mean``.

    Attributes:
        mean: (k, 1, inputs).
        scale: (k, 1, inputs), > 0.
        clip: of normalised rows, > 0; infinite: they are not clipped.
        weights: of each layer, (k, inputs, outputs) float32.
        biases: of each layer, (k, 1, outputs) float32.
        activations: of each layer; the last brings actions into [-1, 1].
    """

    mean: NDArray[np.floating]
    scale: NDArray[np.floating]
    clip: float
    weights: tuple[NDArray[np.float32], ...]
    biases: tuple[NDArray[np.float32], ...]
    activations: tuple[Activation, ...]

    def arrays(self) -> Arrays:
        """Return all of it by name; :func:`run_arrays` needs nothing else."""
        named: Arrays = {"mean": self.mean, "scale": self.scale}
        named |= {"clip": np.array(self.clip), "activations": np.array(self.activations)}
        for layer, (weight, bias) in enumerate(zip(self.weights, self.biases, strict=True)):
            named |= {f"weight_{layer}": weight, f"bias_{layer}": bias}
        return named


@dataclass(frozen=True)
class Sets:
    """A network over sets, from raw ``entities`` to mean actions (:mod:`..torchrl.entities`).

    Attributes:
        named: ``sizes``, entries of the own token, of another robot's and of an ROI's; for each of
            ``own``, ``robot`` and ``roi`` the columns ``_pairs`` (2, k) that turn and ``_rest``
            that do not; ``next``, the columns by which the next ROI is found; ``rays`` (8, 8), and
            the ``first_ray``; ``turns``, whether observations are turned; ``rivals`` (4, 2), what
            is read of them, and their ``scales`` (2,), only where no assignment is seen; and of
            each layer the weight (inputs, outputs) and the ``_bias`` (1, outputs), float32.
        clip: infinite, since tokens are not normalised.
    """

    named: Arrays
    clip: float = math.inf

    def arrays(self) -> Arrays:
        """Return all of it by name."""
        return self.named


Plain = Layers | Sets
"""What :func:`run_arrays` runs."""


@runtime_checkable
class HasLayers(Protocol):
    """A policy that can be exported."""

    def layers(self) -> Plain:
        """Return its network.

        Raises:
            ConfigError: the network has parts that :class:`Layers` has not.
        """
        ...


def run_arrays(file: Arrays, seen: Any, xp: Any = np) -> Any:
    """Return mean actions (W, n, 2), float32, of ``arrays()`` for what W worlds show."""
    if "sizes" in file:
        return _run_sets(file, seen, xp)
    networks, _, inputs = file["mean"].shape
    rows = seen.reshape(-1, networks, inputs).swapaxes(0, 1)
    limit = float(file["clip"])
    flow = xp.clip((rows - file["mean"]) / file["scale"], -limit, limit)
    flow = xp.asarray(flow, dtype=xp.float32)
    for layer, activation in enumerate(file["activations"]):
        flow = flow @ file[f"weight_{layer}"] + file[f"bias_{layer}"]
        name = str(activation)
        flow = xp.tanh(flow) if name == "tanh" else xp.clip(flow, *LIMITS[name])
    return flow.swapaxes(0, 1).reshape(seen.shape[0], -1, 2)


def _run_sets(file: Arrays, seen: Any, xp: Any) -> Any:
    """Return the actions of :class:`Sets` for observations (W, n, size) of any n and m."""
    (own_size, robot_size, roi_size), n = file["sizes"].tolist(), seen.shape[1]
    rows, start = seen.reshape(-1, seen.shape[2]), own_size + (n - 1) * robot_size
    count, own = rows.shape[0], rows[:, None, :own_size]
    robots = rows[:, own_size:start].reshape(count, n - 1, robot_size)
    rois = rows[:, start:].reshape(count, -1, roi_size)
    each = xp.arange(count)
    left, away, *order, x, y = file["next"].tolist()
    rank = rois[..., left] * (2.0 - rois[..., away])
    for column in order:
        rank = rank + 2.0 * rois[..., column]
    toward = rois[each, rank.argmax(1)][:, [x, y]] * float(file["turns"])
    sign = xp.where(toward < 0.0, -xp.ones_like(toward), xp.ones_like(toward))
    swap = abs(toward[:, 1:]) > abs(toward[:, :1])

    def turned(kind: str, tokens: Any) -> Any:
        columns, rest = file[f"{kind}_pairs"], file[f"{kind}_rest"]
        x = tokens[..., columns[0]] * sign[:, None, :1]
        y = tokens[..., columns[1]] * sign[:, None, 1:]
        first, second = xp.where(swap[:, None], y, x), xp.where(swap[:, None], x, y)
        return xp.concatenate([tokens[..., rest], first, second], -1)

    def found(kind: str, tokens: Any, *more: Any) -> Any:
        """Return the features of tokens, 0 where nothing is there."""
        flow = xp.concatenate([turned(kind, tokens), *more], -1)
        flow = flow.reshape(count * tokens.shape[1], flow.shape[2])
        flow = _layer(file, f"{kind}.2", _layer(file, f"{kind}.0", flow))
        return flow.reshape(count, tokens.shape[1], flow.shape[1]) * (tokens[..., :1] != 0.0)

    element = (sign[:, 0] < 0) + 2 * (sign[:, 1] < 0) + 4 * swap[:, 0]
    rays = own[each[:, None], 0, int(file["first_ray"]) + file["rays"][element]]
    mine = xp.concatenate([turned("own", own)[:, 0], rays], -1)
    alone, left = "rivals" in file, rois[..., :1] != 0.0  # alone: without an assignment
    features = found("roi", rois, *([_rivals(file, own, robots, rois, xp)] if alone else []))
    flow = _layer(file, "own.0", mine)
    others = xp.concatenate([0.0 * flow[:, None], found("robot", robots)], 1)
    pooled = _pooled(features, left, _linear(file, "query", mine), xp)
    flow = _layer(file, "mix.0", xp.concatenate([flow, *pooled, xp.amax(others, 1)], -1))
    flow = flow + _layer(file, "deep.0", flow)
    if alone:
        features = _linear(file, "again", features) + _linear(file, "tell", flow)[:, None]
        features = features * (features > 0.0) * left
        pooled = _pooled(features, left, _linear(file, "ask", flow), xp)
        flow = flow + _layer(file, "whole.0", xp.concatenate([flow, *pooled], -1))
    action = _linear(file, "head", flow)
    action = xp.where(swap, action[:, [1, 0]], action) * sign
    action = xp.clip(action, -1.0, 1.0) * (rows != 0.0).any(-1)[:, None]
    return action.reshape(-1, n, 2)


def _linear(file: Arrays, name: str, flow: Any) -> Any:
    return flow @ file[name] + file[f"{name}_bias"]


def _layer(file: Arrays, name: str, flow: Any) -> Any:
    flow = _linear(file, name, flow)
    return flow * (flow > 0.0)


def _pooled(features: Any, left: Any, query: Any, xp: Any) -> list[Any]:
    """Return the greatest of the ROIs' features (B, m, width), and their mean by attention."""
    score = (features * query[:, None]).sum(-1)[..., None] / math.sqrt(query.shape[-1])
    weight = xp.exp(score - xp.amax(score, 1)[:, None]) * left
    weight = weight / (weight.sum(1)[:, None] + LEAST)
    return [xp.amax(features, 1), (weight * features).sum(1)]


def _rivals(file: Arrays, own: Any, robots: Any, rois: Any, xp: Any) -> Any:
    """Return the greatest features of the other robots for each ROI (B, m, width)."""
    at_roi, at_robot, faster, speed = file["rivals"]
    near, far = file["scales"].tolist()
    scaled = rois[..., at_roi], robots[..., at_robot]
    to_roi, to_robot = (far * x / (1.0 - abs(x)) for x in scaled)
    ways = to_roi[:, :, None] - to_robot[:, None]
    length, mine = (((x * x).sum(-1)[..., None] + SHORT) ** 0.5 for x in (ways, to_roi))
    moves = (2.0 * robots[..., faster] + own[..., speed])[:, None]
    more = length - mine[:, :, None]
    seen = [length / (length + far), length / (length + near), more / (abs(more) + near)]
    seen += [(ways * moves).sum(-1)[..., None] / length]
    features = _layer(file, "rivals.seen.0", xp.concatenate(seen, -1)) * robots[:, None, :, :1]
    return xp.amax(features, 2) if robots.shape[1] else features.sum(2)
