"""The decentralised form: PettingZoo's own tests, and numbers worked out by hand."""

from __future__ import annotations

import copy
import math
import pickle
from types import SimpleNamespace

import numpy as np
import pettingzoo
import pytest
from pettingzoo.test import (
    api_test,
    max_cycles_test,
    parallel_api_test,
    parallel_seed_test,
    render_test,
    seed_test,
)
from pettingzoo.test.state_test import state_test

from mbn_marl import Field, navigation_v0, parallel_env
from mbn_marl.adapters.infos import GAP
from mbn_marl.config import CONDITIONS
from mbn_marl.errors import ActionError, StepError
from mbn_marl.field import catalogue_names
from tests.support.forms import INFO_KEYS, NOTHING
from tests.support.worlds import DISTURBANCES

CONFIGURATIONS = {
    "default": {},
    "state in float64, wind": {
        "field": "field_09",
        "dtype": "float64",
        "observation": "state",
        "wind": (0.05, 90.0),
    },
    "one robot, short": {"field": "field_07", "n_robots": 1, "max_steps": 30},
    "formal, team, local": {
        "field": "field_01",
        "n_robots": 2,
        "reward": "formal",
        "reward_sharing": "team",
        "observation": "local",
    },
    "unicycles": {"dynamics": "unicycle", "observation": "lidar"},
    "disturbed, holonomic and bicycles": DISTURBANCES
    | {"dynamics": ("holonomic", "bicycle", "bicycle")},
    "failing": {"failures": {"rate": 0.05, "kind": "vanish"}},
    "failing, terminated": {"failures": {"rate": 0.05}, "failed_agents": "terminate"},
    "random starts, one-hot": {"field": "field_10", "random_starts": True, "one_hot": True},
}
every_configuration = pytest.mark.parametrize(
    "settings", CONFIGURATIONS.values(), ids=list(CONFIGURATIONS)
)
no_warnings = pytest.mark.filterwarnings("error")


def random_actions(env, rng):
    return {agent: rng.uniform(-1, 1, 2).astype(np.float32) for agent in env.agents}


@pytest.fixture
def square():
    """Two robots facing each other, 20 units apart, in a square of 100 units."""
    return Field(
        vertices=[(0.0, 0.0), (100.0, 0.0), (100.0, 100.0), (0.0, 100.0)],
        rois=[(15.0, 50.0), (60.0, 90.0)],
        starts=[(40.0, 50.0), (60.0, 50.0)],
    )


FAST = {"f_max": 5.0, "v_clip": 5.0}


class TestOfficial:
    """PettingZoo's own tests, with every warning an error."""

    @no_warnings
    @every_configuration
    def test_parallel_api(self, settings):
        parallel_api_test(navigation_v0.parallel_env(**settings), num_cycles=1200)

    @no_warnings
    @every_configuration
    def test_api(self, settings):
        api_test(navigation_v0.env(**settings), num_cycles=200)

    @no_warnings
    @every_configuration
    def test_raw_api(self, settings):
        api_test(navigation_v0.raw_env(**settings), num_cycles=50)

    @every_configuration
    def test_seed(self, settings):
        seed_test(lambda: navigation_v0.env(**settings), num_cycles=200)

    @every_configuration
    def test_parallel_seed(self, settings):
        parallel_seed_test(lambda: navigation_v0.parallel_env(**settings), num_cycles=200)

    def test_max_cycles(self):
        max_cycles_test(navigation_v0)
        max_steps_too = SimpleNamespace(
            parallel_env=lambda max_cycles: navigation_v0.parallel_env(max_steps=max_cycles),
            env=lambda max_cycles: navigation_v0.env(max_steps=max_cycles),
        )
        max_cycles_test(max_steps_too)

    @no_warnings
    @every_configuration
    def test_state(self, settings):
        state_test(navigation_v0.env(**settings), navigation_v0.parallel_env(**settings))

    def test_render(self, monkeypatch):
        monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
        render_test(navigation_v0.env)


