"""A memory behind an encoder: a GRU cell whose state the first step of an episode clears."""

# TorchRL's ``GRUModule`` has one cell and not one for each robot, and takes longer on a CPU, since
# it pads the episodes in a sequence to one length.

from dataclasses import dataclass, field

import torch
from torch import nn

# An update goes back through so many steps: 16 cost about as much as one, 64 twice as much.
CHUNK = 16


@dataclass
class Past:
    """The state before the first step, and then, from the memory, those around each step."""

    first: torch.Tensor  # (B, rows, units)
    begins: torch.Tensor  # where episodes begin: (B,) for one step, (B, T) for T of them
    # The states that steps began and ended with, (B, rows, units) or (B, T, rows, units).
    before: torch.Tensor = field(init=False)
    after: torch.Tensor = field(init=False)


class Stacked(nn.Module):
    """Layers of the networks of rows (..., n, k); ``of`` are their numbers, from 0 on."""

    # Of one network rows may have any n.
    def __init__(self, of: tuple[int, ...]) -> None:
        super().__init__()
        self.count, self._of = max(of) + 1, list(of)

    def orthogonal(self, inputs: int, outputs: int, gain: float) -> nn.Parameter:
        empty = torch.empty(self.count, inputs, outputs)
        return nn.Parameter(torch.stack([nn.init.orthogonal_(matrix, gain) for matrix in empty]))

    # A parameter with one entry for all rows or one for each.
    def of_rows(self, parameter: torch.Tensor) -> torch.Tensor:
        return parameter if self.count in (1, len(self._of)) else parameter[self._of]

    # Rows (..., n, k) as (1, all, k), or as (n, all / n, k) if their networks differ; and back.
    def apart(self, rows: torch.Tensor) -> torch.Tensor:
        n = 1 if self.count == 1 else len(self._of)
        return rows.reshape(-1, n, rows.shape[-1]).transpose(0, 1)

    def together(self, flow: torch.Tensor, shape: torch.Size) -> torch.Tensor:
        return flow.transpose(0, 1).reshape(*shape, -1)


class Memory(Stacked):
    """A GRU cell for each network."""

    def __init__(self, of: tuple[int, ...], inputs: int, units: int) -> None:
        super().__init__(of)
        self.inward = self.orthogonal(inputs, 3 * units, 1.0)
        self.around = self.orthogonal(units, 3 * units, 1.0)
        self.shifts = nn.Parameter(torch.zeros(self.count, 2, 1, 3 * units))

    # The states (..., n, units) after inputs (..., n, inputs) of one step, (B,), or of T, (B, T).
    # ``frame``: what the cell of a subclass takes of each row.
    def forward(self, flow: torch.Tensor, past: Past, *frame: torch.Tensor) -> torch.Tensor:
        shifts, inward = self.of_rows(self.shifts)[:, 0], self.of_rows(self.inward)
        drives = torch.baddbmm(shifts, self.apart(flow), inward)
        goes_on = 1.0 - past.begins.float()[..., None, None]
        parts, one = (goes_on, self.together(drives, flow.shape[:-1]), *frame), flow.ndim == 3
        state, before, after = past.first, [], []
        for on, *now in [parts] if one else zip(*(part.unbind(1) for part in parts), strict=True):
            before.append(state * on)
            state = self.cell(before[-1], *now)
            after.append(state)
        both = before, after
        past.before, past.after = (s[0] if one else torch.stack(s, 1) for s in both)
        return past.after

    def cell(self, state: torch.Tensor, drive: torch.Tensor) -> torch.Tensor:
        shifts, around = self.of_rows(self.shifts)[:, 1], self.of_rows(self.around)
        inner = torch.baddbmm(shifts, self.apart(state), around)
        inner, units = self.together(inner, state.shape[:-1]), state.shape[-1]
        gates = (drive[..., : 2 * units] + inner[..., : 2 * units]).sigmoid()
        reset, keep = gates.chunk(2, -1)
        new = (drive[..., 2 * units :] + reset * inner[..., 2 * units :]).tanh()
        return new + keep * (state - new)
