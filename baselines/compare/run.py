"""Train variants on fields with equal budgets, and compare what the runs recorded."""

from pathlib import Path

from baselines.algorithms import find_algorithm
from baselines.compare.records import Results, RunRecord
from baselines.compare.variants import CompareConfig
from baselines.runs import files
from baselines.runs.files import RunError
from baselines.runs.folder import RunFolder
from baselines.sweep.processes import LocalEngine
from baselines.sweep.run import check_outcomes, train_runs
from baselines.training.run_logger import Listener, find_wandb
from baselines.training.train import prepare
from mbn_marl.errors import ConfigError, collecting


def train_all_runs(
    config: CompareConfig,
    out: Path,
    *,
    command: str,
    processes: int,
    force: bool = False,
    resume: bool = False,
    wandb: str | None = None,
    listener: Listener = lambda report: None,
) -> Results:
    """Train every run into a folder under ``out``, so many ``processes`` at a time.

    A run that diverges stops no other; its label is then left out of the results, which say so. A
    RunError says that a run failed or all labels diverged, a ConfigError all that is not valid.
    """
    if wandb is not None:
        find_wandb()
    runs = config.runs()
    problems: list[str] = []
    for run in {(run.shown_as, run.field): run for run in runs}.values():  # whatever the seed
        with collecting(problems):
            find_algorithm(run.algorithm).trainer.check(*prepare(run))
    if problems:
        raise ConfigError("comparison", problems)
    if not resume:
        files.claim_folder(out, force=force)
    elif not (out / "config.json").is_file():
        raise RunError(f"{out} is not the folder of a comparison: it has no config.json")
    elif changed := files.differences(files.read_json(out / "config.json", dict), config.to_json()):
        raise ConfigError(f"{out} cannot be resumed", changed)
    with files.alone(out, "mbn compare"):
        if not resume:
            files.write_json(out / "config.json", config.to_json())
            files.write_provenance(out, command)
        engine = LocalEngine(processes)
        outcomes = train_runs(runs, out, engine, wandb=wandb, listener=listener)
    broken = {name: one for name, one in outcomes.items() if one.state == "diverged"}
    check_outcomes([one for name, one in outcomes.items() if name not in broken], out)
    left_out = {run.shown_as for run in runs if run.name in broken}
    errors = {name: one.error or "" for name, one in broken.items()}
    records = [
        RunRecord.read(RunFolder.open(out / run.name))
        for run in runs
        if run.shown_as not in left_out
    ]
    if not records:
        raise RunError("nothing is left to compare:\n" + "\n".join(errors.values()))
    named = [variant.label for variant in config.variants if variant.label is not None]
    return Results.of(records, errors, named)
