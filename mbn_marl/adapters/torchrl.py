"""TorchRL: the engine's worlds as one native, batched ``EnvBase``."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Unpack

import numpy as np
import torch
from numpy.typing import NDArray
from tensordict import TensorDict, TensorDictBase
from torchrl.data import Bounded, Categorical, Composite, Unbounded
from torchrl.envs import EnvBase

from mbn_marl.adapters.one_world import OfEngine, flag_problems, known_settings
from mbn_marl.config import Settings
from mbn_marl.engine import BatchEngine, Fields
from mbn_marl.engine.validation import as_array, reset_problems
from mbn_marl.errors import ConfigError, FieldError

GROUP = "robots"
METRICS = ("success", "collision", "rois_visited", "steps", "episode_return")
"""The metrics of an episode so far that a step can report under ``"metrics"``."""
FLAGS = ("terminated", "truncated", "done")

Rows = NDArray[Any] | torch.Tensor
"""An array of the engine, which is a tensor on CUDA."""


class NavigationEnv(OfEngine, EnvBase):
    """The decentralised form, ``num_worlds`` at once, for TorchRL's collectors and losses.

    Batch size ``[W]``, one group ``robots`` of ``n``. ``D`` is the engine's dtype.

    =============================================  ===============  =======  ==============
    entry                                          shape            dtype    range
    =============================================  ===============  =======  ==============
    ``("robots", "action")``                       ``(W, n, 2)``    float32  [-1, 1]
    ``("robots", "observation")``                  ``(W, n, obs)``  float32  see the engine
    ``("robots", "reward")`` (in ``"next"``)       ``(W, n, 1)``    D        reward units
    ``("robots", "mask")``, if some may not        ``(W, n)``       bool     robots that work
    ``"state"``, the paper's vector                ``(W, 4n + 1)``  D        see the engine
    ``"team_reward"``, the centralised reward      ``(W, 1)``       D        reward units
    ``("metrics", name)``, name of ``METRICS``     ``(W, 1)``       float32
    ``("metrics", "drawn/...")``, drawn numbers    ``(W, 1)``       float32
    ``"terminated"``, ``"truncated"``, ``"done"``  ``(W, 1)``       bool
    =============================================  ===============  =======  ==============

    - ``"state"`` is ``(W, 5n + 1)``, with headings before the visit code, if a robot has a heading.
      With ``failures``, or if teams vary, n flags of the robots that do not work come right before
      it.
    - A robot that has failed is masked from the step on in which it does: its actions do nothing,
      and but for ``reward_sharing="team"`` its rewards are 0 as long as another one works. So is
      one that is not in the team of the episode: its observations and rewards are 0.
    - ``terminated`` is success or collision, ``truncated`` is the step limit, ``done`` is either.
      The robots of a world end together, so these are at the root, as in TorchRL's VMAS
      environments; a loss on the robots' rewards wants them expanded to ``(W, n, 1)``.
    - ``team_reward`` and ``metrics`` describe the step that led here and are zero after a reset,
      but for the numbers that the episode has drawn.
      They are observations for TorchRL, so that ``reward_key`` stays the robots' reward.
    - Worlds that have ended wait for a reset of their rows (``"_reset"``), which collectors and
      ``rollout`` do themselves; ``"_step"`` masks, as ``rollout(break_when_all_done=True)`` writes
      them, leave ended worlds where they are.
    - Every tensor is the caller's own: nothing is overwritten by a later step.
    - ``state``, ``team_reward`` and ``metrics`` cost time; leave out those that nothing reads.

    Args:
        field: a catalogue name, a file, a ``Field``, or a list of them (world ``w`` gets number
            ``w`` modulo their count); or a ``FieldSampler``, which draws one for each episode.
        num_worlds: ``W``.
        seed: of all worlds, until ``set_seed()`` gives another; each has its stream.
        device: where the tensors live. On CUDA, which has to be torch's current device, the engine
            computes too (see ``BatchEngine``); for any other device it computes on the CPU.
        threads: of the engine on the CPU; ``None`` lets it choose.
        state: give the entry ``"state"``.
        team_reward: give the entry ``"team_reward"``.
        metrics: the names of the metrics to give, of ``METRICS``; none leaves the entry out.
        **settings: the fields of ``NavigationConfig``.

    Attributes:
        engine: the engine; look at it, but let only this object step and reset it.
        n_agents: robots in a world.
        group_map: the names of the robots in each group, as TorchRL's other environments give it.

    Raises:
        FieldError: the field is not valid.
        ConfigError: a setting or a metric's name is not valid.

    Source:
        Choton, Woods, Hsu, section 3: ``"state"`` and ``"team_reward"``.
    """

    def __init__(
        self,
        field: Fields,
        num_worlds: int,
        *,
        seed: int = 0,
        device: torch.device | str | None = "cpu",
        threads: int | None = None,
        state: bool = True,
        team_reward: bool = True,
        metrics: Sequence[str] = METRICS,
        **settings: Unpack[Settings],
    ) -> None:
        problems, names = list[str](), [*metrics] if isinstance(metrics, Iterable) else [metrics]
        if not all(name in METRICS and names.count(name) == 1 for name in names):
            allowed = f"each at most once of {', '.join(METRICS)}"
            problems.append(f"metrics: {metrics!r}; allowed: {allowed}")
        problems += flag_problems(state=state, team_reward=team_reward)
        where = torch.device("cpu" if device is None else device)
        known, unknown = known_settings(settings, self)
        try:
            engine = BatchEngine(
                field,
                num_worlds,
                seed=seed,
                autoreset="disabled",
                device="cuda" if where.type == "cuda" else "cpu",
                threads=threads,
                **known,
            )
        except FieldError as error:
            raise error.beside([*problems, *unknown]) from None
        except ConfigError as error:
            problems += error.problems
        if problems := [*problems, *unknown]:
            raise ConfigError("NavigationEnv", problems)
        super().__init__(device=where, batch_size=[num_worlds])
        self.engine = engine
        self._give = as_array if engine.device == "cpu" else torch.as_tensor
        self._state, self._team_reward, self._measures = state, team_reward, tuple(names)
        self._drawn = tuple(f"drawn/{name}" for name in self.engine.config.drawn if names)
        self._metrics = self._measures + self._drawn
        self.n_agents = self.engine.n_robots
        self.group_map = {GROUP: [f"robot_{i}" for i in range(self.n_agents)]}
        self._next_seed: int | None = None
        self._loaded = False
        self._make_specs()

    def _make_specs(self) -> None:
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
        bounds, shape = (
            (engine.observation_low, engine.observation_high),
            (*robots, engine.obs_size),
        )
        self.observation_spec = group("observation", self._box(*bounds, shape, torch.float32))
        if engine.may_rest:
            mask = Categorical(2, shape=robots, dtype=torch.bool, device=self.device)
            self.observation_spec[GROUP, "mask"] = mask
        if self._state:
            low, high = engine.state_low, engine.state_high
            self.observation_spec["state"] = self._box(low, high, (*worlds, len(low)), dtype)
        if self._team_reward:
            self.observation_spec["team_reward"] = scalar(worlds, dtype)
        if self._metrics:
            columns = {name: scalar(worlds, torch.float32) for name in self._metrics}
            self.observation_spec["metrics"] = Composite(columns, shape=worlds, device=self.device)
        flag = Categorical(2, shape=(*worlds, 1), dtype=torch.bool, device=self.device)
        flags = {name: flag.clone() for name in FLAGS}
        self.done_spec = Composite(flags, shape=worlds, device=self.device)

    def _box(self, low: Any, high: Any, shape: tuple[int, ...], dtype: torch.dtype) -> Bounded:
        bounds = [torch.as_tensor(bound, dtype=dtype).expand(shape) for bound in (low, high)]
        return Bounded(*bounds, shape=shape, dtype=dtype, device=self.device)

    def _set_seed(self, seed: int | None) -> None:
        if problems := reset_problems(seed, 0):
            raise ConfigError("set_seed", problems)
        self._next_seed, self._loaded = seed, False

    def _reset(self, tensordict: TensorDictBase | None = None, **_: Any) -> TensorDict:
        mask = None if tensordict is None else tensordict.get("_reset", None)
        if mask is not None and not mask.all():
            observations = self.engine.reset_worlds(self._give(mask.reshape(-1)))
        else:
            if self._loaded:
                ended = torch.from_numpy(~self.engine.running).to(self.device)
                observations = self.engine.reset_worlds(self._give(ended))
            else:
                observations = self.engine.reset(seed=self._next_seed)
            self._next_seed, self._loaded = None, False
        flags = torch.zeros(self.engine.num_worlds, dtype=torch.bool, device=self.device)
        return self._entries(observations, flags, flags)

    def save_state(self) -> dict[str, NDArray[Any]]:
        return self.engine.save_state()

    def load_state(self, saved: Mapping[str, NDArray[Any]]) -> None:
        """Continue with the next step or full reset exactly where ``saved`` was taken.

        That reset begins new episodes only in the worlds that had ended. A state of another
        environment is an ``MbnError``.
        """
        self.engine.load_state(saved)
        self._loaded = True

    def maybe_reset(self, tensordict: TensorDictBase) -> TensorDictBase:
        # The result is that of TorchRL's own, which would merge every entry row by row; the engine
        # already has the current rows of all worlds side by side.
        if self.any_done(tensordict):
            ended = tensordict.pop("_reset").reshape(-1)
            observations = self.engine.reset_worlds(self._give(ended))
            none = torch.zeros_like(ended)
            tensordict.update(self._entries(observations, none, none))
        return tensordict

    def _step(self, tensordict: TensorDictBase) -> TensorDict:
        mask = tensordict.get("_step", None)
        active = None if mask is None else self._give(mask.reshape(-1))
        actions = self._give(tensordict.get((GROUP, "action")))
        observations, rewards, *ended = self.engine.step(actions, active)
        self._loaded = False
        made = self._entries(observations, *map(self._tensor, ended))
        made[GROUP, "reward"] = self._tensor(rewards).unsqueeze(-1)
        return made

    def _rows(self) -> torch.Tensor:
        """Return the metrics and the drawn numbers, (count, W) float32; there is at least one."""
        known = [*self.engine.metrics(self._measures).values()]
        known += self.engine.drawn().values() if self._drawn else []
        if self.engine.device == "cuda":
            return torch.stack([torch.as_tensor(row).float() for row in known])
        return torch.from_numpy(np.array(known, np.float32)).to(self.device)

    def _entries(
        self, observations: Rows, terminated: torch.Tensor, truncated: torch.Tensor
    ) -> TensorDict:
        worlds = self.batch_size
        robots = {"observation": self._tensor(observations)}
        if self.engine.may_rest:
            robots["mask"] = self._fresh(self.engine.working)
        flags = (terminated, truncated, terminated | truncated)
        entries: dict[str, Any] = {
            name: flag.unsqueeze(-1) for name, flag in zip(FLAGS, flags, strict=True)
        }
        entries[GROUP] = self._unchecked(robots, torch.Size((*worlds, self.n_agents)))
        if self._state:
            entries["state"] = self._fresh(self.engine.state())
        if self._team_reward:
            entries["team_reward"] = self._tensor(self.engine.team_rewards).unsqueeze(-1)
        if self._metrics:
            columns = self._rows().unsqueeze(-1).unbind(0)
            metrics = dict(zip(self._metrics, columns, strict=True))
            entries["metrics"] = self._unchecked(metrics, worlds)
        return self._unchecked(entries, worlds)

    def _unchecked(self, entries: dict[str, Any], size: torch.Size) -> TensorDict:
        # The entries have this batch size and device by construction.
        made: TensorDict = TensorDict._new_unsafe(entries, size, device=self.device)
        return made

    def _fresh(self, array: Rows) -> torch.Tensor:
        return torch.as_tensor(array, device=self.device)

    def _tensor(self, array: Rows) -> torch.Tensor:
        # The engine overwrites its arrays at the next step.
        if isinstance(array, torch.Tensor):
            return array.clone()
        return torch.from_numpy(array.copy()).to(self.device)
