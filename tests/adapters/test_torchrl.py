"""The TorchRL environment: specs, equality with the engine, resets, and that losses train on it."""

import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase, assert_close
from tensordict.nn import TensorDictModule
from torchrl.envs import EnvBase, PettingZooWrapper, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs

from mbn_marl import parallel_env
from mbn_marl.adapters.torchrl import GROUP, METRICS, NavigationEnv
from mbn_marl.engine import BatchEngine
from mbn_marl.errors import ActionError, ConfigError, StepError
from tests.support.configurations import STORM_OF_THREE
from tests.support.problems import places_of

pytestmark = pytest.mark.slow
WORLDS, STEPS = 6, 60
LIVELY = {"max_steps": 25, "safety_distance": 50.0, "random_starts": True}


def push(seed: int = 0) -> TensorDictModule:
    """A policy of random forces, the same on every call here."""
    generator = torch.Generator().manual_seed(seed)

    def force(observation: torch.Tensor) -> torch.Tensor:
        return 2.0 * torch.rand((*observation.shape[:-1], 2), generator=generator) - 1.0

    key = (GROUP, "observation")
    return TensorDictModule(force, in_keys=[key], out_keys=[(GROUP, "action")])


def play(env: EnvBase, steps: int = STEPS) -> TensorDictBase:
    return env.rollout(steps, push(), break_when_any_done=False)


def test_entries_are_those_of_the_table():
    env = NavigationEnv("field_03", WORLDS)
    assert (env.action_key, env.reward_key) == ((GROUP, "action"), (GROUP, "reward"))
    assert env.group_map == {GROUP: ["robot_0", "robot_1", "robot_2"]}
    shapes = {key: tuple(item.shape) for key, item in env.rollout(1)[:, 0].items(True, True)}
    size = env.engine.obs_size
    world = {"state": (WORLDS, 13), **dict.fromkeys(("team_reward", "done"), (WORLDS, 1))}
    world |= dict.fromkeys(("terminated", "truncated"), (WORLDS, 1))
    world |= {("metrics", name): (WORLDS, 1) for name in METRICS}
    world |= {(GROUP, "observation"): (WORLDS, 3, size)}
    following = {("next", *(k if isinstance(k, tuple) else (k,))): v for k, v in world.items()}
    robots = {(GROUP, "action"): (WORLDS, 3, 2), ("next", GROUP, "reward"): (WORLDS, 3, 1)}
    assert shapes == world | following | robots


def test_specs():
    for settings in (
        {"max_steps": 2},
        {"observation": "state", "reward_sharing": "team"},
        {"n_robots": 1, "reward": "formal", "random_starts": True, "one_hot": True},
    ):
        env = NavigationEnv("field_03", 3, **settings)
        check_env_specs(env, break_when_any_done="both", seed=0)
    check_env_specs(NavigationEnv(["field_03", "field_07"], 4))


@pytest.mark.parametrize(("transformed", "dtype"), [(False, "float32"), (True, "float64")])
def test_rollout_is_the_engine_step_by_step(transformed, dtype):
    settings = LIVELY | {"dtype": dtype}
    env = NavigationEnv("field_03", WORLDS, seed=5, **settings)
    data = play(TransformedEnv(env, StepCounter()) if transformed else env)
    engine = BatchEngine("field_03", WORLDS, seed=5, autoreset="disabled", **settings)
    observations = engine.reset()
    for now in data.unbind(1):
        np.testing.assert_array_equal(now[GROUP, "observation"], observations)
        np.testing.assert_array_equal(now["state"], engine.state())
        assert not now["done"].any()
        observations, rewards, terminated, truncated = engine.step(now[GROUP, "action"].numpy())
        after, metrics = now["next"], engine.metrics()
        np.testing.assert_array_equal(after[GROUP, "observation"], observations)
        np.testing.assert_array_equal(after["state"], engine.state())
        np.testing.assert_array_equal(after[GROUP, "reward"][..., 0], rewards)
        np.testing.assert_array_equal(after["team_reward"][:, 0], engine.team_rewards)
        np.testing.assert_array_equal(after["terminated"][:, 0], terminated)
        np.testing.assert_array_equal(after["truncated"][:, 0], truncated)
        ended = terminated | truncated
        np.testing.assert_array_equal(after["done"][:, 0], ended)
        for name in METRICS:
            expected = metrics[name].astype(np.float32)
            np.testing.assert_array_equal(after["metrics", name][:, 0], expected)
        observations = engine.reset_worlds(ended)
    assert data["next", "terminated"].any() and data["next", "truncated"].any()


@pytest.mark.parametrize("more", [{}, STORM_OF_THREE], ids=["calm", "storm"])
def test_own_maybe_reset_equals_torchrls(more):
    settings = more | {"field": "field_03", "num_worlds": WORLDS, "seed": 1} | LIVELY
    own = NavigationEnv(**settings)
    plain = TransformedEnv(NavigationEnv(**settings))
    expected = play(plain)
    assert expected["next", "done"][:, :-1].any()
    assert_close(play(own), expected, rtol=0.0, atol=0.0)


