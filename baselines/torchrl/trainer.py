"""MAPPO, IPPO and joint PPO of TorchRL's parts: collect, estimate advantages, descend, repeat."""

import math
import time
from collections.abc import Sequence
from dataclasses import asdict, replace
from functools import partial
from pathlib import Path
from typing import Any, get_args

import torch
from pydantic import TypeAdapter
from tensordict import TensorDictBase
from tensordict.nn import TensorDictSequential
from torchrl.collectors import Collector
from torchrl.modules import ProbabilisticActor
from torchrl.objectives.multiagent import IPPOLoss, MAPPOLoss
from torchrl.objectives.value import MultiAgentGAE

from baselines.policies.load import load_trained, open_run
from baselines.runs import tensors
from baselines.runs.files import (
    differences,
    read_arrays,
    read_json,
    reading,
    write_arrays,
    write_json,
)
from baselines.runs.folder import RunFolder, saved_at
from baselines.torchrl import networks
from baselines.torchrl.config import MultiAgentPPOConfig
from baselines.torchrl.entities import Tokens
from baselines.torchrl.memory import CHUNK
from baselines.torchrl.networks import Key
from baselines.torchrl.policy import TeamPolicy, is_shared
from baselines.training.aids import STAGES, RoiCurriculum, between
from baselines.training.config import Budget, Task
from baselines.training.run_logger import Recorder
from mbn_marl.adapters.torchrl import NavigationEnv
from mbn_marl.config import LIMITS, Dynamics, NavigationConfig, make_config
from mbn_marl.engine import BatchEngine
from mbn_marl.errors import ConfigError, collecting
from mbn_marl.field import FieldSampler

NETWORKS, OPTIMIZER = "networks.safetensors", "optimizer.safetensors"
MEMORIES = "memories.safetensors"
NOISE = "log_std"
WORLDS, COUNTERS = "worlds.npz", "counters.json"
MINIMISED = ("loss_critic", "loss_objective", "loss_entropy")
# A run that begins with another one's actor learns its values first, in so many rollouts: an
# untrained critic would ruin the actor.
CRITIC_FIRST = 5
MOST_DECISIONS = 2**26  # of a rollout, that has to fit in memory
LOGGED = ("loss_objective", "loss_critic", "entropy", "kl_approx", "clip_fraction")


def train(task: Task, hyperparameters: MultiAgentPPOConfig, recorder: Recorder) -> None:
    Trainer(task, hyperparameters, recorder).run()


def check(task: Task, hyperparameters: MultiAgentPPOConfig) -> None:
    settings, drawn = make_config(task.settings), isinstance(task.field, FieldSampler)
    sets = hyperparameters.network == "entities"
    sizes: Any = task.field.robots if drawn else (len(task.field.starts),) * 2  # type: ignore[union-attr]
    few, varies = (settings.n_robots or sizes[1]) < 2, drawn and sizes[0] < sizes[1]
    apart = not is_shared(settings, task.field.arena)
    unknown = any(name.startswith(LIMITS) for name in settings.drawn)
    wrong: list[tuple[str, bool, tuple[Any, ...], str]] = [
        ("scattered", drawn, (0.0,), "on random fields"),
        ("shaping", not sets, (0.0,), "with network mlp"),
        ("critic", drawn, ("centralized", "independent"), "on random fields"),
        ("actor", apart, ("decentralized",), "where robots do not hear all others at once"),
    ]
    for name in ("sharing", "critic_sharing"):
        same = "none", "full", "full+id", None
        wrong += [
            (name, varies, ("full", None), "with teams of different sizes"),
            (name, unknown and not varies, same, "where episodes draw traits"),
        ]
    problems = [
        f"{name}: {value!r}; allowed {where}: {', '.join(map(repr, allowed))}"
        for name, applies, allowed, where in wrong
        if applies and (value := getattr(hyperparameters, name)) not in allowed
    ]
    decisions = hyperparameters.num_worlds * hyperparameters.rollout_steps
    if not 2 <= decisions <= MOST_DECISIONS:
        allowed = f"allowed: 2 to {MOST_DECISIONS:,}"
        problems.append(f"num_worlds x rollout_steps: {decisions:,}; {allowed}")
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
        engine = BatchEngine(**{**training, "field": task.field}, num_worlds=1)
    if problems:
        raise ConfigError("training", problems)
    if (begun_with := task.config.transferred_from) is not None:
        ours = shape_of(task, hyperparameters, hyperparameters.sharing, engine)
        check_source(open_run(str(begun_with)), ours)


