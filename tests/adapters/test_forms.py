"""The three forms and the oracle agree step by step, on random worlds and in every situation."""

from collections import Counter
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_array_equal
from numpy.typing import NDArray

from mbn_marl import Field
from mbn_marl.adapters.infos import GAP
from mbn_marl.config import Failures, Uniform
from mbn_marl.engine.mdp.observations import LIDARS, WITH_RAYS
from tests.support.field_cases import HOLE, LETTER_L, SQUARE
from tests.support.forms import BatchForm, CentralizedForm, Outcome, ParallelForm, TeamSharingForm
from tests.support.oracle import Oracle
from tests.support.scores import TERMS, Step
from tests.support.worlds import ASSIGNED, DRAWN, OWN, Pilot, World, random_field, worlds

pytestmark = pytest.mark.slow

EXAMPLES = 6  # for each number of robots; with knowledge "own" a half, which are longer
STEPS, STEPS_OF_OWN = 60, 250
TIE = {"float64": 1e-9, "float32": 1e-2}  # units: a closer decision may fall either way
ROUNDING = {"float64": 1e-12, "float32": 3e-6}  # relative, of sums in any order
SIGHT = 3e-7  # of observations, whose scales are products with reciprocals
DOUBT = 5e-4  # units, of the position from which walls are seen in float32


def situations(step: Step) -> dict[str, bool]:
    return {
        "wall": any(step.wall),
        "revisit": any(step.revisit),
        "roi": any(step.reached),
        "success": step.all_visited and not step.collided,
        "collision": step.collided,
        "truncated": step.truncated,
        "known state": step.met_before,
        "new state": not step.met_before,
        **({} if all(step.works) else {"failed": True, "all failed": not any(step.works)}),
    }


def check_outcome(outcome: Outcome, oracle: Oracle, step: Step, rounding: float) -> None:
    assert_array_equal(outcome.state, oracle.state())
    assert (outcome.terminated, outcome.truncated) == (step.terminated, step.truncated)
    assert outcome.team_reward == pytest.approx(step.team_reward, rel=rounding, abs=rounding * 1e5)
    assert np.isfinite(outcome.state).all()


def check_sights(outcome: Outcome, oracle: Oracle, dtype: str, missing: int = 0) -> None:
    """Compare to rounding; ``missing`` counts the ROIs that another field of the batch has more."""
    # In float32 a ray along a wall or past a corner may jump.
    for robot, observation in enumerate(outcome.observations):
        low = high = oracle.observe(robot, missing)
        if oracle.observation in WITH_RAYS and dtype == "float32":
            corners = [(dx, dy) for dx in (-DOUBT, DOUBT) for dy in (-DOUBT, DOUBT)]
            views = [low, *(oracle.observe(robot, missing, corner) for corner in corners)]
            low, high = np.min(views, axis=0), np.max(views, axis=0)
        slack = SIGHT + (high - low) / 100  # beside a corner the four views are not the extremes
        wrong = (observation < low - slack) | (observation > high + slack)
        assert not wrong.any(), (robot, np.flatnonzero(wrong), observation[wrong], low[wrong])


def check_rewards(outcome: Outcome, step: Step, rounding: float) -> None:
    close = {"rel": rounding, "abs": rounding * 1e5}
    assert outcome.rewards == pytest.approx(step.rewards, **close)
    assert sum(outcome.rewards) == pytest.approx(step.team_reward, **close)
    for info, reward, terms in zip(outcome.infos, outcome.rewards, step.terms, strict=True):
        logged = {term: info[f"reward/{term}"] for term in TERMS}
        assert logged == pytest.approx(terms, **close)
        assert sum(logged.values()) == pytest.approx(reward, **close)


def check_infos(infos: list[dict[str, float]], oracle: Oracle, rounding: float) -> None:
    expected = oracle.metrics()
    for robot, info in enumerate(infos):
        for name in ("success", "collision", "rois_visited"):
            assert info[name] == expected[name], name
        assert info["wall_hits"] == expected["wall_hits"][robot]
        assert info["failed"] == expected["failed"][robot]
        for name in ("path_length", "impulse"):
            value = pytest.approx(expected[name][robot], rel=1e3 * rounding, abs=1e3 * rounding)
            assert info[name] == value, name


