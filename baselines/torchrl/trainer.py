"""MAPPO, IPPO and joint PPO of TorchRL's parts: collect, estimate advantages, descend, repeat."""

import math
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import torch
from numpy.typing import NDArray
from pydantic import TypeAdapter
from tensordict import TensorDict, TensorDictBase
from tensordict.nn import TensorDictSequential
from torchrl.collectors import Collector
from torchrl.modules import ProbabilisticActor
from torchrl.objectives.multiagent import IPPOLoss, MAPPOLoss
from torchrl.objectives.value import MultiAgentGAE

from baselines.policies.load import load_trained, open_run
from baselines.policies.policy import TrainedPolicy
from baselines.runs import tensors
from baselines.runs.files import read_arrays, read_json, reading, write_arrays, write_json
from baselines.runs.folder import saved_at
from baselines.torchrl.config import MultiAgentPPOConfig
from baselines.torchrl.entities import Tokens
from baselines.torchrl.networks import DISTRIBUTIONS, GaussianPolicy, Key, TeamShape, ValueNetwork
from baselines.torchrl.policy import TeamPolicy
from baselines.training.aids import RoiCurriculum, between
from baselines.training.config import Budget, Task
from baselines.training.run_logger import Recorder
from mbn_marl.adapters.torchrl import NavigationEnv
from mbn_marl.config import make_config
from mbn_marl.engine import BatchEngine
from mbn_marl.errors import ConfigError, collecting
from mbn_marl.field import FieldSampler

NETWORKS, OPTIMIZER = "networks.safetensors", "optimizer.safetensors"
WORLDS, TEACHER_WORLDS, COUNTERS = "worlds.npz", "teacher_worlds.npz", "counters.json"
MINIMISED = ("loss_objective", "loss_critic", "loss_entropy")
LOGGED = ("loss_objective", "loss_critic", "entropy", "kl_approx", "clip_fraction", "imitation")


def train(task: Task, hyperparameters: MultiAgentPPOConfig, recorder: Recorder) -> None:
    Trainer(task, hyperparameters, recorder).run()


def check(task: Task, hyperparameters: MultiAgentPPOConfig) -> None:
    settings, drawn = make_config(task.settings), isinstance(task.field, FieldSampler)
    sets = hyperparameters.network == "entities"
    most = task.field.robots[1] if drawn else len(task.field.starts)  # type: ignore[union-attr]
    few = (settings.n_robots or most) < 2
    wrong = {
        "scattered": (drawn, 0.0, "on random fields"),
        "imitation_until": (hyperparameters.teacher is None, 0.0, "without a teacher"),
        "shaping": (not sets, 0.0, "with network mlp"),
        "sharing": (sets, "full", "with network entities"),
        "actor": (sets, "decentralized", "with network entities"),
    }
    problems = [
        f"{name}: {value!r}; allowed {where}: {allowed!r}"
        for name, (applies, allowed, where) in wrong.items()
        if applies and (value := getattr(hyperparameters, name)) != allowed
    ]
    seen, widths = settings.observation, list(hyperparameters.hidden)
    of_sets = {
        f"hidden: {widths}; allowed with network entities: two widths": len(widths) != 2,
        "one_hot: True; allowed with network entities: False": settings.one_hot,
        "robots: 1; allowed with network entities: at least 2": few,
        f"observation: {seen!r}; allowed: 'entities', the network's": seen != "entities",
    }
    problems += [problem for problem, applies in of_sets.items() if sets and applies]
    largest = RoiCurriculum(hyperparameters.roi_radius, window=1)
    training = hyperparameters.in_training(task, largest, 1)
    with collecting(problems):
        BatchEngine(**{**training, "field": task.field}, num_worlds=1)
    if hyperparameters.teacher is not None:
        with collecting(problems):
            check_teacher(hyperparameters.teacher, task)
    if problems:
        raise ConfigError("training", problems)


