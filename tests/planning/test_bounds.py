"""The proved bounds: closed forms, the relaxation, and brute force on small instances."""

import itertools
import math

import numpy as np
import pytest

from mbn_marl import BatchEngine
from mbn_marl.config import NavigationConfig, make_config
from mbn_marl.field import Field
from mbn_marl.planning import partition, plan
from mbn_marl.planning.legs import NEVER, proved_legs
from mbn_marl.planning.linear_program import make_solver
from mbn_marl.planning.orders import UndecidedError
from mbn_marl.planning.planner import prove
from mbn_marl.planning.problem import make_problem
from mbn_marl.planning.relaxation import Disc, Region, Relaxation, StepWindows, fixed_windows
from tests.support.planning_cases import SQUARE, U_SHAPE, brute_force, small_field

pytestmark = pytest.mark.slow
LATER = 1e12  # a deadline that never comes


@pytest.mark.parametrize(
    ("seed", "n", "wind", "velocity"),
    [
        *((seed, 2, None, (0.0, 0.0)) for seed in range(5)),
        *((seed, 1, (0.2, 200.0), (0.0, 0.0)) for seed in (10, 11)),
        *((10, 1, None, (3.0, -4.0)), (11, 1, None, (-2.0, 1.5))),
    ],
)
def test_the_bound_agrees_with_brute_force(seed, n, wind, velocity):
    """The bound lies between the answers for slightly larger and slightly smaller discs."""
    kinds = {"roi_kinds": (0, 1), "start_kinds": (0, 1)} if seed in (2, 4) else {}
    field, config = small_field(seed, n=n, **kinds), make_config({"wind": wind} if wind else {})
    bound = prove(make_problem(field, config).moving([velocity] * n), LATER).bound
    how = {"wind": config.wind_increment(), "velocity": velocity}
    least = brute_force(field, 10.0 / math.cos(math.pi / 48), **how)
    assert bound == least or least < bound <= brute_force(field, 10.0, **how)


def test_legs_by_hand():
    # From rest an axis moves 0.5, 1.5, 3, 5, 7.5, ...; discs of 10 are reached 10 units early.
    offsets = [(17.4, 0.0), (17.6, 0.0), (0.0, 9.0), (6.0 + 3.0, 8.0 + 3.0), (9.1, 11.1)]
    rois = [(150.0 + x, 150.0 + y) for x, y in offsets]
    problem = make_problem(Field(SQUARE, rois, [(150.0, 150.0)]), NavigationConfig())
    assert proved_legs(problem, 1e-6, 100).first.tolist() == [[5, 6, 1, 3, 4]]
    assert proved_legs(problem, 1e-6, 5).first[0, 1] == NEVER
    # At 2 units a step 2.5, 5.5, 9 ahead, 7.4 by step 3; at -2 first back, then 7.5 by step 10.
    for velocity, steps in ((2.0, 3), (-2.0, 10)):
        moving = problem.moving([(velocity, 0.0)])
        assert proved_legs(moving, 1e-6, 100).first[0, 0] == steps
    # Between discs: 30 - 20 = 10 units at 5 a step; from 110 to 170.2, 60.2 - 20 = 40.2; overlap.
    rois = [(110.0, 110.0), (140.0, 110.0), (140.1, 170.2), (120.0, 110.0)]
    problem = make_problem(Field(SQUARE, rois, [(200.0, 200.0)]), NavigationConfig())
    between = proved_legs(problem, 1e-9, 100).between
    assert [between[0, 1], between[1, 2], between[0, 3]] == [2, 9, 0]


@pytest.mark.parametrize("few", [partition.FEW_ROIS, 0])  # both searches
@pytest.mark.parametrize("seed", range(3))
def test_partitions_against_enumeration(seed, few, monkeypatch):
    monkeypatch.setattr(partition, "FEW_ROIS", few)
    rng = np.random.default_rng(seed)
    masks = np.arange(32)
    shares = [[mask >> j & 1 for j in range(5)] for mask in range(32)]
    costs = np.stack([shares @ rng.integers(1, 20, 5) for _ in range(3)])
    costs += 5 * (np.sum(shares, axis=1) > 2)
    totals, worst = [], []
    for owners in itertools.product(range(3), repeat=5):
        parts = [sum(1 << j for j in range(5) if owners[j] == i) for i in range(3)]
        each = [int(costs[i, mask]) for i, mask in enumerate(parts)]
        totals.append(sum(each))
        worst.append(max(each))
    assert partition.least_makespan(masks, costs, 31) == min(worst)
    for most in (min(worst), min(worst) - 1):
        allowed = np.where(costs <= most, costs, NEVER)
        chosen = partition.cheapest_partition(masks, allowed, 31)
        assert (chosen is None) == (most < min(worst))
        if chosen is not None:
            assert sum(chosen) == np.bitwise_or.reduce(chosen) == 31
            assert max(allowed[i, mask] for i, mask in enumerate(chosen)) <= most
    chosen = partition.cheapest_partition(masks, costs, 31)
    assert chosen is not None
    if few:
        assert sum(costs[i, mask] for i, mask in enumerate(chosen)) == min(totals)


