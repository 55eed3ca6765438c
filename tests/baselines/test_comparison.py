"""Comparisons: statistics by hand, what may be compared, and going on after an interruption."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from rich.console import Console
from scipy import stats

from baselines.cli import main
from baselines.compare import aggregate as stratified
from baselines.compare.aggregate import Estimate
from baselines.compare.results import Result, Results, find_results
from baselines.compare.run import CompareConfig, train_all_runs
from baselines.compare.summary import THRESHOLDS, summarise
from baselines.compare.tables import print_comparison
from baselines.compare.variants import Variant, parse_variants, read_variants
from baselines.runs.files import RunError, read_json, write_json
from baselines.runs.folder import RunFolder
from baselines.training.config import DivergenceError, TrainConfig
from baselines.training.overrides import parse, words_of
from baselines.training.progress_bar import Report
from baselines.training.train import train
from mbn_marl.config import NavigationConfig
from mbn_marl.errors import ConfigError
from mbn_marl.field import Field, load_field

OPTIMA = {"field_01": 158_800.0, "field_03": 159_490.0}

# ---------------------------------------------------------------- statistics


def test_the_interquartile_mean_cuts_a_quarter_at_both_ends() -> None:
    # Eight runs: two go at each end, and 1, 2, 3, 4 stay. Of five runs one goes at each end.
    scores = np.array([[0.0, 100.0, 3.0, 9.0], [1.0, 4.0, 2.0, -50.0]])
    assert stratified.interquartile_mean(scores).value == np.mean([1.0, 2.0, 3.0, 4.0])
    assert stratified.interquartile_mean(np.array([[9.0, 1.0, 2.0, 3.0, 70.0]])).value == 14.0 / 3.0


def test_the_optimality_gap_is_the_mean_shortfall() -> None:
    # Short of 1 by 0.5, 0, 0 (not -1) and 3.
    assert stratified.optimality_gap(np.array([[0.5, 1.0], [2.0, -2.0]])).value == 0.875


def test_a_resample_stays_within_each_field() -> None:
    # Fields far apart, their runs equal: whatever is drawn, the mean is the same. Runs drawn
    # across fields would give means from 0 to 1.
    scores = np.array([[0.0, 0.0, 0.0], [1.0, 1.0, 1.0]])
    assert stratified.optimality_gap(scores) == Estimate(0.5, 0.5, 0.5)


def test_an_interval_by_hand() -> None:
    # One field with runs 0 and 1: a resample's gap is 1, 0.5 or 0 with probability 1/4, 1/2, 1/4.
    assert stratified.optimality_gap(np.array([[0.0, 1.0]])) == Estimate(0.5, 0.0, 1.0)
    # Two such fields: the mean of two, 0 and 1 with 1/16 each, more than 2.5 %.
    assert stratified.optimality_gap(np.array([[0.0, 1.0]] * 2)) == Estimate(0.5, 0.0, 1.0)
    # Three: 0 and 1 with 1/64 each, less than 2.5 %; 1/6 and less with 1/64 + 6/64.
    low, high = stratified.optimality_gap(np.array([[0.0, 1.0]] * 3))[1:]
    assert (low, high) == pytest.approx((1 / 6, 5 / 6))


def test_the_interval_is_the_bootstrap_of_scipy_in_one_field() -> None:
    scores = np.random.default_rng(1).normal(0.5, 0.1, (1, 12))
    ours = stratified.interquartile_mean(scores)
    theirs = stats.bootstrap(
        (scores[0],),
        lambda runs, axis: stats.trim_mean(runs, 0.25, axis=axis),
        n_resamples=10_000,
        method="percentile",
        rng=np.random.default_rng(2),
    ).confidence_interval
    assert ours[1:] == pytest.approx((theirs.low, theirs.high), abs=0.01)


def test_one_seed_has_no_interval() -> None:
    scores = np.array([[0.2], [0.4]])
    assert stratified.interquartile_mean(scores) == pytest.approx((0.3, None, None))
    assert stratified.probability_of_improvement(scores, scores) == Estimate(0.5, None, None)
    assert stratified.performance_profile(scores, np.array([0.3])).share.tolist() == [0.5]


def test_the_probability_of_improvement_compares_within_each_field() -> None:
    # Field 0: ours win 3 of 4 pairs and tie the other; field 1: they lose all.
    ours, theirs = np.array([[2.0, 5.0], [10.0, 10.0]]), np.array([[1.0, 2.0], [99.0, 99.0]])
    value, low, high = stratified.probability_of_improvement(ours, theirs)
    assert value == (3.5 / 4 + 0.0) / 2
    # The most that can be drawn is a win of all pairs of field 0: 1/2. The least is (2, 2)
    # against (2, 2), probability 1/16, which ties: 1/4.
    assert (low, high) == (0.25, 0.5)
    back = stratified.probability_of_improvement(theirs, ours)
    assert back.value == 1.0 - value


def test_the_performance_profile_counts_runs_above() -> None:
    scores = np.array([[0.0, 0.5], [0.5, 1.0]])
    profile = stratified.performance_profile(scores, np.array([-1.0, 0.0, 0.5, 0.9, 1.0]))
    assert profile.share.tolist() == [1.0, 0.75, 0.25, 0.25, 0.0]
    # Above 0.9: the second field's runs are drawn 0.5 twice, once, or never, 1/4, 1/2, 1/4.
    assert (profile.low[3], profile.high[3]) == (0.0, 0.5)
    assert (profile.low[0], profile.high[0]) == (1.0, 1.0)


# ---------------------------------------------------------------- results


def _made_up(share: float, field: Field, seed: int) -> tuple[list[dict[str, Any]], dict[str, Any]]:
    """Evaluations and the final one of a run that reaches ``share``."""
    best = share * OPTIMA.get(field.name, 150_000.0)
    always = float(share > 0.7)
    final = {
        "env_steps": 400,
        "seconds": 10.0 + seed,
        "stochastic": {"return_mean": best / 2, "success_rate": share, "makespan": 20.0},
        "deterministic": {"return_mean": best, "success_rate": always, "makespan": None},
    }
    passed = 1e5 if share > 0.7 else 0.0
    returns = ((100, -5.0), (300, passed), (400, best / 2))
    history = [
        {"env_steps": steps, "seconds": steps / 100, "return_mean": mean} for steps, mean in returns
    ]
    return history, final


def make_run(
    folder: Path,
    share: float = 0.5,
    *,
    recorded: tuple[list[dict[str, Any]], dict[str, Any]] | None = None,
    field_object: Field | None = None,
    **changes: Any,
) -> Result:
    """A finished run with made-up results: its mean actions reach ``share`` of the optimum.

    Sampled actions reach half as much. 100 000 is passed at 300 env-steps, or never. ``recorded``
    are its evaluations and the final one, instead of these.
    """
    request = {"algorithm": "mappo", "setting": "N", "label": None, "field": "field_03", "seed": 0}
    budget = {"steps": 400, "evaluate_every": 100, "episodes": 2}
    learning = {
        "environment": NavigationConfig().model_dump(mode="json"),
        "hyperparameters": {"gamma": 0.99},
    }
    config = {**request, **budget, **learning, **changes}
    field = field_object or load_field(config["field"])
    label = config["label"] or config["algorithm"]
    path = folder / f"{label}-{field.name}-{config['seed']}-{len(list(folder.iterdir()))}"
    run = RunFolder.create(path, config, field, "mbn train")
    history, final = recorded or _made_up(share, field, config["seed"])
    write_json(path / "evaluation.json", final)
    write_json(path / "evaluations.json", history)
    return Result.read(run)


def test_a_comparison_by_hand(tmp_path: Path) -> None:
    shares = {"field_01": (1.0, 0.5), "field_03": (0.75, 0.25)}
    results = [
        make_run(tmp_path, share, field=field, seed=seed)
        for field, pair in shares.items()
        for seed, share in enumerate(pair)
    ]
    results += [
        make_run(tmp_path, 0.6, field=field, seed=seed, algorithm="ppo", label="central")
        for field in shares
        for seed in (0, 1)
    ]
    found = summarise(Results.of(results))
    row = found.rows[0]
    assert (row.label, row.algorithm, row.form) == ("mappo", "mappo", "decentralized")
    assert (row.field, row.seeds, row.env_steps, row.seconds) == ("field_01", 2, 400, 10.5)
    assert (row.optimum, row.optimum_share) == (158_800.0, 0.375)
    assert (row.return_low, row.return_mean, row.return_high) == (39_700.0, 59_550.0, 79_400.0)
    assert (row.success_rate, row.deterministic_success_rate, row.makespan) == (0.75, 0.5, 20.0)
    assert (row.deterministic_return, row.deterministic_best) == (0.75 * 158_800.0, 158_800.0)
    assert (row.reached, row.env_steps_to_threshold, row.seconds_to_threshold) == (1, 300.0, 3.0)
    assert [(entry.label, entry.field) for entry in found.rows[1:]] == [
        ("central", "field_01"),
        ("mappo", "field_03"),
        ("central", "field_03"),
    ]
    mappo, central = found.aggregates
    # Sampled scores 0.5, 0.25, 0.375, 0.125: the middle two, and the mean shortfall.
    assert mappo.iqm.value == pytest.approx(0.3125)
    assert mappo.gap.value == pytest.approx(0.6875)
    assert mappo.deterministic_gap.value == pytest.approx(0.375)
    assert (mappo.reached, mappo.fields, mappo.seeds) == (2, 2, 2)
    assert (central.form, central.success_rate) == ("centralized", 0.6)
    # In each field one run of two is above 0.6 of the optimum.
    assert found.improvement["mappo"]["central"].value == 0.5
    share = dict(zip(THRESHOLDS.round(3), mappo.profile.share, strict=True))
    assert (share[0.2], share[0.3], share[0.45]) == (0.75, 0.5, 0.25)


def test_tables_and_files_hold_the_numbers(tmp_path: Path) -> None:
    (tmp_path / "runs").mkdir()
    for seed, share in enumerate((1.0, 0.5)):
        make_run(tmp_path / "runs", share, seed=seed)
        make_run(tmp_path / "runs", 0.9, seed=seed, label="other")
    console = Console(width=80, record=True, file=(tmp_path / "out").open("w"))
    comparison = summarise(find_results([tmp_path / "runs"]))
    print_comparison(comparison, console)
    text = console.export_text()
    assert "…" not in text
    assert "field_03: 400 env-steps a run, 2 seeds each" in text
    line = next(line for line in text.splitlines() if "25.0..50.0" in line)
    assert " ".join(line.split()) == "mappo 37.5% 25.0..50.0 62.50% 25.00% 75.0% 0k 1/2 3.0"
    encoded = json.loads(json.dumps(comparison.to_json(), allow_nan=False))
    assert encoded["aggregates"][0]["iqm"] == {"value": 0.375, "low": 0.25, "high": 0.5}
    assert encoded["probability_of_improvement"]["other"]["mappo"]["value"] == 0.5
    assert len(encoded["profile_thresholds"]) == len(encoded["aggregates"][0]["profile"]["share"])
    assert comparison.csv().splitlines()[1].startswith("mappo,mappo,decentralized,2,400,0.75")


def test_fields_without_a_proof_are_left_out_of_the_aggregates(tmp_path: Path) -> None:
    known = load_field("field_03")
    own = Field(vertices=known.vertices, rois=known.rois, starts=known.starts, name="own")
    unproved = make_run(tmp_path, 0.5, field_object=own)
    assert summarise(Results.of([unproved])).aggregates == ()
    both = summarise(Results.of([unproved, make_run(tmp_path, 0.5)]))
    assert both.unproved == ("own",)
    assert both.aggregates[0].fields == 1
    assert both.aggregates[0].deterministic_gap.value == pytest.approx(0.5)


WIND = {**NavigationConfig().model_dump(mode="json"), "wind": [0.1, 30.0]}
TEAM = {**NavigationConfig().model_dump(mode="json"), "reward_sharing": "team"}


@pytest.mark.parametrize(
    ("other", "message"),
    [
        ([], r"seeds: ppo on field_03 has 1 \(0\), another has 2; allowed: equally many"),
        (
            [{"field": "field_01", "seed": 1}],
            r"mappo on field_01 has 0 \(none\)(.*\n)+.*ppo on field_01 has 1",
        ),
        ([{"seed": 0}], "seeds: ppo on field_03 has seed 0 twice"),
        ([{"seed": 1, "steps": 500}], "steps: must be the same in all runs; .* 400, .* 500"),
        ([{"seed": 1, "episodes": 3}], "episodes: must be the same in all runs"),
        ([{"seed": 1, "hyperparameters": {}}], "hyperparameters: .* runs labelled ppo; "),
        ([{"seed": 1, "environment": WIND}], r"environment\.wind: must be the same in all runs"),
        ([{"seed": 1, "environment": TEAM}], "environment: must be the same in runs labelled ppo"),
    ],
)
def test_what_may_not_be_compared_is_named(
    other: list[dict[str, Any]], message: str, tmp_path: Path
) -> None:
    results = [make_run(tmp_path, seed=seed) for seed in (0, 1)]
    results += [make_run(tmp_path, algorithm="ppo", seed=0)]
    results += [make_run(tmp_path, algorithm="ppo", **changes) for changes in other]
    with pytest.raises(ConfigError, match=message):
        Results.of(results)


def test_learners_may_see_different_things(tmp_path: Path) -> None:
    Results.of([make_run(tmp_path), make_run(tmp_path, label="team", environment=TEAM)])


def test_fields_of_one_name_must_be_the_same(tmp_path: Path) -> None:
    known = load_field("field_01")
    other = Field(
        vertices=known.vertices, rois=known.rois[:1], starts=known.starts, name="field_03"
    )
    with pytest.raises(ConfigError, match="have different fields of the name field_03"):
        Results.of([make_run(tmp_path), make_run(tmp_path, label="b", field_object=other)])


def test_only_finished_runs_are_compared(tmp_path: Path) -> None:
    run = make_run(tmp_path).run
    (run.path / "evaluation.json").unlink()
    with pytest.raises(RunError, match="not a finished run"):
        find_results([tmp_path])

    (tmp_path / "empty").mkdir()
    with pytest.raises(RunError, match="holds none"):
        find_results([tmp_path / "empty"])


# ---------------------------------------------------------------- variants


def test_overrides_are_read_and_written() -> None:
    words = ["sharing=full+id", "model.gamma=0.9", "model.net=[8, 8]", "environment.wind=[0.1, 30]"]
    values = parse([*words, "rate=1e-05", 'name="3"', "on=true"])
    assert values == {
        "sharing": "full+id",
        "model": {"gamma": 0.9, "net": [8, 8]},
        "environment": {"wind": [0.1, 30]},
        "rate": 1e-5,
        "name": "3",
        "on": True,
    }
    assert parse(words_of(values)) == values


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["gamma"], "gamma: must be NAME=VALUE"),
        (["model.=1"], "model.=1: must be"),
        (["a=1", "a=2"], "a=2: a is set twice"),
        (["a=1", "a.b=2"], "a.b is set twice"),
        (["environment=3"], r"environment: must be environment\.NAME=VALUE"),
    ],
)
def test_wrong_overrides_are_named(words: list[str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        parse(words)


def test_variants_on_the_command_line_have_settings() -> None:
    ppo, crossq = parse_variants(["ppo", "crossq:A"])
    assert (ppo.name, crossq.name) == ("ppo", "crossq-A")
    assert crossq.training("field_03", 4, steps=9).name == "crossq-A-field_03-seed4"
    with pytest.raises(ConfigError, match=r"setting: .*'A', 'B' or 'N' \(got 'C'\)"):
        parse_variants(["ppo:C"])
    (mappo,) = parse_variants(["mappo:A"])
    with pytest.raises(ConfigError, match="setting: mappo has N, not A"):
        mappo.training("field_03", 0)


def test_variants_in_a_file_have_labels(tmp_path: Path) -> None:
    path = tmp_path / "study.yaml"
    path.write_text(
        "team: {algorithm: ippo, environment: {reward_sharing: team}}\n"
        "low: {algorithm: ippo, hyperparameters: {entropy: 0.01}}\n"
    )
    team, low = read_variants(path)
    run = low.training("field_03", 2, steps=7)
    assert (run.name, run.hyperparameters) == ("low-field_03-seed2", {"entropy": 0.01})
    assert run.command.endswith("--label low --set entropy=0.01")
    assert team.training("field_03", 2).command.endswith("--set environment.reward_sharing=team")
    path.write_text("team: {algorithm: ippo, colour: red}\n")
    with pytest.raises(ConfigError, match=r"study\.yaml: team.*\n?.*colour: unknown name; known"):
        read_variants(path)
    with pytest.raises(ConfigError, match="label: 'a/b'; allowed: letters"):
        TrainConfig("ippo", "field_03", label="a/b")


# ---------------------------------------------------------------- going on


TINY: Mapping[str, Any] = {
    "num_worlds": 4,
    "rollout_steps": 16,
    "hidden": [8],
    "action_repeat": [1, 1],
}
CONFIG = CompareConfig(
    variants=tuple(
        Variant(algorithm=name, label=f"{name}-tiny", hyperparameters=dict(TINY))
        for name in ("mappo", "ippo")
    ),
    fields=("field_03",),
    seeds=(0, 1),
    steps=320,
    evaluate_every=128,
    episodes=2,
)


def test_an_interrupted_comparison_goes_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("baselines.compare.markdown.write_animation", lambda episode, path: None)
    out = tmp_path / "comparison"
    second = out / CONFIG.runs()[1].name

    def interrupt(report: Report) -> None:
        if report.run == second.name and (second / "checkpoints").exists():
            raise InterruptedError

    with pytest.raises(InterruptedError):
        train_all_runs(CONFIG, out, command="mbn compare", processes=1, listener=interrupt)
    first = out / CONFIG.runs()[0].name / "evaluation.json"
    finished_at = first.stat().st_mtime_ns
    killed = out / CONFIG.runs()[2].name
    killed.mkdir()
    (killed / ".config.json.x").touch()  # as a process leaves it that is killed at once
    results = train_all_runs(CONFIG, out, command="mbn compare", processes=1, resume=True)
    assert (results.labels, results.seeds) == (("mappo-tiny", "ippo-tiny"), 2)
    assert first.stat().st_mtime_ns == finished_at
    assert read_json(second / "resumed.json")[0]["env_steps"] > 0
    assert not (killed / "resumed.json").exists()
    config = read_json(second / "config.json")
    assert (config["label"], config["hyperparameters"]["num_worlds"]) == ("ippo-tiny", 4)
    page = tmp_path / "docs" / "found.md"
    assert main(["report", "--comparison", str(out), "-o", str(page)]) == 0
    assert "](found/learning_curves_field_03.png)" in page.read_text()
    reported = read_json(page.parent / "found" / "comparison.json")
    assert {row["label"] for row in reported["rows"]} == {"mappo-tiny", "ippo-tiny"}
    again = train_all_runs(CONFIG, out, command="mbn compare", processes=1, resume=True)
    assert summarise(again).to_json() == summarise(results).to_json()


@pytest.mark.parametrize("processes", [1, 2])
def test_a_learner_that_breaks_down_stops_its_own_run_alone(
    processes: int, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture
) -> None:
    monkeypatch.setattr("baselines.compare.markdown.write_animation", lambda episode, path: None)
    out, variants = tmp_path / "out", tmp_path / "variants.yaml"
    wild = {**TINY, "learning_rate": [1e30, 1e30], "max_grad_norm": 1e30}
    blocks = {
        "wild": {"algorithm": "mappo", "hyperparameters": wild},
        "tame": {"algorithm": "mappo", "hyperparameters": dict(TINY)},
    }
    variants.write_text(json.dumps(blocks))
    budget = "--seeds 0 1 --steps 320 --evaluate-every 320 --episodes 1"
    where = ["--out", str(out), "--variants", str(variants), "--processes", str(processes)]
    command = ["compare", *where, *budget.split()]
    assert main(command) == 2
    told = capsys.readouterr()
    for seed in (0, 1):
        said = f"{out / f'wild-field_03-seed{seed}'}: the learner broke down"
        assert said in told.err and said in (out / "comparison.md").read_text()
        assert (out / f"tame-field_03-seed{seed}" / "evaluation.json").is_file()
    found = read_json(out / "comparison.json")
    assert {row["label"] for row in found["rows"]} == {"tame"}
    assert set(found["broken_runs"]) == {"wild-field_03-seed0", "wild-field_03-seed1"}

    alone = json.dumps({"wild": blocks["wild"]})
    variants.write_text(alone)
    command[2] = str(tmp_path / "alone")
    assert main(command) == 2
    assert "nothing is left to compare" in capsys.readouterr().err


def test_one_broken_run_leaves_its_label_out(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    broken = CONFIG.runs()[-1].name

    def train_or_break(config: TrainConfig, out: Path, **options: Any) -> RunFolder:
        if config.name == broken:
            raise DivergenceError("loc is nan")
        return train(config, out, **options)

    monkeypatch.setattr("baselines.sweep.processes.train", train_or_break)
    results = train_all_runs(CONFIG, tmp_path / "out", command="mbn compare", processes=1)
    assert (results.labels, results.seeds) == (("mappo-tiny",), 2)
    assert results.broken == {broken: "loc is nan"}


def test_only_the_same_comparison_goes_on(tmp_path: Path) -> None:
    out = tmp_path / "comparison"
    out.mkdir()
    with pytest.raises(RunError, match="not the folder of a comparison"):
        train_all_runs(CONFIG, out, command="mbn compare", processes=1, resume=True)
    write_json(out / "config.json", {**CONFIG.to_json(), "seeds": [0, 2], "steps": 7})
    with pytest.raises(ConfigError) as caught:
        train_all_runs(CONFIG, out, command="mbn compare", processes=1, resume=True)
    assert caught.value.problems == [
        "seeds: the comparison has [0, 2], this command [0, 1]",
        "steps: the comparison has 7, this command 320",
    ]
    assert [path.name for path in out.iterdir()] == ["config.json"]
