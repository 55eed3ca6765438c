"""``from baselines import load_policy``: how a policy comes into a user's program."""

import subprocess
import sys
from typing import Any

import numpy as np
import pytest

from baselines import load_policy
from baselines.evaluation.evaluate import evaluate
from baselines.evaluation.rollout import record_episode
from baselines.policies.classical import make_classical
from baselines.policies.load import load_trained, merge_settings, open_run
from baselines.policies.policy import Observes, Origin, Policy
from baselines.runs.files import RunError
from mbn_marl import BatchEngine, Field, Uniform, load_field, parallel_env
from mbn_marl.config import CONDITIONS, make_config
from mbn_marl.errors import ConfigError, MbnError
from mbn_marl.field import load_fields
from tests.support.problems import places_of

LIDAR = {"observation": "lidar"}
pytestmark = pytest.mark.slow

WITHOUT = """
import sys

class Absent:
    def find_spec(self, name, path=None, target=None):
        if name.split(".")[0] in %r:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Absent())
from baselines.cli.main import main
sys.exit(main(%r))
"""
LEARNERS = ("torch", "filelock", "pandas", "safetensors", "optuna", "supersuit")
PLANNER = (*LEARNERS, "scipy", "highspy", "clarabel")
PICTURES = (*PLANNER, "matplotlib", "pygame", "PIL")


@pytest.mark.parametrize(
    ("command", "absent", "missing"),
    [
        ("zoo", PICTURES, ""),
        ("fields", PICTURES, ""),
        ("evaluate random --field field_03 --episodes 2", PICTURES, ""),
        ("plan field_03 --out plan", (*LEARNERS, "pygame"), ""),
        ("render field_03 -o actions.gif", PLANNER, ""),
        ("watch nobody", PLANNER, "nobody: "),
        ("evaluate zoo:field_03", ("torch",), "'torch'"),
    ],
)
def test_commands_need_no_other_extras(command, absent, missing, tmp_path):
    program = WITHOUT % (absent, command.split())
    run = subprocess.run(
        [sys.executable, "-c", program], cwd=tmp_path, capture_output=True, text=True
    )
    assert run.returncode == (2 if missing else 0), run.stderr
    assert missing in run.stderr
    assert ("No module" in run.stderr) == (".[baselines]" in run.stderr) == (absent == ("torch",))


def test_a_policy_of_the_zoo_acts_as_in_an_evaluation():
    run = open_run("zoo:field_07")
    evaluated = record_episode(load_trained(run), run.field, run.config["environment"])
    policy = load_policy("zoo", "field_07")
    assert policy.observes == "observations" and policy.field == run.field
    assert repr(policy) == "LoadedPolicy('zoo in field_07', field='field_07')"
    env = parallel_env(policy.field, **policy.settings)
    seen, _ = env.reset(seed=0)
    for expected in evaluated.actions:
        assert env.agents
        actions = policy.act(dict(reversed(seen.items())))
        taken = np.stack([actions[agent] for agent in env.agents])
        assert taken.dtype == np.float32
        np.testing.assert_array_equal(taken, expected)
        rows = np.stack(list(seen.values()))
        np.testing.assert_array_equal(policy.act(rows), taken)
        np.testing.assert_array_equal(policy.act(np.stack([rows, rows])), np.stack([taken] * 2))
        last = policy.act({"robot_2": seen["robot_2"]})
        np.testing.assert_array_equal(last["robot_2"], taken[2])
        seen, *_ = env.step(actions)
    assert not env.agents and policy.act({}) == {}