def traits_of(config: NavigationConfig, n: int, kinds: Sequence[int]) -> list[tuple[float, ...]]:
    """Return of each robot mass, force and speed limit over the usual, its dynamics and kind."""
    usual, traits = make_config({}), []
    parts = (config.of_each(name, n) for name in (*LIMITS, "dynamics"))
    for *limits, dynamics, kind in zip(*parts, kinds or (0,) * n, strict=False):
        numbers = [one / getattr(usual, name) for one, name in zip(limits, LIMITS, strict=True)]
        flags = [dynamics == one for one in get_args(Dynamics)]
        flags += [kind == one for one in sorted(set(kinds))]
        traits.append((*numbers, *map(float, flags)))
    return traits


def shape_of(
    task: Task, config: MultiAgentPPOConfig, sharing: networks.Sharing, engine: BatchEngine
) -> networks.TeamShape:
    tokens = Tokens.of(engine.observation_table) if config.network == "entities" else None
    n = engine.n_robots
    shape = networks.TeamShape(
        *(engine.obs_size, n, config.hidden, sharing, config.actor, tokens, config.memory)
    )
    if sharing == "full+id":
        return replace(shape, extras=tuple(map(tuple, torch.eye(n).tolist())))
    if sharing in ("none", "full"):
        return shape
    traits = traits_of(engine.config, n, getattr(task.field, "start_kinds", ()))
    if sharing == "full+traits":
        return replace(shape, extras=tuple(traits))
    alike = [*dict.fromkeys(traits)]
    return replace(shape, groups=tuple(map(alike.index, traits)))


def check_source(source: RunFolder, ours: networks.TeamShape) -> None:
    """Raise a ConfigError if a run's networks are not those of robots of this team."""
    policy: Any = load_trained(source)
    shapes: tuple[networks.TeamShape, ...] = policy.network.shape, ours
    one_team = any(shape.of_one_team for shape in shapes)
    apart = any(max(shape.of) > 0 for shape in shapes)
    theirs, wanted = (
        {
            "groups": shape.groups,
            "ids or traits": len(shape.extras[0]) if shape.extras else 0,
            "robots": shape.n_robots if one_team else None,
            "actor": shape.actor if apart else None,
        }
        for shape in shapes
    )
    if problems := differences(theirs, wanted):
        raise ConfigError(f"from: {source.path}", problems)


