"""Who acts where: the field, the settings and the policy that a command line names."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from baselines.evaluation.policy import Policy, RandomPolicy, load_policy
from baselines.runs.folder import RunFolder
from baselines.zoo.entries import PREFIX, entry_names, open_run
from mbn_marl.episode import is_episode_file
from mbn_marl.errors import ConfigError
from mbn_marl.field import Field, load_field

RANDOM = "random"


@dataclass(frozen=True)
class Actor:
    """A policy in its field, with the environment's settings and a name in words."""

    policy: Policy
    field: Field
    settings: Mapping[str, Any]
    name: str


def find_actor(source: str, policy: str | None = None, *, seed: int = 0) -> Actor:
    """Find the actor of a command line.

    Args:
        source: a run's folder or ``zoo:NAME``, with their field; or a field's name or file.
        policy: in a field: ``"random"``, a run's folder or ``zoo:NAME``; ``None`` for random.
        seed: of random actions.

    Raises:
        MbnError: one of them is not there.
        ConfigError: a policy for a run, which has its own, or one for other numbers of robots or
            ROIs than the field's.
    """
    if source.startswith(PREFIX) or Path(source).is_dir():
        if policy is None:
            return _of_run(open_run(source), source)
        problem = f"policy: {source} has its own; to try another, name a field"
        raise ConfigError("policy", [problem])
    if is_episode_file(source):
        raise ConfigError("policy", [f"{source} is an episode; `mbn replay` plays it"])
    field = load_field(source)
    if policy in (None, RANDOM):
        return Actor(RandomPolicy(seed), field, {}, "random actions")
    run = open_run(str(policy))
    sizes = [(len(one.starts), len(one.rois)) for one in (run.field, field)]
    if sizes[0] != sizes[1]:
        trained, asked = (f"{robots} robots and {rois} ROIs" for robots, rois in sizes)
        raise ConfigError("policy", [f"{policy}: trained for {trained}; {field.name} has {asked}"])
    return replace(_of_run(run, ""), field=field, name=f"{policy} in {field.name}")


def zoo_policy(source: str) -> str | None:
    """Return the zoo's policy for a field of the catalogue, if there is one."""
    return f"{PREFIX}{source}" if source in entry_names() else None


def _of_run(run: RunFolder, name: str) -> Actor:
    return Actor(load_policy(run), run.field, run.config["environment"], name)
