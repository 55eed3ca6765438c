"""The decentralised form given bad input.

Each is an error that names the offender and what is allowed; nothing moves.
"""

from __future__ import annotations

import numpy as np
import pettingzoo
import pytest

from mbn_marl import navigation_v0, parallel_env
from mbn_marl.config import RewardProfile
from mbn_marl.errors import ActionError, ConfigError, FieldError, MbnError, StepError


@pytest.fixture
def env():
    env = parallel_env()
    env.reset(seed=0)
    env.step({agent: [0.5, 0.5] for agent in env.agents})
    return env


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"robot_1": [np.nan, 0.0]}, "robot_1"),
        ({"robot_2": np.array([0.0, -np.inf], np.float32)}, "robot_2"),
        ({"robot_0": [0.0]}, "robot_0"),
        ({"robot_0": 0.5}, "robot_0"),
        ({"robot_0": np.zeros((2, 1))}, "robot_0"),
        ({"robot_1": [[0.0, 0.0]]}, "robot_1"),
        ({"robot_1": "north"}, "robot_1"),
        ({"robot_2": None}, "robot_2"),
        ({"robot_9": [0.0, 0.0]}, "robot_9"),
    ],
)
def test_wrong_actions(env, changes, named):
    state = env.state()
    actions = {agent: [0.0, 0.0] for agent in env.agents} | changes
    with pytest.raises(ActionError, match=named) as caught:
        env.step(actions)
    assert "allowed" in str(caught.value)
    innocent = set(env.possible_agents) - set(changes)
    assert not any(f"{agent}:" in str(caught.value) for agent in innocent)
    assert np.array_equal(env.state(), state)
    assert env.agents == env.possible_agents
    twin = parallel_env()
    twin.reset(seed=0)
    twin.step({agent: [0.5, 0.5] for agent in twin.agents})
    good = {agent: [0.1, -0.2] for agent in env.agents}
    assert env.step(good)[1:] == twin.step(good)[1:]


def test_every_robot_has_the_same_wrong_shape(env):
    with pytest.raises(ActionError, match=r"robot_0.*robot_1.*robot_2"):
        env.step({agent: [0.0, 0.0, 0.0] for agent in env.agents})


def test_missing_and_unknown_agents_are_all_named(env):
    with pytest.raises(ActionError, match=r"robot_7.*robot_1"):
        env.step({"robot_0": [0, 0], "robot_2": [0, 0], "robot_7": [0, 0]})
    with pytest.raises(ActionError, match="robot_0"):
        env.step({})
    with pytest.raises(ActionError, match="actions: "):
        env.step([[0, 0]] * 3)


def test_order():
    env = parallel_env(max_steps=1)
    for actions in ({}, {"robot_0": [0, 0]}):
        with pytest.raises(StepError, match="reset"):
            env.step(actions)
    with pytest.raises(StepError, match="reset"):
        env.state()
    env.reset()
    actions = {agent: [0, 0] for agent in env.agents}
    env.step(actions)
    state = env.state()
    with pytest.raises(StepError, match="reset"):
        env.step(actions)
    assert env.step({}) == ({}, {}, {}, {}, {})
    assert np.array_equal(env.state(), state)
    env.reset()
    assert len(env.step(actions)[0]) == 3


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"render_mode": "ascii"}, "render_mode: "),
        ({"reward": "sparse"}, "reward: "),
        ({"observation": "pixels"}, "observation: "),
        ({"colour": "red"}, "colour: "),
        ({"n_robots": 9}, "n_robots: "),
        ({"max_cycles": 4, "max_steps": 5}, "max_cycles: "),
        ({"reward": RewardProfile(name="mine"), "max_cycles": 0}, "max_steps: "),
    ],
)
def test_settings(settings, named):
    with pytest.raises(ConfigError, match=named):
        parallel_env(**settings)


def test_names():
    with pytest.raises(FieldError, match="field_99"):
        parallel_env("field_99")
    env = parallel_env()
    for space in (env.observation_space, env.action_space):
        with pytest.raises(MbnError, match="robot_3"):
            space("robot_3")
    with pytest.raises(Exception, match="field_03"):
        pettingzoo.make("parallel", "mbn/field_99-v0")


@pytest.mark.parametrize("action", [[None, None], [10**400, 0], [np.inf, 0.0]])
def test_one_action_at_a_time_that_is_no_action_is_refused(action):
    aec = navigation_v0.raw_env("field_03")
    aec.reset()
    with pytest.raises(ActionError, match=r"robot_0: .*two finite numbers"):
        aec.step(action)
    assert aec.agent_selection == "robot_0"


def test_an_array_may_be_used_again_for_the_next_robot():
    aec, together = navigation_v0.raw_env("field_03"), parallel_env("field_03")
    aec.reset()
    together.reset()
    buffer = np.zeros(2, np.float32)
    actions = {agent: np.array([0.3 * k, -0.2]) for k, agent in enumerate(aec.agents)}
    for agent in list(aec.agents):
        buffer[:] = actions[agent]
        aec.step(buffer)
    together.step(actions)
    np.testing.assert_array_equal(aec.state(), together.state())
