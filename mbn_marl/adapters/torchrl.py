"""TorchRL: the engine's worlds as one native, batched ``EnvBase``."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Unpack

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from mbn_marl.config import Settings
from mbn_marl.engine import BatchEngine, FieldLike

GROUP = "robots"
METRICS = ("success", "collision", "rois_visited", "steps", "episode_return")
"""The metrics of an episode so far that every step reports under ``"metrics"``."""

Rows = NDArray[Any] | torch.Tensor
"""An array of the engine, which is a tensor on CUDA."""


class NavigationEnv(EnvBase):
    """The decentralised form, ``num_worlds`` at once, for TorchRL's collectors and losses.

    Batch size ``[W]``, one group ``robots`` of ``n``. ``D`` is the engine's dtype.

    =============================================  ===============  =======  ==============
    entry                                          shape            dtype    range
    =============================================  ===============  =======  ==============
    ``("robots", "action")``                       ``(W, n, 2)``    float32  [-1, 1]
    ``("robots", "observation")``                  ``(W, n, obs)``  float32  see the engine
    ``("robots", "reward")`` (in ``"next"``)       ``(W, n, 1)``    D        reward units
    ``"state"``, the paper's vector                ``(W, 4n + 1)``  D        see the engine
    ``"team_reward"``, the centralised reward      ``(W, 1)``       D        reward units
    ``("metrics", name)``, name of ``METRICS``     ``(W, 1)``       float32
    ``"terminated"``, ``"truncated"``, ``"done"``  ``(W, 1)``       bool
    =============================================  ===============  =======  ==============

    - ``terminated`` is success or collision, ``truncated`` is the step limit, ``done`` is either.
      The robots of a world end together, so these are at the root, as in TorchRL's VMAS
      environments; a loss on the robots' rewards wants them expanded to ``(W, n, 1)``.
    - ``team_reward`` and ``metrics`` describe the step that led here and are zero after a reset.
      They are observations for TorchRL, so that ``reward_key`` stays the robots' reward.
    - Worlds that have ended wait for a reset of their rows (``"_reset"``), which collectors and
      ``rollout`` do themselves; ``"_step"`` masks, as ``rollout(break_when_all_done=True)`` writes
      them, leave ended worlds where they are.
    - Every tensor is the caller's own: nothing is overwritten by a later step.

    Args:
        field: a catalogue name, a file, a ``Field``, or a list of them (world ``w`` gets number
            ``w`` modulo their count).
        num_worlds: ``W``.
        seed: of all worlds, until ``set_seed()`` gives another; each has a stream of its own.
        device: where the tensors live. On torch's current CUDA device the engine computes too (see
            ``BatchEngine``); for any other device it computes on the CPU.
        threads: of the engine on the CPU; ``None`` takes as many as there are cores.
        **settings: the fields of ``NavigationConfig``.

    Attributes:
        engine: the engine; look at it, but let only this object step and reset it.
        n_agents: robots in a world.
        group_map: the names of the robots in each group, as TorchRL's other environments give it.

    Raises:
        FieldError: the field is not valid.
        ConfigError: a setting is not valid.

    Source:
        Choton, Woods, Hsu, section 3: ``"state"`` and ``"team_reward"``.
    """

    def __init__(
        self,
        field: FieldLike | Sequence[FieldLike],
        num_worlds: int,
        *,
        seed: int = 0,
        device: torch.device | str = "cpu",
        threads: int | None = None,
        **settings: Unpack[Settings],
    ) -> None:
        super().__init__(device=device, batch_size=[num_worlds])
        self.engine = BatchEngine(
            field,
            num_worlds,
            seed=seed,
            autoreset="disabled",
            device="cuda" if self.device.type == "cuda" else "cpu",
            threads=threads,
            **settings,
        )
        self._give = _to_numpy if self.engine.device == "cpu" else _as_it_is
        self.n_agents = self.engine.n_robots
        self.group_map = {GROUP: [f"robot_{i}" for i in range(self.n_agents)]}
        self._next_seed: int | None = None
        self._running = (torch.zeros(num_worlds, dtype=torch.bool, device=self.device),) * 2
        self._make_specs()

    def _make_specs(self) -> None:
        """Declare every entry of the class's table."""
        engine = self.engine
        worlds, robots = (engine.num_worlds,), (engine.num_worlds, engine.n_robots)
        dtype = torch.from_numpy(np.empty(0, engine.dtype)).dtype

        def scalar(shape: tuple[int, ...], dtype: torch.dtype) -> Unbounded:
            return Unbounded(shape=(*shape, 1), dtype=dtype, device=self.device)

        def group(name: str, spec: Any) -> Composite:
            entries = Composite({name: spec}, shape=robots, device=self.device)
            return Composite({GROUP: entries}, shape=worlds, device=self.device)

        self.action_spec = group("action", self._box(-1.0, 1.0, (*robots, 2), torch.float32))
        self.reward_spec = group("reward", scalar(robots, dtype))
        observation = self._box(
            engine.observation_low,
            engine.observation_high,
            (*robots, engine.obs_size),
            torch.float32,
        )
        state_size = engine.state_low.shape[0]
        self.observation_spec = group("observation", observation).update(
            {
                "state": self._box(
                    engine.state_low, engine.state_high, (*worlds, state_size), dtype
                ),
                "team_reward": scalar(worlds, dtype),
                "metrics": Composite(
                    {name: scalar(worlds, torch.float32) for name in METRICS},
                    shape=worlds,
                    device=self.device,
                ),
            }
        )
        flag = Categorical(2, shape=(*worlds, 1), dtype=torch.bool, device=self.device)
        self.done_spec = Composite(
            {name: flag.clone() for name in ("done", "terminated", "truncated")},
            shape=worlds,
            device=self.device,
        )

    def _box(
        self,
        low: NDArray[Any] | float,
        high: NDArray[Any] | float,
        shape: tuple[int, ...],
        dtype: torch.dtype,
    ) -> Bounded:
        """A bounded spec of ``shape``, its bounds repeated over the leading dimensions."""
        bounds = [torch.as_tensor(bound, dtype=dtype).expand(shape) for bound in (low, high)]
        return Bounded(*bounds, shape=shape, dtype=dtype, device=self.device)

    def _set_seed(self, seed: int | None) -> None:
        """Seed all worlds from the next full reset on."""
        self._next_seed = seed

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDict:
        """Reset the worlds that ``"_reset"`` marks, or all of them."""
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is None or mask.all():
            observations = self.engine.reset(seed=self._next_seed)
            self._next_seed = None
        else:
            observations = self.engine.reset_worlds(self._give(mask.reshape(-1)))
        return self._entries(observations, {}, *self._running)

    def maybe_reset(self, tensordict: TensorDictBase) -> TensorDictBase:
        """Reset the worlds that ``tensordict`` says are done, in place.

        ``step_and_maybe_reset`` calls it with the entries of the class's table, ``(W, 1)`` flags
        among them.

        The result is that of TorchRL's own ``maybe_reset``, which would merge every entry row by
        row; the engine already has the current rows of all worlds side by side.
        """
        if self.any_done(tensordict):
            ended = tensordict.pop("_reset")
            past = tensordict.select("team_reward", "metrics", *self.done_keys)
            tensordict.update(past.apply(lambda entry: entry.masked_fill(ended, 0)))
            observations = self.engine.reset_worlds(self._give(ended.reshape(-1)))
            tensordict[GROUP, "observation"] = self._tensor(observations)
            tensordict["state"] = self._tensor(self.engine.state())
        return tensordict

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        """Step all worlds, or those that ``"_step"`` marks."""
        mask = tensordict.get("_step", None)
        active = None if mask is None else self._give(mask.reshape(-1))
        actions = self._give(tensordict.get((GROUP, "action")))
        observations, rewards, terminated, truncated = self.engine.step(actions, active)
        robots = {"reward": self._tensor(rewards).unsqueeze(-1)}
        return self._entries(observations, robots, terminated, truncated)

    def _entries(
        self,
        observations: Rows,
        robots: dict[str, torch.Tensor],
        terminated: Rows,
        truncated: Rows,
    ) -> TensorDict:
        """The tensordict of a step or a reset, with ``robots`` added to the group's entries."""
        engine, worlds = self.engine, self.batch_size
        metrics = engine.metrics()
        robots["observation"] = self._tensor(observations)
        entries = {
            GROUP: TensorDict(robots, (*worlds, self.n_agents), device=self.device),
            "state": self._tensor(engine.state()),
            "team_reward": self._column(engine.team_rewards),
            "metrics": TensorDict(
                {name: self._column(metrics[name]).to(torch.float32) for name in METRICS},
                worlds,
                device=self.device,
            ),
            "terminated": self._column(terminated),
            "truncated": self._column(truncated),
            "done": self._column(terminated | truncated),
        }
        return TensorDict(entries, worlds, device=self.device)

    def _tensor(self, array: Rows) -> torch.Tensor:
        """A copy of an engine's array, which the engine will overwrite, as a tensor."""
        return torch.as_tensor(array).clone().to(self.device)

    def _column(self, array: Rows) -> torch.Tensor:
        """A copy of an array ``(W,)`` as a tensor ``(W, 1)``."""
        return self._tensor(array).unsqueeze(-1)


def _to_numpy(tensor: torch.Tensor) -> NDArray[Any]:
    """The numbers of a tensor of any device, not to be written to."""
    array: NDArray[Any] = tensor.numpy(force=True)
    return array


def _as_it_is(tensor: torch.Tensor) -> torch.Tensor:
    """The tensor, which lies where the engine wants it."""
    return tensor
