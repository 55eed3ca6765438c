"""Actor and critic of a team, as TorchRL's losses and collectors want them."""

# The layers compute what TorchRL's ``MultiAgentMLP`` does, faster on a CPU. The modules derive from
# ``TensorDictModuleBase``, since ``TensorDictModule`` looks for pandas at every output.

import math
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.modules import RunningValueNorm

from baselines.torchrl.entities import SetActor, SetCritic, Tokens

Network = Literal["mlp", "entities"]
Sharing = Literal["full", "full+id", "none"]
Actor = Literal["centralized", "decentralized"]
Critic = Literal["centralized", "independent"]


class Key:
    OBSERVATION, NORMALIZED = ("robots", "observation"), ("robots", "normalized")
    LOC, SCALE, ACTION = ("robots", "loc"), ("robots", "scale"), ("robots", "action")
    LOG_PROB, VALUE, MASK = "log_prob", "state_value", ("robots", "mask")


# Normalised observations are clipped to +-CLIP, as is usual (a bit that was rarely set).
CLIP = 10.0
HALF_LOG_TWO_PI = 0.5 * math.log(2.0 * math.pi)


@dataclass(frozen=True)
class TeamShape:
    obs_size: int
    n_robots: int
    # These are as in MultiAgentPPOConfig.
    hidden: tuple[int, ...]
    sharing: Sharing
    actor: Actor = "decentralized"
    # Of networks over sets, for teams of any size.
    tokens: Tokens | None = None

    @property
    def networks(self) -> int:
        return self.n_robots if self.sharing == "none" else 1


class TeamMLP(nn.Module):
    """A tanh network for all rows of a batch, or one for each of k groups of rows."""

    # ``sizes``: inputs, hidden layers, outputs. Weights start orthogonal, the last with its gain.
    def __init__(self, networks: int, sizes: tuple[int, ...], *, last_gain: float) -> None:
        super().__init__()
        gains = [nn.init.calculate_gain("tanh")] * (len(sizes) - 2) + [last_gain]
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        for (inputs, outputs), gain in zip(pairwise(sizes), gains, strict=True):
            empty = torch.empty(networks, inputs, outputs)
            weight = torch.stack([nn.init.orthogonal_(matrix, gain) for matrix in empty])
            self.weights.append(nn.Parameter(weight))
            self.biases.append(nn.Parameter(torch.zeros(networks, 1, outputs)))

    # (..., n, inputs) -> (..., n, outputs); n is the number of networks, or any if that is 1.
    def forward(self, rows: torch.Tensor) -> torch.Tensor:
        networks = len(self.weights[0])
        flow = rows.reshape(-1, networks, rows.shape[-1]).transpose(0, 1)
        *hidden, (last, bias) = zip(self.weights, self.biases, strict=True)
        for weight, shift in hidden:
            flow = torch.baddbmm(shift, flow, weight).tanh_()
        flow = torch.baddbmm(bias, flow, last)
        return flow.transpose(0, 1).reshape(*rows.shape[:-1], -1)


# The rows of a team side by side: (..., n, size) -> (..., 1, n size).
def joined(rows: torch.Tensor) -> torch.Tensor:
    return rows.flatten(-2).unsqueeze(-2)


class Normalize(TensorDictModuleBase):
    """Running normalisation of observations, one for each network; none until the first update."""

    # Tokens are left as they are: one statistic for all of a kind would not fit each.
    def __init__(self, shape: TeamShape) -> None:
        super().__init__()
        self.in_keys, self.out_keys = [Key.OBSERVATION], [Key.NORMALIZED]
        robots = (shape.n_robots,) if shape.networks > 1 else ()
        self._tokens = shape.tokens is not None
        if not self._tokens:
            self.statistics = RunningValueNorm(shape=(*robots, shape.obs_size))

    def update(self, observations: torch.Tensor) -> None:
        if not self._tokens:
            self.statistics.update(observations)

    def normalize(self, observations: torch.Tensor) -> torch.Tensor:
        if self._tokens:
            return observations
        scale = torch.where(self.statistics.count > 0, self.statistics.scale(), 1.0)
        normalized: torch.Tensor = (observations - self.statistics.mean) / scale
        return normalized.clamp_(-CLIP, CLIP)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        return tensordict.set(Key.NORMALIZED, self.normalize(tensordict.get(Key.OBSERVATION)))


