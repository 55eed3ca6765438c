"""A teacher: a trained policy that says what it would do where the learner is.

Source: Schmitt et al., "Kickstarting Deep Reinforcement Learning", 2018.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import torch
from numpy.typing import NDArray
from tensordict import TensorDictBase

from baselines.policies.load import load_trained, open_run
from baselines.policies.policy import TrainedPolicy
from baselines.torchrl.networks import Key
from baselines.training.config import Task
from mbn_marl.adapters.torchrl import NavigationEnv
from mbn_marl.config import make_config
from mbn_marl.engine import BatchEngine
from mbn_marl.errors import ConfigError

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
    """Raise an MbnError if there is no such teacher, or it cannot act where the learner does."""
    policy, seen = find_teacher(source, task.settings)
    if policy.observes != "observations":
        problem = f"teacher: {source} acts on the state; allowed: on robots' own observations"
        raise ConfigError("training", [problem])
    policy.fit(BatchEngine(task.field, 1, threads=1, **{**task.settings, **seen}))


class Teacher:
    """Follow the learner's rollouts in the same worlds, which show what the teacher sees."""

    # ``learner``: the settings of its environment, in place of which make_env takes some.

    def __init__(
        self, source: str, learner: Mapping[str, Any], make_env: Callable[..., NavigationEnv]
    ) -> None:
        policy, seen = find_teacher(source, learner)
        self._env = make_env(**seen)
        self._policy = policy.fit(self._env.engine)
        self._now = self._env.reset()

    def actions(self, rollout: TensorDictBase, repeat: int) -> torch.Tensor:
        """Return the mean actions (W, T, n, 2) for a rollout (W, T) that follows the last one."""
        self._env.action_repeat = repeat
        answers = []
        for taken in rollout[Key.ACTION].unbind(1):
            seen = self._now[Key.OBSERVATION].numpy(force=True)
            answers.append(torch.from_numpy(self._policy.act(seen, deterministic=True)))
            _, self._now = self._env.step_and_maybe_reset(self._now.set(Key.ACTION, taken))
        return torch.stack(answers, 1).clamp_(-1.0, 1.0).to(rollout.device)

    def save_state(self) -> dict[str, NDArray[Any]]:
        return self._env.save_state()

    def load_state(self, saved: Mapping[str, NDArray[Any]]) -> None:
        self._env.load_state(saved)
        self._now = self._env.reset()
