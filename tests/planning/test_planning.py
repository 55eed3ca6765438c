"""The planner: its bounds against brute force, its plans in the engine, its honesty."""

from __future__ import annotations

import dataclasses
import itertools
import json
import math
from pathlib import Path
from typing import Any

import highspy
import numpy as np
import pytest
import shapely

from baselines.classical.cloning import clone
from baselines.classical.controller import make_classical
from baselines.classical.demonstrations import record_demonstrations
from baselines.cli import main
from baselines.evaluation.evaluate import evaluate
from benchmarks.planning.study import Attempt, study_planning, target_rows
from mbn_marl import BatchEngine, centralized_env, parallel_env
from mbn_marl.config import NavigationConfig, make_config
from mbn_marl.episode import check_episode, load_episode
from mbn_marl.errors import ConfigError, MbnError
from mbn_marl.field import Field, catalogue_names, load_field
from mbn_marl.optimum import optimal_return
from mbn_marl.planning import Plan, UnsolvableError, plan, replay
from mbn_marl.planning.legs import NEVER, proved_legs
from mbn_marl.planning.partition import cheapest_partition, least_makespan
from mbn_marl.planning.planner import prove
from mbn_marl.planning.problem import make_problem
from mbn_marl.planning.relaxation import Disc, Region, Relaxation, Windows, at_steps, make_solver
from mbn_marl.planning.surroundings import surroundings
from tests.field.test_field_files import OPTIMAL_MAKESPANS
from tests.support.planning_cases import U_SHAPE, brute_force, labyrinth, small_field, star_field

SQUARE = [(100.0, 100.0), (300.0, 100.0), (300.0, 300.0), (100.0, 300.0)]
LATER = 1e12
"""A deadline that never comes."""


def replayed(found: Plan, dtype: str, **settings: object) -> tuple[bool, int, float]:
    """Success, length and return of the plan's actions in the public environment."""
    env = parallel_env(found.field, dtype=dtype, **settings)
    env.reset(seed=0)
    total, infos = 0.0, {}
    for step, actions in enumerate(found.actions):
        assert env.agents, f"ended after {step} steps"
        _, rewards, _, _, infos = env.step(dict(zip(env.agents, actions, strict=True)))
        total += sum(rewards.values())
    success = infos["robot_0"]["success"] == 1.0
    return success and not env.agents, len(found.actions), total


# The ten fields


@pytest.mark.parametrize(
    ("name", "makespan"), zip(catalogue_names(), OPTIMAL_MAKESPANS, strict=True)
)
def test_the_ten_fields_are_proved_optimal(name: str, makespan: int) -> None:
    found = plan(name)
    assert (found.makespan, found.makespan_lower_bound, found.optimal) == (makespan, makespan, True)
    assert load_field(name).optimal_makespan == makespan
    assert found.return_ == 160_000 - 30 * makespan == optimal_return(found.field)
    assert found.actions.shape == (makespan, 3, 2)
    assert found.actions.dtype == np.float32
    assert np.abs(found.actions).max() <= 1.0
    assert sorted(itertools.chain(*found.assignment)) == list(range(6))
    for dtype in ("float32", "float64"):
        success, steps, total = replayed(found, dtype)
        assert (success, steps) == (True, makespan)
        assert total == pytest.approx(160_000 - 30 * makespan, rel=1e-6)


def test_environments_say_their_optimal_return() -> None:
    assert parallel_env("field_03").unwrapped.optimal_return == 159_490.0
    assert centralized_env("field_09").unwrapped.optimal_return == 157_510.0
    assert parallel_env("field_03", wind=(0.1, 0.0)).unwrapped.optimal_return is None


def test_no_optimum_is_claimed_where_a_wall_might_pay() -> None:
    # 40 robots for 26 steps cost 10,400, more than the 10,000 of a push against the wall.
    starts = [(20.0 + 20.0 * k, 20.0) for k in range(40)]
    corners = [(0, 0), (1000, 0), (1000, 300), (0, 300)]
    for makespan, claimed in ((25, 110_000 - 10_000), (26, None)):
        field = Field(corners, [(500.0, 200.0)], starts, optimal_makespan=makespan)
        assert optimal_return(field) == claimed


