"""The centralised form: Gymnasium's checks, its own vector, and bad input."""

import copy

import gymnasium
import numpy as np
import pettingzoo
import pytest
from gymnasium.utils.env_checker import check_env
from gymnasium.vector import AutoresetMode, SyncVectorEnv

from mbn_marl import Field, centralized_env, parallel_env
from mbn_marl.adapters.gymnasium import CentralizedVectorEnv
from mbn_marl.config import CONDITIONS
from mbn_marl.errors import ActionError, ConfigError, StepError
from mbn_marl.field import catalogue_names
from tests.support.field_cases import SQUARE
from tests.support.forms import NOTHING
from tests.support.problems import places_of

LANE = Field(vertices=SQUARE, rois=[(55.0, 50.0)], starts=[(20.0, 50.0)])


class TestOfficial:
    @pytest.mark.filterwarnings("error")
    def test_check_env(self):
        check_env(gymnasium.make("mbn/field_03-v0").unwrapped)
        check_env(gymnasium.make("mbn/field_07-v0", n_robots=1, max_steps=30).unwrapped)

    def test_ids_are_the_catalogue_under_every_condition(self):
        ids = {env_id for env_id in gymnasium.registry if env_id.startswith("mbn/")}
        marks = ["", *(f"-{name}" for name in CONDITIONS if name != "calm")]
        marks.append("-flat")
        assert ids == {f"mbn/{name}{mark}-v0" for name in catalogue_names() for mark in marks}
        for registry in (pettingzoo.parallel_registry, pettingzoo.aec_registry):
            assert {*registry} >= {env_id for env_id in ids if "-flat" not in env_id}
        for name in catalogue_names():
            env = gymnasium.make(f"mbn/{name}-v0", n_robots=2)
            parallel = pettingzoo.make("parallel", f"mbn/{name}-v0", n_robots=2)
            aec = pettingzoo.make("aec", f"mbn/{name}-windy-v0", max_cycles=7)
            for made in (env, parallel, aec):
                assert made.unwrapped.engine.field.name == name
            assert env.action_space.shape == (2, 2)
            assert parallel.possible_agents == ["robot_0", "robot_1"]
            config = aec.unwrapped.engine.config
            assert (config.max_steps, config.wind) == (7, CONDITIONS["windy"]["wind"])

    def test_flat_actions(self):
        flat, env = gymnasium.make("mbn/field_03-flat-v0"), centralized_env("field_03")
        assert flat.action_space.shape == (6,)
        flat.reset()
        assert env.reset()[1] == NOTHING
        action = np.linspace(-1.0, 1.0, 6, dtype=np.float32)
        assert np.array_equal(flat.step(action)[0], env.step(action.reshape(3, 2))[0])
        with pytest.raises(ActionError):
            flat.step(action.reshape(3, 2))

    def test_frames(self):
        env = gymnasium.make("mbn/field_03-v0", render_mode="rgb_array_list")
        env.reset()
        env.step(env.action_space.sample())
        assert [(frame.ndim, frame.dtype) for frame in env.render()] == [(3, np.uint8)] * 2
        env.close()
        env.close()
        with pytest.warns(UserWarning, match="render_mode"):
            assert centralized_env().render() is None
        envs = gymnasium.make_vec("mbn/field_03-v0", num_envs=2, render_mode="rgb_array")
        envs.reset()
        assert len(envs.render()) == 2


class TestBadInput:
    def test_actions(self):
        env = centralized_env()
        env.reset()
        env.step(np.full((3, 2), 0.5))
        before = env.engine.state()
        for action, place in (
            (np.zeros((2, 2)), r"action: float64 of shape \(2, 2\)"),
            ([[0.0, 0.0], [0.0, np.nan], [0.0, 0.0]], "robot_1"),
            ("north", "action: "),
            (np.ones(6, bool), "action: "),
            ([[0.0], [0.0, 1.0]], "action: "),
        ):
            with pytest.raises(ActionError, match=place):
                env.step(action)
            assert np.array_equal(env.engine.state(), before)
        env.step(np.zeros((3, 2), int))

    def test_order(self):
        env, envs = centralized_env(max_steps=1), CentralizedVectorEnv(4)
        with pytest.raises(StepError):
            envs.step(np.zeros((4, 3, 2)))
        with pytest.raises(StepError):
            env.step(np.zeros((3, 2)))
        env.reset()
        assert env.step(np.zeros((3, 2)))[2:4] == (False, True)
        with pytest.raises(StepError):
            env.step(np.zeros((3, 2)))

    def test_names(self):
        wrong = {"render_mode": "x", "autoreset_mode": "x", "max_episode_steps": 0}
        wrong["knowledge"] = "own"
        found = places_of(ConfigError, CentralizedVectorEnv, 0, **wrong)
        assert {*found} == {*wrong, "num_envs"}
        assert places_of(ConfigError, centralized_env, flat="no", tau=0) == ["flat", "tau"]
        for call, error, place in (
            (lambda: centralized_env(autoreset=1), ConfigError, "autoreset: "),
            (lambda: CentralizedVectorEnv(2, seed=1), ConfigError, "seed: "),
            (
                lambda: CentralizedVectorEnv(2, max_episode_steps=10, max_steps=11),
                ConfigError,
                "max_episode_steps: ",
            ),
            (lambda: gymnasium.make("mbn/field_99-v0"), gymnasium.error.NameNotFound, "field_09"),
        ):
            with pytest.raises(error, match=place):
                call()


