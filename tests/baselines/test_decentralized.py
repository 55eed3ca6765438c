"""The multi-agent trainer: its losses, rollouts, training aid and early stop."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from tensordict import TensorDict
from tensordict.nn import TensorDictModule
from torch import nn
from torchrl.modules import IndependentNormal, ProbabilisticActor
from torchrl.objectives.multiagent import IPPOLoss, MAPPOLoss

from baselines.torchrl.config import load
from baselines.torchrl.curriculum import RoiCurriculum
from baselines.torchrl.loss import Samples, log_prob, ppo_losses
from baselines.torchrl.networks import GaussianPolicy, TeamShape
from baselines.torchrl.rollout import Rollout, Worlds
from baselines.torchrl.shaping import Approach
from baselines.training.config import TrainConfig
from baselines.training.run_logger import EpisodeWindow
from baselines.training.train import train
from mbn_marl.engine import BatchEngine
from mbn_marl.errors import ConfigError
from mbn_marl.field import Field, save_field

CPU = torch.device("cpu")
LINE = Field(
    vertices=[(0, 0), (400, 0), (400, 100), (0, 100)],
    rois=[(130, 50), (330, 50)],
    starts=[(100, 50), (380, 50)],
)
"""Robot 0 has ROI 0 30 units to its right, robot 1 has ROI 1 50 units to its left."""


# Losses


class Given(nn.Module):
    """Hands out fixed tensors as if a network had computed them."""

    def __init__(self, *tensors: torch.Tensor) -> None:
        super().__init__()
        self.tensors = nn.ParameterList(tensors)

    def forward(self, _: torch.Tensor) -> Any:
        tensors = tuple(tensor * 1.0 for tensor in self.tensors)
        return tensors if len(tensors) > 1 else tensors[0]


@pytest.mark.parametrize("theirs", [MAPPOLoss, IPPOLoss])
def test_the_losses_are_those_of_torchrl(theirs: type[MAPPOLoss]) -> None:
    torch.manual_seed(0)
    rows, robots = 50, 3
    mean, log_std = torch.randn(rows, robots, 2), torch.tensor([0.1, -0.4])
    values, targets = torch.randn(2, rows, robots)
    old_mean = mean + 0.3 * torch.randn(rows, robots, 2)
    actions = old_mean + torch.randn(rows, robots, 2)
    samples = Samples(
        observations=torch.zeros(rows, robots, 1),
        actions=actions,
        log_probs=log_prob(actions - old_mean, torch.zeros(2)),
        advantages=torch.randn(rows, robots),
        targets=targets,
    )
    group = "robots"
    actor = ProbabilisticActor(
        TensorDictModule(
            Given(mean, log_std.exp().expand_as(mean)),
            in_keys=[(group, "observation")],
            out_keys=[(group, "loc"), (group, "scale")],
        ),
        in_keys=[(group, "loc"), (group, "scale")],
        out_keys=[(group, "action")],
        distribution_class=IndependentNormal,
        return_log_prob=True,
        log_prob_key=(group, "log_prob"),
    )
    critic = TensorDictModule(
        Given(values.unsqueeze(-1)), in_keys=[(group, "observation")], out_keys=[(group, "value")]
    )
    loss = theirs(
        actor,
        critic,
        clip_epsilon=0.2,
        entropy_coeff=0.02,
        critic_coeff=0.5,
        loss_critic_type="l2",
        normalize_advantage=False,
        functional=False,
        log_explained_variance=False,
    )
    loss.set_keys(
        action=(group, "action"), sample_log_prob=(group, "log_prob"), value=(group, "value")
    )
    own = TensorDict(
        {
            "observation": samples.observations,
            "action": actions,
            "log_prob": samples.log_probs,
        },
        (rows, robots),
    )
    batch = TensorDict(
        {
            group: own,
            "advantage": samples.advantages.unsqueeze(-1),
            "value_target": targets.unsqueeze(-1),
        },
        (rows,),
    )
    expected = loss(batch)
    ours = ppo_losses(mean, log_std, values, samples, clip=0.2)
    assert ours.objective.item() == pytest.approx(expected["loss_objective"].item(), rel=1e-5)
    assert ours.critic.item() == pytest.approx(expected["loss_critic"].item(), rel=1e-5)
    assert ours.entropy.item() == pytest.approx(expected["entropy"].mean().item(), rel=1e-5)
    assert ours.clip_fraction.item() == pytest.approx(expected["clip_fraction"].item(), rel=1e-5)
    assert 0.1 < ours.clip_fraction.item() < 0.9


def test_the_surrogate_of_two_robots_by_hand() -> None:
    # One step, one axis off the mean by e: log-ratio = 0.5 (old - new) with squares of the noise.
    actions = torch.tensor([[[1.0, 0.0], [2.0, 0.0]]])
    old = log_prob(actions, torch.zeros(2))
    samples = Samples(
        torch.zeros(1, 2, 1), actions, old, torch.tensor([[1.0, -1.0]]), torch.tensor([[3.0, 0.0]])
    )
    mean = torch.tensor([[[1.0, 0.0], [0.0, 0.0]]])
    losses = ppo_losses(mean, torch.zeros(2), torch.tensor([[1.0, 0.0]]), samples, clip=0.2)
    # Robot 0: ratio exp(0.5), clipped to 1.2; robot 1: ratio 1, advantage -1.
    assert losses.objective.item() == pytest.approx(-(1.2 - 1.0) / 2)
    assert losses.critic.item() == pytest.approx(0.5 * (4.0 + 0.0) / 2)
    assert losses.entropy.item() == pytest.approx(1.0 + math.log(2.0 * math.pi))
    assert losses.clip_fraction.item() == 0.5


# Rollouts


def _worlds(
    worlds: int = 6, decisions: int = 20, seed: int = 3, **settings: Any
) -> tuple[Worlds, GaussianPolicy, EpisodeWindow]:
    torch.manual_seed(0)
    engine = BatchEngine("field_03", worlds, seed=seed, threads=1, **settings)
    generator = torch.Generator().manual_seed(5)
    episodes = EpisodeWindow()
    network = GaussianPolicy(TeamShape(engine.obs_size, engine.n_robots, (8,), "full"))
    return Worlds(engine, decisions, CPU, generator, episodes.add), network, episodes


def _copy(rollout: Rollout) -> Rollout:
    return Rollout(*(part.clone() for part in rollout))


LIVELY = {"max_steps": 9, "random_starts": True, "safety_distance": 45.0}


@pytest.mark.parametrize("repeat", [1, 3])
def test_a_rollout_is_what_the_engine_did(repeat: int) -> None:
    worlds, network, episodes = _worlds(**LIVELY)
    first, second = (_copy(worlds.roll_out(network, repeat)) for _ in range(2))
    twin = BatchEngine("field_03", 6, seed=3, threads=1, **LIVELY)
    seen = twin.reset().copy()
    returns: list[float] = []
    for rollout in (first, second):
        for t in range(20):
            assert np.array_equal(rollout.observations[t], seen)
            assert np.array_equal(rollout.before[t], twin.state())
            rewards = np.zeros((6, 3), np.float32)
            done = np.zeros(6, bool)
            last = np.zeros((6, 13), np.float32)
            for _ in range(repeat):
                seen, got, terminated, truncated = twin.step(rollout.actions[t].numpy())
                rewards += np.where(done[:, None], 0.0, got)
                now = terminated | truncated
                returns += twin.metrics()["episode_return"][now].tolist()
                new = now & ~done
                assert np.array_equal(rollout.terminated[t, new], terminated[new])
                last[new] = twin.final_state()[new]
                final = rollout.final_observations[t, new]
                assert np.array_equal(final, twin.final_observations[new])
                done |= now
            last[~done] = twin.state()[~done]
            assert np.array_equal(rollout.done[t], done)
            assert np.allclose(rollout.rewards[t], rewards)
            assert np.array_equal(rollout.after[t], last)
        assert np.array_equal(rollout.observations[20], seen)
    assert len(returns) > 10
    assert episodes.pop()["return_mean"] == pytest.approx(np.mean(returns))


def test_log_probabilities_are_those_of_the_sampled_actions() -> None:
    worlds, network, _ = _worlds()
    rollout = worlds.roll_out(network, 1)
    mean, std = network(rollout.observations[:-1])
    expected = torch.distributions.Normal(mean, std).log_prob(rollout.actions).sum(-1)
    assert torch.allclose(rollout.log_probs, expected, atol=1e-4)


# The training aid


def _state(x0: float, x1: float, visited: tuple[int, int]) -> torch.Tensor:
    code = 2.0 * visited[0] + visited[1]
    return torch.tensor([x0, 50.0, x1, 50.0, 0.0, 0.0, 0.0, 0.0, code])


def test_approach_by_hand() -> None:
    approach = Approach(LINE, 2, CPU)
    start = _state(100.0, 380.0, (0, 0))
    assert approach.remaining(start).item() == 30.0 + 50.0
    # Robot 0 moves 10 nearer to ROI 0; robot 1 moves 5 away from ROI 1.
    assert approach(start, _state(110.0, 385.0, (0, 0))).item() == 10.0 - 5.0
    # The first ROI is the highest bit: only ROI 1 is left when it is visited.
    assert approach.remaining(_state(100.0, 380.0, (1, 0))).item() == 50.0
    assert approach.remaining(_state(100.0, 380.0, (0, 1))).item() == 30.0
    assert approach.remaining(_state(100.0, 380.0, (1, 1))).item() == 0.0


def test_the_aid_of_an_episode_is_the_distance_it_covered() -> None:
    engine = BatchEngine(LINE, 8, seed=1, threads=1, max_steps=40, random_starts=True)
    approach = Approach(LINE, 2, CPU)
    engine.reset()
    start = approach.remaining(torch.from_numpy(engine.state()))
    total = torch.zeros(8)
    for _ in range(40):
        before = torch.from_numpy(engine.state())
        engine.step(engine.sample_actions())
        after = torch.from_numpy(engine.state())
        ended = torch.from_numpy(engine.metrics()["steps"] == 40)
        if ended.any():
            after = torch.from_numpy(engine.final_state())
            break
        total += approach(before, after)
    total += approach(before, after)
    assert torch.allclose(total, start - approach.remaining(after), atol=1e-2)


# Hyperparameters


def test_action_repeat_falls_to_its_second_value() -> None:
    config = load("mappo", "N", {"action_repeat": [4, 1], "action_repeat_until": 0.5})
    assert [config.repeat_at(share) for share in (0.0, 0.25, 0.4, 0.5, 1.0)] == [4, 2, 2, 1, 1]


@pytest.mark.parametrize(("sharing", "told"), [("full", False), ("full+id", True), ("none", False)])
def test_full_id_tells_the_network_which_robot_it_is(sharing: str, told: bool) -> None:
    assert load("mappo", "N", {"sharing": sharing}).environment["one_hot"] is told


def test_an_unknown_sharing_is_refused() -> None:
    with pytest.raises(ConfigError, match="'full', 'full\\+id' or 'none'"):
        load("ippo", "N", {"sharing": "some"})


# The curriculum


def test_rois_shrink_when_the_team_succeeds_and_grow_when_it_fails() -> None:
    curriculum = RoiCurriculum(8.0, stages=3, bounds=(0.25, 0.75), window=4)
    sizes, moves = [], []
    none, all_of_them, half = [0, 0, 0, 0, 0], [1, 1, 1, 1], [1, 1, 0, 0]
    windows = ([1, 1, 1, 0], [1, 0], [1, 1], half, none, *[all_of_them] * 3)
    for successes in windows:
        curriculum.add(successes)
        moves.append(curriculum.move())
        sizes.append(curriculum.radius)
    assert sizes == pytest.approx([4.0, 4.0, 2.0, 2.0, 4.0, 2.0, 1.0, 1.0])
    assert moves == [True, False, True, False, True, True, True, False]


def test_rois_never_grow_beyond_their_first_size() -> None:
    curriculum = RoiCurriculum(8.0, stages=3, bounds=(0.25, 0.75), window=4)
    curriculum.add([0, 0, 0, 0])
    assert not curriculum.move() and curriculum.radius == 8.0


def test_training_has_its_own_rois_and_time_limit_and_evaluations_the_true_ones(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = []

    class Watched(BatchEngine):
        def __init__(self, *args: Any, **settings: Any) -> None:
            super().__init__(*args, **settings)
            made.append((self.config.roi_radius, self.config.max_steps))

    monkeypatch.setattr("baselines.torchrl.trainer.BatchEngine", Watched)
    small = {"num_worlds": 4, "rollout_steps": 32, "hidden": [8], "action_repeat": [1, 1]}
    # Whatever the team does is enough for the next stage.
    small |= {"roi_radius": 16.0, "roi_stages": 2, "roi_success": [0.0, 0.0], "episode_steps": 32}
    config = TrainConfig("mappo", "field_03", steps=384, episodes=2, hyperparameters=small)
    run = train(config, tmp_path / "run")
    assert made == [(160.0, 32), (40.0, 32), (10.0, 32)]
    assert max(run.evaluation["deterministic"]["per_episode"]["steps"]) == 1000


# Stopping early


EASY = Field(
    vertices=[(0, 0), (100, 0), (100, 100), (0, 100)],
    rois=[(50, 50)],
    starts=[(30, 50)],
    name="easy",
)


@pytest.mark.parametrize("algorithm", ["mappo", "ppo"])
def test_a_run_stops_when_an_evaluation_passes(algorithm: str, tmp_path: Path) -> None:
    save_field(EASY, tmp_path / "easy.yaml")
    config = TrainConfig(
        algorithm,
        str(tmp_path / "easy.yaml"),
        steps=400_000,
        evaluate_every=16_384,
        episodes=20,
        stop_at=100_000.0,
        environment={"max_steps": 100},
    )
    run = train(config, tmp_path / "run")
    *earlier, passed, final = run.evaluations
    assert passed["env_steps"] <= final["env_steps"] < config.steps
    assert passed["return_mean"] >= 100_000.0 and passed["success_rate"] >= 0.99
    assert all(entry["return_mean"] < 100_000.0 for entry in earlier[:1])
    assert run.finished and not (run.path / "checkpoints").exists()
