"""The hyperparameters of MAPPO, IPPO and joint PPO."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field, field_validator

from baselines.torchrl.networks import Actor, Critic, Network, Sharing
from baselines.training.aids import Count, NonNegative, Positive, Share, TrainingAids, between
from baselines.training.hyperparameters import read_block, read_blocks, validate

SOURCE = Path(__file__).with_name("hyperparameters.yaml")


class MultiAgentPPOConfig(TrainingAids):
    """Everything about the learner. A pair ``(a, b)`` is interpolated linearly over training.

    Attributes:
        actor: ``"decentralized"``, each robot acts on its own observation, or ``"centralized"``,
            one network maps all observations to all forces (one reward, one log-probability).
        critic: it sees ``"centralized"`` all observations, or ``"independent"`` each robot's own.
        num_worlds: worlds stepped side by side.
        rollout_steps: decisions of every world between two updates.
        epochs, minibatches: passes over a rollout, and minibatches of a pass.
        network: ``"mlp"``, or ``"entities"``, a network over sets for fields and teams of any
            size, which are those of the observation of that name; it is shared by all robots.
        hidden: widths of the hidden layers of actor and critic (tanh); of a network over sets
            those of its tokens and of what follows.
        sharing: of the networks: ``"full"``, one for all robots; ``"full+id"``, one that also
            gets the robot's number (one-hot); ``"none"``, one for each. A central critic is one.
        learning_rate, adam_epsilon: of Adam; the rate from and to.
        max_grad_norm: the gradient of actor and critic together is clipped to this norm.
        clip: PPO's clip range of the probability ratio.
        gamma, gae_lambda: discount per step, and lambda of generalised advantage estimation.
        entropy: weight of the entropy bonus.
        log_std_start: initial logarithm of the actions' standard deviation (state-independent,
            one per axis; actions outside [-1, 1] are clipped by the engine).
        log_std_cap: upper limit of it: the first value until ``log_std_cap_from`` (a share of
            training), then falling linearly to the second.
        shaping: the reward, as the learner sees it, of getting a unit nearer to the end of the
            team's ways (:meth:`~.entities.Tokens.way_left`); potential-based, so that the best
            policy stays the same. Only with ``network: entities``.
        teacher: a trained policy to imitate, ``zoo:NAME`` or a run's folder, or none. It may see
            more than the learner, such as the assignment. The loss gets the squared distance of
            mean actions from the teacher's in the states that the learner comes to.
        teacher_weight: of that distance in the loss, from and to.
        imitation_until: the share of training, at its beginning, in which the actor does nothing
            but imitate and the critic waits (DAgger: the learner acts, the teacher says how).
        final_gain: what mean actions are multiplied by after the last update. Full force is the
            fastest, but while noise adds to them, larger means gain little.
    """

    actor: Actor
    critic: Critic
    num_worlds: Count
    rollout_steps: Count
    epochs: Count
    minibatches: Count
    network: Network
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
    shaping: NonNegative
    teacher: str | None
    teacher_weight: tuple[NonNegative, NonNegative]
    imitation_until: Share
    final_gain: Positive

    @field_validator("teacher")
    @classmethod
    def _found_from_anywhere(cls, value: str | None) -> str | None:
        return str(Path(value).resolve()) if value and Path(value).is_dir() else value

    @property
    def decisions(self) -> int:
        """Decisions of a rollout, each for all robots of one world."""
        return self.num_worlds * self.rollout_steps

    def cap_at(self, progress: float) -> float:
        """The upper limit of log-std at ``progress``, the share of training done, in [0, 1]."""
        falling = (progress - self.log_std_cap_from) / (1.0 - self.log_std_cap_from)
        return between(self.log_std_cap, falling)


def load(
    algorithm: str,
    setting: str,
    overrides: Mapping[str, Any],
    *,
    num_envs: int | None = None,
    file: Path | None = None,
) -> MultiAgentPPOConfig:
    """The hyperparameters of an algorithm, as :meth:`baselines.algorithms.Algorithm.resolve`."""
    if file is None:
        blocks = read_blocks(SOURCE)
        recorded = {**blocks["shared"], **blocks[algorithm]}
    else:
        recorded = read_block(file, setting)
    given = {"num_worlds": num_envs} if num_envs is not None else {}
    place = f"hyperparameters of {algorithm}" if file is None else str(file)
    config = validate(MultiAgentPPOConfig, {**recorded, **overrides, **given}, place)
    environment = {**config.environment, "one_hot": config.sharing == "full+id"}
    if config.network == "entities":
        environment["observation"] = "entities"
    return config.model_copy(update={"environment": environment})
