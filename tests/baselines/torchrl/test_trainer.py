"""The multi-agent trainer: hyperparameters, aids and targets."""

import math
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict

from baselines import load_policy
from baselines.algorithms import find_algorithm
from baselines.evaluation.evaluate import bound_of, evaluate, unseen
from baselines.torchrl import trainer
from baselines.torchrl.config import load
from baselines.torchrl.entities import SetActor, SetCritic, Tokens
from baselines.torchrl.networks import Key, TeamShape
from baselines.torchrl.trainer import Trainer, traits_of
from baselines.training import run_logger
from baselines.training.config import TrainConfig
from baselines.training.train import prepare, train
from mbn_marl.config import make_config
from mbn_marl.engine import BatchEngine
from mbn_marl.errors import ConfigError, MbnError
from mbn_marl.field import FieldSampler, load_fields
from mbn_marl.field.splits import SEARCH, search_side_by_side
from tests.support.problems import places_of
from tests.support.runs import interrupted, recorded, same_policies, small_config

pytestmark = pytest.mark.slow


def test_algorithms_differ_by_what_actor_and_critic_see_alone():
    of = {"mappo": ("decentralized", "centralized"), "ippo": ("decentralized", "independent")}
    seen = {**of, "ppo-joint": ("centralized", "centralized")}
    for setting in ("N", "G"):
        blocks = [load(name, setting, {}).model_dump() for name in seen]
        assert [(one.pop("actor"), one.pop("critic")) for one in blocks] == [*seen.values()]
        assert all(one == blocks[0] for one in blocks)
    assert blocks[0]["network"] == "entities" == blocks[0]["environment"]["observation"]


def test_cap_of_the_standard_deviation_stays_and_then_falls():
    config = load("mappo", "N", {"log_std_cap": [0.5, -1.5], "log_std_cap_from": 0.5})
    caps = [config.cap_at(progress) for progress in (0.0, 0.5, 0.75, 1.0, 1.1)]
    assert caps == [0.5, 0.5, -0.5, -1.5, -1.5]


SMALL = {"num_worlds": 4, "rollout_steps": 32, "hidden": [8]}
TINY = {"num_worlds": 2, "rollout_steps": 8, "minibatches": 1}


@pytest.mark.parametrize(("algorithm", "memory"), [("mappo", 0), ("ppo-joint", 0), ("mappo", 6)])
def test_a_time_limit_is_bootstrapped_and_a_termination_is_not(
    algorithm, memory, tmp_path, monkeypatch
):
    kept = []
    samples = trainer.Trainer._samples

    @torch.no_grad()
    def keep(self: Any, rollout: Any) -> Any:
        made = samples(self, rollout)
        # An update begins with the probabilities that the rollout had, also in the middle of it.
        again = self.actor.get_dist(made).log_prob(made[Key.ACTION])
        torch.testing.assert_close(again, made[Key.LOG_PROB], atol=1e-4, rtol=1e-4)
        # The value of what each step led to, after what the critic remembers of the steps before.
        kinds = (*self.critic.in_keys, *[self.critic.first] * bool(memory))
        seen = self.network.norm(rollout["next"].clone()).select(*kinds).reshape(-1)
        last = self.critic(seen)[Key.VALUE].unflatten(0, rollout.shape)
        kept.append((self.reward, rollout.clone(), last))
        return made

    monkeypatch.setattr(trainer.Trainer, "_samples", keep)
    short = {**SMALL, "memory": memory, "roi_radius": 1.0, "episode_steps": 8, "gae_lambda": 0.0}
    config = TrainConfig(
        algorithm,
        "field_03",
        steps=128,
        episodes=2,
        environment={"safety_distance": 45.0, "random_starts": True},
        hyperparameters=short,
    )
    train(config, tmp_path / "run")
    reward_key, rollout, last = kept[0]
    ended = rollout["next", "terminated"]
    assert ended.any() and (rollout["next", "truncated"] & ~ended).any()
    # With lambda 0 the target is one step's: reward, and what follows unless a success or collision
    # ended it.
    reward = rollout[reward_key]
    reward = reward.unsqueeze(-2) if algorithm == "ppo-joint" else reward
    expected = reward + 0.95 * last * ~ended.unsqueeze(-2)
    assert torch.allclose(rollout["value_target"], expected, atol=1e-4)
    assert expected.shape[-2] == (1 if algorithm == "ppo-joint" else 3)
    goes_on = ~rollout["next", "done"][:, :-1, 0]
    torch.testing.assert_close(last[:, :-1][goes_on], rollout[Key.VALUE][:, 1:][goes_on])