def check_team_info(outcome: Outcome, infos: list[dict[str, float]], rounding: float) -> None:
    (team,) = outcome.infos
    assert team.keys() == infos[0].keys()
    for name, value in team.items():
        shared = name in ("success", "collision", "rois_visited", GAP) or name[:6] == "drawn/"
        expected = infos[0][name] if shared else sum(info[name] for info in infos)
        close = pytest.approx(expected, rel=rounding, abs=rounding * 1e5, nan_ok=True)
        assert value == close, name
    logged = sum(team[f"reward/{term}"] for term in TERMS)
    assert logged == pytest.approx(outcome.team_reward, rel=rounding, abs=rounding * 1e5)


class Together:
    def __init__(
        self, field: Field, dtype: str, num_worlds: int = 1, which: int = 0, **options: Any
    ) -> None:
        options["dtype"] = self.dtype = dtype
        self.rounding = ROUNDING[dtype]
        self.oracle = Oracle(field, **options)
        self.forms = (
            ParallelForm(field, **options),
            BatchForm(field, num_worlds, which, **options),
            TeamSharingForm(field, **options),
            *([] if self.oracle.knowledge else [CentralizedForm(field, **options)]),
        )
        self.reset(0)

    def reset(self, episode: int | None = None) -> None:
        self.oracle.reset(episode=episode)
        for form in self.forms:
            assert_array_equal(form.reset(), self.oracle.state())

    def follow(self, actions: NDArray[np.float32], step: Step) -> None:
        one, many, shared, *team = outcomes = [form.step(actions) for form in self.forms]
        for outcome in outcomes:
            check_outcome(outcome, self.oracle, step, self.rounding)
        check_sights(one, self.oracle, self.dtype)
        for outcome in (one, many):
            check_rewards(outcome, step, self.rounding)
            check_infos(outcome.infos, self.oracle, self.rounding)
        assert_array_equal(one.observations, many.observations)
        assert_array_equal(one.observations, shared.observations)
        assert {outcome.team_reward for outcome in (shared, *team)} == {many.team_reward}
        for outcome in team:
            check_team_info(outcome, one.infos, self.rounding)


def compare(world: World, dtype: str, num_worlds: int, which: int) -> Counter[str]:
    """Play a world for a while, through resets. Returns what happened how often."""
    seen = Counter()
    together = Together(world.field, dtype, num_worlds, which, **world.settings)
    pilot = Pilot(world, together.oracle)
    for _ in range(STEPS_OF_OWN if together.oracle.knowledge else STEPS):
        actions = pilot.actions()
        step = together.oracle.step(actions.tolist())
        if step.margin < TIE[dtype]:
            seen["tie"] += 1
            break
        together.follow(actions, step)
        seen.update(situations(step))
        robots, rois = range(together.oracle.n), range(len(together.oracle.rois))
        known = [[together.oracle.is_done(i, j) for j in rois] for i in robots]
        seen["unaware"] += known != [together.oracle.visited] * len(robots)
        if step.terminated or step.truncated:
            together.reset()
    return seen


ORDER = ("bicycle", "holonomic", "unicycle", "point_mass")
TEAMS, FEW = (1, 2, 3, 5, 7), (2, 3)
LOCAL = {**OWN, "observation": "local"}
HIDDEN = {"observation": "lidar_local", "hidden_rois": True}
PLAIN = [{"observation": name} for name in ("relative", "local", "state")]
COMPILED = {
    "plain": ("float32", TEAMS, PLAIN),
    "precise": ("float64", TEAMS, PLAIN),
    "rays": ("float64", FEW, [{"observation": name} for name in LIDARS]),
    "all of it": ("float64", TEAMS, [DRAWN]),
    "and entities": ("float32", FEW, [{**DRAWN, **ASSIGNED}]),
    "own": ("float64", FEW, [{**DRAWN, **OWN, "hidden_rois": True, "observation": "entities"}]),
    "own, local": ("float64", FEW, [LOCAL, {**OWN, **HIDDEN}]),
    "kinds": ("float32", FEW, [{**DRAWN, **ASSIGNED}]),
    "kinds, own": ("float64", FEW, [LOCAL, {**OWN, **HIDDEN}]),
    "and entities, fresh": ("float32", FEW, [{**DRAWN, **ASSIGNED, "assignment": "fresh"}]),
}
*GATE, LAST = COMPILED


