"""The deployment loop: a policy acts on what a simulator's vehicles really do."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from time import process_time
from typing import Any, Literal, Protocol

import numpy as np

from mbn_marl.config import Failures
from mbn_marl.engine import BatchEngine, TrackedWorld
from mbn_marl.episode import Episode
from mbn_marl.episode.play import EpisodeLog
from mbn_marl.errors import ConfigError
from mbn_marl.field import Field
from mbn_marl.sim3d.simulator import Floats, Mission, Simulator


class Policy(Protocol):
    """A policy, such as those of ``baselines``.

    It ``observes`` the robots' observations (1, n, obs_size) or the paper's state (1, 4n + 1).
    """

    observes: Literal["observations", "state"]

    def act(self, seen: np.ndarray, *, deterministic: bool) -> np.ndarray:
        """Return actions (1, n, 2) in [-1, 1] for what ``observes`` names."""


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
        """Return the smallest distance of two robots after any step, units; ``None`` for one.

        Robots that have vanished do not count.
        """
        gone, positions = self.episode.gone, self.episode.positions.astype(np.float64)
        if positions.shape[1] == 1:
            return None
        gaps = np.linalg.norm(positions[:, :, None] - positions[:, None], axis=-1)
        robots = np.arange(positions.shape[1])
        gaps[:, robots, robots] = np.inf
        gaps[gone[:, :, None] | gone[:, None]] = np.inf
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

    The engine's own code makes observations from what was measured, turns forces into the
    velocities to command, and judges where the vehicles came to be.

    Args:
        policy: what acts.
        field: where.
        settings: of the environment.
        simulator: what moves the robots; it is reset, and left open.
        seed: key of all random numbers.
        source: what the policy is, in words.

    Raises:
        ConfigError: field and settings do not fit together, or the simulator's vehicles cannot fail
            as the settings say.
        MbnError: the simulator cannot be used.
    """
    engine = BatchEngine(field, 1, seed=seed, autoreset=False, threads=1, **settings)
    if engine.config.drawn:  # a simulator needs numbers
        engine.reset()
        settings = engine.config_in().model_dump()
        return deploy(policy, field, settings, simulator, seed=seed, source=source)
    kind = _checked_kind(engine.config.failures, simulator)
    config, wind = engine.config, engine.config.wind_increment()
    if simulator.has_wind:
        calm = {**settings, "wind": (0.0, 0.0)}
        engine = BatchEngine(field, 1, seed=seed, autoreset=False, threads=1, **calm)
    world = TrackedWorld(engine, simulator.speed_limit)
    observations = engine.reset()
    starts = engine.snapshot().positions
    simulator.reset(Mission(field, starts, wind, config.tau, config.roi_radius))
    seconds, log = 0.0, EpisodeLog(engine)
    commands: list[Floats] = []
    failed = np.zeros(engine.n_robots, np.bool_)
    while engine.running[0]:
        seen = engine.state() if policy.observes == "state" else observations
        actions = np.asarray(policy.act(seen, deterministic=True)[0])
        command = world.command(actions)
        for robot in np.flatnonzero(command.failed & ~failed):
            simulator.fail(int(robot), kind)
        failed = command.failed
        commands.append(command.velocities)
        simulator.command(command.velocities)
        begun = process_time()
        simulator.step()
        seconds += process_time() - begun
        motion = simulator.motion()
        world.measure(motion.positions, motion.velocities)
        for roi in log.add(actions):
            simulator.spray(roi)
    return Deployment(
        episode=log.episode(config, source, seed),
        commands=np.stack(commands),
        wall_hits=int(engine.metrics()["wall_hits"].sum()),
        seconds=None if simulator.external else seconds,
    )


def _checked_kind(failures: Failures | None, simulator: Simulator) -> str:
    """Return what failed robots do; raise ``ConfigError`` if the simulator's vehicles cannot."""
    kind = (failures or Failures()).kind
    if failures is not None and kind not in simulator.failures:
        allowed = f"allowed with its vehicles: {', '.join(map(repr, simulator.failures))}"
        place = type(simulator).__name__
        raise ConfigError("deployment", [f"failures.kind: {kind!r} with {place}; {allowed}"])
    return kind
