"""A trained centralised policy: Stable-Baselines3's file beside the normalisation as JSON."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecNormalize

from baselines.centralized.config import algorithm_class
from baselines.runs import RunFolder
from baselines.storage import RunError, read_json, write_json
from mbn_marl.render.files import replacing

MODEL = "model.zip"
NORMALIZATION = "normalization.json"


@dataclass(frozen=True)
class Normalization:
    """How ``VecNormalize`` treats an observation: ``clip((x - mean) / sqrt(var + epsilon))``.

    Attributes:
        mean: (4n+1,) running mean of the state.
        variance: (4n+1,) running variance.
        epsilon: keeps the division finite.
        clip: bound of the result.
    """

    mean: np.ndarray
    variance: np.ndarray
    epsilon: float
    clip: float

    @classmethod
    def of(cls, env: VecNormalize) -> Normalization:
        """The normalisation of ``env`` as it is now."""
        statistics: Any = env.obs_rms
        return cls(statistics.mean.copy(), statistics.var.copy(), env.epsilon, env.clip_obs)

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> Normalization:
        """The inverse of :meth:`to_json`."""
        arrays = (np.asarray(values["mean"]), np.asarray(values["variance"]))
        return cls(*arrays, values["epsilon"], values["clip"])

    def __call__(self, states: np.ndarray) -> np.ndarray:
        """Normalise ``states`` (worlds, 4n+1)."""
        scaled: np.ndarray = (states - self.mean) / np.sqrt(self.variance + self.epsilon)
        clipped: np.ndarray = np.clip(scaled, -self.clip, self.clip)
        return clipped.astype(np.float32)

    def to_json(self) -> dict[str, Any]:
        """As JSON values."""
        lists = {"mean": self.mean.tolist(), "variance": self.variance.tolist()}
        return {**lists, "epsilon": self.epsilon, "clip": self.clip}


class CentralizedPolicy:
    """One policy for the whole team, on the paper's state.

    Args:
        model: the trained algorithm.
        normalization: of the states.
    """

    observes: Literal["observations", "state"] = "state"

    def __init__(self, model: BaseAlgorithm, normalization: Normalization) -> None:
        self.model = model
        self.normalization = normalization

    def act(self, seen: np.ndarray, *, deterministic: bool) -> np.ndarray:
        """Actions (worlds, n, 2) for states (worlds, 4n+1)."""
        actions, _ = self.model.predict(self.normalization(seen), deterministic=deterministic)
        return actions

    def save(self, folder: Path) -> None:
        """Write the model and the normalisation into ``folder``."""
        write_json(folder / NORMALIZATION, self.normalization.to_json())
        with replacing(folder / MODEL) as temporary:
            self.model.save(temporary)


def load(run: RunFolder) -> CentralizedPolicy:
    """Load the latest policy of a run.

    Stable-Baselines3's files hold pickled parts: load only runs that you trust.

    Raises:
        RunError: a file is missing.
    """
    path = run.policy / MODEL
    if not path.is_file():
        raise RunError(f"{path} is missing: the run has saved no policy")
    model = algorithm_class(run.config["algorithm"]).load(path, device="cpu")
    values = read_json(run.policy / NORMALIZATION)
    normalization = Normalization(
        np.asarray(values["mean"]),
        np.asarray(values["variance"]),
        values["epsilon"],
        values["clip"],
    )
    return CentralizedPolicy(model, normalization)
