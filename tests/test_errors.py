"""A name that is not known is answered with its place, the one that may be meant, and all."""

from __future__ import annotations

import pytest

from baselines.algorithms import find_algorithm
from baselines.sweep.spec import GridSpec
from baselines.training.hyperparameters import validate
from baselines.zoo.entries import open_run
from mbn_marl.config import make_config
from mbn_marl.errors import MbnError, unknown
from mbn_marl.field import load_field

GRID = {"store": "runs", "algorithms": ["ppo"], "seeds": [0], "budget": {"stepss": 1}}


def test_what_is_close_is_named_first() -> None:
    assert unknown("pet", "cta", ["dog", "cat"]) == "unknown pet; known: dog, cat"
    meant = "unknown pet (did you mean cat?); known: dog, cat"
    assert unknown("pet", "catt", ["dog", "cat"]) == meant
    assert unknown("pet", "cat", []) == "unknown pet; known: none"


def test_every_lookup_by_name_says_what_may_be_meant() -> None:
    for look_up, place, meant in (
        (lambda: find_algorithm("mapo"), "mapo: ", "mappo"),
        (lambda: load_field("feild_03"), "unknown field", "field_03"),
        (lambda: open_run("zoo:feild_03"), "zoo:feild_03: ", "field_03"),
        (lambda: make_config({"reward": "realeased"}), "reward: ", "released"),
        (lambda: make_config({"max_step": 5}), "max_step: ", "max_steps"),
        (lambda: make_config({"reward": {"name": "own", "medum": 5}}), "reward.medum: ", "medium"),
        (lambda: validate(GridSpec, GRID, "grid.yaml"), "budget.stepss: ", "steps"),
    ):
        with pytest.raises(MbnError) as caught:
            look_up()
        assert place in str(caught.value)
        assert f"did you mean {meant}" in str(caught.value)
    known = str(caught.value).split("known: ")[1]
    assert known == "steps, evaluate_every, episodes, stop_at", "only those of its level"
