"""Policies without learning, and their commands."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from baselines.cli import main
from baselines.evaluation.evaluate import evaluate
from baselines.policies.classical import make_classical
from mbn_marl import BatchEngine
from mbn_marl.config import Failures
from mbn_marl.episode import check_episode, load_episode
from mbn_marl.field import load_field
from mbn_marl.planning import plan

pytestmark = pytest.mark.slow
FIELD = load_field("field_03")


@pytest.mark.parametrize(("name", "makespan"), [("greedy", 22), ("planner", 17), ("replan", 17)])
def test_classical_policies(name: str, makespan: int) -> None:
    summary = evaluate(make_classical(name, FIELD, {}), FIELD, {}, episodes=3).summary()
    assert (summary["success_rate"], summary["wall_hits"]) == (1.0, 0.0)
    assert 17.0 <= summary["makespan"] <= makespan + (name == "greedy")


WINDS = tuple({"wind": wind} for wind in ((0.35, 0), (0.35, 90), (0.2, 215)))
FAULTS = tuple({"failures": Failures(at={i: t})} for i, t in ((0, 5), (1, 8), (2, 7), (2, 12)))


@pytest.mark.parametrize(("name", "most"), [("greedy", 36), ("replan", 31)])
@pytest.mark.parametrize("worlds", [WINDS, FAULTS], ids=["windy", "failing"])
def test_a_policy_finds_out_what_each_of_its_worlds_is_like(
    name: str, most: int, worlds: tuple[dict[str, Any], ...]
) -> None:
    policy = make_classical(name, FIELD, worlds[0])
    engines = [BatchEngine(FIELD, 1, autoreset="disabled", **world) for world in worlds]
    for engine in engines:
        engine.reset()
    for _ in range(most):
        states = np.concatenate([engine.state() for engine in engines])
        actions = policy.act(states, deterministic=True)
        for engine, action in zip(engines, actions, strict=True):
            assert not action[engine.failed[0]].any()
            if engine.running[0]:
                engine.step(action[None])
    assert [engine.snapshot().success for engine in engines] == [True] * len(worlds)


def test_replan_does_what_plan_does_while_nothing_disturbs_it() -> None:
    found, engine = plan("field_06"), BatchEngine("field_06", 1, autoreset="disabled", threads=1)
    policy = make_classical("replan", found.field, {})
    engine.reset()
    for actions in found.actions:
        np.testing.assert_array_equal(policy.act(engine.state(), deterministic=True)[0], actions)
        engine.step(actions[None])
    assert engine.snapshot().success


def test_mbn_plan_prints_draws_and_saves(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "plan"
    assert main(["plan", "field_03", "-o", str(out)]) == 0
    printed = capsys.readouterr().out
    assert "17 steps" in printed and "yes, proved" in printed
    saved = json.loads((out / "plan.json").read_text())
    assert (saved["makespan"], saved["optimal"], saved["return"]) == (17, True, 159_490.0)
    assert (out / "plan.png").read_bytes()[:4] == b"\x89PNG"
    visits = ", ".join(f"w{roi + 1}" for roi in saved["assignment"][0])
    assert visits in printed, "numbered as in the picture"
    episode = load_episode(out / "episode.json")
    check_episode(episode)
    assert (episode.source, episode.outcome) == ("plan, proved optimal", "success")
    assert (episode.steps, episode.team_return) == (17, 159_490.0)
    with np.load(out / "plan.npz") as arrays:
        assert arrays["actions"].shape == (17, 3, 2)
    before = sorted(tmp_path.iterdir())
    assert main(["plan", "field_03", "-o", str(out)]) == 2
    assert str(out) in capsys.readouterr().err
    for wrong in (["--n-robots", "9"], ["--time-limit", "-1"], ["--wind", "nan", "0"]):
        assert main(["plan", "field_03", *wrong, "-o", str(out), "--force"]) == 2
        assert wrong[0][2:].replace("-", "_") in capsys.readouterr().err
    assert sorted(tmp_path.iterdir()) == before


def test_mbn_evaluate_takes_classical_policies(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "result.json"
    words = ["--field", "field_03", "--episodes", "2", "--json", str(out)]
    assert main(["evaluate", "planner", *words]) == 0
    assert "0.00%" in capsys.readouterr().out
    result = json.loads(out.read_text())
    assert result["optimum"] == 159_490.0
    assert result["optimality_gap"] == {"stochastic": 0.0, "deterministic": 0.0}
    assert main(["evaluate", "greedy"]) == 2
    assert "field" in capsys.readouterr().err
