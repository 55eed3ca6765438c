"""The deployment loop: a policy acts on what a simulator's vehicles really do."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from time import process_time
from typing import Any, Literal, Protocol

import numpy as np
from numpy.typing import NDArray

from mbn_marl.config import NavigationConfig
from mbn_marl.engine import BatchEngine, TrackedWorld
from mbn_marl.episode import Episode, Outcome
from mbn_marl.field import Field
from mbn_marl.sim3d.simulator import Floats, Mission, Simulator


class Policy(Protocol):
    """A policy, such as those of ``baselines``.

    Attributes:
        observes: ``"observations"``, the robots' own, (1, n, obs_size), or ``"state"``, the
            paper's vector, (1, 4n + 1).
    """

    observes: Literal["observations", "state"]

    def act(self, seen: np.ndarray, *, deterministic: bool) -> np.ndarray:
        """Actions (1, n, 2) in [-1, 1] for what ``observes`` names."""
        ...


@dataclass(frozen=True, eq=False)
class Deployment:
    """The outcome of a policy in a simulator, with n robots in T steps.

    Attributes:
        episode: the episode with the measured positions. It does not replay in the engine, whose
            robots move otherwise, unless the simulator was the plane.
        commands: (T, n, 2), the velocities that were commanded, units/step.
        wall_hits: steps of any robot that was stopped at the edge of the field or was beyond it.
        seconds: of one processor core that the simulator's steps took; ``None`` if it is another
            program, whose time is not known.
    """

    episode: Episode
    commands: Floats
    wall_hits: int
    seconds: float | None

    @property
    def success(self) -> bool:
        """Return whether all ROIs were visited, without a collision."""
        return self.episode.outcome == "success"

    @property
    def makespan(self) -> int | None:
        """Return the steps to success; ``None`` without it."""
        return self.episode.steps if self.success else None

    @property
    def separation(self) -> float | None:
        """Return the smallest distance of two robots after any step, units; ``None`` for one."""
        positions = self.episode.positions.astype(np.float64)
        if positions.shape[1] == 1:
            return None
        gaps = np.linalg.norm(positions[:, :, None] - positions[:, None], axis=-1)
        robots = np.arange(positions.shape[1])
        gaps[:, robots, robots] = np.inf
        return float(gaps.min())

    @property
    def tracking_error(self) -> float:
        """Return how far robots came to be from the MDP's ``p + v' tau``, RMS over steps, units."""
        positions = self.episode.positions.astype(np.float64)
        missed = np.diff(positions, axis=0) - self.commands * self.episode.config.tau
        return float(np.sqrt(np.square(missed).sum(axis=-1).mean()))


def deploy(
    policy: Policy,
    field: Field,
    settings: Mapping[str, Any],
    simulator: Simulator,
    *,
    seed: int = 0,
    source: str = "",
) -> Deployment:
    """Let a policy act on a simulator's vehicles for one episode, with mean actions.

    In each step the engine's own code makes the observation from the measured positions and
    velocities, turns the force into the velocity to command, limit included, and judges where the
    vehicles came to be.

    Args:
        policy: what acts.
        field: where.
        settings: of the environment.
        simulator: what moves the robots; it is reset, and left open.
        seed: of random starts.
        source: what the policy is, in words.

    Raises:
        ConfigError: field and settings do not fit together.
        MbnError: the simulator cannot be used.
    """
    engine = BatchEngine(field, 1, seed=seed, autoreset=False, threads=1, **settings)
    config, wind = engine.config, engine.config.wind_increment()
    if simulator.has_wind:
        calm = {**settings, "wind": (0.0, 0.0)}
        engine = BatchEngine(field, 1, seed=seed, autoreset=False, threads=1, **calm)
    world = TrackedWorld(engine, simulator.speed_limit)
    observations = engine.reset()
    start = engine.snapshot()
    simulator.reset(Mission(field, start.positions, wind, config.tau, config.roi_radius))
    seconds = 0.0
    log = _Log(start.positions, np.zeros(len(field.rois), np.int32))
    while engine.running[0]:
        seen = engine.state() if policy.observes == "state" else observations
        actions = np.asarray(policy.act(seen, deterministic=True)[0])
        command = world.command(actions)
        simulator.command(command.velocities)
        begun = process_time()
        simulator.step()
        seconds += process_time() - begun
        motion = simulator.motion()
        world.measure(motion.positions, motion.velocities)
        for roi in log.add(engine, actions, command.velocities):
            simulator.spray(roi)
    return Deployment(
        episode=log.episode(engine, config, source, seed),
        commands=np.stack(log.commands),
        wall_hits=int(engine.metrics()["wall_hits"].sum()),
        seconds=None if simulator.external else seconds,
    )


class _Log:
    """The steps of an episode so far."""

    def __init__(self, starts: Floats, visits: NDArray[np.int32]) -> None:
        self.positions, self.visits = [starts], visits
        self.actions: list[Floats] = []
        self.commands: list[Floats] = []
        self.terms: list[Floats] = []
        self.rewards: list[float] = []

    def add(self, engine: BatchEngine, actions: Floats, commands: Floats) -> list[int]:
        """Note a step; return the ROIs that were visited in it."""
        now = engine.snapshot()
        fresh = now.visited & (self.visits == 0)
        self.visits[fresh] = now.step
        self.positions.append(now.positions)
        self.actions.append(np.clip(actions, -1, 1).astype(engine.dtype))
        self.commands.append(commands)
        self.terms.append(engine.reward_terms()[0].astype(np.float64))
        self.rewards.append(float(engine.team_rewards[0]))
        return [int(roi) for roi in np.flatnonzero(fresh)]

    def episode(
        self, engine: BatchEngine, config: NavigationConfig, source: str, seed: int
    ) -> Episode:
        """Return the episode that was noted."""
        last = engine.snapshot()
        ended: Outcome = "success" if last.success else "truncated"
        return Episode(
            field=engine.field,
            config=config,
            actions=np.stack(self.actions),
            positions=np.stack(self.positions),
            visits=self.visits,
            terms=np.stack(self.terms),
            team_rewards=np.array(self.rewards),
            outcome="collision" if last.collision else ended,
            source=source,
            seed=seed,
        )
