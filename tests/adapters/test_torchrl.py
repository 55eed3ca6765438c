"""The TorchRL environment: specs, equality with the engine, resets, and that losses train on it."""

from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict, TensorDictBase, assert_close
from tensordict.nn import TensorDictModule
from tensordict.nn.distributions import NormalParamExtractor
from torchrl.collectors import Collector
from torchrl.envs import EnvBase, PettingZooWrapper, StepCounter, TransformedEnv
from torchrl.envs.utils import check_env_specs
from torchrl.modules import MultiAgentMLP, ProbabilisticActor, TanhNormal, ValueOperator
from torchrl.objectives import ClipPPOLoss, ValueEstimators

from mbn_marl import parallel_env
from mbn_marl.adapters.torchrl import GROUP, METRICS, NavigationEnv
from mbn_marl.engine import BatchEngine
from mbn_marl.errors import ActionError, ConfigError, StepError
from tests.support import configurations

pytestmark = pytest.mark.slow
WORLDS, STEPS = 6, 60
LIVELY = {"max_steps": 25, "safety_distance": 50.0, "random_starts": True}
"""Settings under which random robots soon collide, or else run out of time."""

STORM = {**configurations.STORM, "dynamics": ("holonomic", "unicycle", "bicycle")}
ENTRIES = [(GROUP, "observation"), "state", "team_reward"]


def push(seed: int = 0) -> TensorDictModule:
    """A policy of random forces that a generator of its own draws: the same on every call here."""
    generator = torch.Generator().manual_seed(seed)

    def force(observation: torch.Tensor) -> torch.Tensor:
        return 2.0 * torch.rand((*observation.shape[:-1], 2), generator=generator) - 1.0

    key = (GROUP, "observation")
    return TensorDictModule(force, in_keys=[key], out_keys=[(GROUP, "action")])


def play(env: EnvBase, steps: int = STEPS) -> TensorDictBase:
    """A rollout through resets, ``(worlds, steps)``."""
    return env.rollout(steps, push(), break_when_any_done=False)


def test_entries_are_those_of_the_table() -> None:
    env = NavigationEnv("field_03", WORLDS)
    assert env.batch_size == (WORLDS,)
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


def test_specs() -> None:
    for settings in (
        {"max_steps": 2},
        {"observation": "state", "reward_sharing": "team"},
        {"n_robots": 1, "reward": "formal", "random_starts": True, "one_hot": True},
    ):
        env = NavigationEnv("field_03", 3, **settings)
        check_env_specs(env, break_when_any_done="both", seed=0)
    check_env_specs(NavigationEnv(["field_03", "field_07"], 4))


@pytest.mark.parametrize(("transformed", "dtype"), [(False, "float32"), (True, "float64")])
def test_rollout_is_the_engine_step_by_step(transformed: bool, dtype: str) -> None:
    """Also that nothing leaks across a reset: ``next`` is the ended episode's, the root the new."""
    settings = LIVELY | {"dtype": dtype}
    env = NavigationEnv("field_03", WORLDS, seed=5, **settings)
    data = play(TransformedEnv(env, StepCounter()) if transformed else env)
    engine = BatchEngine("field_03", WORLDS, seed=5, autoreset="disabled", **settings)
    observations = engine.reset()
    steps = np.zeros(WORLDS, int)
    for now in data.unbind(1):
        np.testing.assert_array_equal(now[GROUP, "observation"], observations)
        np.testing.assert_array_equal(now["state"], engine.state())
        assert not now["done"].any()
        observations, rewards, terminated, truncated = engine.step(now[GROUP, "action"].numpy())
        after, metrics = now["next"], engine.metrics()
        steps += 1
        np.testing.assert_array_equal(after[GROUP, "observation"], observations)
        np.testing.assert_array_equal(after["state"], engine.state())
        np.testing.assert_array_equal(after[GROUP, "reward"][..., 0], rewards)
        np.testing.assert_array_equal(after["team_reward"][:, 0], engine.team_rewards)
        np.testing.assert_array_equal(after["terminated"][:, 0], terminated)
        np.testing.assert_array_equal(after["truncated"][:, 0], truncated)
        np.testing.assert_array_equal(after["truncated"][:, 0], (steps == 25) & ~terminated)
        np.testing.assert_array_equal(after["done"][:, 0], terminated | truncated)
        for name in METRICS:
            expected = metrics[name].astype(np.float32)
            np.testing.assert_array_equal(after["metrics", name][:, 0], expected)
        ended = terminated | truncated
        observations = engine.reset_worlds(ended)
        steps[ended] = 0
    assert data["next", "terminated"].any() and data["next", "truncated"].any()


@pytest.mark.parametrize("more", [{}, STORM], ids=["calm", "storm"])
def test_own_maybe_reset_equals_torchrls(more: dict[str, Any]) -> None:
    settings = more | {"field": "field_03", "num_worlds": WORLDS, "seed": 1} | LIVELY
    own = NavigationEnv(**settings)
    plain = TransformedEnv(NavigationEnv(**settings))
    expected = play(plain)
    assert expected["next", "done"][:, :-1].any()
    assert_close(play(own), expected, rtol=0.0, atol=0.0)


