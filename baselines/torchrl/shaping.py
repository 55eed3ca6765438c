"""A training aid: approaching an ROI that nobody has visited pays a little.

It is added to what the learner sees and to nothing else: every reported return is the true one.
"""

from __future__ import annotations

import torch

from mbn_marl.field import Field


class Approach:
    """How much nearer a team has come to the ROIs it still has to visit.

    The measure of a state is the sum, over the ROIs that are not visited in it, of the distance
    from the nearest robot (units); what is left of a visited ROI's distance counts as covered.

    Args:
        field: whose ROIs.
        n_robots: robots of a world.
        device: of the states.
    """

    def __init__(self, field: Field, n_robots: int, device: torch.device) -> None:
        self._robots = n_robots
        self._rois = torch.tensor(field.rois, dtype=torch.float32, device=device)
        count = len(field.rois)
        self._shifts = torch.arange(count - 1, -1, -1, device=device)  # first ROI: highest bit

    def remaining(self, states: torch.Tensor) -> torch.Tensor:
        """The measure (...) of the paper's states (..., 4n + 1)."""
        positions = states[..., : 2 * self._robots].float()
        positions = positions.reshape(*states.shape[:-1], self._robots, 2)
        offsets = positions.unsqueeze(-2) - self._rois  # (..., n, m, 2)
        nearest = offsets.square().sum(-1).amin(-2).sqrt()
        visited = (states[..., -1:].long() >> self._shifts) & 1
        measure: torch.Tensor = (nearest * (1 - visited)).sum(-1)
        return measure

    def __call__(self, before: torch.Tensor, after: torch.Tensor) -> torch.Tensor:
        """The decrease (...) of the measure, in units, from states to those they led to.

        Args:
            before: states in which an action was taken, (..., 4n + 1).
            after: states it led to; where that ended the episode, its last one, not the reset's.
        """
        return self.remaining(before) - self.remaining(after)