class TestNumbersByHand:
    def test_agents_spaces_and_state(self):
        env = parallel_env("field_03", dtype="float64")
        assert env.possible_agents == ["robot_0", "robot_1", "robot_2"]
        env.reset(seed=1)
        assert env.agents == env.possible_agents
        assert env.state_space.shape == (13,)
        assert env.state_space.high.tolist() == [1000.0] * 6 + [5.0] * 6 + [63.0]
        assert env.state_space.low.tolist() == [0.0] * 6 + [-5.0] * 6 + [0.0]
        assert env.state().dtype == np.float64
        expected = [200.0, 250.0, 300.0, 300.0, 250.0, 300.0, *[0.0] * 7]
        assert env.state().tolist() == expected
        for agent in env.agents:
            assert env.action_space(agent).shape == (2,)
            assert env.observation_space(agent).dtype == np.float32
            assert env.observation_space(agent) is env.observation_space(agent)
        assert env.action_space("robot_0") is not env.action_space("robot_1")

    def test_standing_still_visits_the_two_rois_in_reach_then_pays_for_known_ground(self):
        env = parallel_env("field_03", dtype="float64")
        env.reset()
        still = {agent: [0.0, 0.0] for agent in env.agents}
        _, rewards, terminated, truncated, infos = env.step(still)
        # (200, 240) is 10 from robot_0, (240, 300) is 10 from robot_2: the second and sixth ROI.
        assert rewards == {"robot_0": 9990.0, "robot_1": -10.0, "robot_2": 9990.0}
        assert env.state()[-1] == 0b010001
        assert set(terminated.values()) == set(truncated.values()) == {False}
        assert [info["rois_visited"] for info in infos.values()] == [2.0, 2.0, 2.0]
        assert infos["robot_0"]["reward/roi"] == 10_000.0
        assert infos["robot_0"]["reward/step"] == -10.0
        assert infos["robot_1"]["reward/roi"] == 0.0
        _, rewards, _, _, infos = env.step(still)
        assert rewards == {"robot_0": -100.0, "robot_1": -100.0, "robot_2": -100.0}
        assert infos["robot_1"]["reward/revisit"] == -100.0
        assert infos["robot_1"]["reward/step"] == 0.0

    def test_a_wall_costs_and_stops(self, square):
        env = parallel_env(square, 1, f_max=50.0, v_clip=50.0, dtype="float64")
        env.reset()
        _, rewards, _, _, infos = env.step({"robot_0": [-0.5, 0.0]})  # to x = 15
        assert rewards["robot_0"] == -10.0 + 10_000.0
        assert infos["robot_0"]["path_length"] == 25.0
        _, rewards, _, _, infos = env.step({"robot_0": [0.0, 1.0]})  # x = -10 is outside
        assert rewards["robot_0"] == -10_000.0 - 100.0
        assert env.state().tolist() == [15.0, 50.0, 0.0, 0.0, 2.0]
        info = infos["robot_0"]
        assert info["wall_hits"] == 1.0
        assert info["reward/wall"] == -10_000.0
        assert info["path_length"] == 25.0
        assert info["impulse"] == pytest.approx(np.hypot(25.0, 50.0), rel=1e-12)

    def test_success_ends_the_episode_for_all(self, square):
        env = parallel_env(square, f_max=40.0, v_clip=40.0, dtype="float64")
        env.reset()
        actions = {"robot_0": [-25 / 40, 0.0], "robot_1": [0.0, 1.0]}
        _, rewards, terminated, truncated, infos = env.step(actions)
        assert rewards == {"robot_0": 59_990.0, "robot_1": 59_990.0}
        assert terminated == {"robot_0": True, "robot_1": True}
        assert truncated == {"robot_0": False, "robot_1": False}
        assert env.agents == []
        assert infos["robot_1"]["success"] == 1.0
        assert infos["robot_1"]["collision"] == 0.0
        assert infos["robot_1"]["reward/success"] == 50_000.0
        assert env.state()[-1] == 3.0

    def test_collision_replaces_the_reward_and_ends_the_episode(self, square):
        env = parallel_env(square, **FAST)
        env.reset()
        towards = {"robot_0": [1.0, 0.0], "robot_1": [-1.0, 0.0]}
        _, rewards, terminated, _, infos = env.step(towards)  # at 45 and 55: exactly C apart
        assert rewards == {"robot_0": -10.0, "robot_1": -10.0}
        assert not any(terminated.values())
        assert infos["robot_0"]["collision"] == 0.0
        _, rewards, terminated, truncated, infos = env.step(towards)
        assert rewards == {"robot_0": -50_000.0, "robot_1": -50_000.0}
        assert all(terminated.values())
        assert not any(truncated.values())
        assert infos["robot_0"]["collision"] == 1.0
        assert infos["robot_0"]["reward/collision"] == -50_000.0
        assert infos["robot_0"]["reward/revisit"] == infos["robot_0"]["reward/step"] == 0.0

    def test_team_sharing_gives_every_robot_the_sum(self, square):
        env = parallel_env(square, f_max=25.0, v_clip=25.0, reward_sharing="team", dtype="float64")
        env.reset()
        _, rewards, _, _, _ = env.step({"robot_0": [-1.0, 0.0], "robot_1": [0.0, 0.0]})
        assert rewards == {"robot_0": 9_980.0, "robot_1": 9_980.0}

    def test_the_time_limit_truncates_and_never_terminates(self, square):
        env = parallel_env(square, max_steps=3)
        env.reset()
        ends = []
        for _ in range(3):
            _, _, terminated, truncated, _ = env.step({a: [0.0, 0.0] for a in env.agents})
            ends.append((terminated["robot_0"], truncated["robot_1"]))
        assert ends == [(False, False), (False, False), (False, True)]
        assert env.agents == []

    def test_actions_out_of_range_are_clipped(self, square):
        env = parallel_env(square, **FAST, dtype="float64")
        env.reset()
        env.step({"robot_0": np.array([-1e300, 7.0]), "robot_1": [1, 0]})
        assert env.state().tolist() == [35.0, 55.0, 65.0, 50.0, -5.0, 5.0, 5.0, 0.0, 0.0]