def test_seed_is_used_once():
    env = NavigationEnv("field_03", WORLDS, seed=3, **LIVELY)
    env.reset()
    expected = env.reset()["state"]
    env.set_seed(3)
    assert (env.reset()["state"] != expected).any() and (env.reset()["state"] == expected).all()


def test_ended_worlds_wait_for_the_others():
    env = NavigationEnv("field_03", WORLDS, seed=2, **LIVELY)
    data = env.rollout(100, push(), break_when_any_done=False, break_when_all_done=True)
    lengths = data["next", "metrics", "steps"][:, -1, 0]
    assert len(set(lengths.tolist())) > 1 and lengths.max() == data.shape[1]
    assert data["next", "done"][:, -1].all()
    through = play(NavigationEnv("field_03", WORLDS, seed=2, **LIVELY), data.shape[1])
    for world, length in enumerate(lengths.int().tolist()):
        through_end, end = through[world, length - 1]["next"], data[world, -1]["next"]
        assert through_end["done"] and (end["state"] == through_end["state"]).all()
        assert end["metrics", "episode_return"] == through_end["metrics", "episode_return"]


def test_bad_steps_are_refused_before_anything_moves():
    env = NavigationEnv("field_03", 2, max_steps=1)
    data = env.rand_action(env.reset())
    before = env.engine.state()
    bad = data.clone()
    bad[GROUP, "action"][1, 2, 0] = torch.nan
    with pytest.raises(ActionError, match=r"world 1.*robot_2"):
        env.step(bad)
    np.testing.assert_array_equal(env.engine.state(), before)
    data = env.rand_action(env.step(data)["next"])
    with pytest.raises(StepError, match="world 0"):
        env.step(data)


@pytest.mark.filterwarnings("ignore:PettingZoo in TorchRL is tested using")
def test_torchrls_wrapper_of_the_parallel_form_keeps_both_ends_apart():
    world = parallel_env("field_03", **LIVELY)
    env = PettingZooWrapper(world, group_map={GROUP: world.possible_agents}, return_state=True)
    data = play(env, 300)["next"]
    terminated, truncated = (data[GROUP, name] for name in ("terminated", "truncated"))
    assert terminated.any() and (truncated & ~terminated).any()
    assert torch.equal(data[GROUP, "done"], terminated | truncated)
    assert data["state"].shape == (300, 13)


def test_only_a_full_reset_uses_a_seed_or_a_saved_state():
    env = NavigationEnv("field_03", 2, **LIVELY)
    first = env.reset()
    saved = env.save_state()
    for before, seed in ((lambda: env.set_seed(9), 9), (lambda: env.load_state(saved), 0)):
        before()
        env.reset(TensorDict({"_reset": torch.tensor([[True], [False]])}, [2]))
        again = env.reset()
        assert env.engine.seed == seed
    assert_close(again[1].exclude("_reset"), first[1])  # world 0 has begun another episode since
    env.load_state(saved)
    env.set_seed(5)  # later than the state: it counts
    env.reset()
    assert env.engine.seed == 5


def test_a_saved_world_that_had_ended_begins_again():
    env = NavigationEnv("field_03", 2, max_steps=3)
    data = env.reset()
    for _ in range(3):
        data = env.step(push()(data))["next"]
    env.load_state(env.save_state())
    data = env.reset()
    assert not data["done"].any() and env.engine.running.all()
    env.load_state(env.save_state())
    env.step(push()(data))
    env.reset()  # a step used the loaded state, so this starts a new episode
    assert not env.engine.metrics(["steps"])["steps"].any()
    env.step(push()(env.reset()))


@pytest.mark.all
def test_torch_compile_leaves_steps_alone():
    env = NavigationEnv("field_03", 2)
    step = torch.compile(env.step)
    assert step(env.rand_action(env.reset()))["next", "robots", "reward"].shape == (2, 3, 1)


def test_sizes_and_metrics_are_checked_at_once():
    assert NavigationEnv("field_03", np.int64(2)).batch_size == (2,)
    wrong = {"metrics": ["success"] * 2, "state": "no", "team_reward": 1}
    for worlds, more, place in ((2.5, {}, "num_worlds"), (2, {"colour": 1}, "colour")):
        places = places_of(ConfigError, NavigationEnv, "field_03", worlds, **wrong, **more)
        assert places == [*wrong, place]
    names = (name for name in ("success", "steps"))
    assert NavigationEnv("field_03", 2, metrics=names).reset().get("metrics", None) is not None
    for metrics in (None, [1, "success"], [["success"]]):
        with pytest.raises(ConfigError, match="metrics: "):
            NavigationEnv("field_03", 2, metrics=metrics)
    with pytest.raises(ConfigError, match="autoreset: "):
        NavigationEnv("field_03", 2, autoreset=True)
    env = NavigationEnv("field_03", 2, device=None)
    assert env.device == torch.device("cpu") and "field_03" in repr(env)
    with pytest.raises(ConfigError, match="seed: "):
        env.set_seed(-1)
