"""The studies of learning."""

import pytest

from baselines.training.train import prepare, resolve
from benchmarks.__main__ import main
from benchmarks.studies import learning
from benchmarks.studies.learning import STUDIES, Study
from mbn_marl.errors import ConfigError
from tests.support.records import CONFIG

pytestmark = pytest.mark.slow


@pytest.mark.parametrize("name", STUDIES)
def test_studies_can_be_trained_and_their_variants_differ(name):
    config = Study(study=name).config()
    # No seed or field that was looked at while tuning, but for the tuning.
    assert min(config.seeds) >= 220 or "trials" in name or name == "validation"
    runs = config.runs()[: len(config.variants)]
    resolved = [resolve(*prepare(run)) for run in runs]
    assert [found["label"] for found in resolved] == [run.label for run in runs]
    parts = [(one["algorithm"], one["hyperparameters"], one["environment"]) for one in resolved]
    assert all(part not in parts[:index] for index, part in enumerate(parts))
    with pytest.raises(ConfigError, match=r"form: .*forms"):
        Study(study="form").config()


def test_a_study_runs(tmp_path, monkeypatch):
    monkeypatch.setattr(learning, "labelled", lambda blocks, place: CONFIG.variants)
    monkeypatch.setattr("baselines.compare.report.write_episode", lambda *drawn: None)
    out = tmp_path / "bench"
    size = ("--fields", "field_03", "--seeds", "0", "--steps", "1", "--processes", "1")
    assert main(["study", "learning", *size, "--out", str(out)]) == 0
    assert (out / "comparison.md").is_file()
