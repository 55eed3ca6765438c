"""A world whose robots move elsewhere, such as in a simulator, and are judged by the same rules."""

# A step of the engine has two halves here, made of the engine's passes. The first turns actions
# into the velocities that the MDP would have next; something else then moves the robots. The second
# takes their measured positions and does the rest of the step: ROIs, memory, collisions, rewards,
# observations.

from __future__ import annotations

from numbers import Real
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mbn_marl.engine import step
from mbn_marl.engine.arguments import worlds_of
from mbn_marl.engine.batch import BatchEngine
from mbn_marl.engine.mdp.disturbances import disturbs_actions, send
from mbn_marl.engine.mdp.drawn_numbers import V_CLIP, limits_in, limits_of
from mbn_marl.engine.mdp.dynamics import keep_heading, propose_move
from mbn_marl.engine.mdp.failures import WORKS, fail, may_rest, move_failed, status_of
from mbn_marl.engine.mdp.observations import observe
from mbn_marl.engine.mdp.rewards import RELEASED, WALL
from mbn_marl.errors import ActionError, ConfigError, StepError
from mbn_marl.jit.compile import compiled, entry_point
from mbn_marl.jit.functions import clip, select

LO, HI = np.uint64(0), np.uint64(1)
INSIDE = 1


class Command(NamedTuple):
    """The velocities that the MDP would give the robots in a step.

    Attributes:
        velocities: (n, 2), units/step, in the engine's dtype; 0 where a robot has to stop.
        allowed: (n,) bool, whether the robot would stay in the field. If not it pays r_l, unless it
            has failed.
        failed: (n,) bool, whether the robot has failed, in this step or before.
    """

    velocities: NDArray[Any]
    allowed: NDArray[np.bool_]
    failed: NDArray[np.bool_]


class TrackedWorld:
    """One world of the MDP whose positions and velocities are measured, not computed.

    A step is :meth:`command` and then :meth:`measure`. A robot that is moved exactly as commanded,
    by ``p' = p + v' tau``, has exactly the episode that the engine would have given it.

    Args:
        engine: of one world, on the CPU, without automatic reset; look at it and reset it, but
            leave its steps to this world.
        speed_limit: of what moves the robots, per axis, units/step, above 0; ``None`` for v_clip
            alone.

    Raises:
        ConfigError: another engine, or the limit is not above 0; all problems are listed.
    """

    def __init__(self, engine: BatchEngine, speed_limit: float | None = None) -> None:
        backend = engine._backend
        single = engine.num_worlds == 1 and engine.autoreset == "disabled"
        limit, problems = np.inf if speed_limit is None else speed_limit, []
        if not isinstance(limit, Real) or not limit > 0.0:
            problems.append(f"speed_limit: {limit!r}; allowed: None, or a number above 0")
        if not (single and engine.device == "cpu"):
            found = f"{engine.num_worlds} worlds on {engine.device}, autoreset {engine.autoreset}"
            allowed = "allowed: one world on the CPU, autoreset disabled"
            problems.append(f"engine: {found}; {allowed}")
        if problems:
            raise ConfigError("tracked world", problems)
        self.engine, self._backend = engine, backend
        self._limits = backend.geometry.team.limits.copy()
        self._limits[V_CLIP] = np.minimum(self._limits[V_CLIP], limit)
        self._allowed = np.ones(engine.n_robots, np.bool_)
        self._commanded: int | None = None  # the step of the last command
        engine.listeners.append(self)

    def was_reset(self, mask: Any) -> None:
        self._commanded = None

    def stepped(self, actions: Any, ended: Any) -> None:
        self._commanded = None

    @property
    def _step(self) -> int:
        return int(self._backend.now.steps[0])

    def command(self, actions: ArrayLike) -> Command:
        """The first half of a step.

        Args:
            actions: (n, 2), finite; values outside [-1, 1] are clipped.

        Raises:
            ActionError: the actions are not allowed; nothing has changed.
            StepError: no episode runs, or the step has a command already.
        """
        if not self.engine.running[0]:
            raise StepError("the episode has not begun, or has ended; allowed: reset() first")
        if self._commanded == self._step:
            raise StepError("the robots have a command; allowed: measure() first")
        shape = (self.engine.n_robots, 2)
        allowed = f"{shape} (robots, axes)"
        given = self._backend.given("actions", actions, allowed)
        if given.shape != shape:
            raise ActionError(f"actions: shape {given.shape}; allowed: {allowed}")
        forces = self._backend.checked_actions(given[None])
        velocities = np.empty((1, self.engine.n_robots, 2), self.engine.dtype)
        chooser = self._backend.arguments_with(self._limits)
        choose_velocities(chooser, forces, velocities, self._allowed)
        self._commanded = self._step
        return Command(velocities[0], self._allowed.copy(), self.engine.failed[0])

    def measure(self, positions: ArrayLike, velocities: ArrayLike) -> None:
        """The second half: the robots came to ``positions``; the outcome is in the engine.

        A robot that works and was measured outside the field pays r_l, as one does that would leave
        it. Positions are clipped to the arena, velocities to v_clip.

        Args:
            positions: (n, 2), units, finite.
            velocities: (n, 2), units/step, finite.

        Raises:
            ActionError: an argument is not allowed.
            StepError: there is no command for this step of the episode.
        """
        if self._commanded != self._step:
            raise StepError("the robots have no command; allowed: command() first")
        shape, measured = (1, self.engine.n_robots, 2), []
        for name, given in (("positions", positions), ("velocities", velocities)):
            allowed = f"allowed: finite numbers of shape {shape[1:]}"
            try:
                array = np.asarray(given, self.engine.dtype)[None]
            except (TypeError, ValueError) as error:
                raise ActionError(f"{name}: {error}; {allowed}") from None
            if array.shape != shape or not np.isfinite(array).all():
                raise ActionError(f"{name}: shape {array.shape[1:]}, or not finite; {allowed}")
            measured.append(np.ascontiguousarray(array))
        take_positions(self._backend.arguments, *measured, self._allowed)
        self._backend.recount()


