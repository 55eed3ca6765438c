"""A trained centralised policy: Stable-Baselines3's file beside the normalisation as JSON."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecNormalize

from baselines.runs.files import RunError, check_members, read_json, write_json
from baselines.runs.folder import RunFolder
from baselines.runs.trust import check_trusted
from baselines.sb3.config import algorithm_class
from mbn_marl.checksums import read_checked
from mbn_marl.errors import MbnError
from mbn_marl.files import replacing

MODEL = "model.zip"
NORMALIZATION = "normalization.json"


@dataclass(frozen=True)
class Normalization:
    """How ``VecNormalize`` treats an observation: ``clip((x - mean) / sqrt(var + epsilon))``.

    Attributes:
        mean: (size,) running mean; of the centralised form's state size is 4n+1.
        variance: (size,) running variance.
        count: how many observations they are of.
        epsilon: keeps the division finite.
        clip: bound of the result.
    """

    mean: np.ndarray
    variance: np.ndarray
    count: float
    epsilon: float
    clip: float

    @classmethod
    def of(cls, env: VecNormalize | None) -> Normalization | None:
        """The normalisation of ``env`` as it is now; ``None`` without one."""
        if env is None:
            return None
        running: Any = env.obs_rms
        return cls(
            running.mean.copy(), running.var.copy(), running.count, env.epsilon, env.clip_obs
        )

    def put_into(self, env: VecNormalize) -> None:
        """Make ``env`` normalise, and go on counting, as this does."""
        running: Any = env.obs_rms
        running.mean, running.var, running.count = self.mean, self.variance, self.count

    @classmethod
    def from_json(cls, values: dict[str, Any]) -> Normalization:
        """The inverse of :meth:`to_json`."""
        arrays = {name: np.asarray(values[name]) for name in ("mean", "variance")}
        return cls(**{**values, **arrays})

    def __call__(self, seen: np.ndarray) -> np.ndarray:
        """Normalise ``seen`` (rows, size)."""
        scaled: np.ndarray = (seen - self.mean) / np.sqrt(self.variance + self.epsilon)
        clipped: np.ndarray = np.clip(scaled, -self.clip, self.clip)
        return clipped.astype(np.float32)

    def to_json(self) -> dict[str, Any]:
        """As JSON values."""
        return {**vars(self), "mean": self.mean.tolist(), "variance": self.variance.tolist()}


class CentralizedPolicy:
    """One policy for the whole team, on the paper's state.

    Args:
        model: the trained algorithm.
        normalization: of the states; ``None`` if it sees them raw.
    """

    observes: Literal["observations", "state"] = "state"

    def __init__(self, model: BaseAlgorithm, normalization: Normalization | None) -> None:
        self.model = model
        self.normalization = normalization

    def act(self, seen: np.ndarray, *, deterministic: bool) -> np.ndarray:
        """Actions (worlds, n, 2) for states (worlds, 4n+1)."""
        states = seen if self.normalization is None else self.normalization(seen)
        actions, _ = self.model.predict(states, deterministic=deterministic)
        return actions

    def save(self, folder: Path) -> None:
        """Write the model, and the normalisation if it has one, into ``folder``."""
        if self.normalization is not None:
            write_json(folder / NORMALIZATION, self.normalization.to_json())
        file = io.BytesIO()  # since torch reports a full disk as anything but that
        self.model.save(file)
        with replacing(folder / MODEL) as temporary:
            temporary.write_bytes(file.getbuffer())


def load(run: RunFolder) -> CentralizedPolicy:
    """Load the latest policy of a run.

    Raises:
        RunError: a file is missing or damaged.
        TrustError: it was made by someone else, and the run is not trusted.
    """
    path = model_file(run)
    model = load_model(run.config["algorithm"], path, trust=run.trust, device="cpu")
    return CentralizedPolicy(model, load_normalization(run.policy))


def load_model(algorithm: str, path: Path, *, trust: bool, **options: Any) -> BaseAlgorithm:
    """The library's learner from its file ``path``, with ``options`` of the library.

    Args:
        algorithm: its name.
        path: the file, which holds pickled parts: loading it runs what is in them.
        trust: load it whoever made it.
        options: of the library.

    Raises:
        DamageError: the file is not what was written.
        RunError: the file is damaged or does not fit.
        TrustError: someone else made it, and ``trust`` is not set.
    """
    try:
        data = read_checked(path.parent, path.name)
        if not trust:
            check_trusted(path)
        check_members(path)
        return algorithm_class(algorithm).load(io.BytesIO(data), **options)
    except MbnError:
        raise
    except Exception as error:  # unpickling raises anything
        raise RunError(f"{path} cannot be read: {error}") from error


def model_file(run: RunFolder) -> Path:
    """The library's file of the latest policy of a run.

    Raises:
        RunError: the run has saved no policy yet.
    """
    path = run.policy / MODEL
    if not path.is_file():
        raise RunError(f"{path} is missing: the run has saved no policy")
    return path


def load_normalization(folder: Path) -> Normalization | None:
    """The normalisation that :meth:`CentralizedPolicy.save` wrote, if there was one."""
    path = folder / NORMALIZATION
    return Normalization.from_json(read_json(path)) if path.is_file() else None
