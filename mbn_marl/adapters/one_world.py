"""Parts that the adapters share: one world that waits for its reset, and frames."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, Unpack

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mbn_marl.adapters.infos import Infos
from mbn_marl.config import FixedSettings, NavigationConfig, Settings, make_config
from mbn_marl.engine import BatchEngine, FieldLike, Fields
from mbn_marl.engine.validation import REAL, as_array, option_problems, reset_problems
from mbn_marl.errors import ConfigError, FieldError, ProblemsError, StepError
from mbn_marl.field import FieldSampler, load_field
from mbn_marl.render.viewer import RENDER_SIZE, Viewer, size_problems

RENDER_FPS = 30


class LazyViewer:
    """Draws worlds of an engine; imports and opens Pygame with the first frame."""

    def __init__(
        self, render_mode: str | None, allowed: Sequence[str], size: tuple[int, int] = RENDER_SIZE
    ) -> None:
        problems = size_problems("render_size", size)
        if render_mode is not None and render_mode not in allowed:
            known = ", ".join(map(repr, allowed))
            problems.append(f"render_mode: unknown mode {render_mode!r}; known: {known}, or None")
        if problems:
            raise ConfigError("environment", problems)
        self.render_mode, self._size = render_mode, (size[0], size[1])
        self._viewer: Viewer | None = None

    def draw(self, engine: BatchEngine, world: int = 0) -> NDArray[np.uint8] | None:
        """Return the frame of a world, ``(height, width, 3)`` uint8, or show it in human mode."""
        if self.render_mode is None:  # Gymnasium and PettingZoo warn too
            gymnasium.logger.warn("render() draws nothing: the environment has no render_mode")
            return None
        if self._viewer is None:
            self._viewer = Viewer(self.render_mode, self._size)
        return self._viewer.draw(engine.snapshot(world))

    def __getstate__(self) -> dict[str, Any]:
        # Another process cannot draw in this window, so a copy opens a new one.
        return {**self.__dict__, "_viewer": None}

    def close(self) -> None:
        if self._viewer is not None:
            self._viewer.close()
            self._viewer = None


class OfEngine:
    """Is shown as its engine is."""

    engine: BatchEngine

    def __repr__(self) -> str:
        return repr(self.engine).replace(type(self.engine).__name__, type(self).__name__, 1)


class OneWorld(OfEngine):
    """An engine with one world, which waits for a reset after its end, and its frames.

    Attributes:
        engine: the engine; read it, but let only the environment step and reset it.
        state_space: the box of :meth:`state`.
        render_mode: ``"human"``, ``"rgb_array"`` or ``None``.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012 - as in Gymnasium and PettingZoo
        "render_modes": ["human", "rgb_array"],
        "render_fps": RENDER_FPS,
    }

    def __init__(
        self,
        field: FieldLike | FieldSampler,
        render_mode: str | None,
        render_size: tuple[int, int],
        problems: Sequence[str] = (),
        names: Mapping[str, str] = MappingProxyType({}),
        /,
        **settings: Unpack[Settings],
    ) -> None:
        self.render_mode = render_mode
        view = render_mode, self.metadata["render_modes"], render_size
        how: dict[str, Any] = {"autoreset": False, "threads": 1}
        self._viewer, engine = make_parts(self, view, field, 1, settings, problems, names, **how)
        self.engine = engine
        self.state_space = spaces.Box(engine.state_low, engine.state_high, dtype=engine.dtype.type)
        self._infos = Infos(engine)
        self._started = False
        self._own_field = None if engine.sampler else engine.field
        self._is_given = False

    @property
    def optimal_return(self) -> float | None:
        """The proved best team return, see :func:`mbn_marl.optimum.optimal_return`."""
        optimum = float(self._infos.optima[0])
        return None if np.isnan(optimum) else optimum

    def state(self) -> NDArray[Any]:
        """Return the paper's state, ``(4n+1,)`` in raw units; before a reset a ``StepError``."""
        if not self._started:
            raise StepError("there is no state before the first reset(): call reset() first")
        state: NDArray[Any] = self.engine.state()[0]
        return state

    def render(self) -> NDArray[np.uint8] | None:
        """Return the current frame, ``(height, width, 3)`` uint8; ``None`` in human mode."""
        return self._viewer.draw(self.engine)

    def close(self) -> None:
        """Close the window, if there is one. The environment can be used again."""
        self._viewer.close()

    def _start(
        self, seed: int | None, options: Mapping[str, Any] | None = None
    ) -> NDArray[np.float32]:
        problems = option_problems(options, ("field", "starts"))
        problems += reset_problems(seed, 0)
        if problems:
            raise ConfigError("reset", problems)
        given, starts = ((options or {}).get(name) for name in ("field", "starts"))
        field = self._own_field if given is None else load_field(given)
        asked = given is not None or starts is not None
        if field is not None and (asked or self._is_given):
            self.engine.set_field(field, starts=starts)
            self._infos.read_optima(known=starts is None)
            self._is_given = asked
        elif starts is not None:
            raise ConfigError("reset", ["options: starts; allowed with a field"])
        first = fresh_seed() if seed is None and not self._started else seed
        observations: NDArray[np.float32] = self.engine.reset(first)[0].copy()
        self._started = True
        self._show()
        return observations

    def _move(self, actions: NDArray[Any]) -> tuple[NDArray[np.float32], NDArray[Any], bool, bool]:
        # The rewards are the engine's: the next step overwrites them.
        observations, rewards, terminated, truncated = self.engine.step(actions[None])
        self._show()
        return observations[0].copy(), rewards[0], bool(terminated[0]), bool(truncated[0])

    def _show(self) -> None:
        if self.render_mode == "human":
            self._viewer.draw(self.engine)


