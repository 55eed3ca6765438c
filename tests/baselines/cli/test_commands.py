"""The command line: what it prints, what it writes, and how it refuses."""

import csv
import json
import os
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from baselines.cli import main
from mbn_marl import load_field
from mbn_marl.config import make_config
from mbn_marl.episode import load_episode, play, save_episode
from mbn_marl.field import generate
from mbn_marl.jit.compile import ANNOUNCEMENT
from tests.support.records import make_run

CATALOGUE = Path(__file__).parents[3] / "envs_catalog"
TINY = ("--steps", "1", "--evaluate-every", "4096", "--episodes", "2")
pytestmark = pytest.mark.slow


def test_train_records_the_run_and_evaluate_repeats_its_evaluation(tmp_path, refusal):
    run, out = tmp_path / "run", tmp_path / "result.json"
    small = ["--set", "num_worlds=4", "rollout_steps=16", "hidden=[8]"]
    words = ["train", "ippo", "field_03", *TINY, "--seed", "7", *small, "--out", str(run)]
    assert main(words) == 0
    config = json.loads((run / "config.json").read_text())
    assert (config["algorithm"], config["field"], config["seed"]) == ("ippo", "field_03", 7)
    assert (run / "command.txt").read_text() == f"{shlex.join(['mbn', *words])}\n"
    with (run / "progress.csv").open(newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["env_steps"] for row in rows] == ["64"]  # one rollout of 16 steps in 4 worlds
    text = (run / "evaluation.json").read_text()
    final = json.loads(text)
    assert "--force" in refusal(words)
    assert (run / "evaluation.json").read_text() == text
    assert main(["evaluate", str(run), "--episodes", "20", "--json", str(out)]) == 0
    result = json.loads(out.read_text())
    assert result["stochastic"] == final["stochastic"]
    assert result["deterministic"]["return_mean"] == final["deterministic"]["return_mean"]
    assert main(["evaluate", str(run), "--episodes", "1", "--json", str(out)]) == 2
    assert json.loads(out.read_text()) == result, "nothing is written over"


@pytest.mark.parametrize(
    ("words", "places"),
    [
        ("train pppo feld_03 --seed -1 --label a/b", ["seed: ", "label: ", "pppo: ", "feld_03: "]),
        ("train ippo field_03 --set gama=1 clip=x", ["gama: ", "clip: "]),
        ("train ippo field_03 --set environment.max_step=5", ["max_step: "]),
        (f"compare --fields field_03 {CATALOGUE}/field_03.yaml", ["two are named field_03"]),
        ("compare --processes 0 --force --resume", ["processes: ", "force and resume: "]),
        ("compare --processes 0 --variants none.yaml", ["processes: ", "none.yaml: "]),
        ("compare --resume --out none", ["none"]),
        ("benchmark nope --tiers 9-x --force --resume", ["force and", "nope: ", "'9-x'"]),
        ("plan field_03 --n-robots 9 --time-limit nan", ["n_robots: ", "time_limit: "]),
        (
            "compare --algos pppo ppo ppo --fields feld_03 --seeds 0 0",
            ["algorithms: ", "seeds: ", "pppo: ", "feld_03: "],
        ),
        (
            "compare --algos ppo:Q mappo:C ippo --fields feld_03 --seeds 0 0",
            ["ppo: setting: 'Q'", "mappo: setting: 'C'", "seeds: ", "feld_03: "],
        ),
        ("evaluate greedy", ["--field"]),
        ("evaluate greddy --field field_03", ["greddy: unknown policy (did you mean greedy?)"]),
        ("render greddy --field field_03 -o a.json", ["greddy: unknown policy"]),
        ("evaluate nowhere", ["nowhere"]),
        ("evaluate runs/nope", ["runs/nope: there is no such folder\n"]),
        ("render field_03 -o picture.bmp", [".png"]),
        ("replay none.json -o a.html", ["none.json: "]),
        ("zoo -o folder", ["out: "]),
        ("fields field_03 --seed 2 -o out", ["seed, out: "]),
        ("fields --count 2 --seed 3", ["seed: ", "count: "]),
        ("fields field_03 --generate farm --count 0", ["generate: ", "count: "]),
        ("fields field_03 --from a.wkt --size 9 10 -o a.png", ["size: ", "from: ", "out: "]),
        ("fields --generate farm --metres-per-unit 2", ["metres_per_unit: "]),
        ("fields --generate farm farm", ["generate: farm, farm"]),
        ("fields --generate farm --out some --figure a.txt", ["a.txt"]),
        ("evaluate greedy --field field_03 --seed -1", ["seed: -1"]),
        ("evaluate greedy --field field_03 --json a --record a", ["json and record: "]),
        ("plan field_03 --write", ["write: "]),
        (f"plan {CATALOGUE}/field_03.yaml --wind 0.1 0 --write", ["write: "]),
        ("transfer ippo", ["settings: "]),
        ("transfer ppo --fields field_01", ["fields: "]),
        ("transfer ppo --source-steps 0", ["source_steps: "]),
        (f"train ppo field_02 --seed {2**32}", ["seed: "]),
        ("train ppo field_02 --setting C", ["--from"]),
        ("train ppo field_02 --setting C --from x", ["x is not a run folder"]),
        ("train ppo field_02 --from x", ["from: "]),
        ("train ppo-shared field_02 --setting A", ["setting: "]),
        ("train ppo field_02 --num-envs 0", ["num_envs: "]),
        ("train crossq-sbx field_02 --device cuda", ["device: JAX"]),
        ("train ippo field_02 --set num_worlds=70000 hidden=[99999]", ["num_worlds", "hidden"]),
        ("train ppo field_02 --hyperparams x.yaml", ["x.yaml: "]),
        ("train ppo field_02 --resume --out x", ["x is not a run folder"]),
        ("tune sac", ["sac: "]),
        ("tune ippo", ["ippo"]),
        ("tune ppo --trials 0", ["trials: "]),
        (
            "tune ppo --trials 0 --processes 0 --field feld_03",
            ["trials: ", "processes: ", "feld_03: "],
        ),
        ("tune ppo --resume", ["is not the folder of a study"]),
    ],
)
def test_all_problems_are_named_at_once(words, places, tmp_path, refusal):
    error = refusal(words.split())
    assert error.count("\n  - ") in (0, len(places)), error
    assert all(place in error for place in places), error
    assert not list(tmp_path.iterdir())


