"""The one trainer of MAPPO and IPPO: TorchRL's environment, networks, estimator and losses.

The rollout is a plain loop over TorchRL's ``step_and_maybe_reset``: a collector would add a copy
of every step and a process boundary, and nothing that a batched environment in one process needs.
"""

from __future__ import annotations

import math
import time

import torch
from tensordict import TensorDictBase
from torchrl.objectives.multiagent import IPPOLoss, MAPPOLoss
from torchrl.objectives.value import MultiAgentGAE

from baselines.decentralized.config import MultiAgentPPOConfig
from baselines.decentralized.networks import (
    ACTION,
    LOG_PROB,
    OBSERVATION,
    VALUE,
    GaussianPolicy,
    TeamShape,
    make_actor,
    make_critic,
)
from baselines.decentralized.policy import DecentralizedPolicy
from baselines.recorder import Recorder
from baselines.runs import Task
from mbn_marl.adapters.torchrl import NavigationEnv

REWARD = ("robots", "reward")
LEARNED_FROM = (OBSERVATION, ACTION, LOG_PROB, "advantage", "value_target")
LOSSES = {"centralized": MAPPOLoss, "independent": IPPOLoss}


def train(task: Task, hyperparameters: MultiAgentPPOConfig, recorder: Recorder) -> None:
    """Train on ``task`` for its budget, rounded up to whole rollouts, and evaluate the result."""
    Trainer(task, hyperparameters, recorder).run()


class Trainer:
    """Multi-agent PPO: rollout, advantages, clipped updates, and again.

    Args:
        task: field, settings, seed and budget.
        config: the hyperparameters.
        recorder: where progress goes.
    """

    def __init__(self, task: Task, config: MultiAgentPPOConfig, recorder: Recorder) -> None:
        torch.manual_seed(task.config.seed)
        self.config = config
        self.recorder = recorder
        self.updates = math.ceil(task.config.steps / config.batch)
        self.env = NavigationEnv(
            task.field, config.num_worlds, seed=task.config.seed, threads=1, **task.settings
        )
        shape = TeamShape(
            self.env.engine.obs_size, self.env.n_agents, config.hidden, config.share_parameters
        )
        self.network = GaussianPolicy(shape, config.log_std_start)
        self.policy = DecentralizedPolicy(self.network)
        self.actor = make_actor(self.network)
        critic = make_critic(self.network, centralized=config.critic == "centralized")
        self.loss = LOSSES[config.critic](
            self.actor,
            critic,
            clip_epsilon=config.clip,
            entropy_coeff=config.entropy,
            loss_critic_type="l2",
            critic_coeff=0.5,
            functional=False,
            log_explained_variance=False,
        )
        self.loss.set_keys(action=ACTION, sample_log_prob=LOG_PROB, value=VALUE, reward=REWARD)
        self.advantages = MultiAgentGAE(
            gamma=config.gamma, lmbda=config.gae_lambda, value_network=critic, deactivate_vmap=True
        )
        self.advantages.set_keys(value=VALUE, reward=REWARD)
        self.parameters = [p for p in self.loss.parameters() if p.requires_grad]
        self.optimizer = torch.optim.Adam(
            self.parameters, lr=config.learning_rate[0], eps=config.adam_epsilon
        )

    def run(self) -> None:
        """Train to the end of the budget."""
        current = self.env.reset()
        self.recorder.start()
        for update in range(self.updates):
            progress = update / self.updates
            for group in self.optimizer.param_groups:
                group["lr"] = self.config.learning_rate_at(progress)
            self.network.cap_log_std(self.config.cap_at(progress))
            started = time.perf_counter()
            batch, current = self._rollout(current)
            collected = time.perf_counter()
            losses = self._update(batch)
            diagnostics = {
                "rollout_seconds": collected - started,
                "update_seconds": time.perf_counter() - collected,
                "std": self.network.log_std.exp().mean().item(),
                **losses,
            }
            self._note_episodes(batch)
            env_steps = (update + 1) * self.config.batch
            self.recorder.update(env_steps, self.policy, diagnostics)
        self.recorder.finish(self.updates * self.config.batch, self.policy)

    @torch.no_grad()
    def _rollout(self, current: TensorDictBase) -> tuple[TensorDictBase, TensorDictBase]:
        """Step every world ``rollout_steps`` times.

        Returns:
            The steps, batch size ``(num_worlds, rollout_steps)``, and where the worlds now are.
        """
        steps = []
        for _ in range(self.config.rollout_steps):
            taken, current = self.env.step_and_maybe_reset(self.actor(current))
            steps.append(taken)
        return torch.stack(steps, dim=1), current

    def _update(self, batch: TensorDictBase) -> dict[str, float]:
        """Learn from a rollout; then take its observations into the normalisation.

        The normalisation stands still in between, so that the old and the new log-probabilities
        are of the same inputs. Truncated episodes bootstrap from the value of their last
        observation: the estimator cuts at ``done`` and stops bootstrapping at ``terminated``.
        """
        rewards = batch["next", *REWARD].float()
        batch.set(("next", *REWARD), rewards * self.config.reward_scale)
        with torch.no_grad():
            self.advantages(batch)
        samples = batch.select(*LEARNED_FROM).reshape(-1)
        sums: dict[str, float] = {}
        for _ in range(self.config.epochs):
            for rows in torch.randperm(len(samples)).chunk(self.config.minibatches):
                losses = self._descend(samples[rows])
                for name, value in losses.items():
                    sums[name] = sums.get(name, 0.0) + value
        self.network.norm.update(samples[OBSERVATION])
        count = self.config.epochs * self.config.minibatches
        return {name: value / count for name, value in sums.items()}

    def _descend(self, samples: TensorDictBase) -> dict[str, float]:
        """One step of Adam on a minibatch."""
        losses = self.loss(samples)
        total = losses["loss_objective"] + losses["loss_entropy"] + losses["loss_critic"]
        self.optimizer.zero_grad()
        total.backward()
        torch.nn.utils.clip_grad_norm_(self.parameters, self.config.max_grad_norm)
        self.optimizer.step()
        names = ("loss_objective", "loss_critic", "entropy", "kl_approx", "clip_fraction")
        return {name: losses[name].item() for name in names}

    def _note_episodes(self, batch: TensorDictBase) -> None:
        """Tell the recorder about the episodes that ended in a rollout."""
        done = batch["next", "done"]
        metrics = batch["next", "metrics"]
        self.recorder.episodes.add(
            metrics["episode_return"][done].tolist(), metrics["success"][done].tolist()
        )