def test_a_policy_of_any_field_acts_for_the_robots_that_are_there():
    policy = load_policy("zoo:generalist-hint")
    env = parallel_env(load_fields("random_convex"), **policy.settings)
    most = env.possible_agents
    seeds = iter(range(50))
    seen, _ = env.reset(seed=next(seeds))
    while most[-1] in seen:
        seen, _ = env.reset(seed=next(seeds))
    rows = np.array([seen.get(agent, np.zeros_like(seen["robot_0"])) for agent in most])
    wanted = policy.act(rows)
    actions = policy.act_in(env, seen)
    assert actions.keys() == seen.keys()
    for agent, action in actions.items():
        np.testing.assert_array_equal(action, wanted[most.index(agent)])
    with pytest.raises(ConfigError, match="observations: "):
        policy.act(seen)


@pytest.mark.parametrize("name", ["greedy", "planner"])
def test_policies_on_the_state_take_it_and_begin_again(name):
    field = load_field("field_03")
    evaluated = record_episode(make_classical(name, field, LIDAR), field, LIDAR)
    policy = load_policy(name, "field_03", **LIDAR)
    assert policy.observes == "state"
    env = parallel_env(field, **policy.settings)
    for limit in (5, None):  # a first episode is left in the middle
        seen, _ = env.reset()
        for expected in evaluated.actions[:limit]:
            if limit is None:
                actions = policy.act_in(env, seen)
            else:
                actions = dict(zip(env.agents, policy.act(env.state()), strict=True))
            np.testing.assert_array_equal(list(actions.values()), expected)
            seen, *_ = env.step(actions)
    assert not env.agents


def test_a_loaded_policy_knows_the_empty_rois_of_every_world_and_forgets_no_episode():
    own = {"knowledge": "own", "decoys": 3, "max_steps": 60}
    policy = load_policy("greedy", "field_03", **own)
    engine = BatchEngine("field_03", 4, seed=5, autoreset="disabled", **policy.settings)
    seen, steps = engine.reset(), np.zeros(4, int)
    while engine.running.any():
        if steps.max() == 3:
            found = evaluate(policy, policy.field, policy.settings, episodes=4, seed=5)
        steps += engine.running
        seen, *_ = engine.step(policy.act_in(engine, seen))
    assert steps.tolist() == found.steps and found.successes == [True] * 4


def test_wrong_observations_and_sources_are_refused_by_place(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "greedy").mkdir()  # as mbn benchmark greedy --out greedy makes it
    policy = load_policy("zoo:field_07")
    with pytest.raises(ConfigError, match=r"zoo:field_07.*\n.*\(2, 3, 30\)"):
        policy.act(np.zeros((2, 3, 30)))
    with pytest.raises(ConfigError, match="robot_1: ") as caught:
        policy.act({"robot_3": np.zeros(55), "robot_0": np.zeros(55), "robot_1": np.zeros(30)})
    assert len(caught.value.problems) == 2
    greedy = load_policy("greedy", "field_07")
    for wrong in (np.zeros((2, 14)), {"robot_0": np.zeros(55)}):
        with pytest.raises(ConfigError, match=r"state\(\)"):
            greedy.act(wrong)
    lonely = Field([(0, 0), (90, 0), (90, 90), (0, 90)], [(70, 70)], [(20, 20)], name="lonely")
    sources = [
        (("zoo:nothing",), MbnError, "zoo:nothing"),
        ((tmp_path,), RunError, str(tmp_path)),
        (("gredy",), RunError, "gredy"),
        (("greedy",), ConfigError, r"field: greedy.*load_policy\('greedy', 'field_03'\)"),
        (("zoo:field_03", lonely), ConfigError, r"lonely(.|\n)*robots: .*\n.*ROIs"),
    ]
    for source, error, place in sources:
        with pytest.raises(error, match=place):
            load_policy(*source)


@pytest.fixture
def write(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)

    def write(text: str) -> str:
        name = f"own_{abs(hash((tmp_path, text)))}"
        (tmp_path / f"{name}.py").write_text(f"import math\n{text}", encoding="utf-8")
        return name

    return write


