"""Actor and critic of a team, as TorchRL's losses and collectors want them."""

# The layers compute what TorchRL's ``MultiAgentMLP`` does, faster on a CPU. The modules derive from
# ``TensorDictModuleBase``, since ``TensorDictModule`` looks for pandas at every output.

import math
from dataclasses import dataclass
from functools import partial
from itertools import pairwise
from typing import Any, Literal

import torch
from tensordict import TensorDictBase
from tensordict.nn import TensorDictModuleBase
from torch import nn
from torchrl.modules import RunningValueNorm

from baselines.torchrl.entities import SetActor, SetCritic, Several, Tokens, others
from baselines.torchrl.memory import Memory, Past, Stacked

Network = Literal["mlp", "entities"]
Sharing = Literal["none", "groups", "full", "full+id", "full+traits"]
Actor = Literal["centralized", "decentralized"]
Critic = Literal["centralized", "state", "independent"]


class Key:
    OBSERVATION, NORMALIZED = ("robots", "observation"), ("robots", "normalized")
    LOC, SCALE, ACTION = ("robots", "loc"), ("robots", "scale"), ("robots", "action")
    LOG_PROB, VALUE, MASK = "log_prob", "state_value", ("robots", "mask")
    STATE, STEPS = "state", ("metrics", "steps")


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
    # Units of the memory.
    memory: int = 0
    # With sharing "groups", the group of each robot, from 0 on.
    groups: tuple[int, ...] = ()
    # Constants of each robot, which its network gets beside its observation: its id or traits.
    extras: tuple[tuple[float, ...], ...] = ()

    @property
    def of(self) -> tuple[int, ...]:
        """The number of each robot's network."""
        each = {"none": tuple(range(self.n_robots)), "groups": self.groups}
        return each.get(self.sharing, (0,) * self.n_robots)

    @property
    def of_one_team(self) -> bool:
        """Networks over sets are of a team of this size alone."""
        return self.tokens is not None and (max(self.of) > 0 or len(self.extras) > 0)


class TeamMLP(Stacked):
    """Tanh networks, with a memory before the last layer if they have one."""

    # ``sizes``: inputs, hidden layers, outputs. Weights start orthogonal, the last with its gain.
    def __init__(
        self, of: tuple[int, ...], sizes: tuple[int, ...], *, last_gain: float, memory: int = 0
    ) -> None:
        super().__init__(of)
        gains = [nn.init.calculate_gain("tanh")] * (len(sizes) - 2) + [last_gain]
        self.weights, self.biases = nn.ParameterList(), nn.ParameterList()
        ends = [*pairwise(sizes)]
        ends[-1] = memory or sizes[-2], sizes[-1]
        for (inputs, outputs), gain in zip(ends, gains, strict=True):
            self.weights.append(self.orthogonal(inputs, outputs, gain))
            self.biases.append(nn.Parameter(torch.zeros(self.count, 1, outputs)))
        self.memory = Memory(of, sizes[-2], memory) if memory else None

    def forward(self, rows: torch.Tensor, past: Past | None = None) -> torch.Tensor:
        flow, shape = self.apart(rows), rows.shape[:-1]
        layers = zip(map(self.of_rows, self.weights), map(self.of_rows, self.biases), strict=True)
        *hidden, (last, bias) = layers
        for weight, shift in hidden:
            flow = torch.baddbmm(shift, flow, weight).tanh_()
        if self.memory is not None and past is not None:
            flow = self.apart(self.memory(self.together(flow, shape), past))
        return self.together(torch.baddbmm(bias, flow, last), shape)


# The rows of a team side by side: (..., n, size) -> (..., 1, n size).
def joined(rows: torch.Tensor) -> torch.Tensor:
    return rows.flatten(-2).unsqueeze(-2)


def normalized(statistics: RunningValueNorm, numbers: torch.Tensor) -> torch.Tensor:
    scale = torch.where(statistics.count > 0, statistics.scale(), 1.0)
    scaled: torch.Tensor = (numbers - statistics.mean) / scale
    return scaled.clamp_(-CLIP, CLIP)