# Bounds


@pytest.mark.parametrize("seed", range(5))
def test_the_bound_agrees_with_brute_force(seed: int) -> None:
    field = small_field(seed)
    bound = prove(make_problem(field, NavigationConfig()), LATER).bound
    assert brute_force(field, 10.0 / math.cos(math.pi / 48)) <= bound <= brute_force(field, 10.0)


@pytest.mark.parametrize("seed", range(2))
def test_the_bound_agrees_with_brute_force_for_one_robot_in_wind(seed: int) -> None:
    field, config = small_field(10 + seed, n=1), make_config({"wind": (0.2, 200.0)})
    bound = prove(make_problem(field, config), LATER).bound
    wind = config.wind_increment()
    optimistic = brute_force(field, 10.0 / math.cos(math.pi / 48), wind)
    assert optimistic <= bound <= brute_force(field, 10.0, wind)


def test_first_legs_by_hand() -> None:
    # From rest an axis moves 0.5, 1.5, 3, 5, 7.5, ...; discs of 10 are reached 10 units early.
    offsets = [(17.4, 0.0), (17.6, 0.0), (0.0, 9.0), (6.0 + 3.0, 8.0 + 3.0), (9.1, 11.1)]
    rois = [(150.0 + x, 150.0 + y) for x, y in offsets]
    problem = make_problem(Field(SQUARE, rois, [(150.0, 150.0)]), NavigationConfig())
    assert proved_legs(problem, 1e-6, 100).first.tolist() == [[5, 6, 1, 3, 4]]
    assert proved_legs(problem, 1e-6, 5).first[0, 1] == NEVER


def test_legs_between_discs_by_hand() -> None:
    rois = [(110.0, 110.0), (140.0, 110.0), (140.1, 170.2), (120.0, 110.0)]
    problem = make_problem(Field(SQUARE, rois, [(200.0, 200.0)]), NavigationConfig())
    between = proved_legs(problem, 1e-9, 100).between
    # 30 - 20 = 10 units at 5 a step; from 110 to 170.2, 60.2 - 20 = 40.2; overlapping discs.
    assert [between[0, 1], between[1, 2], between[0, 3]] == [2, 9, 0]


@pytest.mark.parametrize("seed", range(3))
def test_partitions_against_enumeration(seed: int) -> None:
    rng = np.random.default_rng(seed)
    costs = rng.integers(1, 50, (3, 16))
    costs[:, 0] = 0
    totals, worst = [], []
    for owners in itertools.product(range(3), repeat=4):
        masks = [sum(1 << j for j in range(4) if owners[j] == i) for i in range(3)]
        shares = [int(costs[i, mask]) for i, mask in enumerate(masks)]
        totals.append(sum(shares))
        worst.append(max(shares))
    chosen = cheapest_partition(costs)
    assert chosen is not None
    assert sum(costs[i, mask] for i, mask in enumerate(chosen)) == min(totals)
    assert sum(chosen) == 15
    assert least_makespan(costs) == min(worst)


def straight(first: int, last: int) -> tuple[Relaxation, Windows]:
    """From rest at the origin to the disc of radius 1 about (8.5, 0), in a window of steps."""
    normals = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    region = Region(normals, np.full(4, 50.0), (-50.0, -50.0), (50.0, 50.0))
    problem = make_problem(Field(SQUARE, [(150, 150)], [(200, 200)]), NavigationConfig())
    relaxation = Relaxation((0.0, 0.0), problem.drives[0], region, (Disc((8.5, 0.0), 1.0),))
    return relaxation, Windows((first,), (last,), (first,), (last,))


