"""Robots that know what they have seen and heard, by hand; ``test_forms`` compares the oracle."""

import math
from collections import Counter
from itertools import combinations

import numpy as np
import pytest

from mbn_marl import BatchEngine, Field, centralized_env, load_field
from mbn_marl.adapters.gymnasium import CentralizedVectorEnv
from mbn_marl.adapters.sb3 import CentralizedVecEnv
from mbn_marl.config import make_config
from mbn_marl.episode import check_episode, load_episode, play, save_episode
from mbn_marl.errors import ConfigError
from mbn_marl.optimum import optimal_makespan
from mbn_marl.planning.problem import make_problem
from tests.support.configurations import entries
from tests.support.problems import places_of

OWN = {"observation": "entities", "knowledge": "own"}
SQUARE = [(0.0, 0.0), (100.0, 0.0), (100.0, 100.0), (0.0, 100.0)]
ROW = Field(SQUARE, [(10.0, 55.0), (90.0, 90.0)], [(10.0 + 20.0 * k, 50.0) for k in range(4)])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("settings", "steps"),
    [
        ({}, [1, 1, 2, 3]),
        ({"comm_delay": 1}, [1, 2, 4, 6]),
        ({"comm_loss": 1.0}, [1, 0, 0, 0]),
        ({"look_radius": 25.0, "comm_radius": 0.0}, [1, 1, 0, 0]),
    ],
    ids=str,
)
def test_words_pass_from_robot_to_robot(settings, steps):
    how = {**OWN, "sensing_radius": 25.0, "comm_radius": 25.0, **settings}
    engine = BatchEngine(ROW, 2, threads=1, **how)
    engine.reset()
    assert [entries(engine, 1)[f"other_{k}_present"] for k in (1, 2, 3)] == [1.0, 1.0, 0.0]
    heard = [0] * 4
    for step in range(1, 8):
        engine.step(np.zeros((2, 4, 2)))
        for i in range(4):
            found = entries(engine, i)
            assert found["roi_1_left"] == 1.0
            heard[i] = heard[i] or step * (found["roi_0_left"] == 0.0)
    assert heard == steps
    assert engine.metrics()["rois_visited"].tolist() == [1, 1]


@pytest.mark.slow
@pytest.mark.parametrize("delay", [0, 2])
def test_recorded_words_are_those_that_were_received(delay, tmp_path):
    """Robot 0 sees the ROI in step 1; each other one learns of it from the one before it alone."""
    rare = {"comm_radius": 25.0, "comm_loss": 0.8, "comm_delay": delay}
    config = make_config({**OWN, **rare, "sensing_radius": 25.0, "hidden_rois": True})
    played = play(ROW, config, np.zeros((90, 4, 2)), seed=3)
    loaded = load_episode(save_episode(played, tmp_path / "episode.json"))
    assert loaded.knowledge is None
    for known in (played.knowledge, check_episode(loaded).knowledge):
        assert not known.heard[:delay].any()
        assert (known.done[:, 1] == 91).all() and known.done[0, 0] == 1
        assert known.found[:2, 0].tolist() == [0, 0]
        for since, seers in ((known.done[:, 0], 1), (known.found[:, 0], 2)):
            for i in range(seers, 4):
                first = since[i - 1] + (i > seers) + delay  # words go one hop a step
                assert since[i] == first + known.heard[first:, i, i - 1].argmax() < 90


@pytest.mark.slow
def test_everybody_in_reach_is_a_team():
    team, own = (
        BatchEngine("field_03", 40, seed=3, roi_radius=40.0, max_steps=60, **settings)
        for settings in ({"observation": "entities"}, {**OWN, "comm_radius": math.inf})
    )
    assert (team.reset() == own.reset()).all()
    for _ in range(150):
        actions = team.sample_actions()
        for ours, theirs in zip(own.step(actions), team.step(actions), strict=True):
            assert (ours == theirs).all()
    assert team.metrics()["rois_visited"].any()


@pytest.mark.slow
def test_decoys_are_drawn_alike_and_told_to_nobody():
    engine = BatchEngine("field_03", 3000, decoys=(1, 2), look_radius=0.0, **OWN)
    seen = engine.reset()
    for numbers in (engine.state()[:, -1], engine.metrics()["rois_visited"]):
        assert not numbers.any()
    left = [entry.offset for entry in engine.observation_table if entry.name.endswith("_left")]
    assert seen[..., left].all()
    sets = Counter(tuple(np.flatnonzero(row).tolist()) for row in engine.decoys)
    expected = {rois: 250 for rois in combinations(range(6), 1)}
    expected |= {rois: 100 for rois in combinations(range(6), 2)}
    assert sets.keys() == expected.keys()
    assert all(abs(sets[rois] - count) < 5 * count**0.5 for rois, count in expected.items())
    shot = engine.snapshot(5)
    assert (shot.empty == engine.decoys[5]).all() and not shot.visited.any()


def test_no_decoys_as_a_range_are_none():
    assert make_config({"decoys": (0, 0)}) == make_config({})
    assert make_config({"decoys": (0, 0), "empty_rois": (1,), **OWN}).empty_rois == (1,)


@pytest.mark.slow
def test_given_rois_are_empty_in_all_episodes():
    engine = BatchEngine("field_03", 3, empty_rois=(4, 1, 4), **OWN)
    for _ in range(2):
        engine.reset()
        assert [np.flatnonzero(row).tolist() for row in engine.decoys] == [[1, 4]] * 3
    assert not engine.config.is_random and engine.config.empty_rois == (1, 4)


@pytest.mark.slow
def test_the_end_is_that_of_the_real_rois():
    engine = BatchEngine(ROW, 40, autoreset=False, decoys=1, **OWN)
    engine.reset()
    _, _, terminated, _ = engine.step(np.zeros((40, 4, 2)))
    near = engine.decoys[:, 0]
    assert 5 < near.sum() < 35
    assert (terminated == ~near).all() and (engine.metrics()["success"] == ~near).all()
    assert (engine.metrics()["rois_visited"] == ~near).all()
    assert (engine.state()[:, -1] == 2.0 * ~near).all()
    assert (engine.team_rewards == np.where(near, -40.0, 110_000.0 - 40.0)).all()


@pytest.mark.parametrize("make", [centralized_env, CentralizedVecEnv, CentralizedVectorEnv])
def test_central_forms_refuse_own_knowledge(make):
    source = {"num_envs": 2} if make is CentralizedVectorEnv else {}
    assert places_of(ConfigError, make, field="field_03", **source, **OWN)[0] == "knowledge"


def test_bounds_are_those_of_a_team_that_knows_all():
    field, own = load_field("field_03"), make_config({**OWN, "comm_radius": 0.0})
    some = make_config({**OWN, "decoys": 1})
    assert optimal_makespan(field, own) == field.optimal_makespan
    assert optimal_makespan(field, some) is None
    assert make_problem(field, own).config == make_problem(field, make_config(OWN)).config
    assert make_problem(field, some, closed_loop=True).config.knowledge == "team"
    with pytest.raises(ConfigError, match="decoys"):
        make_problem(field, some)