def budget(task: Task, hyperparameters: MultiAgentPPOConfig) -> Budget:
    decisions = hyperparameters.decisions
    env_steps = -(-task.config.steps // decisions) * decisions
    steps, worlds = hyperparameters.rollout_steps, hyperparameters.num_worlds
    return Budget(env_steps, f"rollouts of {steps} decisions in {worlds} worlds")


class Trainer:
    """Multi-agent PPO; networks, losses and, on CUDA, the worlds are on the task's device."""

    def __init__(self, task: Task, config: MultiAgentPPOConfig, recorder: Recorder) -> None:
        torch.manual_seed(task.config.seed)
        self.task, self.config, self.recorder = task, config, recorder
        self.curriculum = RoiCurriculum(config.roi_radius, window=config.num_worlds)
        # The env-steps at which ROIs last were too large.
        self.grown = 0
        env = self._make_env()
        engine = env.engine
        shape = shape_of(task, config, config.sharing, engine)
        self.network = networks.GaussianPolicy(shape, config.log_std_start).to(env.device)
        shape = shape_of(task, config, config.critic_sharing or config.sharing, engine)
        state = engine.state_low.size, engine.n_rois
        self.tokens = shape.tokens
        self.critic = networks.ValueNetwork(shape, config.critic, state).to(env.device)
        joint = config.actor == "centralized"
        self.works = (Key.MASK,) if joint and engine.may_rest else ()
        self.actor = ProbabilisticActor(
            self.network,
            in_keys=[Key.LOC, Key.SCALE, *self.works],
            out_keys=[Key.ACTION],
            distribution_class=networks.DISTRIBUTIONS[config.actor],
            return_log_prob=True,
            log_prob_key=Key.LOG_PROB,
        )
        self.loss = (IPPOLoss if config.critic == "independent" else MAPPOLoss)(
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
        reward = ("team_reward",) if joint else ("robots", "reward")
        self.estimator.set_keys(value=Key.VALUE, reward=reward)
        self.reward = ("next", *reward)
        self.parameters = list(self.loss.parameters())
        self.optimizer = torch.optim.Adam(self.parameters, eps=config.adam_epsilon, fused=True)
        self._collect_from(env)

    def _make_env(self, **changed: Any) -> NavigationEnv:
        config, worlds = self.task.config, self.config.num_worlds
        return NavigationEnv(
            num_worlds=worlds,
            seed=self.curriculum.seed(config.seed),
            device=config.device,
            threads=1,
            state=self.config.critic == "state",
            team_reward=self.config.actor == "centralized",
            metrics=("success", "episode_return", *["steps"] * bool(self.config.memory)),
            **{**self.config.in_training(self.task, self.curriculum, worlds), **changed},
        )

    def _collect_from(self, env: NavigationEnv) -> None:
        self.env = env
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
        env_steps, begun_with = 0, self.task.config.transferred_from
        if self.recorder.checkpoint is not None:
            env_steps = self._restore(self.recorder.checkpoint)
        elif begun_with is not None:
            self._begin_with(open_run(str(begun_with)))
        self.recorder.start()
        while self.recorder.has_more(env_steps, begun=self.curriculum.begun):
            progress = env_steps / self.task.config.steps
            for group in self.optimizer.param_groups:
                group["lr"] = between(config.learning_rate, progress)
            if self.curriculum.radius > 1.0:
                self.grown = env_steps
            self.network.log_std.data.clamp_(max=config.cap_at(self._narrowing(env_steps)))
            started = time.perf_counter()
            rollout = next(self.rollouts).copy()
            collected = time.perf_counter()
            self._estimate(rollout)
            first = begun_with and env_steps < CRITIC_FIRST * config.decisions
            losses = self._descend(self._samples(rollout), MINIMISED[: 1 if first else None])
            self.network.norm.update(rollout[Key.OBSERVATION])
            self.critic.update(rollout)
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
            self.recorder.update(env_steps, lambda: policy, diagnostics | losses)
            if self.recorder.checkpoint_due:
                save = partial(self._save, env_steps)
                self.recorder.save_checkpoint(env_steps, policy, save)
        self.network.amplify(config.final_gain)
        self.recorder.finish(env_steps, policy, changed=config.final_gain != 1.0)

    def _begin_with(self, source: RunFolder) -> None:
        # The noise, and the memory if the source has none, are as in a new run.
        theirs: Any = load_trained(source)
        ours = self.network.state_dict()
        self.network.load_state_dict({**ours, **theirs.network.state_dict(), NOISE: ours[NOISE]})
        self.network.amplify(self.config.first_gain)
        # The critic begins with what they share, which is the encoder.
        values = self.critic.values.state_dict()
        shared = {
            name: tensor
            for name, tensor in self.network.mean.state_dict().items()
            if "encoder." in name and values.get(name, tensor[:0]).shape == tensor.shape
        }
        self.critic.values.load_state_dict({**values, **shared})

    def _narrowing(self, env_steps: int) -> float:
        # The first half of the way follows success, by the stages of the ROIs' size even if that is
        # fixed, so that a team that fails again explores. The second half follows the time.
        stages = self.curriculum.stage / STAGES / 2
        return stages + (env_steps - self.grown) / self.task.config.steps

    @torch.no_grad()
    def _estimate(self, rollout: TensorDictBase) -> None:
        # An episode cut off by the time limit bootstraps from the value of its last
        # observation, rollout["next"], never from that of the next episode's first.
        values = self.critic(rollout)[Key.VALUE].roll(-1, 1)
        apart = rollout["next", "done"].squeeze(-1).clone()
        apart[:, -1] = True  # the others are followed by a step of the rollout
        following = self.network.norm(rollout["next"][apart])
        values[apart] = self.critic(following)[Key.VALUE]
        rollout["next", Key.VALUE] = values
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
        if self.env.engine.teams_vary and self.config.actor == "decentralized":
            rollout["value_target"] *= rollout[Key.OBSERVATION].any(-1, keepdim=True)

    def _samples(self, rollout: TensorDictBase) -> TensorDictBase:
        kept = (Key.ACTION, Key.LOG_PROB, "advantage", "value_target")
        memories = (self.network, self.critic) if self.config.memory else ()
        states = (one.before for one in memories)
        samples = rollout.select(*self.critic.in_keys, *self.works, *kept, *states)
        if not memories:
            return samples.reshape(-1)
        # Sequences, with the states before their first steps.
        samples = samples.reshape(-1, math.gcd(CHUNK, self.config.rollout_steps))
        samples.batch_size = samples.batch_size[:1]
        for one in memories:
            samples.set(one.first, samples.pop(one.before)[:, 0])
        return samples

    def _shaped(self, rollout: TensorDictBase, tokens: Tokens) -> torch.Tensor:
        # By how many units each decision has shortened the ways left, discounted. After the end
        # of an episode nothing is left.
        # One reward for the team is that of the mean over its robots.
        rows, ways = rollout[Key.OBSERVATION].shape[:-1], []
        for seen in (rollout[Key.OBSERVATION], rollout["next", *Key.OBSERVATION]):
            way = tokens.way_left(seen.flatten(0, -2), rows[-1]).reshape(rows)
            if "team_reward" in self.reward:
                way = way.sum(-1, keepdim=True) / seen.any(-1).sum(-1, keepdim=True).clamp(min=1)
            ways.append(way)
        running = ~rollout["next", "terminated"]
        nearer: torch.Tensor = ways[0] - self.estimator.gamma * ways[1] * running
        return nearer.reshape(rollout[self.reward].shape)

    def _descend(self, samples: TensorDictBase, minimised: Sequence[str]) -> dict[str, float]:
        # The normalisation does not change meanwhile: old and new log-probabilities are of the
        # same inputs.
        history = []
        for _ in range(self.config.epochs):
            order = torch.randperm(len(samples), device=samples.device)
            for rows in order.chunk(self.config.minibatches):
                pick = partial(torch.index_select, dim=0, index=rows)  # faster than samples[rows]
                part = samples.apply(pick, batch_size=rows.shape)
                losses = self.loss(part)
                self.optimizer.zero_grad()
                sum(losses[name] for name in minimised).backward()
                torch.nn.utils.clip_grad_norm_(self.parameters, self.config.max_grad_norm)
                self.optimizer.step()
                history.append(losses.select(*LOGGED).detach())
        means: Any = torch.stack(history).mean(0)
        return {name.removeprefix("loss_"): value.item() for name, value in means.items()}

    def _save(self, env_steps: int, folder: Path) -> None:
        tensors.write_tensors(folder / NETWORKS, self.loss.state_dict())
        moments = tensors.moments_of(self.optimizer.state_dict())
        tensors.write_tensors(folder / OPTIMIZER, moments)
        write_arrays(folder / WORLDS, self.env.save_state(), compress=True)
        if self.config.memory:
            states = {one.name: one.past for one in (self.network, self.critic)}
            tensors.write_tensors(folder / MEMORIES, states)
        counters: dict[str, Any] = {"env_steps": env_steps, "grown": self.grown}
        counters["curriculum"] = asdict(self.curriculum)
        write_json(folder / COUNTERS, {**counters, "generators": tensors.save_generators()})

    def _restore(self, folder: Path) -> int:
        with reading(folder):
            weights, state = self.loss.state_dict(), self.optimizer.state_dict()
            self.loss.load_state_dict(tensors.read_tensors(folder / NETWORKS, weights))
            moments = tensors.read_tensors(folder / OPTIMIZER)
            self.optimizer.load_state_dict(tensors.with_moments(state, moments))
            counters = read_json(folder / COUNTERS)
            self.curriculum = TypeAdapter(RoiCurriculum).validate_python(counters["curriculum"])
            self.grown = int(counters["grown"])
            env = self._make_env()
            env.load_state(read_arrays(folder / WORLDS))
            self._collect_from(env)
            # Last, since a new collector tries the policy.
            if self.config.memory:
                states = tensors.read_tensors(folder / MEMORIES)
                for one in (self.network, self.critic):
                    one.past = states[one.name].to(env.device)
            tensors.restore_generators(counters["generators"])
            began = self.recorder.began
            return saved_at(folder, began + counters["env_steps"]) - began
