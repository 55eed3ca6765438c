"""The same bits on every machine: digests of what two batches compute (mdp.md, "The same bits").

``python -m tests.engine.test_machines`` prints those of this machine.
"""

from __future__ import annotations

import hashlib
import json
import platform
from typing import Any

import numpy as np
import pytest

from mbn_marl import BatchEngine, Uniform
from mbn_marl.field import FieldSampler, catalogue_names
from mbn_marl.field.layout import FAMILIES

STEPS, WORLDS = 150, 40
RANDOM = FieldSampler(FAMILIES, robots=(2, 4), rois=(2, 6), seed=5)
ALL_DYNAMICS = ("point_mass", "holonomic", "unicycle", "bicycle")
BATCHES: dict[str, tuple[Any, dict[str, Any]]] = {
    "catalogue, float64": (
        catalogue_names(),
        {
            **{"observation": "lidar", "dtype": "float64", "reward": "formal"},
            **{"wind": (0.05, 40.0), "random_starts": True, "roi_radius": 40.0, "max_steps": 90},
        },
    ),
    "random fields in a storm, float32": (
        RANDOM,
        {
            **{"observation": "entities", "assignment": True, "condition": "storm"},
            **{"dynamics": ALL_DYNAMICS, "mass": Uniform(0.8, 1.5), "tau": Uniform(0.8, 1.2)},
            **{"roi_radius": 20.0, "max_steps": 90},
        },
    ),
}
EXPECTED: dict[str, dict[str, str]] = {
    "catalogue, float64": {
        "observations": "673fdef946a9",
        "rewards": "c483cd657639",
        "terminated": "6d53092172d4",
        "truncated": "d67482a1396c",
        "state": "478fdb6c97d4",
        "success": "906ad37621d1",
        "collision": "12b4868ac9b2",
        "rois_visited": "226efd5da69d",
        "steps": "d9ad9fbe49a1",
        "episode_return": "f3b200daa7d8",
        "wall_hits": "8f09934dd0af",
        "path_length": "224e1513bb2d",
        "impulse": "4e8d885583c9",
        "failed": "a449143636d0",
        "return_": "f10e790483e9",
    },
    "random fields in a storm, float32": {
        "observations": "5ee891ef7405",
        "rewards": "c2fb49bf9ae3",
        "terminated": "352fe46a2ed0",
        "truncated": "935d0ce93a21",
        "state": "0b6870592c36",
        "success": "eda3dd3db287",
        "collision": "400860a4b4a9",
        "rois_visited": "edc9a31974cc",
        "steps": "e61a2db9cc88",
        "episode_return": "aada78522f46",
        "wall_hits": "479efec76bf3",
        "path_length": "95c5c0170c5c",
        "impulse": "848ba5d539ce",
        "failed": "219ea59c1a03",
        "return_": "b22bb7716b37",
    },
}


def digests(name: str) -> dict[str, str]:
    """Return a digest of each output of a batch, over all its steps."""
    source, settings = BATCHES[name]
    engine = BatchEngine(source, WORLDS, seed=11, **settings)
    rng = np.random.default_rng(3)
    found = {"observations": hashlib.sha256(engine.reset(11).tobytes())}
    names = ("observations", "rewards", "terminated", "truncated")
    for _ in range(STEPS):
        shape = (WORLDS, engine.n_robots, 2)
        outputs = engine.step(rng.uniform(-1.0, 1.0, shape).astype(np.float32))
        rows = dict(zip(names, outputs[:4], strict=True)) | {"state": engine.state()}
        rows |= {key: np.asarray(value) for key, value in engine.metrics().items()}
        for key, value in rows.items():
            found.setdefault(key, hashlib.sha256()).update(np.ascontiguousarray(value).tobytes())
    return {key: value.hexdigest()[:12] for key, value in found.items()}


@pytest.mark.slow
@pytest.mark.parametrize("name", BATCHES)
def test_every_machine_finds_the_same_bits(name: str) -> None:
    assert digests(name) == EXPECTED[name]


if __name__ == "__main__":
    print(platform.machine())
    for batch in BATCHES:
        print(json.dumps({batch: digests(batch)}), flush=True)
