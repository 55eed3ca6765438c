"""The oracle's rewards: the events of a step, and their worth under both rule sets."""

import math
from dataclasses import dataclass, field

TERMS = ("step", "revisit", "wall", "roi", "success", "collision")


@dataclass(frozen=True)
class Profile:
    """The weights r_s, r_m, r_l, r_inf of a reward profile and the rules that use them."""

    rules: str
    small: float = 10.0
    medium: float = 100.0
    large: float = 10_000.0
    infinite: float = 100_000.0


@dataclass
class Step:
    """The events of one step; ``margin`` is the least distance of a decision from its threshold."""

    works: list[bool] = field(default_factory=list)
    wall: list[bool] = field(default_factory=list)
    revisit: list[bool] = field(default_factory=list)
    reached: list[int] = field(default_factory=list)
    all_visited: bool = False
    collided: bool = False
    met_before: bool = False
    margin: float = math.inf
    terms: list[dict[str, float]] = field(default_factory=list)
    team_reward: float = 0.0
    rewards: list[float] = field(default_factory=list)
    terminated: bool = False
    truncated: bool = False


def released_reward(step: Step, profile: Profile) -> tuple[float, list[dict[str, float]]]:
    """The released code's reward: the team's, and each robot's share by term."""
    parts = parts_of(step)
    if step.collided:
        return -profile.infinite, [by_term(collision=-profile.infinite * part) for part in parts]
    team = profile.infinite if step.all_visited else 0.0
    shares = []
    rows = zip(step.works, step.wall, step.revisit, step.reached, parts, strict=True)
    for works, wall, revisit, reached, part in rows:
        own = by_term(
            step=-profile.small if works and not revisit else 0.0,
            revisit=-profile.medium if works and revisit else 0.0,
            wall=-profile.large if wall else 0.0,
            roi=profile.large * reached,
        )
        team += sum(own.values())
        own["success"] = profile.infinite * part if step.all_visited else 0.0
        shares.append(own)
    return team, shares


def formal_reward(step: Step, profile: Profile) -> tuple[float, list[dict[str, float]]]:
    """The paper's section 3, R = R_C + R_I + R_F + R_V: the team's, and each robot's share."""
    r_c = -profile.infinite if step.collided else 0.0
    r_i = profile.infinite if step.all_visited else profile.large * sum(step.reached)
    r_f = -profile.large * sum(step.wall) if any(step.wall) else -profile.small
    r_v = -profile.medium if step.met_before else profile.small
    shares = []
    for wall, reached, part in zip(step.wall, step.reached, parts_of(step), strict=True):
        own = by_term(
            wall=-profile.large if wall else 0.0,
            roi=0.0 if step.all_visited else profile.large * reached,
            success=profile.infinite * part if step.all_visited else 0.0,
            collision=r_c * part,
        )
        if not any(step.wall):
            own["step"] -= profile.small * part
        if step.met_before:
            own["revisit"] -= profile.medium * part
        else:
            own["step"] += profile.small * part
        shares.append(own)
    return r_c + r_i + r_f + r_v, shares


def parts_of(step: Step) -> list[float]:
    """Each robot's part of what the team gets: equal among those that work, or among all."""
    sharing = step.works if any(step.works) else [True] * len(step.works)
    return [works / sum(sharing) for works in sharing]


def by_term(**values: float) -> dict[str, float]:
    return {name: values.get(name, 0.0) for name in TERMS}
