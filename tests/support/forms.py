"""The forms of the environment with one interface: reset and step one world."""

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mbn_marl import BatchEngine, Field, centralized_env, parallel_env
from mbn_marl.adapters.infos import GAP, UNDEFINED
from mbn_marl.engine import INFO_COLUMNS, REWARD_TERMS


@dataclass
class Outcome:
    state: NDArray[Any]
    team_reward: float
    terminated: bool
    truncated: bool
    infos: list[dict[str, float]]
    rewards: list[float] = field(default_factory=list)
    observations: list[NDArray[np.float32]] = field(default_factory=list)

    @property
    def ended(self) -> bool:
        return self.terminated or self.truncated


def first_seed(env: Any) -> int | None:
    return 0 if env.engine.episode_numbers[0] < 0 else None


class ParallelForm:
    def __init__(self, field: Field | str, **settings: Any) -> None:
        self.env = parallel_env(field, **settings)

    def reset(self) -> NDArray[Any]:
        observations, _ = self.env.reset(seed=first_seed(self.env))
        self._check(observations)
        return self.env.state()

    def step(self, actions: NDArray[np.float32]) -> Outcome:
        agents = self.env.possible_agents
        observations, rewards, terminated, truncated, infos = self.env.step(
            dict(zip(agents, actions, strict=True))
        )
        self._check(observations)
        assert len(set(terminated.values())) == len(set(truncated.values())) == 1
        shares = [rewards[agent] for agent in agents]
        return Outcome(
            state=self.env.state(),
            team_reward=self.team_reward(shares),
            terminated=terminated["robot_0"],
            truncated=truncated["robot_0"],
            infos=[infos[agent] for agent in agents],
            rewards=shares,
            observations=[observations[agent] for agent in agents],
        )

    @staticmethod
    def team_reward(shares: list[float]) -> float:
        return sum(shares)

    def _check(self, observations: dict[str, NDArray[np.float32]]) -> None:
        assert list(observations) == self.env.possible_agents
        for agent, observation in observations.items():
            assert self.env.observation_space(agent).contains(observation)


class TeamSharingForm(ParallelForm):
    def __init__(self, field: Field | str, **settings: Any) -> None:
        super().__init__(field, reward_sharing="team", **settings)

    @staticmethod
    def team_reward(shares: list[float]) -> float:
        assert len(set(shares)) == 1
        return shares[0]


class CentralizedForm:
    def __init__(self, field: Field | str, **settings: Any) -> None:
        self.env = centralized_env(field, **settings)

    def reset(self) -> NDArray[Any]:
        state, _ = self.env.reset(seed=first_seed(self.env))
        assert self.env.observation_space.contains(state)
        return state

    def step(self, actions: NDArray[np.float32]) -> Outcome:
        state, reward, terminated, truncated, info = self.env.step(actions)
        assert self.env.observation_space.contains(state)
        return Outcome(state, reward, terminated, truncated, [info])


class BatchForm:
    """One world of a ``BatchEngine`` that restarts ended worlds; others get other actions."""

    def __init__(self, field: Any, num_worlds: int, world: int, **settings: Any) -> None:
        self.engine = BatchEngine(field, num_worlds, **settings)
        self.world = world
        self._fresh = False

    def reset(self) -> NDArray[Any]:
        if not self._fresh:
            self._check(self.engine.reset())
        self._fresh = False
        shot = self.engine.snapshot(self.world)
        assert (shot.step, shot.success, shot.collision) == (0, False, False)
        return self.engine.state()[self.world]

    def step(self, actions: NDArray[np.float32]) -> Outcome:
        engine, world = self.engine, self.world
        batch = engine.sample_actions()
        batch[world] = actions
        observations, rewards, terminated, truncated = engine.step(batch)
        self._check(observations)
        self._fresh = bool(terminated[world] | truncated[world])
        states = engine.final_state() if self._fresh else engine.state()
        seen = engine.final_observations if self._fresh else observations
        return Outcome(
            state=states[world],
            team_reward=float(engine.team_rewards[world]),
            terminated=bool(terminated[world]),
            truncated=bool(truncated[world]),
            infos=self._infos(),
            rewards=rewards[world].tolist(),
            observations=list(seen[world].copy()),
        )

    def _infos(self) -> list[dict[str, float]]:
        metrics = {name: rows[self.world] for name, rows in self.engine.metrics().items()}
        infos = []
        for robot, terms in enumerate(self.engine.reward_terms()[self.world]):
            info = {name: float(metrics[name]) for name in TEAM_METRICS}
            info |= {name: float(metrics[name][robot]) for name in ROBOT_METRICS}
            named = zip(REWARD_TERMS, terms, strict=True)
            infos.append(info | {f"reward/{name}": float(term) for name, term in named})
        return infos

    def _check(self, observations: NDArray[np.float32]) -> None:
        low, high = self.engine.observation_low, self.engine.observation_high
        assert ((observations >= low) & (observations <= high)).all()


INFO_KEYS = (*INFO_COLUMNS, GAP)  # The keys of every info where nothing is drawn
NOTHING = {**dict.fromkeys(INFO_COLUMNS, 0.0), GAP: UNDEFINED}  # The info of a reset
TEAM_METRICS = ("success", "collision", "rois_visited")
ROBOT_METRICS = ("wall_hits", "path_length", "impulse", "failed")