def make_parts(
    form: object,
    view: tuple[str | None, Sequence[str], tuple[int, int]],
    field: Fields,
    num_worlds: int,
    settings: Mapping[str, Any],
    problems: Sequence[str] = (),
    names: Mapping[str, str] = MappingProxyType({}),
    **options: Any,
) -> tuple[LazyViewer, BatchEngine]:
    """Return a form's viewer and engine; an error adds all problems of both to ``problems``.

    It is a FieldError if a field cannot be read, else a ConfigError.
    ``names`` are the form's own names of the engine's arguments.
    """
    found = [*problems]
    known, unknown = known_settings(settings, form)
    try:
        viewer = LazyViewer(*view)
    except ConfigError as error:
        found += error.problems
    try:
        engine = BatchEngine(field, num_worlds, **options, **known)
    except ProblemsError as error:
        own = [
            re.sub(r"\b\w+(?=:)", lambda found: names.get(found[0], found[0]), problem)
            for problem in error.problems
        ]
        if isinstance(error, FieldError):
            raise FieldError(error.source, own).beside([*found, *unknown]) from None
        found += own
    if found := [*found, *unknown]:
        raise ConfigError("environment", found)
    return viewer, engine


def flag_problems(**flags: object) -> list[str]:
    return [
        f"{name}: {value!r}; allowed: True, False"
        for name, value in flags.items()
        if not isinstance(value, bool | np.bool_)
    ]


def fresh_seed() -> int:
    """Return a seed from the system's entropy, as a first reset without one has in Gymnasium."""
    return int(np.random.SeedSequence().generate_state(1, np.uint64)[0] >> 1)


def real_numbers(value: object, shape: tuple[int, ...]) -> NDArray[np.floating[Any]] | None:
    """Return a new array of real numbers of this shape, ``None`` for any other ``value``."""
    try:
        array = as_array(value)
    except (TypeError, ValueError):
        return None
    if array.shape != shape or array.dtype.kind not in REAL:
        return None
    return array.astype(array.dtype if array.dtype.kind == "f" else np.float64)


def known_settings(settings: Mapping[str, Any], form: object) -> tuple[dict[str, Any], list[str]]:
    """Return those of an environment of this ``form``, and a problem for each other name.

    Arguments of the engine that the form sets itself are other names.
    """
    names = {*NavigationConfig.model_fields, "condition"}
    known = {name: value for name, value in settings.items() if name in names}
    try:
        make_config({name: settings[name] for name in settings if name not in names}, form)
    except ConfigError as error:
        return known, list(error.problems)
    return known, []


def central_problems(settings: Mapping[str, Any]) -> list[str]:
    """Refuse settings in which no robot sees the state that a central policy acts on."""
    allowed = "allowed: 'team', since one policy sees the whole state"
    return [f"knowledge: 'own'; {allowed}"] if settings.get("knowledge") == "own" else []


def rename_max_steps(name: str, value: int | None, settings: FixedSettings) -> list[str]:
    """Put ``value`` into ``settings`` as ``max_steps``, which another library calls ``name``.

    Returns:
        The problem if they are two numbers.
    """
    if value is not None:
        if settings.get("max_steps", value) != value:
            return [f"{name}: is max_steps, give only one"]
        settings["max_steps"] = value
    return []