class TestVector:
    def test_make_vec_gives_one_engine(self):
        envs = gymnasium.make_vec("mbn/field_06-v0", num_envs=5)
        assert isinstance(envs, CentralizedVectorEnv)
        assert envs.engine.num_worlds == envs.num_envs == 5
        assert envs.metadata["autoreset_mode"] is AutoresetMode.NEXT_STEP
        assert (envs.observation_space.shape, envs.action_space.shape) == ((5, 13), (5, 3, 2))
        assert envs.observation_space.contains(envs.reset(seed=1)[0])

    @pytest.mark.slow
    @pytest.mark.parametrize(
        ("mode", "sharing"),
        [(AutoresetMode.NEXT_STEP, "team"), *((mode, "individual") for mode in AutoresetMode)],
    )
    def test_it_does_what_gymnasiums_own_vector_does(self, mode, sharing):
        settings = {"field": "field_03", "max_steps": 25, "wind": (0.08, 45.0), "f_max": 1.0}
        settings |= {"reward_sharing": sharing}
        native = CentralizedVectorEnv(6, autoreset_mode=mode, **settings)
        single = SyncVectorEnv([lambda: centralized_env(**settings)] * 6, autoreset_mode=mode)
        np.testing.assert_equal(native.reset(seed=3), single.reset(seed=3))
        rng = np.random.default_rng(8)
        terminations = truncations = 0
        for _ in range(120):
            actions = rng.uniform(-1, 1, (6, 3, 2)).astype(np.float32)
            ours, theirs = native.step(actions), single.step(actions)
            np.testing.assert_equal(ours[:4], theirs[:4])
            assert [one.dtype for one in ours[2:4]] == [bool, bool]
            assert_same_infos(ours[4], theirs[4])
            terminations += ours[2].sum()
            truncations += ours[3].sum()
            ended = ours[2] | ours[3]
            if mode is AutoresetMode.DISABLED and ended.any():
                mask = {"reset_mask": ended}
                ours, theirs = native.reset(options=mask), single.reset(options=dict(mask))
                assert np.array_equal(ours[0], theirs[0])
                assert_same_infos(ours[1], theirs[1])
        assert min(terminations, truncations) > 4

    def test_what_was_returned_stays_as_it_was(self):
        envs = CentralizedVectorEnv(2, LANE, f_max=30.0, v_clip=30.0, max_steps=2)
        actions = np.array([[[0.0, 1.0]], [[1.0, 0.0]]])  # world 1 succeeds, world 0 runs out
        kept = [envs.reset(seed=1), envs.step(actions), envs.step(actions)]
        before = copy.deepcopy(kept)
        envs.step(-actions)
        envs.reset()
        np.testing.assert_equal(kept, before)

    def test_seeds(self):
        envs = gymnasium.make_vec("mbn/field_03-v0", num_envs=3, random_starts=True)
        first, second, again, other = (envs.reset(seed=seed)[0] for seed in (5, None, 5, 6))
        assert np.array_equal(first, again)
        assert (first != second).any() and (first != other).any()
        assert len(np.unique(first, axis=0)) == 3

    def test_without_seeds_copies_differ(self):
        for make in (
            lambda: gymnasium.make_vec("mbn/field_03-v0", num_envs=1, random_starts=True),
            lambda: centralized_env("field_03", random_starts=True),
            lambda: parallel_env("field_03", random_starts=True),
        ):
            one, other = make(), make()
            assert (one.reset()[0] is not None) and (other.reset()[0] is not None)
            assert (one.engine.state() != other.engine.state()).any()
            assert one.engine.seed != other.engine.seed

    def test_a_first_reset_with_a_mask_draws_a_seed(self):
        one, other = (CentralizedVectorEnv(1, "field_03", random_starts=True) for _ in range(2))
        first, second = (
            envs.reset(options={"reset_mask": np.array([True])})[0] for envs in (one, other)
        )
        assert (first != second).any() and one.engine.seed != other.engine.seed

    def test_wrong_options(self):
        envs = CentralizedVectorEnv(2)
        before, _ = envs.reset()
        for options, seed, place in (
            ({"reset_mask": np.array([True])}, None, "reset_mask: "),
            ({}, [0, 1], "seed: "),
            ({"reset_mask": np.array([1, 0])}, None, "reset_mask: "),
            ({"reset_mask": np.array([True, False])}, 3, "reset_mask: "),
            ({"field": "field_03", "reset_msk": [True]}, None, r"'field': (.|\n)*'reset_msk': "),
            ([1, 2], 3, "options: "),
        ):
            with pytest.raises(ConfigError, match=place):
                envs.reset(seed=seed, options=options)
            assert np.array_equal(envs.engine.state(), before)


def assert_same_infos(ours, theirs):
    # Sums over robots may differ in the last bit.
    for key, value in theirs.items():
        if isinstance(value, dict):
            assert_same_infos(ours[key], value)
        elif value.dtype == object:
            np.testing.assert_equal([*ours[key]], [*value])
        else:
            np.testing.assert_allclose(ours[key], value, rtol=1e-12, err_msg=key)
    assert ours.keys() == theirs.keys()


@pytest.mark.parametrize("make", [centralized_env, parallel_env])
def test_a_seed_of_numpy_is_a_seed(make):
    env, same = make("field_03"), make("field_03")
    env.reset(seed=np.int64(3))
    same.reset(seed=3)
    assert env.np_random.random() == same.np_random.random()
    assert env.engine.seed == 3