def test_robots_that_failed_do_not_move_the_actor(tmp_path, monkeypatch):
    kept = []
    samples = trainer.Trainer._samples

    def keep(self: Any, rollout: Any) -> Any:
        kept.append(rollout.clone())
        return samples(self, rollout)

    monkeypatch.setattr(trainer.Trainer, "_samples", keep)
    environment = {"failures": {"at": {1: 4}, "kind": "brake"}}
    config = TrainConfig("mappo", "field_03", steps=128, episodes=2, environment=environment)
    train(replace(config, hyperparameters={**SMALL, "roi_radius": 1.0}), tmp_path / "run")
    advantage, works = kept[0]["advantage"], kept[0]["robots", "mask"].unsqueeze(-1)
    assert 0.0 < works.float().mean() < 1.0 and not advantage[~works].any()
    assert abs(advantage[works].mean()) < 1e-5 and abs(advantage[works].std() - 1.0) < 1e-5


@pytest.mark.parametrize(
    ("algorithm", "field", "changes"),
    [
        ("mappo", "random_convex", {}),
        ("mappo", "random_convex", {"memory": 6}),
        ("ppo-joint", "random_convex", {"memory": 6}),
        ("ippo", "field_03", {"memory": 6, "sharing": "groups", "critic_sharing": "full+traits"}),
    ],
)
def test_a_run_of_setting_g_resumes(algorithm, field, changes, tmp_path):
    small = {"num_worlds": 4, "rollout_steps": 16, "hidden": [16, 16], "minibatches": 4, **changes}
    budget = {"steps": 320, "evaluate_every": 128, "episodes": 2}
    fast = {"v_clip": [5.0, 3.5, 5.0]} if field == "field_03" else {}
    how = {"environment": {"max_steps": 100, **fast}, "hyperparameters": small}
    config = TrainConfig(algorithm, field, "G", **budget, **how)
    assert not interrupted(config, tmp_path / "run").finished
    whole, again = train(config, tmp_path / "whole"), train(config, tmp_path / "run", resume=True)
    assert recorded(again) == recorded(whole) and same_policies(again, whole)


def test_robots_are_alike_in_dynamics_limits_and_kind():
    config = make_config({"v_clip": (5.0, 3.5, 5.0), "dynamics": ("unicycle",) * 3})
    for kinds, alike in (((), True), ((1, 0, 1), True), ((0, 0, 1), False)):
        first, second, third = traits_of(config, 3, kinds)
        assert first != second and (first == third) == alike


SEEN = {"observation": "entities", "assignment": True}
TEAMS = FieldSampler(robots=(2, 4), rois=(3, 5), seed=7)
WORLDS = 24
OF_RAYS = {"x": lambda k: (4 - k) % 8, "y": lambda k: -k % 8, "swap": lambda k: (2 - k) % 8}


