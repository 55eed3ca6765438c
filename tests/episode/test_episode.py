"""Episodes: recorded from every form of the environment, kept as JSON, replayed bit for bit."""

import base64
import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import gymnasium
import numpy as np
import pytest
import torch

from mbn_marl import (
    BatchEngine,
    Failures,
    Field,
    Uniform,
    centralized_env,
    env,
    load_field,
    parallel_env,
)
from mbn_marl.adapters.sb3 import CentralizedVecEnv
from mbn_marl.adapters.torchrl import NavigationEnv
from mbn_marl.config import make_config
from mbn_marl.engine import REWARD_TERMS
from mbn_marl.episode import EpisodeRecorder, check_episode, load_episode, play, save_episode
from mbn_marl.episode.files import CodedArray
from mbn_marl.errors import EpisodeError, MbnError
from tests.support.configurations import EVERYTHING
from tests.support.problems import places_of

SETTINGS = {"wind": (0.2, 30.0), "max_steps": 40}


def moves(steps: int) -> Any:
    """Return (steps, 3, 2) random actions, some of them beyond what is allowed."""
    return np.random.default_rng(0).normal(0.0, 0.7, (steps, 3, 2)).astype(np.float32)


def drive(world: Any, reset: Callable[[], Any], step: Callable[[Any], Any], index: int = 0) -> Any:
    with EpisodeRecorder(world, world=index, source="test") as recorder:
        reset()
        for one in moves(20):
            step(one)
    return recorder


def drive_parallel() -> Any:
    world = parallel_env("field_03", **SETTINGS)

    def step(one: Any) -> None:
        world.step(dict(zip(world.agents, one, strict=True)))

    return drive(world, lambda: world.reset(seed=5), step)


def drive_aec() -> Any:
    world = env("field_03", **SETTINGS)
    return drive(world, lambda: world.reset(seed=5), lambda one: [*map(world.step, one)])


def drive_gymnasium() -> Any:
    world = gymnasium.make("mbn/field_03-v0", **SETTINGS)
    return drive(world, lambda: world.reset(seed=5), world.step)


def drive_batch() -> Any:
    engine = BatchEngine(["field_02", "field_03"], 6, seed=5, **SETTINGS)
    batch = np.zeros((6, engine.n_robots, 2))

    def step(one: Any) -> None:
        batch[3] = one
        engine.step(batch)

    return drive(engine, engine.reset, step, 3)


def drive_torchrl() -> Any:
    world = NavigationEnv("field_03", 2, seed=5, **SETTINGS)
    data = world.reset()

    def step(one: Any) -> None:
        nonlocal data
        data["robots", "action"] = torch.from_numpy(np.stack([0 * one, one]))
        data = world.step(data)["next"]

    return drive(world, world.reset, step, 1)


def drive_sb3() -> Any:
    world = CentralizedVecEnv("field_03", 2, seed=5, **SETTINGS)
    return drive(world, world.reset, lambda one: world.step(np.stack([0 * one, one])), 1)


DRIVES = [drive_parallel, drive_aec, drive_gymnasium, drive_batch, drive_torchrl, drive_sb3]


@pytest.mark.parametrize("record", DRIVES)
def test_every_form_of_the_environment_can_be_recorded(record, tmp_path):
    (episode,) = record().episodes
    assert (episode.steps, episode.seed, episode.source) == (20, 5, "test")
    assert episode.field == load_field("field_03")
    np.testing.assert_array_equal(episode.actions, np.clip(moves(20), -1, 1))
    loaded = load_episode(save_episode(episode, tmp_path / "episode.json"))
    check_episode(loaded)
    for name in ("field", "config", "outcome", "source", "seed"):
        assert getattr(loaded, name) == getattr(episode, name), name
    for name in ("actions", "positions", "visits", "terms", "team_rewards"):
        mine, theirs = getattr(loaded, name), getattr(episode, name)
        assert mine.dtype == theirs.dtype and mine.tobytes() == theirs.tobytes(), name