OWN = """
class Counting:
    settings = {"observation": "lidar", "max_steps": 2}
    def __init__(self, field):
        self.field, self.began = field, []
    def act(self, observations, deterministic=True):
        return observations[..., :2] * (1.0 if deterministic else 0.5)
    def reset(self, worlds=None):
        self.began.append(None if worlds is None else worlds.tolist())

def function(field):
    return lambda observations: 0.5 * observations[..., :2]
"""


def test_a_policy_of_ones_own(write):
    module = write(OWN)
    policy = load_policy(f"{module}:Counting", "field_03", max_steps=3)
    assert policy.settings == {"observation": "lidar", "max_steps": 3}
    seen = np.random.default_rng(0).uniform(-1.0, 1.0, (2, 3, 55)).astype(np.float32)
    np.testing.assert_array_equal(policy.act(seen), seen[..., :2])
    np.testing.assert_array_equal(policy.act(seen, deterministic=False), seen[..., :2] / 2)
    half = load_policy(f"{module}:function")  # of any field
    actions = half.act(seen[:, :2, :9], deterministic=True)
    np.testing.assert_array_equal(actions, seen[:, :2, :2] / 2)
    summary = evaluate(policy, "field_03", policy.settings, episodes=2, deterministic=True)
    assert summary.steps == [3, 3]
    own = policy.policy
    assert own._made.began == [None, [True, True]] and own._made.field == policy.field


BAD = """
class Bad:
    settings, observes, act = {"obsevation": "lidar", "max_steps": 0}, "everything", None
    def __init__(self, field): pass

class Deaf(Bad):
    settings, observes = {}, "state"
    def act(self): pass

def none(): pass
def flat(field): return lambda observations: observations[..., 0]
"""


def test_mistakes_in_ones_own_are_listed(write):
    module = write(BAD)
    for name, places in (
        ("Bad", ["act", "observes", "max_steps", "obsevation"]),
        ("Deaf", ["act()"]),
        ("none", ["none()"]),
        ("math.pi", ["math.pi is float"]),
        ("nothing", ["'nothing'"]),
    ):
        with pytest.raises(ConfigError, match=f"{module}:{name}") as caught:
            load_policy(f"{module}:{name}", "field_03")
        for problem, place in zip(caught.value.problems, places, strict=True):
            assert place in problem
    with pytest.raises(ConfigError, match="own_missing"):
        load_policy("own_missing:make")
    with pytest.raises(ModuleNotFoundError, match="not_installed"):
        load_policy(f"{write('import not_installed')}:make")
    with pytest.raises(ConfigError, match=rf"{module}:flat(.|\n)*\(2, 3\)"):
        load_policy(f"{module}:flat").act(np.zeros((2, 3, 4)))


CORNERS = [(0, 0), (200, 0), (200, 200), (0, 200)]
HOME = Field(CORNERS, [(130, 100)], [(100, 100), (20, 100)], arena=(200, 200))
LARGER = Field(CORNERS, HOME.rois, HOME.starts, arena=(400, 400))
OTHER = Field(CORNERS, [(130, 100), (50, 50)], HOME.starts, arena=(300, 200))
SHOWN = {
    **{"dynamics": ("point_mass", "unicycle"), "failures": {"at": {1: 3}}},
    **{"wind": (0.1, 30.0), "max_steps": 6},
}
"""Every observation has entries of headings and failures."""


class Trained(Policy):
    def __init__(self, observes: Observes = "observations", **settings: Any) -> None:
        self.observes, self.origin = observes, Origin(HOME, make_config(settings))
        self.seen: np.ndarray | None = None

    def act(self, seen: np.ndarray, *, deterministic: bool) -> np.ndarray:
        if self.seen is None:
            self.seen = seen.copy()
        return np.zeros((len(seen), 2, 2), np.float32)


def refused(policy: Policy, field: Field, settings: dict[str, Any]) -> list[str]:
    named = places_of(ConfigError, evaluate, policy, field, settings)
    assert named == places_of(ConfigError, record_episode, policy, field, settings)
    return named