def test_root_tells_of_the_last_step_and_of_nothing_after_a_reset() -> None:
    data = play(NavigationEnv("field_03", WORLDS, **LIVELY))
    ended = data["next", "done"][:, :-1, 0]
    for key in ("team_reward", ("metrics", "episode_return"), ("metrics", "steps")):
        root, previous = data[key][:, 1:, 0], data["next", key][:, :-1, 0]
        assert (root[ended] == 0).all() and (root[~ended] == previous[~ended]).all()
        assert (previous[ended] != 0).all()


def test_partial_reset_leaves_the_other_worlds_alone() -> None:
    env = NavigationEnv("field_03", 4, **LIVELY)
    data = env.rollout(3, push(), break_when_any_done=True)[:, -1]["next"]
    assert not data["done"].any()
    mask = torch.tensor([[True], [False], [False], [True]])
    chosen = mask[:, 0]
    back = env.reset(data.clone().set("_reset", mask))
    for key in ENTRIES:
        assert (back[key][~chosen] == data[key][~chosen]).all()
    assert (back["state"][chosen] != data["state"][chosen]).any(1).all()
    assert env.engine.metrics()["steps"].tolist() == [0, 3, 3, 0]


def test_seed_decides_all_episodes() -> None:
    env = NavigationEnv("field_03", WORLDS, seed=3, **LIVELY)
    first = play(env)
    env.set_seed(4)
    other = play(env)
    env.set_seed(3)
    assert_close(play(env), first, rtol=0.0, atol=0.0)
    assert (other["state"] != first["state"]).any()


def test_seed_is_used_once() -> None:
    env = NavigationEnv("field_03", WORLDS, seed=3, **LIVELY)
    env.reset()
    expected = env.reset()["state"]
    env.set_seed(3)
    first = env.reset()["state"]
    assert (first != expected).any() and (env.reset()["state"] == expected).all()


def test_ended_worlds_wait_for_the_others() -> None:
    """The usual evaluation loop: until every world has ended once."""
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


def test_bad_steps_are_refused_before_anything_moves() -> None:
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
    with pytest.raises(ConfigError, match="max_step: "):
        NavigationEnv("field_03", 2, max_step=3)  # type: ignore[call-arg]


def actor_and_critic(env: EnvBase, team: bool) -> tuple[ProbabilisticActor, ValueOperator]:
    """MAPPO's networks; the critic values the team (from the state) or each robot."""
    size = env.observation_spec[GROUP, "observation"].shape[-1]
    network = MultiAgentMLP(size, 4, 3, centralised=False, share_params=True, num_cells=[8])
    parameters = TensorDictModule(
        torch.nn.Sequential(network, NormalParamExtractor()),
        in_keys=[(GROUP, "observation")],
        out_keys=[(GROUP, "loc"), (GROUP, "scale")],
    )
    actor = ProbabilisticActor(
        parameters,
        spec=env.full_action_spec_unbatched,
        in_keys=[(GROUP, "loc"), (GROUP, "scale")],
        out_keys=[(GROUP, "action")],
        distribution_class=TanhNormal,
        return_log_prob=True,
    )
    if team:
        return actor, ValueOperator(torch.nn.Linear(13, 1), in_keys=["state"])
    values = MultiAgentMLP(size, 1, 3, centralised=True, share_params=True, num_cells=[8])
    value_key = (GROUP, "state_value")
    return actor, ValueOperator(values, in_keys=[(GROUP, "observation")], out_keys=[value_key])


def expand_done(data: TensorDictBase) -> None:
    """Give the group flags of its own, as a loss on the robots' rewards wants them."""
    for name in ("done", "terminated"):
        flag = data["next", name].unsqueeze(-2)
        data["next", GROUP, name] = flag.expand(data["next", GROUP, "reward"].shape)


def ppo_gradients(env: EnvBase, team: bool) -> list[torch.Tensor]:
    """Collect, estimate advantages, differentiate TorchRL's PPO loss."""
    actor, critic = actor_and_critic(env, team)
    with torch.no_grad():
        data = env.rollout(8, actor, break_when_any_done=False)
    loss = ClipPPOLoss(actor, critic)
    loss.set_keys(action=(GROUP, "action"), sample_log_prob=(GROUP, "action_log_prob"))
    if team:
        loss.set_keys(reward="team_reward")
    else:
        expand_done(data)
        keys = {name: (GROUP, name) for name in ("reward", "done", "terminated")}
        loss.set_keys(value=(GROUP, "state_value"), **keys)
    loss.make_value_estimator(ValueEstimators.GAE, gamma=0.99, lmbda=0.95)
    loss.value_estimator(data)
    if team:
        data["advantage"] = data["advantage"].unsqueeze(-2)
        losses: TensorDict = loss(data)
    else:
        losses = loss(data)
    sum(value for key, value in losses.items() if key.startswith("loss_")).backward()
    return [weights.grad for weights in loss.parameters() if weights.requires_grad]