@pytest.mark.parametrize(("steps", "inflation"), [(4, 2.5), (5, 0.0), (6, -1.0)])
def test_the_relaxation_is_exact_at_fixed_times(steps: int, inflation: float) -> None:
    relaxation, _ = straight(steps, steps)
    solved = relaxation.solve(make_solver(), at_steps([steps]), relaxation.tangents(), 100.0)
    assert solved.inflation == pytest.approx(inflation, abs=1e-4)
    assert solved.bound == pytest.approx(inflation, abs=1e-4)
    assert solved.bound <= solved.inflation + 1e-9


def test_bounds_hold_with_a_solver_that_stops_early() -> None:
    relaxation, windows = straight(4, 4)
    highs = make_solver()
    highs.setOptionValue("simplex_iteration_limit", 2)
    assert isinstance(highs, highspy.Highs)
    assert relaxation.solve(highs, windows, relaxation.tangents(), 100.0).bound <= 2.5 + 1e-9


def test_bounds_hold_where_rounding_of_a_strong_wind_moves_robots() -> None:
    # Force and wind all but cancel, and what is left of their float32 values is a little more.
    settings: dict[str, Any] = {"f_max": 1000.2, "wind": (1000.05, 0.0)}
    lane = [(100.0, 100.0), (900.0, 100.0), (900.0, 300.0), (100.0, 300.0)]
    engine = BatchEngine(Field(lane, [(120, 200)], [(880, 200)]), 1, threads=1, **settings)
    engine.reset()
    for _ in range(30):
        engine.step(np.array([[[-1.0, 0.0]]]))
    reached = float(engine.snapshot().positions[0, 0])
    assert reached < 880.0 - 0.15 * 30 * 31 / 2 - 0.01
    field = Field(lane, [(reached - 9.999, 200.0)], [(880, 200)])
    assert prove(make_problem(field, make_config(settings)), LATER).bound <= 30


def test_long_episodes_do_not_weaken_the_bound() -> None:
    # Rounding may do much in 100,000 steps, but little in the 250 that matter here.
    field = Field(SQUARE, [(280, 200)], [(110, 200)])
    settings: dict[str, Any] = {"f_max": 0.005, "max_steps": 100_000}
    # From rest, 160 units take 0.005 L (L + 1) / 2 >= 160.
    assert prove(make_problem(field, make_config(settings)), LATER).bound == 253


# Plans


@pytest.mark.parametrize("reach", [7.5, 7.5 + 10.0, 27.5 + 5.0 * 20])
def test_ties_are_polished_to_exact_motions(reach: float) -> None:
    # The ROI comes within exactly 10 units in the last step, at full force all the way.
    field = Field([(0, 0), (900, 0), (900, 300), (0, 300)], [(110.0 + reach, 200)], [(100, 200)])
    found = plan(field)
    assert found.optimal
    assert abs(found.trail[-1, 0, 0] - field.rois[0, 0]) <= 10.0


def test_an_roi_at_the_start_takes_one_step() -> None:
    found = plan(Field(SQUARE, [(150, 150)], [(150, 150)]))
    assert (found.makespan, found.optimal, found.return_) == (1, True, 109_990.0)


def test_wind_is_part_of_the_plan() -> None:
    field = Field(SQUARE, [(120, 120), (200, 200)], [(280, 280)])
    calm, against = plan(field), plan(field, wind=(0.4, 30.0))
    assert calm.makespan is not None and against.makespan is not None
    assert against.optimal and against.makespan > calm.makespan_lower_bound
    assert replayed(against, "float32", wind=(0.4, 30.0))[:2] == (True, against.makespan)


def test_robots_pass_each_other() -> None:
    # Two robots whose straight ways cross, and a lane that only one fits through at a time.
    field = Field(SQUARE, [(290, 290), (110, 290)], [(110, 110), (290, 110)])
    found = plan(field, n_robots=2)
    assert found.makespan is not None
    apart = np.hypot(*(found.trail[:, 0] - found.trail[:, 1]).T)
    assert apart.min() >= 10.0


