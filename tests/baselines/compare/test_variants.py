"""Variants of algorithms: from the command line, from a file, and as overrides."""

import math

import pytest

from baselines.algorithms import find_algorithm
from baselines.compare.variants import CompareConfig, parse_variant, read_variants
from baselines.training.aids import TrainingAids
from baselines.training.config import Hyperparameters, TrainConfig, parse, words_of
from baselines.training.train import prepare
from mbn_marl import Uniform
from mbn_marl.errors import ConfigError

AIDS = TrainingAids.model_fields.keys() - Hyperparameters.model_fields.keys()


def test_overrides_are_read_and_written():
    words = ["sharing=full+id", "model.gamma=0.9", "model.net=[8, 8]", "environment.wind=[0.1, 30]"]
    values = parse([*words, "rate=1e-05", 'name="3"', "on=true", "far=inf"])
    assert values == {
        "sharing": "full+id",
        "model": {"gamma": 0.9, "net": [8, 8]},
        "environment": {"wind": [0.1, 30]},
        "rate": 1e-5,
        "name": "3",
        "on": True,
        "far": math.inf,
    }
    assert parse(words_of(values)) == values
    drawn = {"environment": {"mass": Uniform(1.0, 2.0)}}
    assert parse(words_of(drawn)) == {"environment": {"mass": {"low": 1.0, "high": 2.0}}}


def test_wrong_overrides_are_refused_by_place():
    cases = ("gamma", "model.=1", "a=1 a=2", "a=1 a.b=2", "environment=3")
    for words, place in zip(cases, ("gamma", "model.=1", "a=2", "a.b", "environment"), strict=True):
        with pytest.raises(ConfigError, match=f"{place}: | {place} "):
            parse(words.split())


def test_variants_on_the_command_line_have_settings():
    ppo, crossq = map(parse_variant, ["ppo", "crossq:A"])
    assert (ppo.name, crossq.name) == ("ppo", "crossq-A")
    assert crossq.training("field_03", 4, steps=9).name == "crossq-A-field_03-seed4"
    with pytest.raises(ConfigError, match="ppo: setting: 'C'"):
        CompareConfig((parse_variant("ppo:C"),))
    mappo = parse_variant("mappo:A")
    with pytest.raises(ConfigError, match="setting: "):
        mappo.training("field_03", 0)


def test_a_block_that_is_no_mapping_is_named(tmp_path):
    path = tmp_path / "study.yaml"
    path.write_text("team: {algorithm: ippo}\nnone:\nword: ippo\n")
    with pytest.raises(ConfigError) as error:
        read_variants(path)
    assert [line.split(":")[0] for line in error.value.problems] == ["none", "word"]


def test_variants_in_a_file_have_labels(tmp_path):
    path = tmp_path / "study.yaml"
    path.write_text(
        "team: {algorithm: ippo, environment: {reward_sharing: team}}\n"
        "low: {algorithm: ippo, hyperparameters: {entropy: 0.01}}\n"
        "tuned: {algorithm: mappo, setting: G, transferred_from: 'zoo:generalist'}\n"
    )
    team, low, tuned = read_variants(path)
    assert "--from zoo:generalist" in tuned.training("field_03", 2).command
    run = low.training("field_03", 2, steps=7)
    assert (run.name, run.hyperparameters) == ("low-field_03-seed2", {"entropy": 0.01})
    assert run.command.endswith("--label low --set entropy=0.01")
    assert team.training("field_03", 2).command.endswith("--set environment.reward_sharing=team")
    path.write_text("team: {algorithm: ippo, colour: red}\n")
    with pytest.raises(ConfigError, match=r"study\.yaml: .*\n?.*team: colour: "):
        read_variants(path)
    path.write_text("one: {algorithm: ippo, colour: red}\ntwo: {algorithm: 5}\n")
    with pytest.raises(ConfigError, match=r"one: colour: (.|\n)*two: algorithm: "):
        read_variants(path)
    with pytest.raises(ConfigError, match="label: "):
        TrainConfig("ippo", "field_03", label="a/b")


def test_the_default_compares_like_with_like():
    config = CompareConfig()
    tasks = {run.shown_as: prepare(run) for run in config.runs()}
    forms = [find_algorithm(task.config.algorithm).form for task, _ in tasks.values()]
    assert sorted(forms) == ["centralized"] * 2 + ["decentralized"] * 2
    alike = [
        (numbers.model_dump(include=AIDS), task.settings["observation"], task.config.steps)
        for task, numbers in tasks.values()
    ]
    assert alike == [alike[0]] * 4
    assert config.steps == 1_800_000


def test_random_fields_need_a_tier():
    mappo = (parse_variant("mappo:G"),)
    config = CompareConfig(mappo, ("random_convex",), tier="1-convex")
    assert config.steps == 7_000_000  # for up to 7 robots and 10 ROIs
    assert {run.tier for run in config.runs()} == {"1-convex"}
    wrong = (("field_03",), "1-convex"), (("random_convex", "random_shapes"), "1-convex")
    for fields, tier in (*wrong, (("field_03", "random_convex"), None)):
        with pytest.raises(ConfigError, match="tier: "):
            CompareConfig(mappo, fields, tier=tier)
