"""The checkers of every library pass in a storm, and infos tell what was drawn."""

import warnings

import gymnasium
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env
from stable_baselines3.common.env_checker import check_env as check_for_sb3
from torchrl.envs.utils import check_env_specs

from mbn_marl import BatchEngine, centralized_env, parallel_env
from mbn_marl.adapters.sb3 import CentralizedVecEnv
from mbn_marl.adapters.torchrl import NavigationEnv
from mbn_marl.config import CONDITIONS
from tests.support.configurations import STORM_OF_THREE as STORM

OF_ID = {name: value for name, value in STORM.items() if name not in CONDITIONS["storm"]}
pytestmark = pytest.mark.slow


def test_the_checkers_of_all_libraries_pass():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # Gymnasium's advice on raw units
        check_env(gymnasium.make("mbn/field_03-storm-v0", **OF_ID).unwrapped)
        check_for_sb3(centralized_env("field_03", **STORM))
        check_for_sb3(centralized_env("field_10", 2, reward="formal", max_steps=20))
    check_env_specs(NavigationEnv("field_03", 4, **STORM))


def test_infos_tell_what_was_drawn():
    how = STORM | {"max_steps": 6}
    engine = BatchEngine("field_03", 4, seed=6, **how)
    engine.reset()
    names = [f"drawn/{name}" for name in engine.drawn()]
    assert {"drawn/wind_speed", "drawn/wind_angle", "drawn/mass"} < set(names)
    drawn = [engine.drawn()]
    engine.reset()
    drawn.append(engine.drawn())
    rows = [np.stack([*one.values()], axis=1) for one in drawn]  # (W, names) of two episodes

    one = parallel_env("field_03", **how)
    for row in rows:
        _, infos = one.reset(seed=6 if row is rows[0] else None)
        for _ in range(6):
            assert all([info[name] for name in names] == row[0].tolist() for info in infos.values())
            *_, infos = one.step(dict.fromkeys(one.agents, (0.0, 0.0)))
        assert all([info[name] for name in names] == row[0].tolist() for info in infos.values())

    same_step = OF_ID | {"autoreset_mode": "SameStep", "max_steps": 6}
    many = gymnasium.make_vec("mbn/field_03-storm-v0", 4, **same_step)
    _, found = many.reset(seed=6)
    for _ in range(6):
        assert np.array_equal(np.stack([found[name] for name in names], axis=1), rows[0])
        *_, found = many.step(np.zeros((4, 3, 2)))
    last = [found["final_info"][name] for name in names]
    assert np.array_equal(np.stack(last, axis=1), rows[0])
    assert np.array_equal(np.stack([found[name] for name in names], axis=1), rows[1])

    batch = NavigationEnv("field_03", 4, seed=6, **how)
    step = batch.rand_step(batch.reset())["next", "metrics"]
    assert np.array_equal(np.concatenate([step[name] for name in names], axis=1), rows[0])

    learners = CentralizedVecEnv("field_03", 4, seed=6, **how)
    learners.reset()
    for _ in range(6):
        *_, infos = learners.step(np.zeros((4, 3, 2), np.float32))
    assert [[info[name] for name in names] for info in infos] == rows[0].tolist()
