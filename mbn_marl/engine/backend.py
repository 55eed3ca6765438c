"""Where an engine's worlds live and move: what ``BatchEngine`` needs to know of it."""

from __future__ import annotations

from dataclasses import dataclass
from types import ModuleType
from typing import Any, Protocol

from numpy.typing import NDArray

from mbn_marl.config import NavigationConfig
from mbn_marl.engine.state import Episode, Geometry, Memory, Output

CUDA_NEEDS = (
    "device: 'cuda' needs an NVIDIA GPU, a torch that can use it (see pytorch.org), "
    "and numba-cuda: pip install 'mbn_marl[cuda]'"
)


@dataclass(frozen=True, eq=False)
class Plan:
    """What a backend is made from.

    Attributes:
        config: with the team size filled in.
        num_worlds: W.
        obs_size: entries of a robot's observation.
        autoreset: the mode's name.
        threads: of the CPU.
        geometry: NumPy tables of the field, or of each world's.
        constants: the MDP's, (1,) record.
    """

    config: NavigationConfig
    num_worlds: int
    obs_size: int
    autoreset: str
    threads: int | None
    geometry: Geometry
    constants: NDArray[Any]

    @property
    def actions_shape(self) -> tuple[int, int, int]:
        """The shape of an action, (W, n, 2)."""
        return self.num_worlds, self.geometry.masses.size, 2


class Backend(Protocol):
    """The worlds on one kind of device, and everything that differs between kinds.

    Attributes:
        plan: what it was made from.
        now: the episode that goes on in each world.
        final: the last finished ones (autoreset same-step).
        memory: what outlives or supports an episode.
        output: what the last step or reset handed out.
    """

    plan: Plan
    now: Episode
    final: Episode
    memory: Memory
    output: Output

    @property
    def xp(self) -> ModuleType:
        """The module of the arrays: numpy or torch."""

    def reseed(self, seed: int) -> None:
        """Use another seed, and number episodes and draws from 0 again."""

    def reset(self, mask: Any) -> None:
        """Begin a new episode in the worlds of a mask (W,), or in all if it is ``None``."""

    def step(self, actions: Any, active: Any) -> None:
        """Check the arguments and step the worlds."""

    def infos(self) -> Any:
        """See ``BatchEngine.infos``."""

    def states(self, *, final: bool) -> Any:
        """See ``BatchEngine.state`` and ``BatchEngine.final_state``."""

    def draw_actions(self) -> Any:
        """The seed's next random actions, a fresh array."""

    @property
    def counters(self) -> dict[str, Any]:
        """The seed and the number of the next draw, arrays (1,)."""

    def recount(self) -> None:
        """Take note that the arrays were written from outside."""

    def raise_fault(self) -> None:
        """Raise what a step has found wrong and could not raise itself."""

    def host(self, array: Any) -> NDArray[Any]:
        """A NumPy copy of an array of this backend."""


def mask_problem(name: str, shape: tuple[int, ...], dtype: object, worlds: int) -> str:
    """What to say of a mask that is not (W,) of bool."""
    return f"{name}: shape {shape} of {dtype}; allowed: ({worlds},) of bool"


def actions_shape_problem(shape: tuple[int, ...], plan: Plan) -> str:
    """What to say of actions of another shape."""
    return f"actions: shape {shape}; allowed: {plan.actions_shape} (worlds, robots, axes)"


def waiting_problem(world: int, *, was_reset: bool) -> str:
    """What to say of a step of a world that waits for a reset."""
    why = "has ended" if was_reset else "was never reset"
    return f"world {world} {why}; allowed: reset() or reset_worlds() first"


def left_out_problem(world: int) -> str:
    """What to say of a running world that a step leaves out."""
    return f"world {world} is left out of the step; allowed: only ended worlds"
