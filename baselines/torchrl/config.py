"""The hyperparameters of MAPPO, IPPO and joint PPO."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

from pydantic import Field

from baselines.torchrl.networks import Actor, Critic, Network, Sharing
from baselines.training.aids import Count, NonNegative, Positive, Share, TrainingAids, between
from baselines.training.config import read_block, read_blocks, validate

SOURCE = Path(__file__).with_name("hyperparameters.yaml")


Size = Annotated[int, Field(ge=1, le=65_536)]  # of arrays that have to fit in memory


class MultiAgentPPOConfig(TrainingAids):
    """Everything about the learner. A pair ``(a, b)`` is interpolated linearly over training."""

    # "decentralized": each robot acts on its own observation. "centralized": one network maps all
    # observations to all forces, with one reward and one log-probability.
    actor: Actor
    # It sees "centralized" all observations, "state" the paper's vector, or "independent" each
    # robot's own observation. The first two are one network, with a value for each robot.
    critic: Critic
    # Worlds stepped side by side, and decisions of each between two updates.
    num_worlds: Size
    rollout_steps: Size
    # Passes over a rollout, and minibatches of a pass.
    epochs: Count
    minibatches: Count
    # "mlp", or "entities": a network over sets for fields and teams of any size, shared by all
    # robots. It reads the observation of that name.
    network: Network
    # Widths of the hidden layers of actor and critic (tanh). A network over sets has two: of its
    # tokens, and of what follows.
    hidden: tuple[Size, ...]
    # "none": a network for each robot. "groups": one for all that are alike in dynamics, mass,
    # force, speed limit and kind. "full": one for all robots. "full+id", "full+traits": one that
    # also gets the robot's number (one-hot), or its traits and the others'.
    sharing: Sharing
    # The same of the critic, by default as the actor's.
    critic_sharing: Sharing | None = None
    # Units of a GRU cell behind the encoders of actor and critic, 0 for none.
    memory: Annotated[int, Field(ge=0, le=65_536)] = 0
    learning_rate: tuple[Positive, Positive]
    adam_epsilon: Positive
    # The gradient of actor and critic together is clipped to this norm.
    max_grad_norm: Positive
    # PPO's clip range of the probability ratio.
    clip: Positive
    # Discount per step, and lambda of generalised advantage estimation.
    gamma: Share
    gae_lambda: Share
    # Weight of the entropy bonus.
    entropy: float
    # Initial logarithm of the actions' standard deviation: it depends on no state, one per axis.
    log_std_start: float
    # Its upper limit falls from the first value to the second: as far as halfway while ROIs shrink,
    # then with time, from this share of training on. If ROIs never shrink success counts all the
    # same, so the noise of a team that succeeds narrows sooner.
    log_std_cap: tuple[float, float]
    log_std_cap_from: Annotated[float, Field(ge=0.0, lt=1.0)]
    # The reward, as the learner sees it, of getting a unit nearer to the end of the team's ways. It
    # is a potential, so the best policy stays the same. Only with network "entities".
    shaping: NonNegative
    # Mean actions are multiplied by this after the last update. Full force is the fastest, but
    # while noise adds to them, larger means gain little.
    final_gain: Positive
    # The same before the first update of a run that begins with another one's policy: 1/3 takes
    # back a final gain of 3. Noise changes little where means are beyond the largest force.
    first_gain: Positive = 1.0

    @property
    def decisions(self) -> int:
        return self.num_worlds * self.rollout_steps

    def cap_at(self, progress: float) -> float:
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
    blocks = read_blocks(SOURCE)
    block = blocks.get(setting, {}) if file is None else read_block(file, setting)
    recorded = {**blocks["shared"], **blocks[algorithm], **block}
    given = {"num_worlds": num_envs} if num_envs is not None else {}
    place = f"hyperparameters of {algorithm}" if file is None else str(file)
    config = validate(MultiAgentPPOConfig, {**recorded, **overrides, **given}, place)
    seen = {"observation": "entities"} if config.network == "entities" else {}
    return config.model_copy(update={"environment": {**config.environment, **seen}})
