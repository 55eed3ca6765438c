"""Policies without learning, and their commands."""

import json

import numpy as np
import pytest

from baselines.cli import main
from baselines.evaluation.evaluate import evaluate, is_one_episode
from baselines.evaluation.rollout import record_episode
from baselines.policies.classical import make_classical
from baselines.policies.policy import Alone, Origin, Policy, RandomPolicy
from baselines.policies.shielded import Shielded
from mbn_marl import BatchEngine, Field, load_field
from mbn_marl.config import Failures, make_config
from mbn_marl.episode import check_episode, load_episode
from mbn_marl.errors import ConfigError
from mbn_marl.planning import plan

pytestmark = pytest.mark.slow
FIELD = load_field("field_03")


@pytest.mark.parametrize(
    ("name", "makespan"), [("greedy", 22), ("planner", 17), ("replan", 17), ("open-loop", 17)]
)
def test_classical_policies(name, makespan):
    summary = evaluate(make_classical(name, FIELD, {}), FIELD, {}, episodes=3).summary()
    assert (summary["success_rate"], summary["wall_hits"]) == (1.0, 0.0)
    assert 17.0 <= summary["makespan"] <= makespan + (name == "greedy")


def test_they_leave_out_the_empty_rois():
    own = {"observation": "entities", "knowledge": "own", "decoys": 3}
    engine = BatchEngine(FIELD, 3, seed=4, autoreset=False, **own)
    engine.reset()
    bounds = [plan(FIELD, visited=np.flatnonzero(row).tolist()).makespan for row in engine.decoys]
    assert min(bounds) < 17
    for name in ("greedy", "planner", "replan", "open-loop"):
        found = evaluate(make_classical(name, FIELD, own), FIELD, own, episodes=3, seed=4)
        assert found.successes == [True] * 3
        assert found.steps == bounds or name == "greedy"


@pytest.mark.parametrize(("name", "field"), [("open-loop", "field_04"), ("blind", "field_03")])
def test_actions_of_another_field_and_of_blind_robots_fail(name, field):
    policy, where = make_classical(name, load_field(field), LOCAL), {**LOCAL, "max_steps": 200}
    assert evaluate(policy, FIELD, where, episodes=1).successes == [False]


LOCAL = {"observation": "lidar_local", "knowledge": "own", "comm_radius": 50.0}


@pytest.mark.parametrize("field", ["field_03", "field_09"])  # field_09 has corners to go round
@pytest.mark.parametrize("change", [{}, {"hidden_rois": True, "sensing_radius": 50.0}], ids=str)
def test_greedy_local_acts_on_each_robots_row_alone(field, change):
    place, settings = load_field(field), {**LOCAL, **change}
    team, alone = (make_classical("greedy-local", place, settings) for _ in range(2))
    engine = BatchEngine(place, 2, **settings)
    observations, robots = engine.reset(), alone.fit(engine)
    assert isinstance(robots, Alone)
    ends = 0
    while ends < 4:
        actions = team.act(observations, deterministic=True)
        np.testing.assert_array_equal(robots.act(observations, deterministic=True), actions)
        observations, _, terminated, truncated = engine.step(actions)
        if (ended := terminated | truncated).any():
            assert engine.metrics(["success"])["success"][ended].all()
            assert not engine.metrics(["wall_hits"])["wall_hits"][ended].any()
            ends += ended.sum()
            for policy in (team, robots):
                policy.reset(ended)


WINDS = tuple({"wind": wind} for wind in ((0.35, 0), (0.35, 90), (0.2, 215)))
FAULTS = tuple({"failures": Failures(at={i: t})} for i, t in ((0, 5), (1, 8), (2, 7), (2, 12)))


@pytest.mark.parametrize(("name", "most"), [("greedy", 36), ("replan", 31)])
@pytest.mark.parametrize("worlds", [WINDS, FAULTS], ids=["windy", "failing"])
def test_a_policy_finds_out_what_each_of_its_worlds_is_like(name, most, worlds):
    policy = make_classical(name, FIELD, worlds[0])
    engines = [BatchEngine(FIELD, 1, autoreset="disabled", **world) for world in worlds]
    for engine in engines:
        engine.reset()
    for _ in range(most):
        states = np.concatenate([engine.state() for engine in engines])
        actions = policy.act(states, deterministic=True)
        for engine, action in zip(engines, actions, strict=True):
            assert not action[engine.failed[0]].any()
            if engine.running[0]:
                engine.step(action[None])
    assert [engine.snapshot().success for engine in engines] == [True] * len(worlds)


