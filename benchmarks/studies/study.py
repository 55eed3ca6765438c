"""The studies that ``mbn bench`` runs, with their usual sizes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from baselines.compare.run import CompareConfig
from baselines.compare.variants import read_variants
from mbn_marl.field import catalogue_names


@dataclass(frozen=True)
class Study:
    """A comparison of variants that a YAML file here lists.

    Attributes:
        name: of the study and its file.
        seeds: usual seeds.
        fields: usual fields; all ten if there are none.
        steps: usual env-steps of a run.
    """

    name: str
    seeds: tuple[int, ...]
    fields: tuple[str, ...] = ()
    steps: int = 1_441_792

    def config(
        self,
        fields: Sequence[str] = (),
        seeds: Sequence[int] = (),
        steps: int | None = None,
        evaluate_every: int = 32_768,
        episodes: int = 100,
    ) -> CompareConfig:
        """The comparison, of the usual size where nothing else is said.

        Raises:
            MbnError: as :class:`~baselines.compare.run.CompareConfig`.
        """
        return CompareConfig(
            variants=read_variants(Path(__file__).with_name(f"{self.name}.yaml")),
            fields=tuple(fields) or self.fields or tuple(catalogue_names()),
            seeds=tuple(seeds) or self.seeds,
            steps=self.steps if steps is None else steps,
            evaluate_every=evaluate_every,
            episodes=episodes,
        )


STUDIES: Mapping[str, Study] = {
    study.name: study
    for study in (
        Study("learning", seeds=(0, 1, 2, 3, 4)),
        Study("sharing", seeds=(0, 1, 2, 3, 4)),
        Study("ablations", seeds=(0, 1, 2), fields=("field_02", "field_10")),
    )
}