@pytest.mark.parametrize("team", [False, True], ids=["robots' reward", "team's reward"])
def test_ppo_loss_trains(team: bool) -> None:
    torch.manual_seed(0)
    gradients = ppo_gradients(NavigationEnv("field_03", 4, max_steps=5), team)
    assert all(grad is not None and grad.isfinite().all() for grad in gradients)
    assert all(grad.abs().sum() > 0 for grad in gradients)


def wrapped_parallel_env(**settings: object) -> PettingZooWrapper:
    env = parallel_env("field_03", **settings)
    return PettingZooWrapper(env, group_map={GROUP: env.possible_agents}, return_state=True)


@pytest.mark.filterwarnings("ignore:PettingZoo in TorchRL is tested using")
def test_pettingzoo_wrapper_trains() -> None:
    """PPO as a user writes it: collector, GAE and loss of TorchRL on PettingZoo's environment."""
    torch.manual_seed(0)
    gamma, env = 0.9, wrapped_parallel_env(**LIVELY)
    actor, critic = actor_and_critic(env, team=False)
    loss = ClipPPOLoss(actor, critic)
    keys = {name: (GROUP, name) for name in ("action", "reward", "done", "terminated")}
    loss.set_keys(sample_log_prob=(GROUP, "action_log_prob"), value=(GROUP, "state_value"), **keys)
    # With lambda = 0 the targets are those of one step, which can be told by hand.
    loss.make_value_estimator(ValueEstimators.GAE, gamma=gamma, lmbda=0.0)
    optimizer = torch.optim.Adam(loss.parameters(), lr=1e-2)
    before = [weights.detach().clone() for weights in loss.parameters()]
    ends = torch.zeros(2)
    collector = Collector(
        env, actor, frames_per_batch=100, total_frames=300, auto_register_policy_transforms=False
    )
    for data in collector:
        data["next", GROUP, "reward"] *= 1e-4
        with torch.no_grad():
            loss.value_estimator(data)
            following = critic(data["next"].clone())[GROUP, "state_value"]
        terminated, truncated = (data["next", GROUP, name] for name in ("terminated", "truncated"))
        going_on = ~terminated  # at a time limit the value of the last observation counts
        target = data["next", GROUP, "reward"] + gamma * going_on * following
        torch.testing.assert_close(data["value_target"], target)
        ended = data["next", "done"][:-1, 0]
        seen, last = data[GROUP, "observation"][1:], data["next", GROUP, "observation"][:-1]
        assert (seen[ended] != last[ended]).any(-1).all() and (seen[~ended] == last[~ended]).all()
        ends += torch.stack([flag[:, 0].sum() for flag in (terminated, truncated & ~terminated)])
        for _ in range(2):
            losses = loss(data)
            total = sum(value for key, value in losses.items() if key.startswith("loss_"))
            assert total.isfinite()
            optimizer.zero_grad()
            total.backward()
            optimizer.step()
    assert (ends > 0).all()
    after = list(loss.parameters())
    assert all(weights.isfinite().all() for weights in after)
    assert all((old != new).any() for old, new in zip(before, after, strict=True))


def test_only_a_full_reset_uses_a_seed_or_a_saved_state() -> None:
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


def test_a_saved_world_that_had_ended_begins_again() -> None:
    env = NavigationEnv("field_03", 2, max_steps=3)
    data = env.reset()
    for _ in range(3):
        data = env.step(push()(data))["next"]
    env.load_state(env.save_state())
    assert not env.reset()["done"].any() and env.engine.running.all()
    env.step(push()(env.reset()))


@pytest.mark.all
def test_torch_compile_leaves_steps_alone() -> None:
    env = NavigationEnv("field_03", 2)
    engine = BatchEngine("field_03", 2)
    engine.reset()

    @torch.compile
    def rewards_of(actions: torch.Tensor) -> torch.Tensor:
        return torch.from_numpy(engine.step(actions.numpy())[1].copy())

    assert rewards_of(torch.zeros(2, 3, 2)).shape == (2, 3)
    step: Any = torch.compile(env.step)
    assert step(env.rand_action(env.reset()))["next", "robots", "reward"].shape == (2, 3, 1)


def test_repeats_sizes_and_metrics_are_checked_at_once() -> None:
    env = NavigationEnv("field_03", 2)
    for value in (0, 1.5, "2", None):
        for make in (
            lambda value=value: NavigationEnv("field_03", 2, action_repeat=value),
            lambda value=value: setattr(env, "action_repeat", value),
        ):
            with pytest.raises(ConfigError, match="action_repeat: "):
                make()
    assert env.action_repeat == 1 and NavigationEnv("field_03", np.int64(2)).batch_size == (2,)
    with pytest.raises(ConfigError) as caught:
        NavigationEnv("field_03", 2.5, metrics=["success", "success"])  # type: ignore[arg-type]
    assert [one.partition(":")[0] for one in caught.value.problems] == ["metrics", "num_worlds"]
