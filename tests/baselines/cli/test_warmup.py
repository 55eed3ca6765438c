"""``mbn warmup`` compiles what the forms use; compilation is announced."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from mbn_marl.jit.compile import ANNOUNCEMENT

pytestmark = pytest.mark.slow

PROBE = """
import json
import numpy as np
from numba.core.registry import CPUDispatcher
from baselines.cli import main
from mbn_marl import BatchEngine, centralized_env, parallel_env
from mbn_marl.adapters.sb3 import SharedPolicyVecEnv
from mbn_marl.engine import kernels, step

def compiled():
    functions = [value for module in (kernels, step) for value in vars(module).values()]
    entries = [each for each in functions if type(each) is CPUDispatcher]
    return {each.__name__: sorted(map(str, each.signatures)) for each in entries}

assert main(["warmup"]) == 0
before = compiled()
settings = {"wind": (0.1, 30.0)}
parallel = parallel_env("field_07", **settings)
parallel.reset(seed=0)
parallel.step({agent: parallel.action_space(agent).sample() for agent in parallel.agents})
parallel.state()
alone = centralized_env("field_07", **settings)
alone.reset(seed=0)
alone.step(alone.action_space.sample())
rows = SharedPolicyVecEnv("field_07", 600, **settings)
rows.reset()
rows.step(np.zeros((1800, 2), np.float32))
engine = BatchEngine("field_07", 600, threads=2)
engine.reset(seed=0)
engine.step(engine.sample_actions())
engine.metrics()
print(json.dumps([before, compiled()]))
"""


def test_the_forms_find_all_compiled() -> None:
    done = subprocess.run([sys.executable, "-c", PROBE], capture_output=True, text=True, check=True)
    seconds, found = done.stdout.splitlines()
    assert seconds.startswith("relative, calm: ")
    before, after = json.loads(found)
    assert {"reset_worlds", "step_worlds", "step_ranges"} < set(before)
    assert all(before.values())
    assert after == before


def test_compilation_is_announced_once(tmp_path: Path) -> None:
    code = "from mbn_marl.engine.kernels import all_finite as f; import numpy as np; "
    code += "[f(np.zeros(2, kind)) for kind in ('f4', 'f8')]"
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    said = [
        subprocess.run(
            [sys.executable, "-c", code],
            env=environment,
            capture_output=True,
            text=True,
            check=True,
        ).stderr
        for _ in range(2)
    ]
    assert said == [f"{ANNOUNCEMENT % 'all_finite'}\n", ""]
