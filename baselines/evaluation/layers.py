"""A trained network as plain arrays, for programs that have none of the libraries it comes from."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

Activation = Literal["tanh", "relu", "clip"]
Arrays = dict[str, NDArray[Any]]

ACTIVATIONS: Mapping[str, Callable[[NDArray[np.float32]], NDArray[np.float32]]] = {
    "tanh": np.tanh,
    "relu": lambda flow: np.maximum(flow, 0),
    "clip": lambda flow: np.clip(flow, -1, 1),
}


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


@runtime_checkable
class HasLayers(Protocol):
    """A policy that can be exported."""

    def layers(self) -> Layers:
        """Return its network.

        Raises:
            ConfigError: the network has parts that :class:`Layers` has not.
        """
        ...


def run_arrays(file: Arrays, seen: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return mean actions (W, n, 2) of :meth:`Layers.arrays` for W worlds, as the page has it."""
    networks, _, inputs = file["mean"].shape
    rows = seen.reshape(-1, networks, inputs).swapaxes(0, 1)
    flow: NDArray[Any] = (rows - file["mean"]) / file["scale"]
    flow = np.clip(flow, -file["clip"], file["clip"]).astype(np.float32)
    for layer, activation in enumerate(file["activations"]):
        flow = ACTIVATIONS[str(activation)](flow @ file[f"weight_{layer}"] + file[f"bias_{layer}"])
    actions: NDArray[np.float32] = flow.swapaxes(0, 1).reshape(len(seen), -1, 2)
    return actions
