"""Grids as files: what they declare, and every problem of one at once."""

import yaml

from baselines.sweep.spec import read_spec, runs_of
from mbn_marl.field import Field, load_field, save_field
from tests.support.grids import TINY, spec_of
from tests.support.pages import FILE_NAME, ROOT, blocks_of


def test_the_examples_are_what_the_page_says(tmp_path):
    for block in blocks_of(ROOT / "docs" / "grid.md"):
        if name := FILE_NAME.match(block.text):
            (tmp_path / name[1]).write_text(block.text)
    runs = runs_of(read_spec(tmp_path / "paper.yaml"))
    assert len(runs) == 180
    assert {run.steps for run in runs} == {5_000_000}
    seen = set()
    for run in runs:
        source = run.transferred_from
        assert source is None or source.name in seen, "a run comes before its source"
        seen.add(run.name)
    names = [run.name for run in runs_of(read_spec(tmp_path / "winds.yaml"))]
    assert len(names) == 48 and "mappo-2robots-wind0.1+30-field_03-seed1" in names


def test_axes_multiply_and_name_the_runs():
    spec = spec_of(
        "runs",
        algorithms=["ppo", "mappo"],
        settings=["A", "N"],
        robots=[2, 3],
        seeds=[4, 5],
        set={"environment.wind": [[0.1, 30]]},
    )
    names = [run.name for run in runs_of(spec)]
    assert len(names) == len(set(names)) == 3 * 2 * 2
    assert names[0] == "ppo-A-2robots-wind0.1+30-field_03-seed4"
    assert "mappo-3robots-wind0.1+30-field_03-seed5" in names
    run = runs_of(spec_of("runs", robots=[2], set={"model.gamma": [0.9]}))[0]
    assert run.environment == {"n_robots": 2}
    assert run.hyperparameters == {"model": {"gamma": 0.9}}
    assert run.shown_as == "a2c-A-2robots-gamma0.9"


def test_wrong_values_are_refused_by_place_and_nothing_is_made(tmp_path, refusal):
    whole, path = load_field("field_02"), tmp_path / "grid.yaml"
    save_field(Field(whole.vertices, whole.rois, whole.starts[:2]), tmp_path / "two.yaml")
    cases = [
        ({"algorithms": []}, "algorithms: "),
        ({"algorithms": ["ppo", "ppo"]}, "algorithms: ppo"),
        ({"algorithms": ["sac"]}, "algorithms.0: sac"),
        ({"algorithms": ["mappo"]}, "settings: mappo"),
        ({"settings": ["C"], "fields": ["two.yaml"]}, "two.yaml: robots"),
        ({"fields": ["feild_3"], "seeds": [-1]}, "grid.yaml: 2 problems"),
        ({"set": {"model.gamma": [2]}}, "model.gamma: "),
        ({"set": {"model.gamma": [2]}}, "grid.yaml: 1 problem"),
        ({"robots": [2], "set": {"environment.n_robots": [3]}}, "set: environment.n_robots"),
        ({"resources": {"retries": -1}}, "resources.retries: "),
    ]
    for changes, place in cases:
        path.write_text(yaml.safe_dump({"store": "runs", **TINY, **changes}))
        assert place in refusal(["grid", str(path)]), changes
    path.write_text(yaml.safe_dump({"store": "runs", **TINY}))
    for words, place in (
        ("nothing.yaml", "nothing.yaml: "),
        ("grid.yaml --address here:1", "address: "),
        ("grid.yaml --processes 0", "processes: "),
    ):
        assert place in refusal(["grid", *words.split()]), words
    assert sorted(tmp_path.iterdir()) == [path, tmp_path / "two.yaml"]