@pytest.mark.parametrize("autoreset", ["same_step", "next_step", "disabled"])
def test_episode_after_episode(autoreset):
    settings = {"max_steps": 12, "random_starts": True, "safety_distance": 3.0}
    engine = BatchEngine("field_03", 3, autoreset=autoreset, **settings)
    returns, total = [], 0.0
    with EpisodeRecorder(engine, world=2) as recorder:
        engine.reset()
        for _ in range(40):
            if autoreset == "disabled" and not engine.running.all():
                engine.reset_worlds(~engine.running)
            _, _, terminated, truncated = engine.step(engine.sample_actions())
            total += float(engine.team_rewards[2])
            if terminated[2] or truncated[2]:
                returns.append(total)
                total = 0.0
    episodes = recorder.episodes
    assert len(returns) >= 3
    finished = [one for one in episodes if one.outcome != "unfinished"]
    assert [one.team_return for one in finished] == pytest.approx(returns, rel=1e-12)
    assert len({one.positions[0].tobytes() for one in episodes}) == len(episodes)
    for one in episodes:
        check_episode(one)


@pytest.mark.parametrize("autoreset", ["same_step", "next_step"])
def test_recording_begins_with_the_next_episode_and_takes_any_actions(autoreset):
    engine = BatchEngine("field_03", 2, autoreset=autoreset, max_steps=5)
    engine.reset()
    engine.step(engine.sample_actions())
    with EpisodeRecorder(engine) as recorder:
        for _ in range(12):
            engine.step(torch.from_numpy(engine.sample_actions()).requires_grad_())
            engine.step(torch.from_numpy(engine.sample_actions()).bfloat16())
    finished = [one for one in recorder.episodes if one.outcome == "truncated"]
    assert len(finished) >= 2
    for one in finished:
        check_episode(one)


def test_what_is_recorded_is_what_happened():
    """Two robots go for an ROI each, worked out by hand; the third stays."""
    field = Field(
        [(0, 0), (100, 0), (100, 100), (0, 100)],
        rois=[(20.0, 20.0), (60.0, 20.0)],
        starts=[(9.0, 20.0), (48.5, 20.0), (80.0, 80.0)],
    )
    push = np.zeros((4, 3, 2))
    push[:, 0] = push[:, 1] = (1.0, 0.0)
    episode = play(field, make_config({"max_steps": 9}), push[:2], source="by hand")
    # After t steps of full thrust: 0.5, then 1.5 further.
    assert episode.positions[:, 0, 0].tolist() == [9.0, 9.5, 10.5]
    assert episode.visits.tolist() == [2, 2]
    assert episode.outcome == "success" and episode.team_return == 20_000 + 100_000 - 4 * 10 - 110
    assert not episode.snapshot(1).success and episode.snapshot(2).success
    assert episode.snapshot(2).team_return == episode.team_return
    with pytest.raises(EpisodeError, match="actions: "):
        play(field, make_config({}), push)


def test_episode_says_how_it_ended():
    """Two robots 10.9 apart: towards each other they are 9.9 apart after a step, less than C."""
    field = Field([(0, 0), (99, 0), (99, 99), (0, 99)], [(50, 80)], [(40, 20), (50.9, 20)])
    actions = np.zeros((1, 2, 2))
    for push, outcome in ((1.0, "collision"), (-1.0, "truncated")):
        actions[0, :, 0] = push, -push
        episode = play(field, make_config({"max_steps": 1}), actions)
        assert episode.outcome == outcome
        assert episode.snapshot(1).collision == (outcome == "collision")
    assert play(field, make_config({"max_steps": 1}), actions[:0]).outcome == "unfinished"


def test_actions_that_cannot_be_played_are_named():
    still = [(0.0, 0.0)] * 3
    for actions, place in (
        ([still, [(0.0, 0.0), (np.inf, 0.0), (0.0, 0.0)]], r"step 2: actions\[0, 1\] "),
        (np.array([[(np.nan, 0.0), *still[1:]]], np.float32), r"step 1: actions\[0, 0\] "),
        ([still, still[1:]], "actions: "),
    ):
        with pytest.raises(EpisodeError, match=place):
            play(load_field("field_03"), make_config({}), actions)


