"""The deployment loop: a policy acts on what a simulator's vehicles really do."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from time import process_time
from typing import Any, Protocol

import numpy as np

from mbn_marl.config import NavigationConfig
from mbn_marl.engine import BatchEngine, TrackedWorld
from mbn_marl.episode import Episode
from mbn_marl.episode.play import EpisodeLog
from mbn_marl.errors import ConfigError
from mbn_marl.field import Field
from mbn_marl.sim3d.simulator import Floats, Mission, Simulator


class Policy(Protocol):
    """``act_in`` returns actions (1, n, 2) in an engine, from the observations that it showed."""

    def act_in(self, world: BatchEngine, observations: Any) -> Any: ...


@dataclass(frozen=True, eq=False)
class Deployment:
    """The outcome of a policy in a simulator, with n robots in T steps."""

    episode: Episode  #: with the measured positions: only the plane's replays in the engine
    commands: Floats  #: (T, n, 2), the velocities that were commanded, units/step
    wall_hits: int  #: steps of any robot that was stopped at the field's edge or was beyond it
    seconds: float | None  #: of one core that the simulator's steps took; ``None`` if unknown

    @property
    def config(self) -> NavigationConfig:
        """The episode's configuration, with numbers in place of what was drawn."""
        return self.episode.config.with_drawn(self.episode.drawn)

    @property
    def success(self) -> bool:
        return self.episode.outcome == "success"

    @property
    def makespan(self) -> int | None:
        return self.episode.steps if self.success else None

    @property
    def separation(self) -> float | None:
        """Least distance of two robots that have not vanished, units; ``None`` for a single one."""
        gone, positions = self.episode.gone, self.episode.positions.astype(np.float64)
        gaps = np.linalg.norm(positions[:, :, None] - positions[:, None], axis=-1)
        gaps[:, np.eye(positions.shape[1], dtype=bool)] = np.inf
        gaps[gone[:, :, None] | gone[:, None]] = np.inf
        return float(gaps.min()) if positions.shape[1] > 1 else None

    @property
    def tracking_error(self) -> float:
        """Distance of robots from the MDP's ``p + v' tau``, RMS over steps, units."""
        positions = self.episode.positions.astype(np.float64)
        missed = np.diff(positions, axis=0) - self.commands * self.config.tau
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
    velocities to command, and judges where the vehicles are. The simulator is reset, and left open;
    ``seed`` is the key of all random numbers, ``source`` the name of the policy.

    Raises:
        ConfigError: field, settings and simulator do not fit together.
        MbnError: the simulator cannot be used.
    """
    alone: dict[str, Any] = {"seed": seed, "autoreset": False, "threads": 1}
    engine = BatchEngine(field, 1, **alone, **settings)
    engine.reset()
    config, now, kind = engine.config, engine.config_in(), ""  # ``now`` without drawn numbers
    if config.failures is not None and (kind := config.failures.kind) not in simulator.failures:
        allowed = f"allowed with its vehicles: {', '.join(map(repr, simulator.failures))}"
        place = type(simulator).__name__
        raise ConfigError("deployment", [f"failures.kind: {kind!r} with {place}; {allowed}"])
    if simulator.has_wind:  # then its bodies feel the wind, and the commands are without
        config = config.model_copy(update={"wind": now.wind})
        engine = BatchEngine(field, 1, **alone, **{**config.model_dump(), "wind": (0.0, 0.0)})
    world, observations = TrackedWorld(engine, simulator.speed_limit), engine.reset(seed)
    starts = engine.snapshot().positions
    simulator.reset(Mission(field, starts, now.wind_increment(), now.tau, now.roi_radius))
    seconds, log, commands = 0.0, EpisodeLog(engine), list[Floats]()
    failed = np.zeros(engine.n_robots, np.bool_)
    try:
        while engine.running[0]:
            actions = np.asarray(policy.act_in(engine, observations)[0])
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
    except BaseException:
        simulator.abandon()
        raise
    return Deployment(
        episode=log.episode(config, source, seed),
        commands=np.stack(commands),
        wall_hits=int(engine.metrics(["wall_hits"])["wall_hits"].sum()),
        seconds=None if simulator.external else seconds,
    )
