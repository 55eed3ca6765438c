"""Errors name the place, the known names and the one that may be meant, and all problems."""

from pathlib import Path

import pytest

from baselines.algorithms import find_algorithm
from baselines.policies.load import check_known, open_run
from baselines.sweep.spec import GridSpec
from baselines.training.config import validate
from mbn_marl import BatchEngine, centralized_env, parallel_env
from mbn_marl.adapters.sb3 import CentralizedVecEnv
from mbn_marl.adapters.torchrl import NavigationEnv
from mbn_marl.config import Uniform, make_config
from mbn_marl.errors import ConfigError, FieldError, MbnError
from mbn_marl.field import FieldSampler, load_field, load_split
from tests.support.problems import places_of

TESTS = Path(__file__).parent
GRID = {"store": "runs", "algorithms": ["ppo"], "seeds": [0], "budget": {"stepss": 1}}


def test_every_lookup_by_name_says_what_may_be_meant():
    for look_up, place, meant in (
        (lambda: find_algorithm("mapo"), "mapo: ", "mappo"),
        (lambda: load_field("feild_03"), "unknown field", "field_03"),
        (lambda: open_run("zoo:feild_03"), "zoo:feild_03: ", "zoo:field_03"),
        (lambda: check_known(f"{TESTS}/supprt"), "/supprt: there is no such folder", "support?)"),
        (lambda: make_config({"reward": "realeased"}), "reward: ", "released"),
        (lambda: make_config({"max_step": 5}), "max_step: ", "max_steps"),
        (lambda: make_config({"conditions": "windy"}), "conditions: ", "condition"),
        (lambda: BatchEngine("field_03", num_wolds=2), "num_wolds: ", "num_worlds"),
        (lambda: parallel_env("field_03", render_mod="human"), "render_mod: ", "render_mode"),
        (lambda: make_config({"reward": {"name": "own", "medum": 5}}), "reward.medum: ", "medium"),
        (lambda: make_config({"observation": "lidr"}), "observation: ", "lidar"),
        (lambda: load_split("tset", "1-convex"), "'tset': ", "test"),
        (lambda: find_algorithm("ppo").resolve({"gamma": 0.9}), "gamma: ", "model.gamma"),
        (lambda: find_algorithm("mappo").resolve({"sharing": "ful"}), "sharing: ", "full"),
        (lambda: validate(GridSpec, GRID, "grid.yaml"), "budget.stepss: ", "steps"),
    ):
        with pytest.raises(MbnError) as caught:
            look_up()
        assert place in str(caught.value)
        assert f"did you mean {meant}" in str(caught.value)
    known = str(caught.value).split("known: ")[1]
    assert known == "steps, evaluate_every, episodes", "only those of its level"


@pytest.mark.parametrize(
    ("form", "wrong"),
    [
        (parallel_env, {"render_mode": "3d", "max_cycles": 0}),
        (centralized_env, {"flat": 3, "knowledge": "own"}),
        (CentralizedVecEnv, {"num_envs": 0, "knowledge": "own"}),
        (CentralizedVecEnv, {"num_envs": 0, "joint_observation": 2}),
        (NavigationEnv, {"num_worlds": 0, "state": 2}),
    ],
)
def test_an_unknown_name_hides_no_other_problem(form, wrong):
    wrong |= {"wind": 3, "autoreset": False}
    places = {*places_of(ConfigError, form, "field_03", **wrong)}
    assert places == {*wrong}
    with pytest.raises(FieldError) as caught:
        form("nowhere", **wrong)
    settings = [line.split(": ")[1] for line in caught.value.problems if "settings: " in line]
    assert {*settings} == places and "unknown field" in caught.value.problems[0]


def test_a_setting_may_be_named_as_an_argument_of_python():
    for take in (make_config, lambda names: FieldSampler(**names), lambda names: Uniform(**names)):
        with pytest.raises(ConfigError, match="self: unknown name"):
            take({"self": 1})


@pytest.mark.parametrize("algorithm", ["crossq", "mappo"])
def test_known_names_can_be_set(algorithm):
    with pytest.raises(ConfigError) as caught:
        find_algorithm(algorithm).resolve({"gamm": 1})
    (problem,) = caught.value.problems
    known = problem.split("known: ")[1].split(", ")
    assert not {"source", "skipped"} & {*known} and "reward_scale" in known
    assert ("scattered" in known) == (algorithm == "mappo")