def test_recording_begins_with_a_reset_and_ends_with_the_block():
    world = centralized_env("field_03")
    world.reset(seed=0)
    world.step(np.zeros((3, 2)))
    with EpisodeRecorder(world) as recorder:
        world.step(np.zeros((3, 2)))  # in the middle of an episode: not recorded
        world.reset()
        world.step(np.ones((3, 2)))
    world.step(np.zeros((3, 2)))
    (episode,) = recorder.episodes
    assert episode.actions.tolist() == [[[1.0, 1.0]] * 3]
    assert not world.engine.listeners
    with pytest.raises(MbnError, match="Env: "):
        EpisodeRecorder(gymnasium.Env())
    with pytest.raises(MbnError, match="world 4"):
        EpisodeRecorder(BatchEngine("field_03", 4), world=4)


def test_starts_of_an_episode_that_do_not_fit_are_listed():
    episode = play(load_field("field_03"), make_config({}), np.zeros((1, 3, 2)))
    episode.positions[0, 0, 0] = -7e11
    with pytest.raises(EpisodeError, match=r"a\.json: .*\n.*starts\[0\]: "):
        check_episode(episode, "a.json")


@pytest.fixture
def document(tmp_path):
    episode = play(load_field("field_03"), make_config({}), moves(12), source="test", seed=1)
    return json.loads(save_episode(episode, tmp_path / "whole.json").read_text())


def test_file_is_small_and_can_be_read_without_this_package(document):
    packed = document["positions"]
    assert packed["dtype"] == "float32" and packed["shape"] == [13, 3, 2]
    positions = np.frombuffer(base64.b64decode(packed["data"]), "<f4").reshape(13, 3, 2)
    assert np.array_equal(positions[0], load_field("field_03").starts.astype(np.float32))
    coded = document["rewards"]["robots"]
    indices = np.frombuffer(base64.b64decode(coded["indices"]["data"]), "<u1")
    assert set(np.asarray(coded["values"])[indices]) <= {0.0, -10.0, -100.0, -10_000.0, 10_000.0}
    assert document["wind"] == [0.0, 0.0] and "wind" not in document["config"]


def test_wrong_content_is_named(document, tmp_path):
    path = tmp_path / "bad.json"
    for text in ('{"format": "mbn-ep', "[" * 100_000, "\udc80", '{"a": 1}'):
        path.write_text(text, "utf-8", "surrogateescape")
        with pytest.raises(EpisodeError, match=r"bad\.json.*\n.*(file|format): "):
            load_episode(path)
    for keys, value, place in (
        (["format"], "mbn-episode/2", "format: "),
        (["actions"], None, "actions: "),
        (["note"], 1, "note: "),
        (["steps"], 10**15, "positions: shape"),
        (["actions", "data"], "AAAA", "actions: data: "),
        (["visits"], [*document["visits"], 9], "visits: 7"),
        (["visits", 0], 99, "visits: allowed"),
        (["team_return"], 1.0, "team_return: "),
        (["rewards", "terms", 0], "roi", "rewards.terms: "),
        (["field", "vertices"], [], "field.vertices: "),
        (["config", "tau"], -1, "config.tau: "),
    ):
        content = part = json.loads(json.dumps(document))
        for key in keys[:-1]:
            part = part[key]
        part[keys[-1]] = value
        path.write_text(json.dumps(content))
        with pytest.raises(EpisodeError) as caught:
            load_episode(path)
        assert str(path) in str(caught.value) and place in str(caught.value), keys


