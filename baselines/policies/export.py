"""Trained policies as ONNX files for other programs."""

import json
import logging
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from baselines.policies.loaded import LoadedPolicy
from baselines.policies.policy import TrainedPolicy
from mbn_marl.engine import BatchEngine
from mbn_marl.errors import ConfigError, MbnError
from mbn_marl.files import check_ending, check_free, claim_file, replacing
from mbn_marl.version import __version__

# The largest difference of an action of the file: sums of float32 have another order.
TOLERANCE = 1e-4
ALLOWED = "has no network; allowed: zoo:NAME and the folders of runs"
OPSET = 18
CHECKED_WORLDS = 256


class Network(torch.nn.Module):
    """A policy's mean actions in [-1, 1], (W, n, 2), for what W worlds show."""

    def __init__(self, policy: TrainedPolicy) -> None:
        super().__init__()
        self._policy, self._network = policy, policy.network

    def forward(self, seen: torch.Tensor) -> torch.Tensor:
        return self._policy.means(seen).clamp(-1.0, 1.0)


def export_policy(
    policy: LoadedPolicy, path: Path, *, force: bool = False
) -> tuple[dict[str, Any], float]:
    """Write a policy's mean actions as an ONNX file; return its metadata and largest difference."""
    # The ONNX function takes float32 of W >= 1 worlds, in their units; it needs no library.
    import onnxruntime
    import onnxscript  # noqa: F401 - the exporter needs it, and says otherwise what is missing

    check_free(check_ending(path, ".onnx"), force=force)
    if not isinstance(policy.policy, TrainedPolicy):
        raise ConfigError("export", [f"{policy.name}: {ALLOWED}"])
    engine = BatchEngine(policy.place, 1, threads=1, **policy.settings)
    seen = _drawn(engine, policy.observes)
    metadata: dict[str, Any] = {
        **{"policy": policy.name, "field": policy.place.name, "takes": policy.observes},
        **{"shape": ["W", *seen.shape[1:]], "returns": ["W", engine.n_robots, 2]},
        **{"environment": policy.settings, "version": __version__},
    }
    logging.disable(logging.WARNING)  # the exporter warns of packages that it does not need here
    with warnings.catch_warnings(action="ignore"):
        program: Any = torch.onnx.export(
            Network(policy.policy).eval(),
            (torch.from_numpy(seen),),
            input_names=[policy.observes],
            output_names=["actions"],
            opset_version=OPSET,
            dynamic_shapes=({0: torch.export.Dim("worlds")},),
            dynamo=True,
            verbose=False,
        )
    logging.disable(logging.NOTSET)
    model = program.model_proto
    model.metadata_props.add(key="mbn_marl", value=json.dumps(metadata))
    content = model.SerializeToString()
    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    difference = max(
        float(np.abs(session.run(["actions"], {policy.observes: rows})[0] - policy.act(rows)).max())
        for rows in (seen, seen[:1])
    )
    if not difference <= TOLERANCE:
        raise MbnError(f"{path}: not written, as its actions differ by up to {difference:.1e}")
    with replacing(claim_file(path, force=force)) as temporary:
        temporary.write_bytes(content)
    return metadata, difference


def _drawn(engine: BatchEngine, observes: str) -> NDArray[np.float32]:
    """Return numbers within the bounds of what W worlds show; a third is 0, as of absent things."""
    high = np.ones((engine.n_robots, engine.obs_size))
    low, high = (engine.state_low, engine.state_high) if observes == "state" else (-high, high)
    random = np.random.default_rng(0)
    drawn = random.uniform(low, high, (CHECKED_WORLDS, *low.shape)).astype(np.float32)
    return np.where(random.random(drawn.shape) < 1 / 3, np.float32(0.0), drawn)