def test_a_search_that_is_cut_short_proves_nothing(monkeypatch):
    monkeypatch.setattr(partition, "FEW_ROIS", 0)
    monkeypatch.setattr(partition, "MOST_NODES", 0)
    costs = np.array([[0, 3, 4, 9], [0, 5, 6, 9]])
    with pytest.raises(UndecidedError):
        partition.cheapest_partition(np.arange(4), costs, 3)
    assert partition.least_makespan(np.arange(4), costs, 3) == 0


def straight(first: int, last: int) -> tuple[Relaxation, StepWindows]:
    """From rest at the origin to the disc of radius 1 about (8.5, 0), in a window of steps."""
    normals = np.array([[1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
    region = Region(normals, np.full(4, 50.0), (-50.0, -50.0), (50.0, 50.0))
    problem = make_problem(Field(SQUARE, [(150, 150)], [(200, 200)]), NavigationConfig())
    at_rest, disc = (0.0, 0.0, 0.0, 0.0), Disc((8.5, 0.0), 1.0)
    relaxation = Relaxation(at_rest, problem.drives[0], region, (disc,))
    return relaxation, StepWindows((first,), (last,), (first,), (last,))


def test_the_relaxation_is_exact_at_fixed_times():
    for steps, inflation in ((4, 2.5), (5, 0.0), (6, -1.0)):
        relaxation, _ = straight(steps, steps)
        windows, tangents = fixed_windows([steps]), relaxation.tangents()
        solved = relaxation.solve(make_solver(), windows, tangents, 100.0)
        found = (solved.bound, solved.inflation)
        assert found == pytest.approx((inflation, inflation), abs=1e-4), steps
        assert solved.bound <= solved.inflation + 1e-9, steps


def test_a_program_that_cannot_be_met_has_an_infinite_bound():
    relaxation, windows = straight(4, 4)
    east = Region(np.array([[-1.0, 0.0]]), np.array([-9.0]), (9.0, -50.0), (50.0, 50.0))
    far = relaxation.with_via(0, east)  # 9 units away after a step
    solved = far.solve(make_solver(), fixed_windows([1, 4]), far.tangents(), 100.0)
    assert solved.bound == np.inf
    highs = make_solver()
    highs.setOptionValue("simplex_iteration_limit", 2)  # the bound holds all the same
    assert relaxation.solve(highs, windows, relaxation.tangents(), 100.0).bound <= 2.5 + 1e-9


def test_bounds_hold_where_rounding_of_a_strong_wind_moves_robots():
    # Force and wind all but cancel, and what is left of their float32 values is a little more.
    settings = {"f_max": 1000.2, "wind": (1000.05, 0.0)}
    lane = [(100.0, 100.0), (900.0, 100.0), (900.0, 300.0), (100.0, 300.0)]
    engine = BatchEngine(Field(lane, [(120, 200)], [(880, 200)]), 1, threads=1, **settings)
    engine.reset()
    for _ in range(30):
        engine.step(np.array([[[-1.0, 0.0]]]))
    reached = float(engine.snapshot().positions[0, 0])
    assert reached < 880.0 - 0.15 * 30 * 31 / 2 - 0.01
    field = Field(lane, [(reached - 9.999, 200.0)], [(880, 200)])
    assert prove(make_problem(field, make_config(settings)), LATER).bound <= 30


def test_long_episodes_do_not_weaken_the_bound():
    # Rounding may do much in 100,000 steps, but little in the 250 that matter here.
    field = Field(SQUARE, [(280, 200)], [(110, 200)])
    settings = {"f_max": 0.005, "max_steps": 100_000}
    # From rest, 160 units take 0.005 L (L + 1) / 2 >= 160.
    assert prove(make_problem(field, make_config(settings)), LATER).bound == 253


def test_the_shape_of_the_field_bounds_the_plan():
    # The straight way from (120, 390) to the disc about (350, 380) takes 48 steps; round the wall,
    # less what steps may cut off, it is (236.5 - 3.5) + 93 + 226.5 - 10 units at 5 a step.
    only = Field(U_SHAPE.vertices, [(350, 380)], [(120, 390)])
    convex = Field([(100, 100), (400, 100), (400, 400), (100, 400)], only.rois, only.starts)
    assert prove(make_problem(convex, NavigationConfig()), LATER).bound == 49
    assert 109 <= prove(make_problem(only, NavigationConfig()), LATER).bound <= 114


def test_the_bound_allows_for_steps_across_thin_walls():
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


@pytest.mark.parametrize(("seed", "more"), [(0, 1), (1, 0), (11, 3), (13, 2)])
def test_the_bound_goes_round_an_obstacle(seed, more):
    # An integer program over the hole's edges gave the same numbers.
    rng = np.random.default_rng(seed)
    start, roi = np.array([150.0, 190.0]), np.array([190.0, 200.0])
    corners = np.array([170.0, 195.0]) + rng.uniform(-24.0, 24.0, (3, 2))
    walled = Field(SQUARE, [tuple(roi)], [tuple(start)], holes=[corners])
    bound = plan(walled).makespan_lower_bound
    assert bound == plan(Field(SQUARE, [tuple(roi)], [tuple(start)])).makespan_lower_bound + more
