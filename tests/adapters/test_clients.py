"""Tools of other libraries, on the environments as they are."""

import sys
from types import ModuleType

import gymnasium
import numpy as np
import pettingzoo
import pytest
from gymnasium.wrappers import TimeAwareObservation
from stable_baselines3.common.vec_env import VecVideoRecorder
from torchrl.envs import GymEnv

from mbn_marl import parallel_env, registration
from mbn_marl.adapters.gymnasium import CentralizedEnv
from mbn_marl.adapters.one_world import RENDER_FPS
from mbn_marl.adapters.sb3 import CentralizedVecEnv, SharedPolicyVecEnv
from mbn_marl.config import CONDITIONS
from mbn_marl.field import catalogue_names
from mbn_marl.render.viewer import RENDER_SIZE

ID = "mbn/field_03-v0"


def test_torchrl_makes_a_registered_environment_and_repeats_actions():
    env = GymEnv(ID, frame_skip=3)
    rollout = env.rollout(2)
    assert rollout["observation"].shape == (2, 13)
    assert env.unwrapped.engine.metrics()["steps"][0] == 6


def test_specs_have_the_time_limit_by_either_name():
    assert gymnasium.make(ID).spec.max_episode_steps == 1000
    assert gymnasium.make(gymnasium.make(ID, max_steps=20).spec).spec.max_episode_steps == 20
    assert TimeAwareObservation(gymnasium.make(ID)).observation_space.shape == (14,)
    assert CentralizedEnv().spec is None
    envs = gymnasium.make_vec(ID, num_envs=2, max_episode_steps=10)
    env = gymnasium.make(ID, max_episode_steps=10)
    assert envs.spec.max_episode_steps == env.spec.max_episode_steps == 10
    assert gymnasium.make_vec(envs.spec).unwrapped.engine.config.max_steps == 10
    envs.reset(seed=0)
    env.reset(seed=0)
    for step in range(1, 11):
        assert envs.step(np.zeros((2, 3, 2)))[3].tolist() == [step == 10] * 2
        assert env.step(np.zeros((3, 2)))[3] is (step == 10)


@pytest.mark.parametrize("kind", [CentralizedVecEnv, SharedPolicyVecEnv])
def test_stable_baselines_films_one_world(kind, tmp_path, monkeypatch):
    # MoviePy, which writes the file, wants another Pillow than the suite's.
    monkeypatch.setitem(sys.modules, "moviepy", ModuleType("moviepy"))
    worlds = kind("field_03", 4, seed=1, render_mode="rgb_array", random_starts=True)
    env = VecVideoRecorder(worlds, str(tmp_path), lambda step: step == 0, video_length=5)
    env.reset()
    for _ in range(3):
        env.step(np.zeros((env.num_envs, *env.action_space.shape)))
    assert np.shape(env.recorded_frames) == (4, *RENDER_SIZE[::-1], 3)
    alone = parallel_env("field_03", render_mode="rgb_array", random_starts=True)
    alone.reset(seed=1)
    assert np.array_equal(env.recorded_frames[0], alone.render())
    assert env.frames_per_sec == RENDER_FPS
    env.recorded_frames.clear()


def test_without_a_registry_of_pettingzoo_gymnasiums_is_filled(monkeypatch):
    monkeypatch.delattr(pettingzoo, "register")
    monkeypatch.setattr(gymnasium.envs.registration, "registry", registry := {})
    registration.register_environments()
    assert len(registry) == len(catalogue_names()) * (len(CONDITIONS) + 1)
    assert gymnasium.make(ID).unwrapped.engine.field.name == "field_03"