class TeamNormal(torch.distributions.Distribution):
    """Normal actions (..., n, 2): log-probabilities (..., n); all rows have one deviation."""

    arg_constraints: dict[str, torch.distributions.constraints.Constraint] = {}  # noqa: RUF012
    has_rsample = True

    def __init__(self, loc: torch.Tensor, scale: torch.Tensor) -> None:
        self.loc, self.scale = loc, scale[(0,) * (scale.ndim - 2)]
        super().__init__(self.over_axes(loc).shape, validate_args=False)
        self.deterministic_sample = loc

    # Terms (..., n, 2) summed over what makes one action.
    def over_axes(self, terms: torch.Tensor) -> torch.Tensor:
        return terms.sum(-1)

    def rsample(self, sample_shape: Any = ()) -> torch.Tensor:
        return torch.addcmul(self.loc, self.scale, torch.randn_like(self.loc))

    def log_prob(self, value: torch.Tensor) -> torch.Tensor:
        noise = (value - self.loc) / self.scale
        return -self.over_axes(0.5 * noise.square() + (self.scale.log() + HALF_LOG_TWO_PI))

    def entropy(self) -> torch.Tensor:
        entropy = self.over_axes(self.scale.log() + (0.5 + HALF_LOG_TWO_PI))
        return entropy.expand(self.batch_shape)


class JointNormal(TeamNormal):
    """The same actions as one of the whole team: log-probabilities (..., 1)."""

    def over_axes(self, terms: torch.Tensor) -> torch.Tensor:
        return terms.sum((-2, -1)).unsqueeze(-1)


DISTRIBUTIONS = {"decentralized": TeamNormal, "centralized": JointNormal}


class GaussianPolicy(TensorDictModuleBase):
    # ``norm`` normalises its input, apart from it, so that an update normalises once.
    def __init__(self, shape: TeamShape, log_std: float = 0.0) -> None:
        super().__init__()
        self.in_keys, self.out_keys = [Key.NORMALIZED], [Key.LOC, Key.SCALE]
        self.shape, self.norm = shape, Normalize(shape)
        self._joint = shape.actor == "centralized"
        n = shape.n_robots
        ends = (n * shape.obs_size, n * 2) if self._joint else (shape.obs_size, 2)
        networks, axes = 1 if self._joint else shape.networks, 2
        if shape.tokens is None:
            sizes = (ends[0], *shape.hidden, ends[1])
            self.mean: TeamMLP | SetActor = TeamMLP(networks, sizes, last_gain=0.01)
        else:
            self.mean, axes = SetActor(shape.tokens, shape.hidden), 1  # the axes are alike
        self.log_std = nn.Parameter(torch.full((n if self._joint else networks, axes), log_std))

    @torch.no_grad()
    def amplify(self, gain: float) -> None:
        if isinstance(self.mean, SetActor):
            last = list(self.mean.head.parameters())
        else:
            last = [self.mean.weights[-1], self.mean.biases[-1]]
        for values in last:
            values.mul_(gain)

    def means(self, normalized: torch.Tensor) -> torch.Tensor:
        """Mean actions (..., n, 2) for normalised observations (..., n, obs_size)."""
        means: torch.Tensor = self.mean(joined(normalized) if self._joint else normalized)
        return means.reshape(*normalized.shape[:-1], 2)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        mean = self.means(tensordict.get(Key.NORMALIZED))
        return tensordict.set(Key.LOC, mean).set(Key.SCALE, self.log_std.exp().expand_as(mean))


class ValueNetwork(TensorDictModuleBase):
    """Values (..., n, 1), or one (..., 1, 1) for a centralised actor."""

    def __init__(self, shape: TeamShape, sees: Critic) -> None:
        super().__init__()
        self.in_keys, self.out_keys = [Key.NORMALIZED], [Key.VALUE]
        self._central = sees == "centralized"
        n, joint = shape.n_robots, shape.actor == "centralized"
        ends = (n * shape.obs_size, 1 if joint else n) if self._central else (shape.obs_size, 1)
        networks = 1 if self._central else shape.networks
        self._tokens = shape.tokens is not None
        if shape.tokens is None:
            sizes = (ends[0], *shape.hidden, ends[1])
            self.values: TeamMLP | SetCritic = TeamMLP(networks, sizes, last_gain=1.0)
        else:
            self.values = SetCritic(shape.tokens, shape.hidden, central=self._central)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        seen = tensordict.get(Key.NORMALIZED)
        joint = self._central and not self._tokens
        values = self.values(joined(seen)).mT if joint else self.values(seen)
        return tensordict.set(Key.VALUE, values)