def test_runs_are_listed_with_their_state(tmp_path, capsys, refusal, monkeypatch):
    names = ("finished", "going", "begun", "damaged")
    paths = {name: make_run(tmp_path, label=name, seed=7).run.path for name in names}
    for name in ("going", "begun"):
        (paths[name] / "evaluation.json").unlink()
    (paths["going"] / "checkpoints" / "000000000300").mkdir(parents=True)
    (paths["begun"] / "evaluations.json").write_text("[]")
    (paths["damaged"] / "evaluation.json").write_text('{"stochastic": {}}')
    (paths["going"] / "evaluations.json").write_text(
        '[{"success_rate": 0.25, "makespan": null, "return_mean": 1.0}]'
    )
    (tmp_path / "stray").mkdir()
    (tmp_path / "stray" / "field.yaml").touch()
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("COLUMNS", "0")  # no width
    assert main(["runs", "."]) == 0
    lines = {
        line.split()[0].split("/")[-1].split("-")[0]: line
        for line in capsys.readouterr().out.splitlines()
        if "-field_03-7-" in line
    }
    end = {name: line.split(maxsplit=1)[1].split() for name, line in lines.items()}
    assert end["finished"] == ["mappo", "field_03", "7", "50.0%", "20.0", "finished"]
    assert end["going"] == ["mappo", "field_03", "7", "25.0%", "-", "300", "of", "400", "env-steps"]
    assert end["begun"] == ["mappo", "field_03", "7", "-", "-", "begun"]
    assert "success_rate" in lines["damaged"]
    assert "nowhere" in refusal(["runs", "nowhere"])


PROBE = """
import json
from numba.core.registry import CPUDispatcher
from baselines.cli import main
from mbn_marl import BatchEngine, parallel_env
from mbn_marl.engine import kernels, step

def compiled():
    functions = [value for module in (kernels, step) for value in vars(module).values()]
    entries = [each for each in functions if type(each) is CPUDispatcher]
    return {each.__name__: sorted(map(str, each.signatures)) for each in entries}

assert main(["warmup"]) == 0
before = compiled()
parallel = parallel_env("field_07", wind=(0.1, 30.0))
parallel.reset(seed=0)
parallel.step({agent: parallel.action_space(agent).sample() for agent in parallel.agents})
parallel.state()
engine = BatchEngine("field_07", 600, threads=2)
engine.reset(seed=0)
engine.step(engine.sample_actions())
engine.metrics()
print(json.dumps([before, compiled()]))
"""


def test_warmup_compiles_all_that_environments_use():
    done = subprocess.run([sys.executable, "-c", PROBE], capture_output=True, text=True, check=True)
    seconds, found = done.stdout.splitlines()
    assert seconds.startswith("relative, calm: ")
    before, after = json.loads(found)
    assert {"reset_worlds", "step_worlds", "step_ranges"} < set(before)
    assert [name for name in before if not before[name]] == ["write_heard"]  # a replay's
    assert after == before


def test_compilation_is_announced_once(tmp_path):
    code = "from mbn_marl.engine.kernels import all_finite as f; import numpy as np; "
    code += "[f(np.zeros(2, kind)) for kind in ('f4', 'f8')]"
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    how = {"env": environment, "capture_output": True, "text": True, "check": True}
    said = [subprocess.run([sys.executable, "-c", code], **how).stderr for _ in range(2)]
    assert said == [f"{ANNOUNCEMENT % 'all_finite'}\n", ""]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory):
    path = tmp_path_factory.mktemp("episodes") / "learned.json"
    assert main(["render", "zoo:field_03", "-o", str(path)]) == 0
    return path


