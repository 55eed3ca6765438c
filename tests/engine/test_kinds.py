"""ROIs for robots of one kind, by hand; ``test_forms`` compares the oracle."""

import itertools

import numpy as np
import pytest

from baselines import load_policy
from baselines.policies.classical import make_classical
from mbn_marl import BatchEngine, Field
from mbn_marl.errors import ConfigError
from mbn_marl.planning import plan
from tests.support.configurations import entries
from tests.support.planning_cases import SQUARE

PLACES = {
    **{"vertices": SQUARE, "rois": [(120.0, 120.0), (280.0, 120.0), (200.0, 140.0)]},
    **{"starts": [(120.0, 120.0), (280.0, 120.0)], "name": "swap"},
}
PLAIN, SWAP = Field(**PLACES), Field(**PLACES, roi_kinds=(7, 3, None), start_kinds=(3, 7))


@pytest.mark.slow
def test_robots_visit_the_rois_of_their_kind():
    engine = BatchEngine([SWAP, PLAIN], 2, autoreset=False, observation="lidar_local")
    engine.reset()
    for robot, mine in enumerate([[0.0, 1.0, 1.0], [1.0, 0.0, 1.0]]):
        assert [entries(engine, robot)[f"roi_{j}_mine"] for j in range(3)] == mine
        assert [entries(engine, robot, 1)[f"roi_{j}_mine"] for j in range(3)] == [1.0] * 3
    engine.step(np.zeros((2, 2, 2)))
    assert engine.metrics()["rois_visited"].tolist() == [0, 2]
    # Robot 0 comes to the ROI without a kind, robot 1 to one of the other kind.
    saved = engine.save_state()
    saved["now.x"][:, 0], saved["now.y"][:, 0] = (210.5, 280.0), (140.0, 130.5)
    engine.load_state(saved)
    _, rewards, _, _ = engine.step(np.array([[[-1.0, 0.0], [0.0, -1.0]]] * 2))
    assert engine.snapshot().visited.tolist() == [False, False, True]
    assert rewards[0].tolist() == [10_000.0 - 10.0, -10.0]
    for field, place in ((SWAP, "n_robots"), (PLAIN, "field")):
        with pytest.raises(ConfigError, match=place):
            BatchEngine(field, 1, n_robots=1).set_field(SWAP)
    with pytest.raises(ConfigError, match="n_robots"):
        BatchEngine(SWAP, 1, n_robots=3, random_starts=True)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["greedy", "planner", "replan", "greedy-local"])
def test_classical_policies_keep_to_their_kinds(name):
    own = {"observation": "lidar_local", "knowledge": "own"} if name == "greedy-local" else {}
    policy = make_classical(name, SWAP, own)
    engine = BatchEngine(SWAP, 1, autoreset=False, max_steps=200, **own)
    seen, policy = engine.reset(), policy.fit(engine)
    while engine.running[0]:
        seen, *_ = engine.step(policy.act_in(engine, seen))
    assert engine.snapshot().success


@pytest.mark.slow
def test_a_policy_over_sets_acts_on_kinds_that_it_has_not_met():
    field = Field(**{**SWAP.to_dict(), "starts": [(120.0, 120.0), (280.0, 180.0)]})
    policy = load_policy("zoo:generalist", field)
    engine = BatchEngine(field, 1, autoreset=False, **policy.settings)
    seen, policy = engine.reset(), policy.fit(engine)
    for robot, left in enumerate([[0.0, 1.0, 1.0], [1.0, 0.0, 1.0]]):
        assert [entries(engine, robot)[f"roi_{j}_left"] for j in range(3)] == left
        assert entries(engine, robot)[f"roi_{1 - robot}_others"] == 1.0  # the other may not go
    while engine.running[0]:
        seen, *_ = engine.step(policy.act_in(engine, seen, deterministic=True))
    assert engine.snapshot().success


@pytest.mark.slow
def test_plans_are_bounded_by_the_kinds():
    plain, swap = plan(PLAIN), plan(SWAP)
    assert plain.makespan < swap.makespan_lower_bound <= swap.makespan
    assert set(swap.assignment[0]) in ({1}, {1, 2}) and set(swap.assignment[1]) in ({0}, {0, 2})
    assert sorted(itertools.chain(*swap.assignment)) == [0, 1, 2]
