"""A trained policy of a team: saved without pickle, loaded to act."""

import math
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path

import numpy as np
import torch
from pydantic import TypeAdapter

from baselines.policies.policy import Policy, Step, TrainedPolicy, Wrapped
from baselines.runs.files import read_json, reading, write_json
from baselines.runs.tensors import read_tensors, write_tensors
from baselines.torchrl.memory import Past
from baselines.torchrl.networks import GaussianPolicy, TeamShape
from mbn_marl.config import NavigationConfig
from mbn_marl.engine import BatchEngine
from mbn_marl.errors import ConfigError

WEIGHTS = "policy.safetensors"
SHAPE = "policy.json"


def is_shared(config: NavigationConfig, arena: Sequence[float]) -> bool:
    """Return whether all robots know at once what any of them knows: then one can act for all."""
    hear_all = config.comm_radius >= math.hypot(*arena) and not config.comm_delay
    return config.knowledge == "team" or (hear_all and not config.comm_loss)


class TeamPolicy(TrainedPolicy):
    network: GaussianPolicy

    def __init__(self, network: GaussianPolicy) -> None:
        self.network = network
        self.reset()

    def reset(self, worlds: np.ndarray | None = None) -> None:
        if worlds is None:
            self._past: torch.Tensor | None = None
        elif self._past is not None:
            self._past[torch.from_numpy(worlds)] = 0.0

    @torch.no_grad()
    def act(self, seen: np.ndarray, *, deterministic: bool) -> np.ndarray:
        std = self.network.std
        rows, past = torch.from_numpy(seen).to(std.device), self._past
        fits = past is not None and len(past) == len(rows)
        mean, self._past = self.step(rows, past if fits else self.blank(rows))
        mean, std = mean.cpu(), std.cpu()  # the noise is the same, whatever the device
        actions = mean if deterministic else mean + std * torch.randn(mean.shape)
        return actions.numpy()

    def blank(self, seen: torch.Tensor) -> torch.Tensor | None:
        return self.network.nothing(seen) if self.network.shape.memory else None

    def step(self, seen: torch.Tensor, past: torch.Tensor | None) -> Step:
        rows = self.network.norm.normalize(seen)
        if past is None:
            return self.network.means(rows), None
        around = Past(past, past.new_zeros(past.shape[0]))
        return self.network.means(rows, around), around.after

    def fit(self, engine: BatchEngine) -> Policy:
        shape = self.network.shape
        if shape.of_one_team and engine.n_robots != shape.n_robots:
            problem = f"robots: {engine.n_robots}; allowed with sharing {shape.sharing}: "
            raise ConfigError("policy", [f"{problem}{shape.n_robots}, those of its training"])
        joint = shape.actor == "centralized" and is_shared(engine.config, engine.arena)
        return self._matched(engine) if joint else super().fit(engine)

    def of_robot(self, robot: int, robots: int) -> Policy:
        if self.network.shape.actor == "centralized":
            problem = "actor: centralized, it sees all rows; allowed: decentralized"
            raise ConfigError("policy", [problem])
        return OneRow(TeamPolicy(self.network), robot, robots)  # with a memory to itself

    def save(self, folder: Path) -> None:
        write_json(folder / SHAPE, asdict(self.network.shape))
        write_tensors(folder / WEIGHTS, self.network.state_dict())


class OneRow(Wrapped):
    """A team's policy for the row of one robot, with zeros in place of the others' rows."""

    # Networks find the robot's weights, and the size of the team, by the rows.
    def __init__(self, policy: Policy, robot: int, robots: int) -> None:
        super().__init__(policy)
        self._robot, self._robots = robot, robots

    def act(self, seen: np.ndarray, *, deterministic: bool) -> np.ndarray:
        rows = np.zeros((len(seen), self._robots, seen.shape[-1]), seen.dtype)
        rows[:, self._robot] = seen[:, 0]
        actions: np.ndarray = self.policy.act(rows, deterministic=deterministic)
        return actions[:, self._robot, None]


def load_policy(folder: Path) -> TeamPolicy:
    with reading(folder / SHAPE):
        shape = TypeAdapter(TeamShape).validate_python(read_json(folder / SHAPE))
        with torch.device("meta"):  # without memory, of which a wrong shape may want much
            sizes = GaussianPolicy(shape)
    with reading(folder / WEIGHTS):
        weights = read_tensors(folder / WEIGHTS, sizes.state_dict())
        sizes.load_state_dict(weights, assign=True)  # raises if they do not fit
        network = GaussianPolicy(shape)
        network.load_state_dict(weights)
    return TeamPolicy(network)