@pytest.mark.parametrize("field", [U_SHAPE, star_field(0), star_field(1)])
def test_fields_that_are_not_convex_have_verified_plans(field: Field) -> None:
    found = plan(field, time_limit=20.0)
    assert found.makespan is not None
    assert found.makespan_lower_bound <= found.makespan
    assert (found.makespan - found.makespan_lower_bound) / found.makespan <= 0.15
    assert shapely.intersects_xy(field.polygon, found.trail.reshape(-1, 2)).all()
    assert replayed(found, "float32")[:2] == (True, found.makespan)


def test_the_shape_of_the_field_bounds_the_plan() -> None:
    # The straight way from (120, 390) to the disc about (350, 380) takes 48 steps; round the wall,
    # less what steps may cut off, it is (236.5 - 3.5) + 93 + 226.5 - 10 units at 5 a step.
    only = Field(U_SHAPE.vertices, [(350, 380)], [(120, 390)])
    convex = Field([(100, 100), (400, 100), (400, 400), (100, 400)], only.rois, only.starts)
    assert prove(make_problem(convex, NavigationConfig()), LATER).bound == 49
    assert 109 <= prove(make_problem(only, NavigationConfig()), LATER).bound <= 114


def test_surroundings_are_convex_parts_of_the_field() -> None:
    field = star_field(2)
    problem = make_problem(field, NavigationConfig())
    rng = np.random.default_rng(0)
    low, high = field.vertices.min(axis=0), field.vertices.max(axis=0)
    paths = rng.uniform(low, high, (3, 20, 2))
    probes = rng.uniform(low, high, (4000, 2))
    inside = shapely.intersects_xy(field.polygon.buffer(1e-6), probes)
    for normals, offsets in itertools.chain(*surroundings(problem, paths)):
        held = np.all(probes @ normals.T <= offsets, axis=1)
        assert not np.any(held & ~inside)
        assert len(normals) >= 3


# Honesty


def test_an_unreachable_roi_is_reported_at_once() -> None:
    with pytest.raises(UnsolvableError, match=r"rois\[0\] by step 1000"):
        plan(labyrinth(24), time_limit=60.0)
    with pytest.raises(UnsolvableError, match=r"rois\[0\]"):
        plan(Field(SQUARE, [(120, 120)], [(280, 280)]), wind=(0.8, 30.0))
    with pytest.raises(UnsolvableError, match="by step 16"):
        plan("field_03", max_steps=16)


def test_out_of_time_the_interval_is_marked() -> None:
    found = plan("field_06", time_limit=1e-6)
    assert not found.optimal
    assert found.makespan_lower_bound <= 39
    assert found.makespan is None or found.makespan > 39


def test_the_time_limit_holds_where_greed_gets_nowhere() -> None:
    # Blown into a wall for good, the greedy controller goes on until the end of the episode.
    found = plan("field_01", wind=(0.55, 0.0), max_steps=4000, time_limit=1.0)
    assert found.makespan is None
    assert found.makespan_lower_bound > 30
    assert found.seconds < 8.0


def test_plans_do_not_compile_what_robots_would_see(monkeypatch: pytest.MonkeyPatch) -> None:
    engines = []

    def spy(*args: Any, **settings: Any) -> BatchEngine:
        engines.append(BatchEngine(*args, **settings))
        return engines[-1]

    monkeypatch.setattr(replay, "BatchEngine", spy)
    assert plan("field_03", observation="lidar", one_hot=True, reward_sharing="team").optimal
    assert engines and {engine.config.observation for engine in engines} == {"relative"}


def test_bad_input_is_named() -> None:
    with pytest.raises(ConfigError, match="time_limit"):
        plan("field_03", time_limit=0.0)
    with pytest.raises(ConfigError, match="n_robots"):
        plan("field_03", n_robots=4)
    with pytest.raises(ConfigError, match="random_starts"):
        plan("field_03", random_starts=True)
    with pytest.raises(ConfigError, match="mass"):
        plan("field_03", mass=(1.0, 2.0))


# Policies


