"""The one trainer of MAPPO and IPPO: TorchRL's environment, networks, estimator and losses.

The rollout is a plain loop over TorchRL's ``step_and_maybe_reset``: a collector would add a copy
of every step and a process boundary, and nothing that a batched environment in one process needs.
"""

from __future__ import annotations

import math
import time
from functools import partial
from pathlib import Path

import torch
from safetensors import torch as safetensors_torch
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
from baselines.generators import restore_generators, save_generators
from baselines.recorder import Recorder
from baselines.runs import Task
from baselines.storage import read_arrays, read_json, write_arrays, write_json
from mbn_marl.adapters.torchrl import NavigationEnv

LEARNER = "learner.safetensors"
WORLDS = "worlds.npz"
COUNTERS = "counters.json"

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
        first, current = 0, self.env.reset()
        if self.recorder.checkpoint is not None:
            first = self._restore(self.recorder.checkpoint, current)
        self.recorder.start()
        for update in range(first, self.updates):
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
            if self.recorder.checkpoint_due:
                save = partial(self._save, update + 1, current)
                self.recorder.save_checkpoint(env_steps, self.policy, save)
        self.recorder.finish(self.updates * self.config.batch, self.policy)

    def _save(self, update: int, current: TensorDictBase, folder: Path) -> None:
        """Write all that :meth:`_restore` needs into ``folder``, without pickle."""
        optimizer = self.optimizer.state_dict()
        moments = {
            f"optimizer.{index}.{name}": tensor
            for index, entry in optimizer["state"].items()
            for name, tensor in entry.items()
        }
        networks = {f"loss.{name}": tensor for name, tensor in self.loss.state_dict().items()}
        tensors = {**networks, **moments, "observation": current[OBSERVATION]}
        whole = torch.contiguous_format
        own = {name: tensor.clone(memory_format=whole) for name, tensor in tensors.items()}
        safetensors_torch.save_file(own, folder / LEARNER)
        write_arrays(folder / WORLDS, self.env.engine.save_state(), compress=True)
        write_json(folder / COUNTERS, {"update": update, "generators": save_generators()})

    def _restore(self, folder: Path, current: TensorDictBase) -> int:
        """Take up the learner of a checkpoint at exactly the same point.

        Args:
            folder: the checkpoint.
            current: where the worlds are; gets the observation, which is all that the actor reads.

        Returns:
            The next update.
        """
        tensors = safetensors_torch.load_file(folder / LEARNER)

        def group(name: str) -> dict[str, torch.Tensor]:
            prefix = f"{name}."
            return {
                key.removeprefix(prefix): tensor
                for key, tensor in tensors.items()
                if key.startswith(prefix)
            }

        self.loss.load_state_dict(group("loss"))
        state: dict[int, dict[str, torch.Tensor]] = {}
        for key, tensor in group("optimizer").items():
            index, name = key.split(".")
            state.setdefault(int(index), {})[name] = tensor
        self.optimizer.load_state_dict({**self.optimizer.state_dict(), "state": state})
        self.env.engine.load_state(read_arrays(folder / WORLDS))
        current[OBSERVATION] = tensors["observation"]
        counters = read_json(folder / COUNTERS)
        restore_generators(counters["generators"])
        update: int = counters["update"]
        return update

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
