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
MEMORY = "memory"


class Network(torch.nn.Module):
    """A policy's mean actions in [-1, 1], (W, n, 2), for what W worlds show, and its memory."""

    def __init__(self, policy: TrainedPolicy) -> None:
        super().__init__()
        self._policy, self._network = policy, policy.network

    def forward(self, seen: torch.Tensor, past: torch.Tensor | None = None) -> Any:
        means, after = self._policy.step(seen, past)
        actions = means.clamp(-1.0, 1.0)
        return actions if past is None else (actions, after)


def export_policy(
    policy: LoadedPolicy, path: Path, *, force: bool = False
) -> tuple[dict[str, Any], float]:
    """Write a policy's mean actions as an ONNX file; return its metadata and largest difference."""
    # The ONNX function takes float32 of W >= 1 worlds, in their units; it needs no library. It also
    # takes a memory, all 0 when an episode begins, and returns the next one.
    import onnxruntime
    import onnxscript  # noqa: F401 - the exporter needs it, and says otherwise what is missing

    check_free(check_ending(path, ".onnx"), force=force)
    if not isinstance(policy.policy, TrainedPolicy):
        raise ConfigError("export", [f"{policy.name}: {ALLOWED}"])
    engine = BatchEngine(policy.place, 1, threads=1, **policy.settings)
    policy.fit(engine)  # raises
    seen = _drawn(engine, policy.observes)
    before = policy.policy.blank(torch.from_numpy(seen))
    memory = {} if before is None else {MEMORY: before.numpy()}
    metadata: dict[str, Any] = {
        **{"policy": policy.name, "field": policy.place.name, "takes": policy.observes},
        **{"shape": ["W", *seen.shape[1:]], "returns": ["W", engine.n_robots, 2]},
        **{"environment": policy.settings, "version": __version__},
        **{name: ["W", *past.shape[1:]] for name, past in memory.items()},
    }
    # The exporter warns of packages that it does not need here.
    logging.getLogger("torch.onnx").setLevel(logging.ERROR)
    with warnings.catch_warnings(action="ignore"):
        program: Any = torch.onnx.export(
            Network(policy.policy).eval(),
            tuple(map(torch.from_numpy, (seen, *memory.values()))),
            input_names=[policy.observes, *memory],
            output_names=["actions", *(f"{name}_after" for name in memory)],
            opset_version=OPSET,
            dynamic_shapes=({0: torch.export.Dim("worlds")},) * (1 + len(memory)),
            dynamo=True,
            verbose=False,
        )
    model = program.model_proto
    model.metadata_props.add(key="mbn_marl", value=json.dumps(metadata))
    content = model.SerializeToString()
    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    difference = 0.0
    for count in (CHECKED_WORLDS, 1):
        policy.reset()
        inputs = {policy.observes: seen, **memory}
        inputs = {name: numbers[:count] for name, numbers in inputs.items()}
        for _ in range(1 + len(memory)):  # the second time with something to remember
            actions, *after = session.run(None, inputs)
            inputs |= dict(zip(memory, after, strict=True))
            theirs = policy.act(inputs[policy.observes])
            difference = max(difference, float(np.abs(actions - theirs).max()))
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