def test_replay_writes_a_page_and_nothing_over_another(recorded, tmp_path, capsys, refusal):
    other = save_episode(
        play(load_field("field_03"), make_config({}), np.zeros((3, 3, 2)), source="waiting"),
        tmp_path / "waiting.json",
    )
    out = tmp_path / "page.html"
    episode = load_episode(recorded)
    assert (episode.outcome, episode.source, episode.seed) == ("success", "zoo:field_03", 0)
    assert episode.field == load_field("field_03") and episode.rois_visited == 6
    assert main(["replay", str(recorded), str(other), "-o", str(out)]) == 0
    assert "zoo:field_03: success" in capsys.readouterr().out
    text = out.read_text()
    assert f"waiting ({other})" in text
    assert "://" not in text.replace("http://www.w3.org/2000/svg", "")
    assert "page.html" in refusal(["replay", str(other), "-o", str(out)])
    assert "at least one" in refusal(["replay", "-o", str(out), "--force"])
    assert out.read_text() == text


def test_render_shows_a_recorded_episode(recorded, tmp_path, refusal):
    for name, start in (("a.gif", b"GIF89a"), ("a.pdf", b"%PDF"), ("a.svg", b"<?xml")):
        assert main(["render", str(recorded), "-o", str(tmp_path / name)]) == 0
        assert (tmp_path / name).read_bytes().startswith(start)
    assert "steps" in refusal(["render", str(recorded), "--steps", "3", "-o", "b.gif"])
    (tmp_path / "foreign.json").write_text('{"type": "other"}')
    assert "foreign.json" in refusal(["render", "foreign.json", "-o", "b.gif"])
    assert not (tmp_path / "b.gif").exists()


def test_evaluate_records_its_best_median_and_worst(tmp_path):
    source = ["random", "--field", "field_07"]
    out, results = tmp_path / "episodes", tmp_path / "results.json"
    command = ["evaluate", *source, "--episodes", "5", "--seed", "3", "--record", str(out)]
    assert main([*command, "--json", str(results)]) == 0
    returns = sorted(json.loads(results.read_text())["stochastic"]["per_episode"]["returns"])
    found = [load_episode(out / f"{name}.json") for name in ("worst", "median", "best")]
    assert [one.team_return for one in found] == [returns[0], returns[2], returns[4]]
    assert [one.source for one in found] == [
        f"random in field_07, sampled actions, {name}" for name in ("worst", "median", "best")
    ]
    assert main(command) == 2, "the folder is there already"


def test_fields_are_listed_and_drawn(tmp_path, capsys):
    out = tmp_path / "fields.pdf"
    assert main(["fields", "field_03", "field_05", "--figure", str(out)]) == 0
    lines = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert ["field_03", "3", "6", "0", "4", "10,800", "17", "159,490"] in lines
    assert out.read_bytes().startswith(b"%PDF")
    assert main(["fields", "--figure", str(out)]) == 2
    assert "field_" not in capsys.readouterr().out


def test_random_fields_are_made(tmp_path, capsys):
    out = tmp_path / "fields"
    words = ["fields", "--generate", "farm", "concave", "--seed", "7", "--count", "2"]
    assert main([*words, "--robots", "4", "--size", "150", "160", "-o", str(out)]) == 0
    assert "4 written to" in capsys.readouterr().out
    made = [load_field(path) for path in sorted(out.iterdir())]
    assert [field.name for field in made] == ["concave-7", "concave-8", "farm-7", "farm-8"]
    assert made[3] == generate("farm", 8, robots=4, size=(150, 160))
    (out / "farm-7.yaml").unlink()
    assert main([*words, "-o", str(out)]) == 2
    refused = capsys.readouterr()
    assert refused.err.count("already exists") == 3 and not refused.out
    assert not (out / "farm-7.yaml").exists()


OWN = """
import numpy as np

class Turns:
    def __init__(self, field):
        self.settings = {"wind": (0.2, 90.0)}

    def act(self, seen, deterministic=True):
        return np.ones((*seen.shape[:2], 2), np.float32)
"""
RENDER, EVALUATE = "render -o a.json --steps 1", "evaluate --episodes 1 --record records"


def test_episodes_are_of_the_policy_the_field_and_the_wind_that_are_named(tmp_path, monkeypatch):
    (tmp_path / "turning.py").write_text(OWN)
    monkeypatch.chdir(tmp_path)
    source = ["turning:Turns", "--field", "field_05"]
    for asked, wind in (([], (0.2, 90.0)), (["--wind", "0.1", "30"], (0.1, 30.0))):
        for words, path in ((RENDER, "a.json"), (EVALUATE, "records/best.json")):
            assert main([*words.split(), *source, *asked, "--force"]) == 0
            episode = load_episode(path)
            assert (episode.field.name, episode.config.wind) == ("field_05", wind)
            assert "turning:Turns" in episode.source and (wind[0] == 0.2 or "30" in episode.source)
    windy = [*RENDER.split(), "--condition", "windy", "--force"]
    assert main([*windy, "greedy", "--field", "field_03"]) == 0
    assert "windy" in load_episode("a.json").source
