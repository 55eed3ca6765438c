"""Networks over sets: one policy for any field, number of ROIs and size of the team."""

# A robot's observation ``entities`` is read as tokens: its own, one for each other robot, one for
# each ROI. The tokens of a kind share weights and are pooled, so no size is fixed. Observations are
# turned and mirrored so that the next ROI lies in the same eighth of the plane, and actions back:
# forces and limits are per axis, so all eight symmetries of the square are exact without wind.

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any, Self

import torch
from torch import nn

from baselines.torchrl.memory import Memory, Past
from mbn_marl.engine.mdp.entities import SCALES
from mbn_marl.engine.mdp.observations import Entry
from mbn_marl.errors import ConfigError

NEAR, FAR = SCALES.tolist()
# Added to the square of a length, units, so that none is 0.
SHORT = 1e-6
RAYS = tuple(f"ray_{k}" for k in range(8))


@dataclass(frozen=True)
class Tokens:
    """The entries of a robot's own token, of another robot's and of an ROI's, in order."""

    own: tuple[str, ...]
    robot: tuple[str, ...]
    roi: tuple[str, ...]

    @classmethod
    def of(cls, table: Sequence[Entry]) -> Self:
        names = [entry.name for entry in table]
        parts = {
            kind: tuple(name.removeprefix(kind) for name in names if name.startswith(kind))
            for kind in ("other_1_", "roi_0_")
        }
        own = (name for name in names if not name.startswith(("other_", "roi_")))
        return cls(tuple(own), parts["other_1_"], parts["roi_0_"])

    def split(self, rows: torch.Tensor, n: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Return the tokens of rows (B, size) for n robots: (B, own), (B, n - 1, .), (B, m, .)."""
        own, robots = len(self.own), (n - 1) * len(self.robot)
        rois = rows.shape[-1] - own - robots
        if rois < 0 or rois % len(self.roi):
            sizes = f"{own} + {len(self.robot)} (n - 1) + {len(self.roi)} m"
            problem = f"observations: {rows.shape[-1]} entries for {n} robots; allowed: {sizes}"
            raise ConfigError("policy", [f"{problem}, for m ROIs"])
        parts = torch.split(rows, [own, robots, rois], -1)
        return (
            parts[0],
            parts[1].reshape(rows.shape[0], n - 1, len(self.robot)),
            parts[2].reshape(rows.shape[0], rois // len(self.roi), len(self.roi)),
        )

    def wider(self, extras: int) -> Self:
        """Return the tokens of robots with so many numbers more."""
        more = tuple(f"extra_{k}" for k in range(extras))
        return replace(self, own=self.own + more, robot=self.robot + more)

    def beside(self, rows: torch.Tensor, extras: torch.Tensor) -> torch.Tensor:
        """Return rows (..., n, size) with the ``extras`` (n, k) of each robot in its tokens."""
        n, there = rows.shape[-2], rows.any(-1, keepdim=True)
        own, robots, rois = self.split(rows.flatten(0, -2), n)
        mine = (extras * there).flatten(0, -2)
        theirs = (extras[others(n)] * there.unsqueeze(-1)).flatten(0, -3)
        team = torch.cat([robots, theirs * robots[..., :1].ne(0.0)], -1)
        parts = own, mine, team.flatten(1), rois.flatten(1)
        return torch.cat(parts, -1).reshape(*rows.shape[:-1], -1)

    def way_left(self, rows: torch.Tensor, n: int) -> torch.Tensor:
        """Return how far a team has to go, as a robot sees it, (B,) units for rows (B, size)."""
        # It is the robot's own tour and the longest one, if it sees the assignment; otherwise the
        # sum of the ROIs' distances from their nearest robots. The row of an absent robot has 0.
        own, _, rois = self.split(rows, n)
        if "own_tour" in self.own:
            at = [self.own.index(name) for name in ("own_tour", "team_tour")]
            return in_units(own[:, at]).sum(-1)
        at = [self.roi.index(name) for name in ("away", "others")]
        return in_units(rois[..., at].clamp(max=0.999)).amin(-1).sum(-1)


# The numbers (n, n - 1) of the other robots of each.
def others(n: int) -> torch.Tensor:
    numbers = [[j for j in range(n) if j != i] for i in range(n)]
    return torch.tensor(numbers, dtype=torch.long).reshape(n, n - 1)


# The inverse of scaled = length / (|length| + FAR).
def in_units(scaled: torch.Tensor) -> torch.Tensor:
    units: torch.Tensor = FAR * scaled / (1.0 - scaled.abs())
    return units


class Turned(nn.Module):
    """The symmetries of the square: tokens as they look when the next ROI lies in one eighth."""

    # That ROI is the first of the robot's queue, if it sees the assignment, or else the nearest.
    # Robots with headings are left as they are, since their actions are no vectors.

    _rays: torch.Tensor

    def __init__(self, tokens: Tokens) -> None:
        super().__init__()
        self._tokens = tokens
        self._fixed = any(name.endswith("cos") for name in tokens.own)
        self._columns: dict[str, tuple[list[list[int]], list[int]]] = {}
        for kind in ("own", "robot", "roi"):
            names = getattr(tokens, kind)
            pairs = [
                (k, names.index(f"{name[:-1]}y"))
                for k, name in enumerate(names)
                if name.endswith("x") and f"{name[:-1]}y" in names
            ]
            turned = {k for pair in pairs for k in pair} | {
                k for k, name in enumerate(names) if name in RAYS
            }
            rest = [k for k in range(len(names)) if k not in turned]
            self._columns[kind] = [list(axis) for axis in zip(*pairs, strict=True)], rest
        self.register_buffer("_rays", _turned_rays(), False)
        self._first_ray = tokens.own.index(RAYS[0])

    # The signs (B, 2), and the swaps (B, 1), that bring the next ROI into the one eighth.
    def signs(self, rois: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        if self._fixed:
            toward = rois.new_ones(rois.shape[0], 2)
        else:
            index = self._tokens.roi.index
            rank = rois[..., index("left")] * (2.0 - rois[..., index("away")])
            if "order" in self._tokens.roi:
                rank = rank + 2.0 * rois[..., index("order")]
            first = torch.arange(rois.shape[0], device=rois.device), rank.argmax(1)
            toward = rois[first][:, [index("far_x"), index("far_y")]]
        swap = toward[:, 1:].abs() > toward[:, :1].abs()
        return torch.where(toward < 0, -1.0, 1.0), swap

    # The rays (B, 8) of own tokens (B, .), turned.
    def rays(self, own: torch.Tensor, signs: torch.Tensor, swap: torch.Tensor) -> torch.Tensor:
        element = ((signs < 0) * signs.new_tensor([1.0, 2.0])).sum(-1) + 4.0 * swap[:, 0]
        rays = own[:, self._first_ray : self._first_ray + len(RAYS)]
        return rays.gather(1, self._rays[element.long()])

    def forward(
        self, kind: str, tokens: torch.Tensor, signs: torch.Tensor, swap: torch.Tensor
    ) -> torch.Tensor:
        """Return tokens (K, .) with their scalars first, then the turned vectors, but for rays."""
        pairs, rest = self._columns[kind]
        x, y = tokens[:, pairs[0]] * signs[:, :1], tokens[:, pairs[1]] * signs[:, 1:]
        return torch.cat([tokens[:, rest], torch.where(swap, y, x), torch.where(swap, x, y)], 1)

    @staticmethod
    def back(actions: torch.Tensor, signs: torch.Tensor, swap: torch.Tensor) -> torch.Tensor:
        return torch.where(swap, actions.flip(-1), actions) * signs


# The ray that is seen as each of the 8 after sign changes of x, y and a swap, (8, 8).
def _turned_rays() -> torch.Tensor:
    table = torch.empty(8, 8, dtype=torch.long)
    for element in range(8):
        for ray in range(8):
            before = (2 - ray) % 8 if element & 4 else ray
            before = -before % 8 if element & 2 else before
            table[element, ray] = (4 - before) % 8 if element & 1 else before
    return table


def _layers(*sizes: int) -> nn.Sequential:
    layers: list[nn.Module] = []
    for inputs, outputs in pairwise(sizes):
        layers += [_linear(inputs, outputs, math.sqrt(2.0)), nn.ReLU()]
    return nn.Sequential(*layers)


def _linear(inputs: int, outputs: int, gain: float) -> nn.Linear:
    layer = nn.Linear(inputs, outputs)
    nn.init.orthogonal_(layer.weight, gain)
    nn.init.zeros_(layer.bias)
    return layer


class Rivals(nn.Module):
    """Features of other robots for each ROI: how far from it they are, how fast they near it."""

    # A robot that does not see the assignment needs them to find out who goes where.

    WIDTH = 16

    def __init__(self, tokens: Tokens) -> None:
        super().__init__()
        self._at = {
            "roi": [tokens.roi.index(f"far_{a}") for a in "xy"],
            "robot": [tokens.robot.index(f"far_{a}") for a in "xy"],
            "faster": [tokens.robot.index(f"dv{a}") for a in "xy"],
            "own": [tokens.own.index(f"own_v{a}") for a in "xy"],
        }
        self.seen = _layers(4, self.WIDTH)

    def forward(self, own: torch.Tensor, robots: torch.Tensor, rois: torch.Tensor) -> torch.Tensor:
        to_roi = in_units(rois[:, None, self._at["roi"]])
        ways = to_roi - in_units(robots[..., self._at["robot"]])
        far, mine = _length(ways), _length(to_roi)
        speed = 2.0 * robots[..., self._at["faster"]] + own[:, None, self._at["own"]]
        nearing = (ways * speed).sum(-1, keepdim=True) / far
        farther = far - mine
        seen = [far / (far + FAR), far / (far + NEAR), farther / (farther.abs() + NEAR), nearing]
        features: torch.Tensor = self.seen(torch.cat(seen, -1)) * robots[..., :1]
        return features.amax(1) if robots.shape[1] else features.sum(1)


def _length(vectors: torch.Tensor) -> torch.Tensor:
    return (vectors.square().sum(-1, keepdim=True) + SHORT).sqrt()


class SetEncoder(nn.Module):
    """Make one vector of what a robot sees: pooled tokens of ROIs and robots beside its own."""

    # If robots do not see the assignment, ROIs' tokens also have Rivals, and are pooled once
    # more, knowing what was found the first time. ``widths``: of the tokens' layers, and the last.
    def __init__(self, tokens: Tokens, widths: tuple[int, ...]) -> None:
        super().__init__()
        width, last = widths[0], widths[-1]
        self._tokens, self.turned = tokens, Turned(tokens)
        self._assigned = "order" in tokens.roi
        self.own = _layers(len(tokens.own), width)
        self.robot = _layers(len(tokens.robot), width, width)
        self.roi = _layers(len(tokens.roi) + (0 if self._assigned else Rivals.WIDTH), width, width)
        self.query = _linear(len(tokens.own), width, 1.0)
        self.mix = _layers(4 * width, last)
        self.deep = _layers(last, last)
        if not self._assigned:
            self.rivals = Rivals(tokens)
            self.again = _linear(width, width, 1.0)
            self.tell = _linear(last, width, 1.0)
            self.ask = _linear(last, width, 1.0)
            self.whole = _layers(2 * width + last, last)

    def forward(
        self, rows: torch.Tensor, n: int
    ) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        own, robots, rois = self._tokens.split(rows, n)
        signs, swap = self.turned.signs(rois)
        # Only tokens of what is there are computed: a third of them.
        roi, row = _present(rois)
        tokens = self.turned("roi", roi, signs[row], swap[row])
        if not self._assigned:
            tokens = torch.cat([tokens, self.rivals(own[row], robots[row], roi)], -1)
        found = _or_zero(self.roi(tokens), roi)
        other, beside = _present(robots)
        team = self.robot(self.turned("robot", other, signs[beside], swap[beside]))
        team = _or_zero(team, other)
        turned = self.turned("own", own, signs, swap)
        own = torch.cat([turned, self.turned.rays(own, signs, swap)], -1)
        blank = found.new_zeros(own.shape[0], found.shape[-1])
        pooled = _pooled(blank, row, found, self.query(own), roi)
        flow = self.mix(torch.cat([self.own(own), *pooled, _most(blank, beside, team)], -1))
        flow = flow + self.deep(flow)
        if not self._assigned:
            found = _or_zero(torch.relu(self.again(found) + self.tell(flow)[row]), roi)
            pooled = _pooled(blank, row, found, self.ask(flow), roi)
            flow = flow + self.whole(torch.cat([flow, *pooled], -1))
        return flow, signs, swap


# The tokens (K, .) of (B, k, .) that are not absent, and the row (K,) of each.
def _present(tokens: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    if torch.compiler.is_exporting():
        # No size in an exported graph depends on the input: it keeps all, and _or_zero drops some.
        rows, count = tokens.shape[:2]
        return tokens.flatten(0, 1), torch.arange(rows)[:, None].expand(rows, count).flatten()
    row, place = tokens[..., 0].nonzero(as_tuple=True)
    return tokens[row, place], row


# The values of tokens (K, .); in an exported graph, 0 for absent ones.
def _or_zero(values: torch.Tensor, tokens: torch.Tensor) -> torch.Tensor:
    if not torch.compiler.is_exporting():
        return values
    return values * (tokens[:, 0] if values.ndim == 1 else tokens[:, :1]).ne(0.0)


# The greatest of the features (K, width) of each row, and their mean by attention. The greatest
# score of a row is taken off its scores, so that no exponential overflows.
def _pooled(
    blank: torch.Tensor,
    row: torch.Tensor,
    features: torch.Tensor,
    query: torch.Tensor,
    tokens: torch.Tensor,
) -> tuple[torch.Tensor, torch.Tensor]:
    score = (features * query[row]).sum(-1) / math.sqrt(features.shape[-1])
    most = score.new_full((query.shape[0],), -torch.inf)
    most = most.scatter_reduce(0, row, score.detach(), "amax")
    weight = _or_zero((score - most[row]).exp(), tokens)
    total = weight.new_zeros(query.shape[0]).index_add(0, row, weight).clamp(min=1e-30)
    weight = (weight / total[row]).unsqueeze(-1)
    return _most(blank, row, features), blank.index_add(0, row, weight * features)


# The greatest of the features (K, width) >= 0 of each row, 0 without any.
def _most(blank: torch.Tensor, row: torch.Tensor, features: torch.Tensor) -> torch.Tensor:
    return blank.scatter_reduce(0, row.unsqueeze(-1).expand_as(features), features, "amax")


# The rows (B, size) of (..., n, size) that are not all 0, and their numbers (B,).
def _of_present(rows: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
    flat = rows.reshape(-1, rows.shape[-1])
    if torch.compiler.is_exporting():  # see _present
        return flat, torch.arange(flat.shape[0])
    present = flat.any(-1).nonzero()[:, 0]
    return (flat if len(present) == len(flat) else flat[present]), present


# (..., n, k): values (B, k) of those that are there, 0 of the others.
def _to_all(values: torch.Tensor, present: torch.Tensor, shape: torch.Size) -> torch.Tensor:
    whole = values.new_zeros(math.prod(shape), values.shape[-1])
    return whole.index_copy(0, present, values).reshape(*shape, -1)


# A state (..., units) in the field turned as its robot sees it, or ``back``: the numbers of its
# first half are vectors.
def _turned(
    state: torch.Tensor, signs: torch.Tensor, swap: torch.Tensor, *, back: bool = False
) -> torch.Tensor:
    pairs = state.shape[-1] // 4
    vectors = state[..., : 2 * pairs].reshape(*state.shape[:-1], pairs, 2)
    signs, swap = signs.unsqueeze(-2), swap.unsqueeze(-2)
    if back:
        vectors = Turned.back(vectors, signs, swap)
    else:
        vectors = vectors * signs
        vectors = torch.where(swap, vectors.flip(-1), vectors)
    return torch.cat([vectors.flatten(-2), state[..., 2 * pairs :]], -1)


class SetMemory(Memory):
    """A memory whose state is that of a robot in the field as it is, though its inputs turn."""

    def forward(self, flow: torch.Tensor, past: Past, *frame: torch.Tensor) -> torch.Tensor:
        return _turned(super().forward(flow, past, *frame), *frame)

    def cell(self, state: torch.Tensor, drive: torch.Tensor, *frame: torch.Tensor) -> torch.Tensor:
        return _turned(super().cell(_turned(state, *frame), drive), *frame, back=True)


class SetNetwork(nn.Module):
    """Outputs of the robots of a team of any size, 0 of absent ones, whose rows are 0."""

    # Each from its own observation and, with ``team``, the mean of what all of the team see.
    def __init__(
        self, tokens: Tokens, widths: tuple[int, ...], *, team: bool = False, memory: int = 0
    ) -> None:
        super().__init__()
        self._team = team
        self.encoder = SetEncoder(tokens, widths)
        self.memory = SetMemory((0,), widths[-1], memory) if memory else None
        # It adds nothing at first, so that a network without a memory can be given one.
        self.recall = _linear(memory, widths[-1], 0.0) if memory else nn.Identity()
        self.width = widths[-1] * (2 if team else 1)

    def forward(self, rows: torch.Tensor, past: Past | None = None) -> torch.Tensor:
        some, present = _of_present(rows)
        flow, *frame = self.encoder(some, rows.shape[-2])
        if self.memory is not None and past is not None:
            parts = (_to_all(part, present, rows.shape[:-1]) for part in (flow, *frame))
            recalled = self.memory(next(parts), past, *parts).flatten(0, -2)[present]
            flow = flow + self.recall(recalled)
        if self._team:
            whole = _to_all(flow, present, rows.shape[:-1])
            count = rows.any(-1, keepdim=True).sum(-2, keepdim=True).clamp(min=1)
            team = (whole.sum(-2, keepdim=True) / count).expand_as(whole)
            flow = torch.cat([flow, team.reshape(-1, team.shape[-1])[present]], -1)
        outputs = self.outputs(flow, *frame)
        if torch.compiler.is_exporting():  # see _of_present
            outputs = outputs * some.any(-1, keepdim=True)
        return _to_all(outputs, present, rows.shape[:-1])

    def outputs(self, flow: torch.Tensor, *frame: torch.Tensor) -> torch.Tensor:
        raise NotImplementedError


class SetActor(SetNetwork):
    def __init__(self, tokens: Tokens, widths: tuple[int, ...], **how: Any) -> None:
        super().__init__(tokens, widths, **how)
        # It adds nothing at first, so that a team can begin with the network of a robot.
        layers = (_layers(self.width, widths[-1]), _linear(widths[-1], widths[-1], 0.0))
        self.mix = nn.Sequential(*layers) if self._team else None
        self.head = _linear(widths[-1], 2, 0.01)

    def outputs(self, flow: torch.Tensor, *frame: torch.Tensor) -> torch.Tensor:
        if self.mix is not None:
            flow = flow[:, : self.width // 2] + self.mix(flow)
        return Turned.back(self.head(flow), *frame)


class SetCritic(SetNetwork):
    def __init__(self, tokens: Tokens, widths: tuple[int, ...], **how: Any) -> None:
        super().__init__(tokens, widths, **how)
        self.mix = _layers(self.width, widths[-1])
        self.head = _linear(widths[-1], 1, 1.0)

    def outputs(self, flow: torch.Tensor, *frame: torch.Tensor) -> torch.Tensor:
        values: torch.Tensor = self.head(self.mix(flow))
        return values


class Several(nn.Module):
    """A network over sets for each group of robots; it sees the rows of its group alone."""

    def __init__(self, of: tuple[int, ...], make: Callable[[], SetNetwork]) -> None:
        super().__init__()
        self.each = nn.ModuleList(make() for _ in range(max(of) + 1))
        members = torch.eye(max(of) + 1)[list(of)].T.unsqueeze(-1)
        self.register_buffer("_members", members, False)

    _members: torch.Tensor

    def forward(self, rows: torch.Tensor, past: Past | None = None) -> torch.Tensor:
        outputs, states = [], []
        for network, mine in zip(self.each, self._members, strict=True):
            outputs.append(network(rows * mine, past))
            if past is not None:
                states.append((past.before * mine, past.after * mine))
        if past is not None:
            past.before, past.after = (torch.stack(s).sum(0) for s in zip(*states, strict=True))
        return torch.stack(outputs).sum(0)
