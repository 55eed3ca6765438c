"""The base of the environments with one world: PettingZoo's and Gymnasium's."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Unpack

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mbn_marl.adapters.infos import Infos
from mbn_marl.adapters.rendering import RENDER_FPS, LazyViewer
from mbn_marl.config import FixedSettings, NavigationConfig, Settings, make_config
from mbn_marl.engine import BatchEngine, FieldLike
from mbn_marl.engine.validation import option_problems, reset_problems
from mbn_marl.errors import ConfigError, StepError
from mbn_marl.field import FieldSampler, load_field


class OneWorld:
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
        **settings: Unpack[Settings],
    ) -> None:
        check_names(settings)
        self.render_mode = render_mode
        self._viewer = LazyViewer(render_mode, self.metadata["render_modes"], render_size)
        self.engine = engine = BatchEngine(field, 1, autoreset=False, threads=1, **settings)
        self.state_space = spaces.Box(engine.state_low, engine.state_high, dtype=engine.dtype.type)
        self._infos = Infos(engine)
        self._started = False
        self._own_field = None if engine.sampler else engine.field
        self._is_given = False

    def __repr__(self) -> str:
        return repr(self.engine).replace(type(self.engine).__name__, type(self).__name__, 1)

    @property
    def optimal_return(self) -> float | None:
        """The proved best team return, see :func:`mbn_marl.optimum.optimal_return`."""
        optimum = float(self._infos.optima[0])
        return None if np.isnan(optimum) else optimum

    def state(self) -> NDArray[Any]:
        """Return the paper's state, ``(4n+1,)`` in the engine's dtype, raw units, a fresh array.

        It is ``(5n+1,)``, with headings before the visit code, if a robot has a heading; with
        ``failures``, or if teams vary, n flags of those that do not work come right before it.

        Raises:
            StepError: before the first reset.
        """
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
        """Start an episode; return fresh observations ``(n, obs_size)``.

        Raises:
            ConfigError: the seed or an option is not allowed; nothing has changed.
            FieldError: the field of the options is invalid or unknown; nothing has changed.
        """
        problems = option_problems(options, ("field", "starts"))
        problems += [] if seed is None else reset_problems(seed, 0)
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
        observations: NDArray[np.float32] = self.engine.reset(seed)[0].copy()
        self._started = True
        self._show()
        return observations

    def _move(self, actions: NDArray[Any]) -> tuple[NDArray[np.float32], NDArray[Any], bool, bool]:
        """Step with actions ``(n, 2)``.

        Return fresh observations ``(n, obs_size)``, rewards ``(n,)`` that the next step overwrites,
        terminated and truncated.
        """
        observations, rewards, terminated, truncated = self.engine.step(actions[None])
        self._show()
        return observations[0].copy(), rewards[0], bool(terminated[0]), bool(truncated[0])

    def _show(self) -> None:
        if self.render_mode == "human":
            self._viewer.draw(self.engine)


def check_names(settings: Mapping[str, Any]) -> None:
    """Check that no setting is an argument of the engine that an environment sets itself.

    Raises:
        ConfigError: naming all problems of the settings, if there is one.
    """
    if not settings.keys() <= {*NavigationConfig.model_fields, "condition"}:
        make_config(settings)


def rename_max_steps(name: str, value: int | None, settings: FixedSettings) -> None:
    """Put ``value`` into ``settings`` as ``max_steps``, which another library calls ``name``.

    Raises:
        ConfigError: both are given, and differ.
    """
    if value is not None:
        if settings.get("max_steps", value) != value:
            raise ConfigError("environment", [f"{name}: is max_steps, give only one"])
        settings["max_steps"] = value