class Normalize(TensorDictModuleBase):
    """Running normalisation of observations, one for all or each robot; none until an update."""

    # Robots have their own without sharing. Tokens are left as they are: one statistic for all of
    # a kind would not fit each.
    def __init__(self, shape: TeamShape) -> None:
        super().__init__()
        self.in_keys, self.out_keys = [Key.OBSERVATION], [Key.NORMALIZED]
        alone = shape.sharing == "none" and shape.n_robots > 1
        robots = (shape.n_robots,) if alone else ()
        self._tokens = shape.tokens is not None
        if not self._tokens:
            self.statistics = RunningValueNorm(shape=(*robots, shape.obs_size))

    def update(self, observations: torch.Tensor) -> None:
        if not self._tokens:
            self.statistics.update(observations)

    def normalize(self, observations: torch.Tensor) -> torch.Tensor:
        return observations if self._tokens else normalized(self.statistics, observations)

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
    """The same actions as one of the team: log-probabilities (..., 1) of active robots."""

    def __init__(
        self, loc: torch.Tensor, scale: torch.Tensor, mask: torch.Tensor | None = None
    ) -> None:
        self._works = mask
        super().__init__(loc, scale)

    def over_axes(self, terms: torch.Tensor) -> torch.Tensor:
        if self._works is not None:
            terms = terms * self._works.unsqueeze(-1)
        return terms.sum((-2, -1)).unsqueeze(-1)


DISTRIBUTIONS = {"decentralized": TeamNormal, "centralized": JointNormal}


class TeamModule(TensorDictModuleBase):
    """An actor or a critic: what its networks see of each robot, and what they remember."""

    # A collector, or a rollout (W, T) without the entry ``first``, continues from the last call.
    name: str
    _joined: bool  # whether a world has one row

    def __init__(self, shape: TeamShape, out_keys: list[Any]) -> None:
        super().__init__()
        self.shape, self.past = shape, None
        self.in_keys: list[Any] = [Key.NORMALIZED]
        self.out_keys = out_keys
        self.before, self.first = f"{self.name}_before", f"{self.name}_first"
        if shape.memory:
            self.in_keys.append(Key.STEPS)
            self.out_keys.append(self.before)
        extras = torch.tensor(shape.extras)
        if shape.extras and shape.tokens is None:
            extras = torch.cat([extras, extras[others(shape.n_robots)].flatten(1)], 1)
        self.register_buffer("_extras", extras, False)

    _extras: torch.Tensor
    past: torch.Tensor | None

    def inputs(self, normalized: torch.Tensor) -> torch.Tensor:
        if not self.shape.extras:
            return normalized
        if self.shape.tokens is not None:
            return self.shape.tokens.beside(normalized, self._extras)
        return torch.cat([normalized, self._extras.expand(*normalized.shape[:-1], -1)], -1)

    def make(self, kind: type[SetActor | SetCritic], *, team: bool) -> Any:
        shape = self.shape
        assert shape.tokens is not None
        tokens = shape.tokens.wider(len(shape.extras[0])) if shape.extras else shape.tokens
        make = partial(kind, tokens, shape.hidden, team=team, memory=shape.memory)
        return make() if team or max(shape.of) == 0 else Several(shape.of, make)

    def nothing(self, seen: torch.Tensor) -> torch.Tensor:
        """Return the memory before the first step of what worlds show, (W, ..., n, size)."""
        rows = 1 if self._joined else seen.shape[-2]
        return seen.new_zeros(seen.shape[0], rows, self.shape.memory)

    def remembered(self, tensordict: TensorDictBase) -> Past | None:
        if not self.shape.memory:
            return None
        first = tensordict.get(self.first, None)
        if first is None:
            seen = tensordict.get(Key.NORMALIZED)
            first = self.nothing(seen) if self.past is None else self.past
        return Past(first, tensordict.get(Key.STEPS).squeeze(-1) == 0)

    def remember(self, tensordict: TensorDictBase, past: Past | None) -> TensorDictBase:
        if past is not None and tensordict.get(self.first, None) is None:
            tensordict.set(self.before, past.before)
            self.past = past.after if past.after.ndim == 3 else past.after[:, -1]
            if past.after.ndim > 3:
                tensordict.set(("next", self.first), past.after)
        return tensordict