class TestEveryStep:
    @every_configuration
    def test_spaces_terms_and_keys(self, settings):
        env = parallel_env(**settings)
        rng = np.random.default_rng(5)
        shared = env.engine.config.reward_sharing == "team"
        env.reset(seed=3)
        for _ in range(400):
            asked = env.agents or env.possible_agents
            if not env.agents:
                observations, infos = env.reset()
                assert all(info == NOTHING for info in infos.values())
            else:
                observations, rewards, terminated, _, infos = env.step(random_actions(env, rng))
                own = {a: sum(v for k, v in infos[a].items() if "/" in k) for a in infos}
                if shared:
                    own = dict.fromkeys(own, sum(own.values()))
                assert rewards == pytest.approx(own, rel=1e-6)
                assert all(type(reward) is float for reward in rewards.values())
                assert all(type(flag) is bool for flag in terminated.values())
            assert env.state_space.contains(env.state())
            assert list(observations) == list(infos) == asked
            for agent, observation in observations.items():
                assert env.observation_space(agent).contains(observation)
                assert tuple(infos[agent]) == INFO_KEYS
                assert all(isinstance(value, float) for value in infos[agent].values())
                known = not env.agents and env.optimal_return is not None
                assert math.isnan(infos[agent][GAP]) != known

    def test_what_was_returned_stays_as_it_was(self):
        env = parallel_env()
        rng = np.random.default_rng(0)
        kept = [env.reset(seed=0)]
        kept += [env.step(random_actions(env, rng)) for _ in range(3)]
        before = copy.deepcopy(kept)
        env.step(random_actions(env, rng))
        env.reset()
        for now, then in zip(kept, before, strict=True):
            for agent in then[0]:
                assert np.array_equal(now[0][agent], then[0][agent])
            assert now[1:] == then[1:]

    def test_two_thousand_steps_are_bitwise_repeatable_with_instances_interleaved(self):
        first, second, other = (parallel_env("field_05", random_starts=True) for _ in range(3))
        rng = np.random.default_rng(9)
        starts = [env.reset(seed=seed) for env, seed in ((first, 7), (second, 7), (other, 8))]
        assert not np.array_equal(first.state(), other.state())
        assert starts[0][0].keys() == starts[2][0].keys()
        episodes = 0
        for _ in range(2000):
            if not first.agents:
                episodes += 1
                for env in (first, second, other):
                    env.reset()
            actions = random_actions(first, rng)
            if other.agents:
                other.step({agent: -action for agent, action in actions.items()})
            results = first.step(actions), second.step(actions)
            assert np.array_equal(first.state(), second.state())
            assert results[0][1:] == results[1][1:]
            for agent in actions:
                assert np.array_equal(results[0][0][agent], results[1][0][agent])
        assert episodes > 3

    def test_seed_restarts_and_no_seed_goes_on(self):
        env = parallel_env(random_starts=True)
        env.reset(seed=4)
        first = env.state()
        env.reset()
        second = env.state()
        env.reset(seed=4)
        assert np.array_equal(env.state(), first)
        env.reset()
        assert np.array_equal(env.state(), second)
        assert not np.array_equal(first, second)

    @pytest.mark.parametrize("copied", [copy.deepcopy, lambda e: pickle.loads(pickle.dumps(e))])
    def test_a_copy_goes_on_as_the_original_would_and_leaves_it_alone(self, copied):
        env = parallel_env()
        rng = np.random.default_rng(2)
        env.reset(seed=3)
        for _ in range(5):
            env.step(random_actions(env, rng))
        twin = copied(env)
        before = env.state()
        actions = random_actions(env, rng)
        results = [twin.step(actions)]
        assert np.array_equal(env.state(), before)
        results.append(env.step(actions))
        assert results[0][1:] == results[1][1:]
        assert np.array_equal(env.state(), twin.state())
        assert not np.array_equal(env.state(), before)