def test_mbn_plan_prints_draws_and_saves(tmp_path, capsys, refusal):
    out = tmp_path / "plan"
    assert main(["plan", "field_03", "-o", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "17 steps" in printed and "yes, proved" in printed
    saved = json.loads((out / "plan.json").read_text())
    assert (saved["makespan"], saved["optimal"], saved["return"]) == (17, True, 159_490.0)
    assert (out / "plan.png").read_bytes()[:4] == b"\x89PNG"
    episode = load_episode(out / "episode.json")
    check_episode(episode)
    assert (episode.source, episode.outcome) == ("plan, proved optimal", "success")
    assert (episode.steps, episode.team_return) == (17, 159_490.0)
    before = sorted(tmp_path.iterdir())
    assert str(out) in refusal(["plan", "field_03", "-o", str(out)])
    assert "wind" in refusal(["plan", "field_03", "--wind", "nan", "0", "-o", str(out), "--force"])
    assert sorted(tmp_path.iterdir()) == before


def test_mbn_evaluate_takes_classical_policies(tmp_path, capsys):
    out = tmp_path / "result.json"
    words = ["--field", "field_03", "--episodes", "2", "--json", str(out)]
    assert main(["evaluate", "planner", *words]) == 0
    assert "0.0%" in capsys.readouterr().out
    result = json.loads(out.read_text())
    assert (result["stochastic"]["gap"], result["deterministic"]["spl"]) == (0.0, 1.0)
    assert result["deterministic"]["per_episode"]["bounds"] == [17, 17]


LEFT, RIGHT = [(100, 250), (100, 100), (200, 100)], [(300, 100), (300, 250)]
SLOT = Field(  # a rectangle with a wall into its middle
    [*LEFT, (200, 160), (204, 160), (204, 100), *RIGHT],
    [(250, 120), (290, 240)],
    [(150, 120), (150, 140), (150, 160), (250, 140)],
)
YARD = Field(  # with a hole
    [(100, 100), (300, 130), (280, 300), (120, 280)],
    [(270, 280), (200, 150)],
    [(130, 140), (150, 150), (130, 170)],
    holes=[[(190, 180), (230, 190), (210, 230)]],
)
FAILURES = {"failures": Failures(at={1: 30})}


class Pusher(Policy):
    observes = "state"

    def __init__(self, field: Field) -> None:
        self.steps, self.robots = 0, len(field.starts)

    def act(self, seen: np.ndarray, *, deterministic: bool) -> np.ndarray:
        n, self.steps = self.robots, self.steps + 1
        places = seen[:, : 2 * n].reshape(-1, n, 2)
        turn = self.steps // 40
        if turn % 2:
            inward = places.mean(axis=1, keepdims=True) - places
            return np.sign(inward).astype(np.float32)
        angle = 2.4 * turn + (0.0 if deterministic else 0.5)
        force = 2.0 * np.array([np.cos(angle), np.sin(angle)], np.float32)
        return np.broadcast_to(force, places.shape)


@pytest.mark.parametrize(
    ("field", "settings"),
    [(SLOT, {}), (YARD, {"wind": (0.2, 200.0)}), (YARD, FAILURES)],
    ids=["slot", "windy", "failing"],
)
def test_a_team_that_pushes_against_walls_and_robots_does_not_touch_them(field, settings):
    world = {**settings, "max_steps": 300}
    bare = evaluate(Pusher(field), field, world, episodes=2)
    assert any(bare.collisions) and any(bare.wall_hits)
    shielded = evaluate(Shielded(Pusher(field)), field, world, episodes=2)
    assert not any(shielded.collisions) and not any(shielded.wall_hits)
    assert min(shielded.steps) > max(bare.steps)


def test_a_policy_that_brakes_itself_acts_as_without():
    field = load_field("field_03")
    alone = record_episode(make_classical("greedy", field, {}), field, {})
    policy = Shielded(make_classical("greedy", field, {}))
    np.testing.assert_array_equal(record_episode(policy, field, {}).actions, alone.actions)
    assert is_one_episode(policy, {}, deterministic=False)
    assert not is_one_episode(Shielded(RandomPolicy()), {}, deterministic=True)


class Trained(Policy):
    origin = Origin(YARD, make_config({}))

    def act(self, seen: np.ndarray, *, deterministic: bool) -> np.ndarray:
        self.seen = seen
        return np.full((len(seen), 3, 2), 0.1, np.float32)


def test_a_trained_policy_is_fitted_behind_the_shield():
    policy, engine = Trained(), BatchEngine(YARD, 2, threads=1, **FAILURES)
    shown = engine.reset()
    actions = Shielded(policy).fit(engine).act_in(engine, shown)
    np.testing.assert_array_equal(actions, policy.act(policy.seen, deterministic=True))
    assert shown.shape[-1] - policy.seen.shape[-1] == 3, "without the flags of failures"
    with pytest.raises(ConfigError, match="robots: "):
        Shielded(policy).fit(BatchEngine(YARD, 1, threads=1, n_robots=2))


def test_the_command(tmp_path, capsys, refusal):
    words = ["evaluate", "random", "--field", "field_03", "--episodes", "2", "--shield"]
    out = tmp_path / "out.json"
    assert main([*words, "--json", str(out)]) == 0
    assert "random in field_03 + shield" in capsys.readouterr().out
    found = json.loads(out.read_text())
    assert found["shield"] is True
    assert found["stochastic"]["collision_rate"] == 0.0
    assert evaluate(RandomPolicy(), "field_03", {}, episodes=2).collisions == [True, True]
    engine = BatchEngine("field_03", 1, threads=1, dynamics=("unicycle", "point_mass", "bicycle"))
    with pytest.raises(ConfigError, match=r"dynamics: \['bicycle', 'unicycle'\]"):
        Shielded(RandomPolicy()).fit(engine)
    assert "dynamics: " in refusal([*words, "--condition", "mixed"])
