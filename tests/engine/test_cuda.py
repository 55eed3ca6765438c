"""The CUDA backend in Numba's simulator, compiled for a GPU, and on a GPU where there is one."""

import importlib.util
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from mbn_marl import BatchEngine, Uniform
from mbn_marl.config import make_config
from mbn_marl.engine.constants import constants_of, make_record
from mbn_marl.engine.mdp.observations import observation_table
from mbn_marl.engine.state import make_episode, make_memory, make_output
from mbn_marl.engine.tables import make_geometry, sizes_of
from mbn_marl.errors import ConfigError
from mbn_marl.field import FieldSampler, load_field
from mbn_marl.field.generator.layout import FAMILIES
from tests.support.pages import ROOT
from tests.support.problems import places_of
from tests.support.worlds import KINDS, OWN

pytestmark = pytest.mark.all
needs_gpu = pytest.mark.skipif(not torch.cuda.is_available(), reason="torch finds no GPU")
MOST_LOCAL_BYTES = 128
ARCHITECTURE = 8, 0  # the A100's; no GPU is needed to compile for it


@pytest.mark.parametrize(
    "part", ["features", "random_fields", "not features and not random_fields"]
)
def test_in_the_simulator(part):
    """Run a part of ``simulated_cuda.py``: the simulator is chosen when numba is imported."""
    tests = ["tests/support/simulated_cuda.py", "-k", part]
    run = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:xdist", *tests],
        cwd=ROOT,
        env=os.environ | {"NUMBA_ENABLE_CUDASIM": "1"},
        capture_output=True,
        text=True,
    )
    assert run.returncode == 0, run.stdout + run.stderr


@pytest.mark.skipif(torch.cuda.is_available(), reason="there is a GPU")
def test_cuda_that_is_missing_is_one_error():
    assert places_of(ConfigError, BatchEngine, "field_01", 2, device="cuda") == ["device"]


def test_no_kernel_is_optimised_at_link_time():
    from mbn_marl.engine import cuda_kernels

    # It would round the sum of a product once, which the machine code of the test below never has.
    assert cuda_kernels.infos.targetoptions["lto"] is False


def ptxas() -> str | None:
    nvidia = importlib.util.find_spec("nvidia")
    folders = [*nvidia.submodule_search_locations] if nvidia else []
    found = (str(path) for folder in folders for path in Path(folder).glob("*/bin/ptxas"))
    return next(found, None) or shutil.which("ptxas")


def compiled_kernels(dtype: Any, settings: dict[str, Any]) -> dict[str, str]:
    from numba import cuda, typeof, types

    from mbn_marl.engine import cuda_kernels as kernels

    settings = dict(settings)
    source = settings.pop("field", (load_field("field_01"),))
    sizes = sizes_of(source)
    vary = sizes.fewest_robots < 3
    config = make_config({"dtype": dtype, "n_robots": 3, **settings})
    real = np.dtype(dtype)
    p = constants_of(make_record(config, 3, sizes.arena, "same_step", teams_vary=vary))
    size = len(observation_table(config, 3, sizes.rois, sizes.arena, vary, sizes.kinds))
    worlds = 2
    g = make_geometry(source, config, 3, worlds, vary)
    now = make_episode(worlds, 3, config, vary)
    mem, out = make_memory(worlds, 3, 6, config, now), make_output(worlds, 3, size, config)
    actions, active = np.zeros((worlds, 3, 2), real), np.zeros(worlds, np.bool_)
    call = kernels.Call(actions, active, np.zeros(1, np.int64))
    rows = (np.zeros((worlds, 3, 13)),)
    work = {
        "step": (kernels.step_kernel(3, size, dtype), (p, g, mem, now, now, out, call)),
        "reset": (kernels.reset_kernel(size), (p, g, mem, now, out, call)),
        "infos": (kernels.infos, (p, g, mem, now, now, out, rows)),
        "states": (kernels.states, (now, (np.zeros((worlds, 13), real),))),
        "draw": (kernels.draw, (p, mem, (np.zeros((worlds, 3, 2), np.float32),))),
    }
    made = {}
    for name, (function, arguments) in work.items():
        signature = types.void(*map(typeof, arguments))
        with kernels.rounded_products():
            made[name], _ = cuda.compile_ptx(
                function.py_func, signature, cc=ARCHITECTURE, device=False
            )
    return made