class Scene:
    def __init__(self, *, assignment: bool) -> None:
        engine = BatchEngine(TEAMS, 1, **{**SEEN, "assignment": assignment})
        self.names = names = [entry.name for entry in engine.observation_table]
        self.tokens = Tokens.of(engine.observation_table)
        self.rows = rows = 0.9 * torch.rand((WORLDS, 4, len(names)), generator=torch.manual_seed(1))
        for k, name in enumerate(names):
            if f"{name[:-1]}x" in names:
                rows[..., k] = 2.0 * rows[..., k] - 0.9
            if name.endswith(("_present", "_left")):
                rows[..., k] = 1.0
        robots = 2 + torch.arange(WORLDS)[:, None] % 3
        absent = {f"other_{k}_": (robots <= k).expand(WORLDS, 4) for k in (1, 2, 3)}
        for roi in (1, 2, 4):  # which some robots have left behind
            chance = torch.rand(WORLDS, 4, generator=torch.manual_seed(roi))
            absent[f"roi_{roi}_"] = chance < 0.3
        absent[""] = torch.arange(4) >= robots
        for start, where in absent.items():
            for k in (k for k, name in enumerate(names) if name.startswith(start)):
                rows[..., k][where] = 0.0
        torch.manual_seed(0)
        self.actor = SetActor(self.tokens, (8, 12))
        self.critic = SetCritic(self.tokens, (8, 12), team=True)
        torch.nn.init.normal_(self.actor.head.weight)

    def mirrored(self, how: str) -> torch.Tensor:
        rows = self.rows.clone()
        for k, name in enumerate(self.names):
            other = f"{name[:-1]}{'x' if name.endswith('y') else 'y'}"
            if name[-1] in "xy" and other in self.names:
                if how == "swap":
                    rows[..., k] = self.rows[..., self.names.index(other)]
                elif name.endswith(how):
                    rows[..., k] *= -1
            if name.startswith("ray_"):
                before = self.names.index(f"ray_{OF_RAYS[how](int(name[4:]))}")
                rows[..., k] = self.rows[..., before]
        return rows


@pytest.fixture(scope="module", params=[True, False])
def scene(request):
    return Scene(assignment=request.param)


@pytest.mark.parametrize("how", ["x", "y", "swap"])
@torch.no_grad()
def test_in_a_mirrored_field_robots_do_the_mirrored_thing(scene, how):
    actions, rows = scene.actor(scene.rows), scene.mirrored(how)
    assert not torch.equal(rows, scene.rows) and actions.abs().mean() > 0.1
    signs = {"x": [-1.0, 1.0], "y": [1.0, -1.0], "swap": [1.0, 1.0]}[how]
    expected = (actions.flip(-1) if how == "swap" else actions) * torch.tensor(signs)
    torch.testing.assert_close(scene.actor(rows), expected)
    torch.testing.assert_close(scene.critic(rows), scene.critic(scene.rows))


@pytest.mark.parametrize("kinds", [("roi_0_", "roi_3_"), ("other_1_", "other_3_")])
@torch.no_grad()
def test_the_order_of_tokens_does_not_matter(scene, kinds):
    places = [[k for k, n in enumerate(scene.names) if n.startswith(kind)] for kind in kinds]
    rows = scene.rows.clone()
    rows[..., places[0] + places[1]] = scene.rows[..., places[1] + places[0]]
    assert not torch.equal(rows, scene.rows)
    torch.testing.assert_close(scene.actor(rows), scene.actor(scene.rows))


@torch.no_grad()
def test_absent_robots_do_nothing_and_count_for_nothing(scene):
    there = scene.rows.any(-1)
    counts = there.sum(1)
    assert {2, 3, 4} == {*counts.tolist()}
    actions, values = scene.actor(scene.rows), scene.critic(scene.rows)
    assert (actions.any(-1) == there).all() and (values.squeeze(-1)[~there] == 0).all()
    world = int((counts == 2).nonzero()[0])  # its rows without the room for others
    width = len(scene.tokens.robot)
    own, rest = scene.rows[world, :2].split(
        [len(scene.tokens.own), len(scene.names) - len(scene.tokens.own)], 1
    )
    small = torch.cat([own, rest[:, :width], rest[:, 3 * width :]], 1)
    torch.testing.assert_close(scene.actor(small), actions[world, :2])
    torch.testing.assert_close(scene.critic(small), values[world, :2])


