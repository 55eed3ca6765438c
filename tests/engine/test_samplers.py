"""A field for every world, a new one for every episode."""

from typing import Any

import numpy as np
import pytest
from shapely import Point

from mbn_marl import BatchEngine
from mbn_marl.errors import ConfigError, MbnError
from mbn_marl.field import Field, FieldSampler, load_field
from mbn_marl.field.generator.layout import FAMILIES
from tests.support.configurations import SAMPLER as ALL
from tests.support.configurations import STORM

pytestmark = pytest.mark.slow
WORLDS, FIRST = 3, 10
TEAM_NUMBERS = ("wall_hits", "path_length", "impulse", "failed", "return_")


def assert_same_observations(ours: BatchEngine, theirs: BatchEngine, world: int, rows: Any) -> None:
    team = theirs.n_robots
    places = {entry.name: entry.offset for entry in ours.observation_table}
    named = [places[entry.name] for entry in theirs.observation_table]
    expected = theirs._backend.output.observations[0]
    np.testing.assert_array_equal(rows[world, :team][:, named], expected)
    assert not rows[world, team:].any()
    for entry in ours.observation_table:
        if entry.name.startswith("other_") and entry.offset not in named:
            number = int(entry.name.split("_")[1])
            flag = entry.name.endswith(("absent", "failed")) and "roi_0_left" not in places
            if number >= team:
                assert (rows[world, :team, entry.offset] == flag).all(), entry
        if entry.name.startswith("roi_") and entry.name.endswith("visited"):
            known = entry.offset in named
            assert known or (rows[world, :team, entry.offset] == 1).all(), entry


@pytest.mark.parametrize(
    "settings",
    [{"random_starts": True, "reward_sharing": "team"}, {"reward": "formal"}, {**STORM}],
    ids=["starts", "formal", "storm"],
)
def test_world_equals_an_engine_with_its_field_alone(settings):
    settings["max_steps"] = 25
    ours = BatchEngine(ALL, WORLDS, seed=3, first_world=FIRST, **settings)

    def begin(world: int, episode: int) -> BatchEngine:
        """The episode of a world, by an engine of one world and one fixed field."""
        field = ALL.field(FIRST + world, episode)
        engine = BatchEngine(field, 1, first_world=FIRST + world, autoreset=False, **settings)
        engine.reset(3, episode)
        return engine

    seen = ours.reset().copy()
    theirs = [begin(w, 0) for w in range(WORLDS)]
    ended, sizes = 0, set()
    for _ in range(90):
        for w in range(WORLDS):
            assert_same_observations(ours, theirs[w], w, seen)
            assert ours.present[w].sum() == theirs[w].n_robots == len(ours.snapshot(w).positions)
            for part in ("edges", "rois", "starts"):
                found, expected = (getattr(o, part) for o in (ours.field_of(w), theirs[w].field))
                np.testing.assert_array_equal(found, expected, part)
        actions = ours.sample_actions()
        seen, rewards, terminated, truncated = (part.copy() for part in ours.step(actions))
        infos, metrics = ours.infos(), ours.metrics()
        for w, engine in enumerate(theirs):
            team = engine.n_robots
            _, own, done, late = engine.step(actions[None, w, :team])
            np.testing.assert_array_equal(rewards[w, :team], own[0])
            assert not rewards[w, team:].any()
            assert (terminated[w], truncated[w]) == (done[0], late[0])
            assert ours.team_rewards[w] == engine.team_rewards[0]
            np.testing.assert_array_equal(infos[w, :team], engine.infos()[0])
            for name, values in engine.metrics().items():
                found = metrics[name][w, :team] if name in TEAM_NUMBERS else metrics[name][w]
                np.testing.assert_array_equal(found, values[0], name)
            if done[0] or late[0]:
                assert_same_observations(ours, engine, w, ours.final_observations)
                ended += 1
                sizes.add((team, len(engine.field.rois)))
                theirs[w] = begin(w, int(ours.episode_numbers[w]))
            if settings.get("reward_sharing") != "team":
                np.testing.assert_allclose(rewards[w].sum(), ours.team_rewards[w], rtol=1e-5)
    assert ended >= 9
    assert len(sizes) >= 5