class GaussianPolicy(TeamModule):
    name = "actor"

    # ``norm`` normalises its input, apart from it, so that an update normalises once.
    def __init__(self, shape: TeamShape, log_std: float = 0.0) -> None:
        super().__init__(shape, [Key.LOC, Key.SCALE])
        self.norm = Normalize(shape)
        joint, n = shape.actor == "centralized", shape.n_robots
        self._joined = joint and shape.tokens is None
        networks, axes = max(shape.of) + 1, 2
        if self._joined:
            sizes, networks = (n * shape.obs_size, *shape.hidden, n * 2), n
            self.mean: Any = TeamMLP((0,), sizes, last_gain=0.01, memory=shape.memory)
        elif shape.tokens is None:
            sizes = (shape.obs_size + self._extras.shape[-1], *shape.hidden, 2)
            self.mean = TeamMLP(shape.of, sizes, last_gain=0.01, memory=shape.memory)
        else:
            self.mean, axes = self.make(SetActor, team=joint), 1  # the axes are alike
            networks = 1 if joint else networks
        self.log_std = nn.Parameter(torch.full((networks, axes), log_std))

    @property
    def std(self) -> torch.Tensor:
        """The deviations of actions, for all rows or for each."""
        std = self.log_std.exp()
        return std if len(std) in (1, self.shape.n_robots) else std[list(self.shape.of)]

    @torch.no_grad()
    def amplify(self, gain: float) -> None:
        for mean in getattr(self.mean, "each", [self.mean]):
            if isinstance(mean, SetActor):
                last = list(mean.head.parameters())
            else:
                last = [mean.weights[-1], mean.biases[-1]]
            for values in last:
                values.mul_(gain)

    def means(self, normalized: torch.Tensor, past: Past | None = None) -> torch.Tensor:
        """Mean actions (..., n, 2) for normalised observations (..., n, obs_size)."""
        rows = joined(normalized) if self._joined else self.inputs(normalized)
        means: torch.Tensor = self.mean(rows, past)
        return means.reshape(*normalized.shape[:-1], 2)

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        past = self.remembered(tensordict)
        mean = self.means(tensordict.get(Key.NORMALIZED), past)
        tensordict = self.remember(tensordict, past)
        return tensordict.set(Key.LOC, mean).set(Key.SCALE, self.std.expand_as(mean))


class ValueNetwork(TeamModule):
    """Values (..., n, 1), or one (..., 1, 1) for a centralised actor."""

    name = "critic"

    # ``state``: the size of the paper's vector, and the number of ROIs, for a critic of it.
    def __init__(self, shape: TeamShape, sees: Critic, state: tuple[int, int] = (1, 0)) -> None:
        super().__init__(shape, [Key.VALUE])
        n, joint = shape.n_robots, shape.actor == "centralized"
        central, self.norm = sees == "centralized", None
        self._joint, self._joined = joint, sees == "state" or (central and shape.tokens is None)
        if self._joined:
            ends = n * shape.obs_size, 1 if joint else n
        else:
            ends = shape.obs_size + self._extras.shape[-1], 1
        if sees == "state":
            ends = state[0] - 1 + state[1], ends[1]
            self.in_keys.append(Key.STATE)
            self.norm = RunningValueNorm(shape=(ends[0],))
            self.register_buffer("_bits", 2.0 ** torch.arange(state[1]), False)
        if self._joined or shape.tokens is None:
            sizes, of = (ends[0], *shape.hidden, ends[1]), (0,) if self._joined else shape.of
            self.values: Any = TeamMLP(of, sizes, last_gain=1.0, memory=shape.memory)
        else:
            self.values = self.make(SetCritic, team=central)

    _bits: torch.Tensor

    def forward(self, tensordict: TensorDictBase) -> TensorDictBase:
        past, seen = self.remembered(tensordict), tensordict.get(Key.NORMALIZED)
        if self.norm is not None:
            rows = normalized(self.norm, self.unpacked(tensordict.get(Key.STATE))).unsqueeze(-2)
        else:
            rows = joined(seen) if self._joined else self.inputs(seen)
        values = self.values(rows, past)
        if self._joined:
            values = values.mT
        elif self._joint:
            there = seen.any(-1, keepdim=True).sum(-2, keepdim=True).clamp(min=1)
            values = values.sum(-2, keepdim=True) / there
        return self.remember(tensordict, past).set(Key.VALUE, values)

    def update(self, rollout: TensorDictBase) -> None:
        if self.norm is not None:
            self.norm.update(self.unpacked(rollout[Key.STATE]))

    def unpacked(self, state: torch.Tensor) -> torch.Tensor:
        """Return states with a flag for each ROI in place of the code of the visited ones."""
        visited = state[..., -1:].div(self._bits, rounding_mode="floor") % 2.0
        return torch.cat([state[..., :-1], visited], -1).float()