def budget(task: Task, hyperparameters: MultiAgentPPOConfig) -> Budget:
    decisions = hyperparameters.decisions
    env_steps = -(-task.config.steps // decisions) * decisions
    steps, worlds = hyperparameters.rollout_steps, hyperparameters.num_worlds
    return Budget(env_steps, f"rollouts of {steps} decisions in {worlds} worlds")


# The settings that say what a robot sees, and nothing else.
SEEN = ("observation", "assignment", "one_hot", "sensing_radius")


def find_teacher(source: str, learner: Mapping[str, Any]) -> tuple[TrainedPolicy, dict[str, Any]]:
    """Return the policy of ``zoo:NAME`` or a run's folder, and the settings of what it sees."""
    # If it sees an assignment, that is the learner's. A learner that sees none could not know what
    # was assigned at first: then it is made for where robots are.
    policy = load_trained(open_run(source))
    assert policy.origin is not None
    seen = {name: getattr(policy.origin.config, name) for name in SEEN}
    shown = make_config(learner).assignment or "fresh"
    return policy, {**seen, "assignment": shown if seen["assignment"] else False}


def check_teacher(source: str, task: Task) -> None:
    policy, seen = find_teacher(source, task.settings)
    if policy.observes != "observations":
        problem = f"teacher: {source} acts on the state; allowed: on robots' own observations"
        raise ConfigError("training", [problem])
    policy.fit(BatchEngine(task.field, 1, threads=1, **{**task.settings, **seen}))


# A teacher says what it would do where the learner is: Schmitt et al., "Kickstarting Deep
# Reinforcement Learning", 2018.
class Teacher:
    """Follow the learner's rollouts in the same worlds, which show what the teacher sees."""

    # ``learner``: the settings of its environment, in place of which make_env takes some.
    def __init__(
        self, source: str, learner: Mapping[str, Any], make_env: Callable[..., NavigationEnv]
    ) -> None:
        policy, seen = find_teacher(source, learner)
        self.env = make_env(**seen)
        self._policy = policy.fit(self.env.engine)
        self._now = self.env.reset()

    def actions(self, rollout: TensorDictBase) -> torch.Tensor:
        """Return the mean actions (W, T, n, 2) for a rollout (W, T) that follows the last one."""
        answers = []
        for taken in rollout[Key.ACTION].unbind(1):
            seen = self._now[Key.OBSERVATION].numpy(force=True)
            answers.append(torch.from_numpy(self._policy.act(seen, deterministic=True)))
            _, self._now = self.env.step_and_maybe_reset(self._now.set(Key.ACTION, taken))
        return torch.stack(answers, 1).clamp_(-1.0, 1.0).to(rollout.device)

    def load_state(self, saved: Mapping[str, NDArray[Any]]) -> None:
        self.env.load_state(saved)
        self._now = self.env.reset()


class Trainer:
    """Multi-agent PPO; networks, losses and, on CUDA, the worlds are on the task's device."""

    def __init__(self, task: Task, config: MultiAgentPPOConfig, recorder: Recorder) -> None:
        torch.manual_seed(task.config.seed)
        self.task, self.config, self.recorder = task, config, recorder
        self.curriculum = RoiCurriculum(config.roi_radius, window=config.num_worlds)
        env = self._make_env()
        engine, sets = env.engine, config.network == "entities"
        self.tokens = Tokens.of(engine.observation_table) if sets else None
        shape = TeamShape(
            *(engine.obs_size, env.n_agents, config.hidden, config.sharing, config.actor),
            tokens=self.tokens,
        )
        self.network = GaussianPolicy(shape, config.log_std_start).to(env.device)
        self.critic = ValueNetwork(shape, config.critic).to(env.device)
        self.actor = ProbabilisticActor(
            self.network,
            in_keys=[Key.LOC, Key.SCALE],
            out_keys=[Key.ACTION],
            distribution_class=DISTRIBUTIONS[config.actor],
            return_log_prob=True,
            log_prob_key=Key.LOG_PROB,
        )
        self.loss = (MAPPOLoss if config.critic == "centralized" else IPPOLoss)(
            self.actor,
            self.critic,
            clip_epsilon=config.clip,
            entropy_coeff=config.entropy,
            critic_coeff=0.5,
            loss_critic_type="l2",
            functional=False,
            normalize_advantage=False,  # :meth:`_samples` does it, over the whole rollout
            log_explained_variance=False,
        )
        self.loss.set_keys(action=Key.ACTION, sample_log_prob=Key.LOG_PROB, value=Key.VALUE)
        self.estimator = MultiAgentGAE(
            gamma=config.gamma, lmbda=config.gae_lambda, value_network=None, vectorized=False
        )
        reward = ("team_reward",) if config.actor == "centralized" else ("robots", "reward")
        self.estimator.set_keys(value=Key.VALUE, reward=reward)
        self.reward = ("next", *reward)
        self.parameters = list(self.loss.parameters())
        self.optimizer = torch.optim.Adam(self.parameters, eps=config.adam_epsilon, fused=True)
        if config.teacher is not None:  # the loss works them out anyway

            def keep(_: Any, __: Any, means: torch.Tensor) -> None:
                self.means = means

            self.network.mean.register_forward_hook(keep)
        self._collect_from(env)

    def _make_env(self, **changed: Any) -> NavigationEnv:
        config, worlds = self.task.config, self.config.num_worlds
        return NavigationEnv(
            num_worlds=worlds,
            seed=self.curriculum.seed(config.seed),
            device=config.device,
            threads=1,
            state=False,
            team_reward=self.config.actor == "centralized",
            metrics=("success", "episode_return"),
            **{**self.config.in_training(self.task, self.curriculum, worlds), **changed},
        )

    def _collect_from(self, env: NavigationEnv) -> None:
        self.env, self.teacher = env, None
        if self.config.teacher is not None:
            self.teacher = Teacher(self.config.teacher, self.task.settings, self._make_env)
        self.rollouts = iter(
            Collector(
                env,
                TensorDictSequential(self.network.norm, self.actor),
                frames_per_batch=self.config.decisions,
                total_frames=-1,
                device=env.device,  # without it every step is cast
                track_traj_ids=False,
                use_buffers=True,
                return_same_td=True,
                auto_register_policy_transforms=False,
            )
        )

    def run(self) -> None:
        config, policy = self.config, TeamPolicy(self.network)
        env_steps = 0
        if self.recorder.checkpoint is not None:
            env_steps = self._restore(self.recorder.checkpoint)
        elif (source := self.task.config.transferred_from) is not None:
            theirs: Any = load_trained(open_run(str(source)))
            self.network.load_state_dict(theirs.network.state_dict())
        self.recorder.start()
        while env_steps < self.task.config.steps:
            progress = env_steps / self.task.config.steps
            for group in self.optimizer.param_groups:
                group["lr"] = between(config.learning_rate, progress)
            self.network.log_std.data.clamp_(max=config.cap_at(progress))
            started = time.perf_counter()
            rollout = next(self.rollouts).copy()
            collected = time.perf_counter()
            if not (imitating := progress < config.imitation_until):
                self._estimate(rollout)
            weight = 1.0 if imitating else between(config.teacher_weight, progress)
            losses = self._descend(self._samples(rollout), weight)
            self.network.norm.update(rollout[Key.OBSERVATION])
            diagnostics = {
                "rollout_seconds": collected - started,
                "update_seconds": time.perf_counter() - collected,
                "std": self.network.log_std.exp().mean().item(),
                "roi_radius": self.curriculum.radius,
            }
            ended, metrics = rollout["next", "done"], rollout["next", "metrics"]
            successes = metrics["success"][ended].tolist()
            self.recorder.episodes.add(metrics["episode_return"][ended].tolist(), successes)
            self.curriculum.add(successes)
            if self.curriculum.move():
                self._collect_from(self._make_env())
            env_steps += config.decisions
            self.recorder.update(env_steps, policy, diagnostics | losses)
            if self.recorder.checkpoint_due:
                save = partial(self._save, env_steps)
                self.recorder.save_checkpoint(env_steps, policy, save)
        self.network.amplify(config.final_gain)
        self.recorder.finish(env_steps, policy)

    @torch.no_grad()
    def _estimate(self, rollout: TensorDictBase) -> None:
        # An episode cut off by the time limit bootstraps from the value of its last
        # observation, rollout["next"], never from that of the next episode's first.
        self.critic(rollout)
        self.critic(self.network.norm(rollout["next"]))
        rollout[self.reward] *= self.config.reward_scale
        if self.tokens is not None and self.config.shaping:
            rollout[self.reward] += self.config.shaping * self._shaped(rollout, self.tokens)
        self.estimator(rollout)
        advantage = rollout["advantage"]
        works = torch.ones_like(advantage, dtype=torch.bool)
        if self.env.engine.may_rest and self.config.actor == "decentralized":
            # The actions of robots that have failed, or are not in the team, have no effect.
            works = rollout[Key.MASK].unsqueeze(-1)
        known = advantage[works]
        rollout["advantage"] = (advantage - known.mean()) / (known.std() + 1e-8) * works
        if self.env.engine.teams_vary:
            rollout["value_target"] *= rollout[Key.OBSERVATION].any(-1, keepdim=True)

    def _samples(self, rollout: TensorDictBase) -> TensorDictBase:
        if self.teacher is not None:
            rollout[Key.TEACHER] = self.teacher.actions(rollout)
        kept = (Key.NORMALIZED, Key.ACTION, Key.LOG_PROB, "advantage", "value_target")
        return rollout.select(*kept, Key.TEACHER, strict=False).reshape(-1)

    def _losses(self, part: TensorDictBase, weight: float) -> TensorDictBase:
        if "advantage" in part:
            losses = self.loss(part)
            total: Any = sum(losses[name] for name in MINIMISED)
        else:
            self.network.means(part[Key.NORMALIZED])
            losses, total = TensorDict(dict.fromkeys(LOGGED, torch.tensor(math.nan))), 0.0
        if self.teacher is not None:
            apart = self.means.reshape(part[Key.TEACHER].shape) - part[Key.TEACHER]
            losses["imitation"] = apart.square().sum(-1).mean()
            total = total + weight * losses["imitation"]
        return losses.set("total", total)

    def _shaped(self, rollout: TensorDictBase, tokens: Tokens) -> torch.Tensor:
        # By how many units each decision has shortened the ways left, discounted. After the end
        # of an episode nothing is left.
        rows, seen = rollout[self.reward].shape, (rollout, rollout["next"])
        before, after = (
            tokens.way_left(td[Key.OBSERVATION].flatten(0, -2), self.env.n_agents).reshape(rows)
            for td in seen
        )
        running = ~rollout["next", "terminated"].unsqueeze(-2)
        nearer: torch.Tensor = before - self.estimator.gamma * after * running
        return nearer

    def _descend(self, samples: TensorDictBase, weight: float) -> dict[str, float]:
        # The normalisation does not change meanwhile: old and new log-probabilities are of the
        # same inputs. ``weight`` is that of the distance from the teacher's actions.
        history = []
        for _ in range(self.config.epochs):
            order = torch.randperm(len(samples), device=samples.device)
            for rows in order.chunk(self.config.minibatches):
                pick = partial(torch.index_select, dim=0, index=rows)  # faster than samples[rows]
                part = samples.apply(pick, batch_size=rows.shape)
                losses = self._losses(part, weight)
                self.optimizer.zero_grad()
                losses["total"].backward()
                torch.nn.utils.clip_grad_norm_(self.parameters, self.config.max_grad_norm)
                self.optimizer.step()
                history.append(losses.select(*LOGGED, strict=False).detach())
        means: Any = torch.stack(history).mean(0)
        return {name.removeprefix("loss_"): value.item() for name, value in means.items()}

    def _save(self, env_steps: int, folder: Path) -> None:
        tensors.write_tensors(folder / NETWORKS, self.loss.state_dict())
        moments = tensors.moments_of(self.optimizer.state_dict())
        tensors.write_tensors(folder / OPTIMIZER, moments)
        write_arrays(folder / WORLDS, self.env.save_state(), compress=True)
        if self.teacher is not None:
            write_arrays(folder / TEACHER_WORLDS, self.teacher.env.save_state(), compress=True)
        counters = {"env_steps": env_steps, "curriculum": asdict(self.curriculum)}
        write_json(folder / COUNTERS, {**counters, "generators": tensors.save_generators()})

    def _restore(self, folder: Path) -> int:
        with reading(folder):
            networks, state = self.loss.state_dict(), self.optimizer.state_dict()
            self.loss.load_state_dict(tensors.read_tensors(folder / NETWORKS, networks))
            moments = tensors.read_tensors(folder / OPTIMIZER)
            self.optimizer.load_state_dict(tensors.with_moments(state, moments))
            counters = read_json(folder / COUNTERS)
            self.curriculum = TypeAdapter(RoiCurriculum).validate_python(counters["curriculum"])
            env = self._make_env()
            env.load_state(read_arrays(folder / WORLDS))
            self._collect_from(env)
            if self.teacher is not None:
                self.teacher.load_state(read_arrays(folder / TEACHER_WORLDS))
            # Last, since a new collector tries the policy.
            tensors.restore_generators(counters["generators"])
            began = self.recorder.began
            return saved_at(folder, began + counters["env_steps"]) - began