def test_fixed_fields_may_have_teams_of_different_sizes():
    big, small = load_field("field_03"), load_field("field_05")
    small = Field(small.vertices, small.rois[:2], small.starts[:2], name="small")
    engine = BatchEngine([big, small], 4, seed=1)
    engine.reset()
    assert engine.present.sum(axis=1).tolist() == [3, 2, 3, 2]
    assert engine.n_robots == 3
    _, rewards, _, _ = engine.step(engine.sample_actions())
    assert not rewards[1, 2]
    np.testing.assert_allclose(rewards.sum(axis=1), engine.team_rewards, rtol=1e-6)
    two = BatchEngine([big, small], 4, seed=1, n_robots=2)
    assert two.present.all()


def test_world_can_be_given_a_field():
    field = load_field("field_09")
    engine = BatchEngine("field_03", 1, seed=1, autoreset=False)
    assert len(field.edges) > len(engine.field.edges)
    starts = field.starts[::-1]
    engine.set_field(field, starts=starts)
    reference = BatchEngine(field, 1, seed=1, autoreset=False, starts=starts)
    np.testing.assert_array_equal(engine.reset(), reference.reset())
    assert engine.snapshot().field == field
    for _ in range(30):
        actions = engine.sample_actions()
        reference.sample_actions()
        np.testing.assert_array_equal(engine.step(actions)[0], reference.step(actions)[0])
    sampled = BatchEngine(ALL, 2, seed=3, autoreset=False)
    sampled.reset()
    sampled.set_field(load_field("field_02"), world=1)
    sampled.reset()
    assert np.array_equal(sampled.field_of(1).rois, load_field("field_02").rois)
    assert np.array_equal(sampled.field_of(0).rois, ALL.field(0, 1).rois)
    sampled.reset()
    assert np.array_equal(sampled.field_of(1).rois, ALL.field(1, 2).rois)


def test_fields_and_samplers_that_do_not_fit_are_refused():
    engine = BatchEngine("field_03", 3, n_robots=2)
    field = load_field("field_05")
    alone = Field(field.vertices, [*field.rois, *(field.rois + 3)], field.starts[:1])
    with pytest.raises(ConfigError) as caught:
        engine.set_field(alone)
    places = [problem.split(";")[0] for problem in caught.value.problems]
    assert any("12 ROIs" in place for place in places)
    assert any(place.startswith("n_robots: 2") for place in places)
    for call, error, place in (
        (lambda: engine.set_field(field, world=7), IndexError, "world 7"),
        (lambda: engine.set_sampler(ALL), ConfigError, "sampler"),
    ):
        with pytest.raises(error, match=place):
            call()


def test_sampler_can_be_replaced():
    small = FieldSampler(FAMILIES, robots=(2, 4), rois=2, size=120, weights=(1, 0, 0, 0, 0), seed=5)
    engine = BatchEngine(ALL, 20, seed=3)
    engine.reset()
    before = engine.field_of(0)
    engine.set_sampler(small)
    assert engine.field_of(0) == before
    engine.reset()
    for world in range(20):
        field = engine.field_of(world)
        assert np.ptp(field.vertices, axis=0).max() == pytest.approx(120.0)
        assert np.array_equal(field.edges, small.field(world, 1).edges)
    large = FieldSampler(FAMILIES, robots=(1, 9), rois=8, arena=(500, 500), size=200)
    with pytest.raises(ConfigError) as caught:
        engine.set_sampler(large)
    assert len(caught.value.problems) == 3  # robots, ROIs, arena
    assert np.array_equal(engine.field_of(3).edges, small.field(3, 1).edges)
    larger = BatchEngine(ALL, 3, n_robots=5, seed=1)
    larger.set_sampler(FieldSampler(FAMILIES, robots=5, rois=2))
    larger.reset()
    assert larger.present.all()


def test_teams_that_start_at_random_may_be_larger_than_the_starts():
    field = load_field("field_03")
    engine = BatchEngine(field, 50, n_robots=7, random_starts=True, seed=2)
    engine.reset()
    for world in range(50):
        positions = engine.snapshot(world).positions
        distances = np.hypot(*(positions[:, None] - positions).transpose(2, 0, 1))
        assert (distances[~np.eye(7, dtype=bool)] >= engine.config.safety_distance).all()
    assert engine.present.all()
    room = int(field.polygon.area / 400)
    for wrong in ({"n_robots": 7}, {"n_robots": room + 1, "random_starts": True}):
        with pytest.raises(ConfigError, match="n_robots"):
            BatchEngine(field, 1, **wrong)
    with pytest.raises(ConfigError, match="or to 64 with"):
        BatchEngine("field_01", 1, n_robots=7)  # which has room for more