@entry_point
def choose_velocities(arguments, actions, velocities, allowed):
    """Steps 1 and 2: write the next velocities (1, n, 2), and whether their ends are inside."""
    p, g, mem, now, _, _, to = worlds_of(arguments)
    put_velocities(p, g, mem, now, to, actions, velocities, allowed)


# A function by itself, since a feature is asked of arguments: their types are known in time.
@compiled
def put_velocities(p, g, mem, now, to, actions, velocities, allowed):
    taken = actions
    if disturbs_actions(now):
        send(p, mem, now, actions, LO, HI)
        taken = mem.acted
    for i in range(now.x.shape[0]):
        if may_rest(now):
            fail(p, g, mem, now, to, i, LO, HI)
        propose_move(p, g, now, to, taken, i, LO, HI)
        if may_rest(now):
            move_failed(p, g, now, to, i, LO, HI)
        step.test_containment(g, to, LO, HI)
        keep_heading(g, now, to, i, LO, HI)
        inside = to.crossings[0] != 0
        allowed[i] = inside
        velocities[0, i, 0] = select(inside, to.vx[0], p.zero)
        velocities[0, i, 1] = select(inside, to.vy[0], p.zero)


@entry_point
def take_positions(arguments, positions, velocities, allowed):
    """Steps 3 to 8 for robots that came to ``positions`` with ``velocities``, (1, n, 2)."""
    p, g, mem, now, _, out, to = worlds_of(arguments)
    n = now.x.shape[0]
    for i in range(n):
        to.x[0], to.y[0] = positions[0, i, 0], positions[0, i, 1]
        _, _, v_clip = limits_in(limits_of(g, i), now, i, LO)
        to.vx[0] = clip(velocities[0, i, 0], -v_clip, v_clip)
        to.vy[0] = clip(velocities[0, i, 1], -v_clip, v_clip)
        step.test_containment(g, to, LO, HI)
        stayed = allowed[i] & (to.crossings[0] != 0) | (status_of(now, i, LO) != WORKS)
        to.crossings[0] = INSIDE
        step.stop_at_walls(p, now, out, to, i, LO, HI)
        now.wall_hits[i, 0] += 0 if stayed else 1
        out.events[i, 0] |= 0 if stayed else WALL
        step.mark_visits(p, g, now, out, i, LO, HI)
    if p.rules == RELEASED:
        step.record_positions(mem, now, LO, HI)
        for i in range(n):
            step.hash_positions(mem, now, out, to, i, LO, HI)
    step.pass_time(p, g, mem, now, LO, HI)
    observe(p, g, mem, now, LO, HI, to.tile, out.observations)
    step.score_step(p, g, mem, now, out, to, LO, HI)
    return step.autoreset(arguments, LO, HI)
