"""The hyperparameters of MAPPO and IPPO."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import Field

from baselines.torchrl.networks import Sharing
from baselines.training.hyperparameters import Hyperparameters, read_block, read_blocks, validate

SOURCE = Path(__file__).with_name("hyperparameters.yaml")

Count = Annotated[int, Field(ge=1)]
Positive = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
Until = Annotated[float, Field(gt=0.0, le=1.0)]


class MultiAgentPPOConfig(Hyperparameters):
    """Everything about the learner. A pair ``(a, b)`` is interpolated linearly over training.

    Attributes:
        critic: what the critic sees: ``"centralized"``, all robots' observations (MAPPO), or
            ``"independent"``, the robot's own (IPPO).
        num_worlds: worlds stepped side by side.
        rollout_steps: decisions of every world between two updates.
        epochs: passes over a rollout.
        minibatches: minibatches of a pass.
        hidden: widths of the hidden layers of actor and critic (tanh).
        sharing: of the networks: ``"full"``, one for all robots; ``"full+id"``, one that is told
            which robot it acts for (one-hot); ``"none"``, one for each. MAPPO's critic is one.
        learning_rate: of Adam, from and to.
        adam_epsilon: of Adam.
        max_grad_norm: the gradient of actor and critic together is clipped to this norm.
        clip: PPO's clip range of the probability ratio.
        gamma: discount per step.
        gae_lambda: lambda of generalised advantage estimation.
        entropy: weight of the entropy bonus.
        log_std_start: initial logarithm of the actions' standard deviation (state-independent,
            one per axis; actions outside [-1, 1] are clipped by the engine).
        log_std_cap: upper limit of it: the first value until ``log_std_cap_from`` of training,
            then falling linearly to the second.
        log_std_cap_from: when the cap begins to fall, as a share of training.
        reward_scale: the learner sees the reward times this.
        approach_bonus: reward units that the team is paid, while it learns, for each unit of
            distance that it comes nearer to the unvisited ROIs (see ``shaping``); 0 for the true
            reward only. Returns that are reported never contain it.
        action_repeat: env-steps that a decision lasts, from and to, falling linearly (rounded)
            over ``action_repeat_until``. Evaluations always decide at every step.
        action_repeat_until: the share of training after which it has its second value.
        roi_radius: how many times as large ROIs are at first: a curriculum (see ``curriculum``),
            1 for none. Training episodes in ``progress.csv`` are of the size at the time,
            evaluations of the true one.
        roi_stages: the stages from there to the true size; at each one the worlds begin anew.
        roi_success: success rates of ``num_worlds`` training episodes or more: below the first
            ROIs go back by a stage, from the second on they go on to the next.
        episode_steps: training episodes are cut off after so many env-steps, if not before, so
            that stuck worlds begin anew; that is a truncation. Evaluations go on to the end.
    """

    critic: Literal["centralized", "independent"]
    num_worlds: Count
    rollout_steps: Count
    epochs: Count
    minibatches: Count
    hidden: tuple[Count, ...]
    sharing: Sharing
    learning_rate: tuple[Positive, Positive]
    adam_epsilon: Positive
    max_grad_norm: Positive
    clip: Positive
    gamma: Share
    gae_lambda: Share
    entropy: float
    log_std_start: float
    log_std_cap: tuple[float, float]
    log_std_cap_from: Annotated[float, Field(ge=0.0, lt=1.0)]
    reward_scale: Positive
    approach_bonus: Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
    action_repeat: tuple[Count, Count]
    action_repeat_until: Until
    roi_radius: Annotated[float, Field(ge=1.0, allow_inf_nan=False)]
    roi_stages: Count
    roi_success: tuple[Share, Share]
    episode_steps: Count

    @property
    def decisions(self) -> int:
        """Decisions of a rollout, each moving all robots of one world."""
        return self.num_worlds * self.rollout_steps

    def cap_at(self, progress: float) -> float:
        """The upper limit of log-std at ``progress``, the share of training done, in [0, 1]."""
        falling = (progress - self.log_std_cap_from) / (1.0 - self.log_std_cap_from)
        return between(self.log_std_cap, falling)

    def repeat_at(self, progress: float) -> int:
        """The env-steps of a decision at ``progress``, in [0, 1]."""
        return round(between(self.action_repeat, progress / self.action_repeat_until))

    def learning_rate_at(self, progress: float) -> float:
        """The learning rate at ``progress``, in [0, 1]."""
        return between(self.learning_rate, progress)


def between(ends: tuple[float, float], share: float) -> float:
    """The number that lies a ``share`` of the way from one end to the other; 0 to 1 counts."""
    start, end = ends
    return start + (end - start) * min(1.0, max(0.0, share))


def load(
    algorithm: str,
    setting: str,
    overrides: Mapping[str, Any],
    *,
    num_envs: int | None = None,
    file: Path | None = None,
) -> MultiAgentPPOConfig:
    """The hyperparameters of ``"mappo"`` or ``"ippo"``, with ``overrides``.

    Args:
        algorithm: its name.
        setting: ``"N"``, their only one.
        overrides: values by name, instead of the recorded ones.
        num_envs: worlds side by side, instead of the recorded number.
        file: a YAML file whose block of the setting takes the place of the recorded values.

    Raises:
        ConfigError: naming every unknown or invalid hyperparameter.
    """
    if file is None:
        blocks = read_blocks(SOURCE)
        recorded = {**blocks["shared"], **blocks[algorithm]}
    else:
        recorded = read_block(file, setting)
    given = {"num_worlds": num_envs} if num_envs is not None else {}
    place = f"hyperparameters of {algorithm}" if file is None else str(file)
    config = validate(MultiAgentPPOConfig, {**recorded, **overrides, **given}, place)
    environment = {**config.environment, "one_hot": config.sharing == "full+id"}
    return config.model_copy(update={"environment": environment})
