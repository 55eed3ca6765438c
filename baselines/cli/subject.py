"""The options that name a policy, its field, a condition and a wind, the same in all commands."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any

from tyro.conf import Positional, arg

from mbn_marl.config import Condition


@dataclass(frozen=True, kw_only=True)
class InWeather:
    """A policy in some weather."""

    source: Positional[Annotated[str, arg(metavar="POLICY")]]
    """The folder of a run; zoo:NAME, a policy of `mbn zoo`; zoo, that of the field; greedy,
    earliest visit first; planner, the best plan, followed in closed loop; replan, which plans again
    if the world leaves it; random; or module:callable, your own."""
    condition: Condition | None = None
    """A named condition, whose weather and failures replace the policy's; by default as it was
    trained."""
    wind: tuple[float, float] | None = None
    """Speed (units/step per step) and angle (degrees from +x) of the wind; by default as it was
    trained."""

    @property
    def asked(self) -> dict[str, Any]:
        """The settings that replace the policy's, for ``find_policy``."""
        return {"condition": self.condition} | ({} if self.wind is None else {"wind": self.wind})

    @property
    def weather(self) -> str:
        """The end of titles, after the policy's name: the condition and the wind."""
        named = "" if self.condition is None else f", {self.condition}"
        return named + (
            "" if self.wind is None else ", wind {:g} at {:g} degrees".format(*self.wind)
        )


@dataclass(frozen=True, kw_only=True)
class Subject(InWeather):
    """A policy in a field and some weather."""

    field: str | None = None
    """A name of `mbn fields`, or a field file; by default that of the run or of zoo:NAME."""