@pytest.mark.parametrize(("name", "makespan"), [("greedy", 22.0), ("planner", 17.0)])
def test_classical_policies(name: str, makespan: float) -> None:
    field = load_field("field_03")
    summary = evaluate(make_classical(name, field, {}), field, {}, episodes=3).summary()
    assert summary["success_rate"] == 1.0
    assert summary["wall_hits"] == 0.0
    assert 17.0 <= summary["makespan"] <= makespan + (name == "greedy")


@pytest.mark.parametrize("speed", [0.1, 0.3])
def test_the_planner_stands_wind_that_it_did_not_plan_for(speed: float) -> None:
    field = load_field("field_01")
    policy = make_classical("planner", field, {})
    summary = evaluate(policy, field, {"wind": (speed, 30.0)}, episodes=2).summary()
    assert summary["success_rate"] == 1.0
    assert summary["makespan"] < 70


def test_one_policy_serves_many_worlds_and_episodes() -> None:
    engine = BatchEngine("field_03", 3, threads=1)
    engine.reset()
    policy = make_classical("planner", load_field("field_03"), {})
    ends = 0
    for _ in range(2 * 17):
        _, _, terminated, _ = engine.step(policy.act(engine.state(), deterministic=True))
        ends += int(terminated.sum())
    assert ends == 6


def test_unknown_classical_policy() -> None:
    with pytest.raises(MbnError, match="greedy, planner"):
        make_classical("magic", load_field("field_03"), {})


# Benchmark, demonstrations and the command line


def test_the_study_counts_what_was_proved() -> None:
    seen: list[None] = []
    rows, instances = study_planning(lambda: seen.append(None), convex=2, winding=1)
    assert len(seen) == 13
    assert [len(instances[name]) for name in ("catalogue", "convex", "winding")] == [10, 2, 1]
    assert [row.value for row in rows[:1] + rows[2:3] + rows[5:6] + rows[-1:]] == [10, 2, 1, 0]
    wrong = [dataclasses.replace(Attempt(**instances["convex"][0]), bound=99)]
    assert target_rows(wrong, wrong, wrong)[-1].value == 3


def test_demonstrations_are_the_plan() -> None:
    found = plan("field_03")
    arrays = record_demonstrations(found, {})
    np.testing.assert_allclose(arrays["actions"], found.actions, atol=1e-6)
    assert arrays["observations"].shape == (17, 3, 30)
    assert arrays["states"].shape == (17, 13)
    assert arrays["rewards"].sum() == pytest.approx(159_490.0)
    assert arrays["terminations"].tolist() == [False] * 16 + [True]
    noisy = record_demonstrations(found, {}, episodes=3, noise=0.1)
    assert set(noisy["episodes"]) == {0, 1, 2}
    assert noisy["successes"].all()
    assert 0.05 < np.std((noisy["taken"] - noisy["actions"])[5:10]) < 0.15