def test_a_policy_of_random_fields_goes_anywhere_but_wants_a_field(tmp_path, refusal):
    small = small_config("mappo", "G")
    changes = {**small.hyperparameters, "scattered": 0.0, "roi_radius": 1.0}
    where = {"field": "random_convex", "environment": {**SEEN, "max_steps": 50}}
    run = train(replace(small, hyperparameters=changes, **where), tmp_path / "run")
    fields = load_fields("random_convex")
    assert run.fields == fields and isinstance(fields, FieldSampler)
    with pytest.raises(MbnError):
        _ = run.field
    free = load_policy(run.path)
    assert free.field is None and free.settings["observation"] == "entities"
    policy = load_policy(run.path, "field_10")
    size = BatchEngine("field_10", 1, **policy.settings).obs_size
    seen = np.random.default_rng(0).uniform(-0.9, 0.9, (2, 3, size)).astype(np.float32)
    actions = policy.act(seen)
    assert actions.shape == (2, 3, 2)
    np.testing.assert_array_equal(free.act(seen), actions)
    whole = evaluate(free, unseen(fields, 5), free.settings, episodes=3)
    assert len(whole.returns) == 3
    with pytest.raises(ConfigError, match="assignment"):
        load_policy(run.path, "field_03", assignment=False)
    assert "field: " in refusal(["evaluate", str(run.path)])
    assert str(run.path) in refusal(["render", str(run.path), "-o", "x.gif"])


@pytest.mark.parametrize(
    ("algorithm", "setting", "source", "memory", "gains"),
    [
        ("mappo", "G", "zoo:generalist", 6, (0.5, 3.0)),
        ("ppo-joint", "G", "zoo:generalist", 0, (1.0, 3.0)),
        ("mappo", "N", "zoo:field_03", 0, (1.0, 1.0)),
    ],
)
def test_a_run_begins_with_the_actor_of_another_one_and_multiplies_its_means(
    algorithm, setting, source, memory, gains, tmp_path
):
    noise = {"log_std_start": -0.5, "log_std_cap": (9.0, 9.0)}
    # The actor keeps still in the first rollouts, of which there are two.
    still = {**TINY, **noise, "learning_rate": (0.01, 0.01), "memory": memory}
    still["first_gain"] = gains[0]
    begins = {"steps": 32, "episodes": 1, "transferred_from": Path(source)}
    tuned = train(
        TrainConfig(algorithm, "field_03", setting, hyperparameters=still, **begins),
        tmp_path / "tuned",
    )
    loaded = [load_policy(str(p)) for p in (source, tuned.path)]
    seen = torch.from_numpy(BatchEngine("field_03", 1, threads=1, **loaded[0].settings).reset())
    first, second = (one.policy for one in loaded)
    theirs, ours = (policy.step(seen, policy.blank(seen))[0] for policy in (first, second))
    torch.testing.assert_close(ours, math.prod(gains) * theirs, atol=1e-5, rtol=1e-4)
    assert second.network.log_std.detach().numpy() == pytest.approx(-0.5)
    assert f"--from {source}" in tuned.command


def test_the_critic_begins_with_the_actors_encoder_and_learns_first():
    begins = {"steps": 96, "transferred_from": Path("zoo:generalist")}
    task, found = prepare(TrainConfig("mappo", "field_03", "G", hyperparameters=TINY, **begins))
    seen = []

    class Watched(Trainer):
        def _descend(self, *asked: Any) -> dict[str, float]:
            losses = super()._descend(*asked)
            networks = self.network.mean.encoder, self.critic.values.encoder
            seen.append([one.own[0].weight.detach().clone() for one in networks])
            return losses

    recorder = SimpleNamespace(
        checkpoint=None,
        checkpoint_due=False,
        episodes=SimpleNamespace(add=lambda *values: None),
        has_more=lambda env_steps, begun: env_steps < 96,
        **{name: lambda *values, **how: None for name in ("start", "update", "finish")},
    )
    watched = Watched(task, found, recorder)
    watched.run()
    actors, critics = zip(*seen, strict=True)
    first = load_policy("zoo:generalist").policy.network.mean.encoder.own[0].weight
    assert all(torch.equal(one, first) for one in actors[:5])
    assert not torch.equal(actors[5], first) and not torch.equal(critics[0], first)
    assert (critics[0] - first).abs().max() < 2e-3  # after one step of 0.0007