class TestAEC:
    def test_it_is_the_parallel_env(self):
        aec, parallel = navigation_v0.env(), parallel_env()
        rng = np.random.default_rng(1)
        aec.reset(seed=1)
        parallel.reset(seed=1)
        for _ in range(50):
            actions = random_actions(parallel, rng)
            result = parallel.step(actions)
            for agent in actions:
                assert aec.agent_selection == agent
                aec.step(actions[agent])
            assert aec.rewards == result[1]
            assert aec.infos == result[4]
            assert np.array_equal(aec.state(), parallel.state())
        assert aec.unwrapped.engine.num_worlds == 1

    @pytest.mark.parametrize("bad", [[np.nan, 0.0], [0.0], None, "north", [np.inf, 1.0]])
    def test_a_wrong_action_is_refused_at_once_and_can_be_given_again(self, bad):
        env = navigation_v0.env()
        env.reset(seed=0)
        with pytest.raises(ActionError, match="robot_0: "):
            env.step(bad)
        assert env.agent_selection == "robot_0"
        for _ in env.possible_agents:
            env.step(np.zeros(2))
        assert env.rewards == {"robot_0": 9990.0, "robot_1": -10.0, "robot_2": 9990.0}

    def test_order(self):
        env = navigation_v0.raw_env(max_steps=1)
        with pytest.raises(StepError, match="reset"):
            env.step(np.zeros(2))
        env.reset()
        for _ in range(3):
            env.step(np.zeros(2))
        with pytest.raises(ActionError, match="robot_0: "):
            env.step(np.zeros(2))
        for _ in range(3):
            env.step(None)
        assert env.agents == []
        with pytest.raises(StepError, match="reset"):
            env.step(None)


class TestRegistry:
    @pytest.mark.parametrize("name", catalogue_names())
    def test_every_field_has_its_id(self, name):
        parallel = pettingzoo.make("parallel", f"mbn/{name}-v0", n_robots=2)
        assert parallel.possible_agents == ["robot_0", "robot_1"]
        assert parallel.unwrapped.engine.field.name == name
        aec = pettingzoo.make("aec", f"mbn/{name}-v0", max_cycles=7)
        assert aec.unwrapped.engine.config.max_steps == 7
        assert aec.unwrapped.engine.field.name == name

    def test_ids_are_the_catalogue_under_every_condition(self):
        marks = ["", *(f"-{name}" for name in CONDITIONS if name != "calm")]
        ids = {f"mbn/{name}{mark}-v0" for name in catalogue_names() for mark in marks}
        for registry in (pettingzoo.parallel_registry, pettingzoo.aec_registry):
            assert {env_id for env_id in registry if env_id.startswith("mbn/")} == ids