def test_mbn_plan_prints_draws_and_saves(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out, export = tmp_path / "plan", tmp_path / "demos.npz"
    words = ["plan", "field_03", "-o", str(out), "--export", str(export), "--episodes", "2"]
    assert main(words) == 0
    printed = capsys.readouterr().out
    assert "17 steps" in printed and "yes, proved" in printed
    saved = json.loads((out / "plan.json").read_text())
    assert (saved["makespan"], saved["optimal"], saved["return"]) == (17, True, 159_490.0)
    assert (out / "plan.png").read_bytes()[:4] == b"\x89PNG"
    visits = ", ".join(f"w{roi + 1}" for roi in saved["assignment"][0])
    assert visits in printed, "numbered as in the picture"
    episode = load_episode(out / "episode.json")
    check_episode(episode)
    assert (episode.source, episode.outcome) == ("plan, proved optimal", "success")
    assert (episode.steps, episode.team_return) == (17, 159_490.0)
    with np.load(out / "plan.npz") as arrays:
        assert arrays["actions"].shape == (17, 3, 2)
    with np.load(export) as arrays:
        assert len(arrays["actions"]) == 34
    before = sorted(tmp_path.iterdir())
    for taken in (["-o", str(out)], ["-o", str(tmp_path / "new"), "--export", str(export)]):
        assert main(["plan", "field_03", *taken]) == 2
        assert "--force" in capsys.readouterr().err
    for wrong in (["--n-robots", "9"], ["--time-limit", "-1"], ["--wind", "nan", "0"]):
        assert main(["plan", "field_03", *wrong, "-o", str(out), "--force"]) == 2
        assert wrong[0][2:].replace("-", "_") in capsys.readouterr().err
    assert sorted(tmp_path.iterdir()) == before
    assert main(["plan", "field_03", "--episodes", "2"]) == 2
    assert "--export" in capsys.readouterr().err


def test_mbn_evaluate_takes_classical_policies(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "result.json"
    words = ["--field", "field_03", "--episodes", "2", "--json", str(out)]
    assert main(["evaluate", "planner", *words]) == 0
    assert "0.00%" in capsys.readouterr().out
    result = json.loads(out.read_text())
    assert result["optimum"] == 159_490.0
    assert result["optimality_gap"] == {"stochastic": 0.0, "deterministic": 0.0}
    assert main(["evaluate", "greedy"]) == 2
    assert "field" in capsys.readouterr().err


def test_infos_report_the_gap_at_the_end() -> None:
    found = plan("field_03")
    env = parallel_env("field_03")
    env.reset(seed=0)
    gaps = []
    for actions in found.actions:
        infos = env.step(dict(zip(env.agents, actions, strict=True)))[-1]
        gaps.append({info["optimality_gap"] for info in infos.values()})
    assert gaps == [{0.0}] * 17
    team = centralized_env("field_03")
    team.reset(seed=0)
    gaps = [team.step(np.zeros((3, 2)))[-1]["optimality_gap"] for _ in range(1000)]
    # Of each robot's 1000 steps the first costs 10, the others, on known ground, 100; two ROIs lie
    # exactly 10 units from starts.
    total = 2 * 10_000 - 3 * (10 + 999 * 100)
    assert gaps == [0.0] * 999 + [pytest.approx(1.0 - total / 159_490)]
    assert "optimality_gap" not in centralized_env("field_03", wind=(0.1, 0.0)).reset()[1]


def test_behaviour_cloning_comes_close_to_the_planner() -> None:
    field = load_field("field_03")
    arrays = record_demonstrations(plan(field), {}, episodes=20, noise=0.2)
    policy = clone(arrays["observations"], arrays["actions"], updates=600, hidden=64)
    summary = evaluate(policy, field, {}, episodes=1, deterministic=True).summary()
    assert summary["success_rate"] == 1.0
    assert summary["makespan"] < 30


def test_the_bound_allows_for_steps_across_thin_walls() -> None:
    # Only positions after steps have to be in the field: at full force a robot strides across.
    wall = [(140.0, 110.0), (142.0, 110.0), (142.0, 290.0), (140.0, 290.0)]
    field = Field(SQUARE, [(160.0, 200.0)], [(120.0, 200.0)], holes=[wall])
    engine = BatchEngine(field, 1, autoreset="disabled", threads=1)
    engine.reset()
    ended = False
    while not ended:
        ended = bool(engine.step(np.array([[[1.0, 0.0]]]))[2][0])
    metrics = engine.metrics()
    assert metrics["success"][0] and metrics["wall_hits"].sum() == 0
    assert prove(make_problem(field, NavigationConfig()), LATER).bound <= metrics["steps"][0]


def test_many_rois_have_a_plan_and_a_bound() -> None:
    rng = np.random.default_rng(0)
    rois = [(x, y) for x, y in rng.uniform(110.0, 290.0, (16, 2))]
    found = plan(Field(SQUARE, rois, [(120, 120), (280, 280)]), time_limit=10.0)
    assert found.makespan is not None
    assert 20 < found.makespan_lower_bound <= found.makespan
    assert sorted(itertools.chain(*found.assignment)) == list(range(16))