def test_file_from_before_a_term_and_a_setting_is_read(document, tmp_path):
    """It names the terms that it has, here in another order and without what was always 0."""
    whole = load_episode(tmp_path / "whole.json")
    with pytest.raises(MbnError, match="json"):
        save_episode(whole, tmp_path / "episode.txt")
    rewards = document["rewards"]
    rewards["terms"] = ["wall", "step", "revisit", "roi"]
    order = [REWARD_TERMS.index(name) for name in rewards["terms"]]
    rewards["robots"] = CodedArray.pack(whole.terms[..., order]).model_dump()
    for name in ("dynamics", "turn_max", "wheelbase", "steer_max"):
        del document["config"][name]
    del document["headings"]
    path = tmp_path / "old.json"
    path.write_text(json.dumps({**document, "checksum": 64 * "0"}, indent=1))
    old = load_episode(path)
    assert np.array_equal(old.terms, whole.terms) and old.terms.any()
    assert old.config == whole.config
    check_episode(old)


ALL = {
    **{**EVERYTHING, "dynamics": "mixed", "gust": 0.1, "action_delay": 2, "position_noise": 2.0},
    **{"wind": (Uniform(0.1, 0.35), Uniform(0.0, 360.0)), "roi_radius": Uniform(5.0, 15.0)},
    **{"failures": Failures(rate=0.1, most=2), "random_starts": True, "max_steps": 15},
}
PARTS = ("positions", "visits", "terms", "winds", "headings", "failed")


@pytest.mark.slow
def test_what_befalls_robots_is_recorded_kept_and_replayed(tmp_path):
    engine = BatchEngine("field_03", 3, seed=5, first_world=7, **ALL)
    with EpisodeRecorder(engine, world=1) as recorder:
        engine.reset()
        shots = []
        for _ in range(15):
            shots.append(engine.snapshot(1))
            engine.step(engine.sample_actions())
        shots.append(engine.snapshot(1))
        engine.step(engine.sample_actions())
    first, second = recorder.episodes
    assert (first.seed, first.world, first.number) == (5, 8, 0)
    assert (second.seed, second.world, second.number) == (5, 8, 1)
    path = save_episode(first, tmp_path / "all.json")
    loaded = load_episode(path)
    assert loaded.drawn == first.drawn and loaded.config == first.config
    assert {"wind_speed", "wind_angle", "roi_radius"} < loaded.drawn.keys()
    for name in PARTS:
        np.testing.assert_array_equal(getattr(loaded, name), getattr(first, name), name)
    assert loaded.steps == 15 and sum(shots[14].failed) == 2
    for step, shot in enumerate(shots[:15]):
        found = loaded.snapshot(step)
        assert (found.roi_radius, found.wind) == (shot.roi_radius, shot.wind)
        for name in ("positions", "headings", "failed"):
            assert np.array_equal(getattr(found, name), getattr(shot, name), equal_nan=True), name
    assert np.isnan(loaded.headings[:, 0]).all() and loaded.headings[-1, 1:].any()
    check_episode(loaded)
    check_episode(second)
    bent = loaded.headings.copy()
    bent[4, 1] += 1e-6
    moved = loaded.positions.copy()
    moved[4, 0, 0] = np.nextafter(moved[4, 0, 0], np.float32(1e9))
    for changes, place in (
        ({"headings": bent}, "headings: .*step 4 "),
        ({"positions": moved}, "positions: .*step 4 "),
        ({"winds": loaded.winds + np.eye(16, 2, -4)}, "winds: .*step 4 "),
        ({"failed": np.where(loaded.failed > 0, loaded.failed + 1, 0)}, "failed: "),
        ({"number": 1}, None),
    ):
        with pytest.raises(EpisodeError, match=place):
            check_episode(replace(loaded, **changes))
    content = json.loads(path.read_text())
    headings = {**content["headings"], "shape": [3, 16]}
    for name, value, problems in (
        ("headings", headings, 1),
        ("failed", [1, 99], 2),
        ("drawn", {"roi_radius": 5.0, "mass": 1.0}, 1),
    ):
        path.write_text(json.dumps({**content, name: value}))
        assert places_of(EpisodeError, load_episode, path) == [name] * problems