def test_robots_that_find_no_random_place_start_apart():
    """A strip 0.2 wide along the diagonal: of 1000 points in its box, a fifth of one is inside."""
    strip = Field([(0, 0), (0.2, 0), (1000, 999.8), (1000, 1000)], [(500, 499.9)], [(100, 99.9)])
    how = {"n_robots": 5, "random_starts": True}
    how |= {"safety_distance": 0.5, "dtype": "float64"}
    engine = BatchEngine(strip, 20, seed=2, autoreset=False, **how)
    engine.reset()
    starts = [engine.snapshot(world).positions for world in range(20)]
    (positions,) = (at for at in starts[:1] if at[0].tolist() == [100.0, 99.9])
    first, second = np.triu_indices(5, 1)
    assert np.linalg.norm(positions[first] - positions[second], axis=1).min() >= 1.0
    assert all(strip.polygon.covers(Point(place)) for place in positions)
    engine.step(np.zeros((20, 5, 2)))
    assert not engine.metrics()["collision"].any()
    wide = load_field("field_03")
    alone = Field(wide.vertices, wide.rois[:1], wide.starts[:1])
    engine = BatchEngine(strip, 1, seed=2, **how)
    engine.set_field(alone)
    engine.reset()
    assert engine.present.all()


def test_absent_robot_leaves_nothing_in_the_revisit_memory():
    """Robot 0 comes back to its start, which nobody has stood on after a step."""
    sampler = FieldSampler(robots=(1, 3), rois=2, size=200, seed=2)
    ours = BatchEngine(sampler, 6, seed=1, autoreset=False)
    ours.reset()
    world = int(np.flatnonzero(ours.present.sum(axis=1) == 1)[0])
    alone = BatchEngine(sampler.field(world), 1, seed=1, first_world=world, autoreset=False)
    alone.reset()
    for force in (1.0, -1.0, -1.0):
        actions = np.zeros((6, 3, 2), np.float32)
        actions[world, 0, 0] = force
        ours.step(actions)
        alone.step(actions[None, world, :1])
        assert ours.team_rewards[world] == alone.team_rewards[0]
    assert ours.state()[world, 0] == alone.state()[0, 0] == np.float32(alone.field.starts[0, 0])


def test_given_field_of_a_samplers_world_is_saved_and_loaded():
    field = load_field("field_09")
    turned = Field(field.vertices[::-1] + 1e-5, field.rois, field.starts, name="turned")
    engine = BatchEngine(FieldSampler(robots=(2, 3), rois=6, seed=1), 2, seed=1, autoreset=False)
    engine.set_field(turned, world=1)
    engine.reset(seed=4)
    assert engine.snapshot(1).field == turned
    other = BatchEngine(FieldSampler(robots=(2, 3), rois=6, seed=1), 2, seed=9, autoreset=False)
    other.load_state(engine.save_state())
    for name in ("rois", "starts"):
        found, expected = (getattr(one, name) for one in (other.field_of(1), turned))
        np.testing.assert_allclose(found, expected, atol=1e-3)
    for _ in range(20):
        actions = engine.sample_actions()
        np.testing.assert_array_equal(other.step(actions)[0], engine.step(actions)[0])
    engine.reset()
    assert engine.field_of(1).name != "turned"
    with pytest.raises(MbnError, match="sampler"):
        BatchEngine(FieldSampler(robots=(2, 3), rois=6, seed=2), 2).load_state(engine.save_state())


def test_state_is_loaded_into_tables_of_another_size():
    sampler = FieldSampler(robots=(2, 3), rois=6, seed=1)
    small, large = (BatchEngine(sampler, 2, seed=1, **STORM) for _ in range(2))
    jagged = [(100 + 3 * k, 100 + 5 * (k % 2)) for k in range(100)]
    field = Field(
        [*jagged, (400, 400), (100, 400)], [(200, 300)], [(150, 200), (200, 200), (250, 200)]
    )
    for ours, theirs in ((small, large), (large, small)):
        large.set_field(field)
        ours.reset()
        theirs.reset()
        saved, before = ours.save_state(), theirs.save_state()
        with pytest.raises(MbnError, match=r"now\.steps"):
            theirs.load_state({**saved, "now.steps": np.zeros(3, np.int32)})
        for name, array in theirs.save_state().items():
            np.testing.assert_array_equal(array, before[name], name)
        theirs.load_state(saved)
        for _ in range(20):
            actions = ours.sample_actions()
            np.testing.assert_array_equal(theirs.step(actions)[0], ours.step(actions)[0])
        assert ours.field_of(0).edges.shape == theirs.field_of(0).edges.shape
    assert len(small.field_of(0).edges) == 102
