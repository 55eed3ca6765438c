"""Grids and studies on a real Ray cluster on this machine, of several nodes; one is lost."""

from __future__ import annotations

import json
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import optuna
import psutil
import pytest
import yaml

from baselines.cli import main
from baselines.runs.folder import RunFolder
from baselines.sweep.processes import LocalEngine
from baselines.sweep.run import Sweep
from baselines.sweep.spec import read_spec
from baselines.sweep.status import Status
from baselines.tuning.study import open_study
from tests.support.runs import recorded, same_policies
from tests.support.terminal import MBN

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
def cluster() -> Iterator[Any]:
    """A head that only schedules, and three nodes with a core each."""
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
    """The file of the grid with its store in ``folder``."""
    path = folder / "grid.yaml"
    path.parent.mkdir(exist_ok=True)
    path.write_text(yaml.safe_dump({"store": str(folder / "runs"), **GRID}))
    return path


def busy_node(cluster: Any, sweep: Sweep) -> tuple[Any, psutil.Process, str] | None:
    """A node that trains a cell past a checkpoint, the process, held still, and the cell."""
    status = Status.of(sweep)
    if status.count("done") < 4:
        return None
    for one in status.runs:
        if one.standing != "running" or one.note is None:
            continue
        process = psutil.Process(one.note.process)
        process.suspend()
        folder = RunFolder(sweep.store.folder(one.run.name))
        parents = [parent.pid for parent in process.parents()]
        for node in cluster.worker_nodes:
            inside = node.all_processes["raylet"][0].process.pid in parents
            if inside and folder.checkpoint is not None and not folder.finished:
                return node, process, one.run.name
        process.resume()
    return None


def test_a_grid_survives_the_loss_of_a_node(cluster: Any, tmp_path: Path) -> None:
    here = Sweep.of(read_spec(spec_in(tmp_path / "local")))
    assert len(here.runs) == 24
    here.train(LocalEngine(1))

    spec = spec_in(tmp_path / "ray")
    sweep = Sweep.of(read_spec(spec))
    words = ["grid", str(spec), "--engine", "ray", "--address", cluster.address]
    driver = subprocess.Popen([*MBN, *words], stdout=subprocess.PIPE, text=True)
    try:
        deadline = time.monotonic() + 300.0
        while (found := busy_node(cluster, sweep)) is None:
            assert driver.poll() is None, "the grid was over before a node could be lost"
            assert time.monotonic() < deadline
            time.sleep(0.005)
        node, process, victim = found
        notes = sweep.store.notes()
        done = {name: note for name, note in notes.items() if note.state == "done"}
        cluster.remove_node(node, allow_graceful=False)
        process.kill()  # with its node: held still, it would not notice
        said, _ = driver.communicate(timeout=300)
    finally:
        driver.kill()
    assert driver.returncode == 0

    ended = sorted(line for line in said.splitlines() if "seed" in line)
    assert ended == sorted(f"{name}: done" for name in sweep.names), "each once, all done"
    notes = sweep.store.notes()
    assert {name: notes[name] for name in done} == done, "what was done was touched again"
    again = {name for name in sweep.names if notes[name].attempt > 1}
    assert again == {victim} and notes[victim].attempt == 2
    history = json.loads((sweep.store.folder(victim) / "resumed.json").read_text())
    assert [entry["env_steps"] > 0 for entry in history] == [True]
    for name in sweep.names:
        ours, theirs = (RunFolder(one.store.folder(name)) for one in (sweep, here))
        assert recorded(ours) == recorded(theirs), name
        assert same_policies(ours, theirs), name

    notes = sweep.store.notes()
    assert main(words) == 0
    assert sweep.store.notes() == notes, "a finished grid has nothing left to do"


def test_workers_share_a_study(cluster: Any, tmp_path: Path) -> None:
    out = tmp_path / "study"
    database = f"sqlite:///{tmp_path / 'trials.db'}"
    tiny = ["--field", "field_03", "--steps", "20", "--evaluate-every", "20", "--episodes", "1"]
    words = ["tune", "a2c", *tiny, "--out", str(out), "--engine", "ray"]
    words += ["--address", cluster.address, "--database", database]
    assert main([*words, "--trials", "4"]) == 0
    trials = open_study(out).get_trials()
    assert [trial.state.name for trial in trials] == ["COMPLETE"] * 4
    assert len({trial.params["learning_rate"] for trial in trials}) == 4
    assert optuna.load_study(study_name="study", storage=database).best_value is not None
    assert main([*words, "--trials", "5", "--resume"]) == 0
    assert len(open_study(out).get_trials()) == 5


@pytest.mark.parametrize("address", ["127.0.0.1:9", "nonsense"])
def test_a_cluster_that_is_not_there_is_named(
    address: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    spec = spec_in(tmp_path)
    assert main(["grid", str(spec), "--engine", "ray", "--address", address]) == 2
    assert address in capsys.readouterr().err
