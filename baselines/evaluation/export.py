"""Trained policies as files for other programs: ONNX, ``torch.export``, plain NumPy arrays."""

from __future__ import annotations

import io
import json
import logging
import math
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
from numpy.typing import NDArray

from baselines.evaluation.fitting import LoadedPolicy
from baselines.evaluation.layers import HasLayers, Plain, run_arrays
from mbn_marl.engine import BatchEngine
from mbn_marl.errors import ConfigError, MbnError, unknown
from mbn_marl.files import check_free, claim_file, replacing
from mbn_marl.version import __version__

TOLERANCE = 1e-4
"""How far an action of the file may be from the policy's: sums of float32 have another order."""
ALLOWED = "has no network; allowed: zoo:NAME and the folders of runs"
OPSET = 18
METADATA = "mbn_marl"
"""The name of the metadata, JSON, in every file."""
CHECKED_WORLDS = 256
WORLDS = {0: torch.export.Dim("worlds")}
"""The axis of what worlds show that may have any length."""

Seen = NDArray[np.float32]
Run = Callable[[Seen], NDArray[np.float32]]
Metadata = dict[str, Any]


class Exported(NamedTuple):
    """The result of an export.

    Attributes:
        metadata: as in the file.
        difference: the largest between an action of the file and the policy's.
    """

    metadata: Metadata
    difference: float


class Network(torch.nn.Module):
    """:func:`~.layers.run_arrays` in torch: actions (W, n, 2) for what W worlds show."""

    def __init__(self, network: Plain) -> None:
        super().__init__()
        self._names: list[tuple[str, str]] = []
        self._numbers = network.arrays()  # those of an axis or none, and words, are constants
        for name, array in self._numbers.items():
            if array.ndim > 1:
                self._names.append((name, f"array_{len(self._names)}"))
                self.register_buffer(self._names[-1][1], torch.tensor(array))

    def forward(self, seen: torch.Tensor) -> torch.Tensor:
        """See :func:`~.layers.run_arrays`."""
        tensors: Any = {name: getattr(self, buffer) for name, buffer in self._names}
        actions: torch.Tensor = run_arrays(self._numbers | tensors, seen, torch)
        return actions


def export_policy(policy: LoadedPolicy, path: Path, *, force: bool = False) -> Exported:
    """Write the mean actions of a policy as a function that needs none of its libraries.

    The function takes float32, what W >= 1 worlds show, in their units, and returns (W, n, 2) in
    [-1, 1]. What is written was read again and gave the policy's actions.

    Args:
        policy: of a run or of the zoo, with its field.
        path: ``.onnx``, ``.pt2`` (:func:`torch.export.load`) or ``.npz``.
        force: move a file that is there aside.

    Raises:
        ConfigError: the policy has no network, or one that cannot be exported.
        MbnError: the name does not end so, or a file is there, or the actions are others.
    """
    write = writer_of(path)
    check_free(path, force=force)
    if policy.field is None or not isinstance(policy.policy, HasLayers):
        raise ConfigError("export", [f"{policy.name}: {ALLOWED}"])
    layers = policy.policy.layers()
    seen = _drawn(BatchEngine(policy.field, 1, threads=1, **policy.settings), policy.observes)
    expected = policy.act(seen)
    metadata = _describe(policy, layers, seen.shape[1:], expected.shape[1])
    content, run = write(layers, metadata, seen)
    difference = max(
        float(np.abs(run(rows) - wanted).max())
        for rows, wanted in ((seen, expected), (seen[:1], expected[:1]))
    )
    if not difference <= TOLERANCE:
        raise MbnError(f"{path}: not written, as its actions differ by up to {difference:.1e}")
    with replacing(claim_file(path, force=force)) as temporary:
        temporary.write_bytes(content)
    return Exported(metadata, difference)


def _drawn(engine: BatchEngine, observes: str) -> Seen:
    """Return what worlds may show, (W, n, obs_size) or (W, size), within its bounds.

    A third is 0, as of what is not there to be seen, the rest uniform.
    """
    high = np.ones((engine.n_robots, engine.obs_size))
    low, high = (engine.state_low, engine.state_high) if observes == "state" else (-high, high)
    random = np.random.default_rng(0)
    drawn = random.uniform(low, high, (CHECKED_WORLDS, *low.shape)).astype(np.float32)
    return np.where(random.random(drawn.shape) < 1 / 3, np.float32(0.0), drawn)


def _describe(policy: LoadedPolicy, layers: Plain, shape: tuple[int, ...], n: int) -> Metadata:
    """Return what a program has to know that feeds the file."""
    return {
        "policy": policy.name,
        "field": getattr(policy.field, "name", None),
        "takes": policy.observes,
        "shape": ["W", *shape],
        "returns": ["W", n, 2],
        "clip": layers.clip if math.isfinite(layers.clip) else None,
        "environment": policy.settings,
        "version": __version__,
    }


def writer_of(path: Path) -> Write:
    """Return what writes a file that ends as ``path`` does; an MbnError lists the endings."""
    write = FORMATS.get(path.suffix.lower())
    if write is None:
        raise MbnError(f"{path}: {unknown('ending', path.suffix, FORMATS)}")
    return write


def _write_npz(layers: Plain, metadata: Metadata, seen: Seen) -> tuple[bytes, Run]:
    buffer = io.BytesIO()
    named: dict[str, Any] = {**layers.arrays(), METADATA: np.array(json.dumps(metadata))}
    np.savez(buffer, **named)
    with np.load(io.BytesIO(buffer.getvalue())) as file:
        arrays = dict(file)
    return buffer.getvalue(), lambda rows: run_arrays(arrays, rows)


def _write_pt2(layers: Plain, metadata: Metadata, seen: Seen) -> tuple[bytes, Run]:
    buffer = io.BytesIO()
    example = (torch.from_numpy(seen),)
    program = torch.export.export(Network(layers), example, dynamic_shapes=(WORLDS,))
    torch.export.save(program, buffer, extra_files={METADATA: json.dumps(metadata)})
    module = torch.export.load(io.BytesIO(buffer.getvalue())).module()
    return buffer.getvalue(), lambda rows: module(torch.from_numpy(rows)).numpy()


def _write_onnx(layers: Plain, metadata: Metadata, seen: Seen) -> tuple[bytes, Run]:
    import onnxruntime
    import onnxscript  # noqa: F401 - the exporter needs it, and says otherwise what is missing

    takes = metadata["takes"]
    with _silence():
        program = torch.onnx.export(
            Network(layers).eval(),
            (torch.from_numpy(seen),),
            input_names=[takes],
            output_names=["actions"],
            opset_version=OPSET,
            dynamic_shapes=(WORLDS,),
            dynamo=True,
            verbose=False,
        )
    assert program is not None
    model = program.model_proto
    model.metadata_props.add(key=METADATA, value=json.dumps(metadata))
    content = model.SerializeToString()
    session = onnxruntime.InferenceSession(content, providers=["CPUExecutionProvider"])
    return content, lambda rows: session.run(["actions"], {takes: rows})[0]


@contextmanager
def _silence() -> Iterator[None]:
    """Keep what torch's exporter says of itself, such as packages that it would like, to itself."""
    with warnings.catch_warnings(action="ignore"):
        logging.disable(logging.WARNING)
        try:
            yield
        finally:
            logging.disable(logging.NOTSET)


Write = Callable[[Plain, Metadata, Seen], tuple[bytes, Run]]
FORMATS: Mapping[str, Write] = {".onnx": _write_onnx, ".pt2": _write_pt2, ".npz": _write_npz}
"""For each ending, returns the bytes of the file, and the function that is read from them."""
