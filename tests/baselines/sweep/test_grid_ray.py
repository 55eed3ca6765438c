"""Grids and studies on a real Ray cluster on this machine, of several nodes; one is lost."""

import json
import subprocess
import time
from contextlib import suppress
from pathlib import Path
from typing import Any

import psutil
import pytest
import yaml

from baselines.runs.files import LOCK, read_json
from baselines.runs.folder import RunFolder
from baselines.sweep.processes import LocalEngine
from baselines.sweep.run import train_runs
from baselines.sweep.spec import read_spec, runs_of
from tests.support.pages import MBN
from tests.support.runs import recorded, same_policies

pytestmark = [pytest.mark.slow, pytest.mark.all]
cluster_utils = pytest.importorskip("ray.cluster_utils", reason="needs the extra [ray]")

NODE = {"num_cpus": 1, "object_store_memory": 80 * 2**20}
GRID = {
    "algorithms": ["a2c", "ppo"],
    "fields": ["field_03"],
    "settings": ["A"],
    "seeds": list(range(12)),
    "set": {"environment.max_steps": [50], "model.n_steps": [64]},
    "budget": {"steps": 320, "evaluate_every": 64, "episodes": 2},
}


@pytest.fixture(scope="module")
def cluster():
    head = {**NODE, "num_cpus": 0, "include_dashboard": False}
    patch = pytest.MonkeyPatch()
    patch.setenv("RAY_worker_niceness", "0")
    made = cluster_utils.Cluster(initialize_head=True, head_node_args=head)
    try:
        for _ in range(3):
            made.add_node(**NODE)
        yield made
    finally:
        made.shutdown()
        patch.undo()


def spec_in(folder: Path) -> Path:
    path = folder / "grid.yaml"
    path.parent.mkdir(exist_ok=True)
    path.write_text(yaml.safe_dump({"store": str(folder / "runs"), **GRID}))
    return path


def busy_node(cluster: Any, store: Path) -> tuple[Any, psutil.Process, str] | None:
    if len([*store.glob("*/evaluation.json")]) < 4:
        return None
    for lock in store.glob(f"*/{LOCK}"):
        with suppress(OSError, ValueError, psutil.Error):  # it may end meanwhile
            process = psutil.Process(json.loads(lock.read_text())["pid"])
            process.suspend()
            folder = RunFolder(lock.parent)
            parents = [parent.pid for parent in process.parents()]
            for node in cluster.worker_nodes:
                inside = node.all_processes["raylet"][0].process.pid in parents
                if inside and folder.checkpoint is not None and not folder.finished:
                    return node, process, lock.parent.name
            process.resume()
    return None


def test_a_grid_survives_the_loss_of_a_node(cluster, tmp_path):
    here, there = (spec_in(tmp_path / name) for name in ("local", "ray"))
    local = read_spec(here)
    train_runs(runs_of(local), local.store, LocalEngine(1))
    store, words = there.parent / "runs", ["grid", str(there), "--engine", "ray"]
    words += ["--address", cluster.address]
    driver = subprocess.Popen([*MBN, *words], stdout=subprocess.PIPE, text=True)
    try:
        deadline = time.monotonic() + 300.0
        while (found := busy_node(cluster, store)) is None:
            assert driver.poll() is None, "the grid was over before a node could be lost"
            assert time.monotonic() < deadline
            time.sleep(0.005)
        node, process, victim = found
        done = {file: file.stat().st_mtime_ns for file in store.glob("*/evaluation.json")}
        cluster.remove_node(node, allow_graceful=False)
        process.kill()  # with its node: held still, it would not notice
        said, _ = driver.communicate(timeout=300)
    finally:
        driver.kill()
    assert driver.returncode == 0
    names = [run.name for run in runs_of(read_spec(there))]
    ended = sorted(line for line in said.splitlines() if "seed" in line)
    assert len(names) == 24
    assert ended == sorted(f"{name}: done" for name in names), "each once, all done"
    assert {file: file.stat().st_mtime_ns for file in done} == done, "a finished run was repeated"
    resumed = {file.parent.name: read_json(file) for file in store.glob("*/resumed.json")}
    assert resumed.keys() == {victim}
    assert [entry["env_steps"] > 0 for entry in resumed[victim]] == [True]
    for name in names:
        ours, theirs = RunFolder(store / name), RunFolder(here.parent / "runs" / name)
        assert recorded(ours) == recorded(theirs), name
        assert same_policies(ours, theirs), name


@pytest.mark.parametrize("address", ["127.0.0.1:9", "nonsense"])
def test_a_cluster_that_is_not_there_is_named(address, tmp_path, refusal):
    words = ["grid", str(spec_in(tmp_path)), "--engine", "ray", "--address", address]
    assert address in refusal(words)
