"""The same bits on every machine: digests of what two batches compute (specification.md)."""

import hashlib
import json
import platform

import numpy as np
import pytest

from mbn_marl import BatchEngine
from mbn_marl.field import catalogue_names
from tests.support.configurations import SAMPLER, STORM

STEPS, WORLDS = 150, 40
ALL_DYNAMICS = ("point_mass", "holonomic", "unicycle", "bicycle")
BATCHES = {
    "catalogue, float64": (
        catalogue_names(),
        {
            **{"observation": "lidar", "dtype": "float64", "reward": "formal"},
            **{"wind": (0.05, 40.0), "random_starts": True, "roi_radius": 40.0, "max_steps": 90},
        },
    ),
    "random fields in a storm, float32": (SAMPLER, {**STORM, "dynamics": ALL_DYNAMICS}),
}
EXPECTED = {
    "catalogue, float64": (
        "673fdef946a9 c483cd657639 6d53092172d4 d67482a1396c 478fdb6c97d4 "
        "906ad37621d1 12b4868ac9b2 226efd5da69d d9ad9fbe49a1 f3b200daa7d8 "
        "8f09934dd0af 224e1513bb2d 4e8d885583c9 a449143636d0 f10e790483e9"
    ),
    "random fields in a storm, float32": (
        "5ee891ef7405 c2fb49bf9ae3 352fe46a2ed0 935d0ce93a21 0b6870592c36 "
        "eda3dd3db287 400860a4b4a9 edc9a31974cc e61a2db9cc88 aada78522f46 "
        "479efec76bf3 95c5c0170c5c 848ba5d539ce 219ea59c1a03 b22bb7716b37"
    ),
}  # The digests in the order of the outputs


def digests(name: str) -> dict[str, str]:
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
def test_every_machine_finds_the_same_bits(name):
    found = digests(name)
    assert found == dict(zip(found, EXPECTED[name].split(), strict=True))


if __name__ == "__main__":
    print(platform.machine())
    for batch in BATCHES:
        print(json.dumps({batch: digests(batch)}), flush=True)