@pytest.mark.parametrize(
    "settings",
    [
        {},
        {"reward": "formal"},
        {"observation": "lidar_local", "field": (KINDS,)},
        {"dynamics": "bicycle"},
        {"gust": 0.1, "action_delay": 2, "dropout": 0.1},
        {"dynamics": "bicycle", "failures": {"rate": 0.1}},
        {"condition": "storm", "v_clip": Uniform(4.0, 6.0)},
        {"field": FieldSampler(FAMILIES, robots=(1, 3))},
        {**OWN, "observation": "entities", "hidden_rois": True},
    ],
    ids=str,
)
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_kernels_become_machine_code(dtype, settings, monkeypatch, tmp_path):
    if importlib.util.find_spec("numba_cuda") is None or (assembler := ptxas()) is None:
        pytest.skip("numba-cuda or ptxas is not installed; `make cuda` installs both")
    from numba.cuda import dispatcher

    device = SimpleNamespace(compute_capability=ARCHITECTURE)
    monkeypatch.setattr(dispatcher, "get_current_device", lambda: device)
    for name, ptx in compiled_kernels(dtype, settings).items():
        depots = [int(size) for size in re.findall(r"__local_depot\d+\[(\d+)\]", ptx)]
        assert sum(depots) <= MOST_LOCAL_BYTES, name  # else arrays have left the registers
        assert not re.search(r"\.func|\bcall", ptx), name  # all is inlined
        # A product without a rounding mode may still be contracted when PTX becomes machine code.
        unrounded = re.findall(r"\b(?:mul|add|sub)\.f(?:32|64)", ptx)
        fused = re.findall(r"\bfma\S*", ptx)
        assert not unrounded, name
        assert not fused, name
        source = tmp_path / f"{name}.ptx"
        source.write_text(ptx)
        command = [assembler, "-v", f"-arch=sm_{ARCHITECTURE[0]}{ARCHITECTURE[1]}", source.name]
        run = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
        assert run.returncode == 0, (name, run.stderr)
        (registers,) = re.findall(r"Used (\d+) registers", run.stderr)
        stack, stores, loads = re.findall(r"(\d+) bytes (?:stack frame|spill)", run.stderr)
        print(
            f"{dtype} {settings} {name}: {registers} registers, {stack} bytes of local memory, "
            f"{stores} stored and {loads} loaded by spills"
        )


@needs_gpu
@pytest.mark.parametrize("dtype", ["float32", "float64"])
def test_equals_the_cpu_on_a_gpu_also_as_a_graph(dtype):
    settings = {"random_starts": True, "max_steps": 90, "dtype": dtype, "seed": 2}
    cpu = BatchEngine("field_03", 1000, **settings)
    gpu = BatchEngine("field_03", 1000, device="cuda", **settings)
    assert (gpu.reset().cpu().numpy() == cpu.reset()).all()
    graph, actions = None, None
    for t in range(400):
        if t == 200:
            graph = torch.cuda.CUDAGraph()
            with torch.cuda.graph(graph):
                actions = gpu.sample_actions()
                results = gpu.step(actions)
        if graph is None:
            actions = gpu.sample_actions()
            results = gpu.step(actions)
        else:
            graph.replay()
        drawn = cpu.sample_actions()
        assert (actions.cpu().numpy() == drawn).all()
        for expected, tensor in zip(cpu.step(drawn), results, strict=True):
            np.testing.assert_array_equal(tensor.cpu().numpy(), expected)
    np.testing.assert_array_equal(gpu.state().cpu().numpy(), cpu.state())


@needs_gpu
@pytest.mark.parametrize(
    "settings",
    [
        {"decoys": 12},
        {"hidden_rois": True, "comm_delay": 2, "comm_loss": 0.2, "comm_radius": 150.0},
    ],
    ids=str,
)
def test_own_knowledge_in_random_fields_equals_the_cpu_on_a_gpu(settings):
    own = {"knowledge": "own", "observation": "entities", "sensing_radius": 100.0, "max_steps": 150}
    fields = FieldSampler(robots=5, rois=24, size=700, seed=4)
    cpu = BatchEngine(fields, 1024, seed=3, **own, **settings)
    gpu = BatchEngine(fields, 1024, seed=3, device="cuda", **own, **settings)
    expected = (cpu.reset(),)
    found = (gpu.reset(),)
    for _ in range(200):
        for one, tensor in zip(expected, found, strict=True):
            np.testing.assert_array_equal(tensor.cpu().numpy(), one)
        actions = cpu.sample_actions()
        expected = *cpu.step(actions), cpu.team_rewards, cpu.state()
        found = *gpu.step(torch.from_numpy(actions).cuda()), gpu.team_rewards, gpu.state()