def test_each_robots_critic_begins_with_its_actors_encoder(monkeypatch):
    small = {**TINY, **ALONE}
    task, found = prepare(TrainConfig("ippo", "field_03", "G", hyperparameters=small, steps=96))
    made = Trainer(task, found, SimpleNamespace(checkpoint=None))
    monkeypatch.setattr(trainer, "load_trained", lambda source: made)
    made._begin_with(None)
    actor, critic = (one.state_dict() for one in (made.network.mean, made.critic.values))
    names = [name for name in actor if "encoder." in name]
    assert len(names) == 78 and all(torch.equal(actor[name], critic[name]) for name in names)


def test_a_run_of_a_tier_has_its_settings_and_its_bounds(tmp_path, monkeypatch):
    few = {name: search_side_by_side(name, math.inf)[:2] for name in ("validation", "test")}
    monkeypatch.setattr(run_logger, "search_side_by_side", lambda split, radius: few[split])
    heard = {"environment": {"comm_radius": math.inf}, "transferred_from": Path("zoo:generalist")}
    asked = TrainConfig(
        *("mappo", "random_search", "G"), tier=SEARCH, steps=16, hyperparameters=TINY, **heard
    )
    found = train(replace(asked, episodes=2), tmp_path / "run").evaluation["deterministic"]
    assert found["per_episode"]["bounds"] == [one.makespan_lower_bound for one in few["test"]]
    assert found["success_rate"] == 1.0
    frozen = few["test"][0]
    settings = {"observation": "entities", **frozen.settings}
    for same in ({"comm_radius": 100.0, "reward": "formal", "max_steps": 500}, {}):
        assert bound_of(frozen, {**settings, **same}) == frozen.makespan_lower_bound
    for other in ({"tau": 2.0}, {"roi_radius": 20.0}, {"wind": (0.1, 0.0)}, {"empty_rois": ()}):
        assert bound_of(frozen, {**settings, **other}) is None
    own = {"sensing_radius": 50.0, "comm_radius": 70.0, "decoys": 3}
    named = places_of(ConfigError, prepare, replace(asked, environment=own))
    assert named == [f"environment.{name}" for name in ("sensing_radius", "decoys", "comm_radius")]


ALONE = {"sharing": "none"}
ONE_DECISION = {"num_worlds": 1, "rollout_steps": 1}
OTHER = {"hidden": (8, 8), "sharing": "none", "network": "mlp"}
NAMED = [f"hyperparameters.{name}" for name in ("network", "hidden", "sharing")]


@pytest.mark.parametrize(
    ("algorithm", "field", "setting", "changes", "named"),
    [
        ("mappo", "random_convex", "G", {"scattered": 0.5}, ["scattered"]),
        ("mappo", "field_03", "N", {"shaping": 0.1}, ["shaping"]),
        ("mappo", "field_03", "G", {**ALONE, "hidden": [64]}, ["hidden"]),
        ("ippo", "random_convex", "G", {**ALONE, "critic": "state"}, ["critic", "sharing"]),
        ("ppo-joint", "field_03", "G", {"environment": {"knowledge": "own"}}, ["actor"]),
        ("mappo", "field_03", "N", ONE_DECISION, ["num_worlds x rollout_steps"]),
        ("mappo", "random_convex", "N", {}, ["field"]),
        ("ppo", "random_convex", "N", {}, ["field"]),
        ("mappo", "field_03", "G", OTHER, ["observation", "robots", "ROIs", "arena", *NAMED]),
    ],
)
def test_what_does_not_go_together_is_refused(algorithm, field, setting, changes, named):
    source = Path("zoo:generalist") if changes is OTHER else None
    config = TrainConfig(
        algorithm, field, setting, hyperparameters=changes, transferred_from=source
    )
    check = find_algorithm(algorithm).trainer.check
    assert places_of(ConfigError, lambda: check(*prepare(config))) == named


