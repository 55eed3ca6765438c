"""The comparisons of learning."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from pydantic import BaseModel
from tyro.conf import Positional

from baselines.cli.compare import WRITTEN, train_and_compare
from baselines.cli.options import CORES, OptionalOutput, Writes
from baselines.compare.variants import CompareConfig, labelled
from baselines.training.config import merged, read_yaml, validate
from mbn_marl.errors import ConfigError, unknown
from mbn_marl.field import catalogue_names

STUDIES = sorted(path.stem for path in Path(__file__).parent.glob("*.yaml"))
STEPS = 1_441_792  # env-steps of a run


class Plan(BaseModel, frozen=True, extra="forbid"):
    """A study, as its YAML file in this folder has it."""

    fields: tuple[str, ...] = tuple(catalogue_names())
    tier: str | None = None  # of random fields
    seeds: tuple[int, ...]  # 220 and up, where nobody looked
    steps: int = STEPS
    evaluate_every: int = 65_536
    shared: dict[str, Any] = {}  # values that all variants begin with
    variants: dict[str, dict[str, Any]]  # the values of ``Variant``, by label


@dataclass(frozen=True)
class Study(Writes):
    """Train and compare the variants of a study, a YAML file in benchmarks/studies."""

    study: Positional[str] = "forms"
    """The name of the file: forms, learning, aids and others."""
    fields: tuple[str, ...] = ()
    """Names of `mbn fields`, or paths; by default the study's."""
    seeds: tuple[int, ...] = ()
    """One run for each variant, field and seed; by default the study's."""
    steps: int | None = None
    """Env-steps of every run; by default the study's."""
    processes: int = CORES
    """Runs at a time, each on one core."""
    resume: bool = False
    """Resume what is in the folder, as `mbn compare` does."""
    out: OptionalOutput = None
    """The folder to write; by default runs/bench-STUDY."""

    def config(self) -> CompareConfig:
        if self.study not in STUDIES:
            raise ConfigError("study", [f"{self.study}: {unknown('study', self.study, STUDIES)}"])
        given = {name: getattr(self, name) for name in ("fields", "seeds", "steps")}
        path = Path(__file__).with_name(f"{self.study}.yaml")
        asked = read_yaml(path) | {
            name: value for name, value in given.items() if value not in ((), None)
        }
        plan = validate(Plan, asked, str(path))
        # A field may be a file in this folder.
        here = ((name, path.parent / name) for name in plan.fields)
        fields = tuple(str(file) if file.is_file() else name for name, file in here)
        blocks = {label: merged(plan.shared, own) for label, own in plan.variants.items()}
        rest = plan.model_dump(exclude={"shared", "variants", "fields"})
        return CompareConfig(labelled(blocks, self.study), fields, **rest)

    def run(self, command: str) -> bool:
        options = {name: getattr(self, name) for name in ("processes", "force", "resume")}
        out = self.out or Path(f"runs/bench-{self.study}")
        train_and_compare(self.config(), out, command=command, **options)
        print(f"written to {out}: {WRITTEN}")
        return True