def failures_of(n: int) -> st.SearchStrategy[Failures]:
    chances = [(0.0, 0), (0.1, n), (1.0, n), (Uniform(0.0, 0.3), n)]
    chances += [(rate, None) for rate in (0.0, 0.1, 1.0)[:n]]
    return st.builds(
        lambda chance, **how: Failures(rate=chance[0], most=chance[1], **how),
        st.sampled_from(chances),
        at=st.dictionaries(st.integers(0, n - 1), st.integers(1, 7)),
        between=st.sampled_from([None, None, (1, 1), (3, 7)]),
        kind=st.sampled_from(["brake", "coast", "vanish"]),
    )


@pytest.mark.parametrize("name", [*GATE, pytest.param(LAST, marks=pytest.mark.all)])
def test_all_forms_agree_with_the_oracle(name):
    seen = Counter()
    dtype, teams, choices = COMPILED[name]
    disturbed, own = choices[0].keys() >= DRAWN.keys(), "knowledge" in choices[0]

    def agree(world: World, num_worlds: int, data: st.DataObject) -> None:
        n, which = len(world.behaviours), 0  # the world that the other forms are, if it is random
        options = data.draw(st.sampled_from(choices))
        if disturbed or own:
            options = {**options, "failures": data.draw(failures_of(n))}
            options["dynamics"] = tuple((ORDER * n)[:n])
        else:
            which = data.draw(st.integers(0, num_worlds - 1), label="world")
        if own:
            options["decoys"] = (0, min(2, len(world.field.rois) - 1))
        if name.startswith("kinds"):
            of_starts, rois = [k % 2 for k in range(n)], len(world.field.rois)
            kind = st.sampled_from([None, *of_starts])
            kinds = {"roi_kinds": data.draw(st.lists(kind, min_size=rois, max_size=rois))}
            kinds |= {"start_kinds": of_starts}
            world = replace(world, field=Field(**world.field.to_dict() | kinds))
        world = replace(world, settings=world.settings | options)
        seen.update(compare(world, dtype, num_worlds, which))

    for n in teams:
        repeat = settings(max_examples=EXAMPLES // (1 + own))
        repeat(given(worlds(n), st.integers(1, 5), st.data())(agree))()
    assert seen.pop("tie", 0) <= len(teams) * EXAMPLES / 4
    assert (seen["unaware"] > 30) == own
    expected = {"wall", "revisit", "roi", "success", "collision", "truncated", "known state"}
    expected |= {"failed", "all failed"} if disturbed else set()
    if teams == TEAMS:
        assert min(seen[situation] for situation in expected) >= 3, f"hardly ever: {seen}"


DIAMOND = [(50.0, 0.0), (100.0, 50.0), (50.0, 100.0), (0.0, 50.0)]
STILL, RIGHT, LEFT, UP = (0.0, 0.0), (1.0, 0.0), (-1.0, 0.0), (0.0, 1.0)
TIES = {
    "onto the outline, then beyond": (
        {"vertices": SQUARE, "starts": [(99.5, 50.0)]},
        [[RIGHT]] * 2,
    ),
    "along the outline": ({"vertices": SQUARE, "starts": [(100.0, 50.0)]}, [[UP], [UP]]),
    "into a corner, level with another": (
        {"vertices": DIAMOND, "starts": [(95.0, 50.0)]},
        [[RIGHT]] * 5,
    ),
    "level with an edge, then along it": (
        {"vertices": LETTER_L, "starts": [(55.0, 50.0)]},
        [[RIGHT]] * 6 + [[UP]],
    ),
    "onto a hole's boundary, then into it": (
        {"vertices": SQUARE, "holes": [HOLE], "starts": [(39.5, 50.0)]},
        [[RIGHT], [RIGHT], [UP]],
    ),
    "onto a hole's corner": (
        {"vertices": SQUARE, "holes": [HOLE], "starts": [(39.5, 39.5)]},
        [[(1.0, 1.0)], [(1.0, 1.0)], [UP]],
    ),
    "ROI at exactly the radius": (
        {"vertices": SQUARE, "rois": [(20.0, 80.0), (60.0, 10.0)], "starts": [(10.0, 80.0)]},
        [[STILL]],
    ),
    "robots at exactly the safety distance, then closer": (
        {"vertices": SQUARE, "starts": [(20.0, 20.0), (30.0, 20.0)]},
        [[STILL, STILL], [RIGHT, LEFT]],
    ),
}


def follow(
    shape: dict[str, Any], script: list[list[tuple[float, float]]], dtype: str, **options: Any
) -> list[Step]:
    together, steps = Together(Field(**shape), dtype, 3, 1, **options), []
    for actions in script:
        steps.append(together.oracle.step(actions))
        together.follow(np.array(actions, np.float32), steps[-1])
    return steps


@pytest.mark.parametrize("dtype", ["float64", "float32"])
@pytest.mark.parametrize("reward", ["released", "formal"])
def test_ties_fall_as_in_the_oracle(reward, dtype):
    for case, (shape, script) in TIES.items():
        steps = follow({"rois": [(60.0, 25.0)], **shape}, script, dtype, reward=reward)
        assert min(step.margin for step in steps) == 0.0, case
    shape = {"vertices": SQUARE, "rois": [(46.0, 50.0)], "starts": [(35.0, 50.0), (57.0, 50.0)]}
    (step,) = follow(shape, [[RIGHT, LEFT]], dtype, reward=reward, f_max=8.0, v_clip=8.0)
    assert step.all_visited and step.collided, "a collision wins over success"
    shape = {"vertices": SQUARE, "rois": [(90.0, 90.0)], "starts": [(20.0, 20.0), (31.0, 20.0)]}
    own = {"reward": reward, "safety_distance": 0.0, "f_max": 5.5, "v_clip": 11}
    steps = follow(shape, [[RIGHT, LEFT]] * 2, dtype, **own)
    assert [step.revisit for step in steps] == [[False, True], [False, False]]


@pytest.mark.parametrize("observation", ["relative", "lidar_local"])
def test_fields_of_one_batch_are_each_the_field_alone(observation):
    rng = np.random.default_rng(5)
    fields = [
        random_field(rng, corners=corners, with_hole=hole, n_rois=n_rois, n_starts=3)
        for corners, hole, n_rois in [(3, False, 2), (8, True, 7), (5, True, 4)]
    ]
    options = {"dtype": "float64", "wind": (0.1, 30.0), "f_max": 2.0, "max_steps": 50}
    options["observation"] = observation
    for which in range(6):
        world = World(fields[which % 3], options, ("seek", "uniform", "push"), seed=which)
        oracle = Oracle(world.field, **options)
        pilot = Pilot(world, oracle)
        form = BatchForm(fields, 6, which, **options)
        assert_array_equal(form.reset(), oracle.state())
        for _ in range(60):
            actions = pilot.actions()
            step = oracle.step(actions.tolist())
            assert step.margin > TIE["float64"]
            outcome = form.step(actions)
            check_outcome(outcome, oracle, step, ROUNDING["float64"])
            check_sights(outcome, oracle, "float64", missing=7 - len(oracle.rois))
            check_rewards(outcome, step, ROUNDING["float64"])
            check_infos(outcome.infos, oracle, ROUNDING["float64"])
            if outcome.ended:
                oracle.reset()
                assert_array_equal(form.reset(), oracle.state())