MLP = TeamShape(55, 3, (8,), "groups", "decentralized", groups=(0, 0, 1))
SETS = TeamShape(30, 3, (8, 8), "none", "decentralized", Tokens(("x",), ("y",), ("z",)))
IDS = replace(SETS, sharing="full+id", extras=((1.0, 0.0, 0.0),) * 3)


@pytest.mark.parametrize(
    ("theirs", "ours", "named"),
    [
        (MLP, MLP, []),
        (MLP, replace(MLP, groups=(0, 1, 1)), ["groups"]),
        (SETS, replace(SETS, n_robots=2), ["robots"]),
        (IDS, replace(IDS, n_robots=2, extras=((1.0, 0.0),) * 2), ["ids or traits", "robots"]),
        (SETS, replace(SETS, actor="centralized"), ["actor"]),
        (replace(SETS, sharing="full"), replace(SETS, sharing="full", n_robots=2), []),
    ],
)
def test_a_run_begins_only_with_networks_of_the_same_team(theirs, ours, named, monkeypatch):
    policy = SimpleNamespace(network=SimpleNamespace(shape=theirs))
    monkeypatch.setattr(trainer, "load_trained", lambda source: policy)
    source = SimpleNamespace(path="there")
    if named:
        assert places_of(ConfigError, trainer.check_source, source, ours) == named
    else:
        trainer.check_source(source, ours)


def test_the_networks_are_checked_before_a_run_begins(monkeypatch):
    policy = SimpleNamespace(network=SimpleNamespace(shape=replace(SETS, n_robots=2)))
    monkeypatch.setattr(trainer, "load_trained", lambda source: policy)
    config = TrainConfig("mappo", "field_03", "G", transferred_from=Path("zoo:generalist"))
    assert places_of(ConfigError, lambda: trainer.check(*prepare(config))) == ["robots"]


def test_each_learner_has_other_random_fields(tmp_path, monkeypatch):
    parts = []

    class Recorder:
        learner, left = 0, 1000

        def __init__(self, *asked: Any) -> None:
            self.conclude = lambda: None

        def begin(self, part: Any) -> None:
            parts.append(part)
            self.learner += 1

    monkeypatch.setattr("baselines.training.train.Recorder", Recorder)
    monkeypatch.setattr("baselines.training.train.LEAST_STEPS", 500)
    monkeypatch.setattr(trainer, "train", lambda *asked: None)
    small = {"learners": 2}
    config = TrainConfig("mappo", "random_convex", "G", steps=1000, hyperparameters=small)
    train(config, tmp_path / "run")
    seeds = [part.config.seed for part in parts]
    assert len(set(seeds)) == 2 and [part.field.seed for part in parts] == seeds


@pytest.mark.parametrize("terminated", [True, False])
def test_shaping_is_the_discounted_difference_of_the_ways_left(terminated):
    def seen(ways: list[float]) -> torch.Tensor:
        rows = torch.zeros(1, len(ways), 2, 6)
        rows[0, :, 0, 0] = torch.tensor([way / (way + 100.0) for way in ways])
        return rows

    trainer = Trainer.__new__(Trainer)
    trainer.env = SimpleNamespace(n_agents=2)
    trainer.estimator = SimpleNamespace(gamma=torch.tensor(0.5))
    trainer.reward = ("next", "robots", "reward")
    tokens = Tokens(("own_tour", "team_tour"), ("present",), ("left", "away", "others"))
    ended = torch.tensor([[[False], [False], [terminated]]])
    after = {"robots": {"observation": seen([200, 100, 60]), "reward": torch.zeros(1, 3, 2, 1)}}
    rollout = TensorDict(
        {"robots": {"observation": seen([300, 200, 100])}, "next": {**after, "terminated": ended}},
        (1, 3),
    )
    # 300 - 200 / 2, 200 - 100 / 2, and 100 - 60 / 2 if the episode was only cut off.
    first = torch.tensor([200.0, 150.0, 100.0 if terminated else 70.0])
    found = trainer._shaped(rollout, tokens)
    torch.testing.assert_close(found[0, :, 0, 0], first)
    assert found.shape == (1, 3, 2, 1) and not found[0, :, 1].any()