def test_all_that_differs_is_named_at_once():
    one_robot = {"n_robots": 1, "observation": "lidar"}
    seen = ["robots", "ROIs", "arena", "observation"]
    for policy, field, settings, named in (
        (Trained(), LARGER, {}, ["arena"]),
        (Trained(), OTHER, one_robot, seen),
        (Trained(), HOME, {"v_clip": (5.0, 6.0)}, ["v_clip"]),
        (Trained("state"), LARGER, {"n_robots": 1}, ["robots"]),
        (Trained(**SHOWN), HOME, {}, ["headings"]),
        (Trained("state", **SHOWN), HOME, {}, ["headings"]),
        (Trained(observation="lidar_local"), HOME, {"observation": "lidar"}, ["observation"]),
    ):
        assert refused(policy, field, settings) == named, (field, settings)
    with pytest.raises(ConfigError, match="v_clip: "):
        evaluate(Trained(), HOME, {"v_clip": Uniform(4.0, 7.0)}, episodes=1)
    run = open_run("zoo:field_03")
    larger = Field(run.field.vertices, run.field.rois, run.field.starts, arena=(900, 900))
    assert refused(load_trained(run), larger, run.config["environment"]) == ["arena"]


@pytest.mark.parametrize("observes", ["observations", "state"])
def test_entries_that_a_policy_was_not_trained_with_are_not_shown_to_it(observes):
    engine = BatchEngine(HOME, 1, **SHOWN)
    engine.reset()
    if observes == "state":
        shown, plain = engine.state(), BatchEngine(HOME, 1).state_low.size
        expected = np.delete(shown[0], [8, 9, 10, 11])  # headings, failures
    else:
        shown, plain = engine.step(np.ones((1, 2, 2)))[0], BatchEngine(HOME, 1).obs_size
        names = [entry.name for entry in engine.observation_table]
        more = [k for k, name in enumerate(names) if name.endswith(("_cos", "_sin", "_failed"))]
        expected = np.delete(shown, more, axis=2)[0]
    trained = Trained(observes)
    trained.fit(engine).act_in(engine, shown)
    assert trained.seen.shape[-1] == plain
    assert np.array_equal(trained.seen[0], expected)
    assert len(evaluate(Trained(observes), HOME, SHOWN, episodes=2).steps) == 2


@pytest.mark.parametrize("observes", ["observations", "state"])
def test_flags_of_failed_robots_are_zero_where_none_can_fail(observes):
    turning = {"dynamics": SHOWN["dynamics"]}
    failing = turning | {"failures": SHOWN["failures"]}
    engine, wanted = BatchEngine(HOME, 1, **turning), BatchEngine(HOME, 1, **failing)
    for one in (engine, wanted):
        one.reset()
        one.step(np.ones((1, 2, 2)))  # robot 1 fails two steps later
    shown, expected = (
        one.state() if observes == "state" else one.step(np.ones((1, 2, 2)))[0]
        for one in (engine, wanted)
    )
    trained = Trained(observes, **failing)
    trained.fit(engine).act(shown, deterministic=True)
    assert np.array_equal(trained.seen, expected)


def test_a_condition_replaces_weather_and_failures_but_not_the_robots():
    trained = {"wind": (0.1, 30.0), "dynamics": "unicycle", "failures": {"rate": 0.1}, "tau": 2.0}
    assert merge_settings(trained, None) == trained
    assert merge_settings(trained, "calm") == {"dynamics": "unicycle", "tau": 2.0}
    gusty = merge_settings(trained, "gusty")
    assert gusty == {**CONDITIONS["gusty"], "dynamics": "unicycle", "tau": 2.0}
    assert merge_settings(trained, "mixed")["dynamics"] == "mixed"
    assert merge_settings(trained, "gusty", wind=(0.2, 0.0))["wind"] == (0.2, 0.0)
    with pytest.raises(ConfigError, match="wind: "):
        merge_settings(trained, "windy", wind=(0.2, 0.0))
