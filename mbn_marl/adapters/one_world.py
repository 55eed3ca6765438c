"""What the PettingZoo and the Gymnasium environment of one world share."""

from __future__ import annotations

from typing import Any, Unpack

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from mbn_marl.adapters.infos import Infos
from mbn_marl.adapters.rendering import LazyViewer
from mbn_marl.config import Settings
from mbn_marl.engine import BatchEngine, FieldLike
from mbn_marl.errors import StepError

RENDER_MODES = ("human", "rgb_array")


class OneWorld:
    """An engine with one world that stays ended until it is reset, and its frames.

    Attributes:
        engine: the engine; look at it, but let only the environment step and reset it.
        infos: makes the infos.
        agents: ``robot_0`` to ``robot_{n-1}``.
        viewer: draws the world.
        started: whether there has been a reset.

    Raises:
        FieldError: listing every problem with the field.
        ConfigError: listing every problem with the settings.
    """

    def __init__(
        self,
        field: FieldLike,
        render_mode: str | None,
        render_size: tuple[int, int],
        **settings: Unpack[Settings],
    ) -> None:
        self.viewer = LazyViewer(render_mode, RENDER_MODES, render_size)
        self.engine = BatchEngine(field, num_worlds=1, autoreset=False, threads=1, **settings)
        self.infos = Infos(self.engine)
        self.agents = [f"robot_{index}" for index in range(self.engine.n_robots)]
        self.started = False

    def reset(self, seed: int | None) -> NDArray[np.float32]:
        """Start an episode: a seed's first one, or the next one of the same seed.

        Returns:
            The robots' observations, ``(n, obs_size)``, fresh.
        """
        observations: NDArray[np.float32] = self.engine.reset(seed)[0].copy()
        self.started = True
        self._show()
        return observations

    def step(self, actions: NDArray[Any]) -> tuple[NDArray[np.float32], NDArray[Any], bool, bool]:
        """Move the robots.

        Args:
            actions: floats of shape ``(n, 2)``; numbers outside [-1, 1] are clipped.

        Returns:
            The robots' observations ``(n, obs_size)``, fresh, and their rewards ``(n,)``, which the
            next step overwrites; whether the episode has terminated, and whether it was truncated.

        Raises:
            ActionError: an action is not finite; nothing has moved.
            StepError: before the first reset, or after the end of an episode.
        """
        observations, rewards, terminated, truncated = self.engine.step(actions[None])
        self._show()
        return observations[0].copy(), rewards[0], bool(terminated[0]), bool(truncated[0])

    def state(self) -> NDArray[Any]:
        """The paper's state, ``(4n+1,)`` in the engine's dtype, fresh.

        Raises:
            StepError: before the first reset.
        """
        if not self.started:
            raise StepError("there is no state before the first reset(): call reset() first")
        state: NDArray[Any] = self.engine.state()[0]
        return state

    def state_space(self) -> spaces.Box:
        """The box that :meth:`state` lies in."""
        engine = self.engine
        return spaces.Box(engine.state_low, engine.state_high, dtype=engine.dtype.type)

    def _show(self) -> None:
        if self.viewer.render_mode == "human":
            self.viewer.draw(self.engine)
