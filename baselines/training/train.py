"""One training run, from a configuration to a finished run folder."""

import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np

from baselines.algorithms import find_algorithm
from baselines.evaluation.evaluate import EVALUATION_SEED, EVALUATIONS
from baselines.policies.load import CARD, PREFIX, open_run
from baselines.policies.policy import acts_on
from baselines.runs.files import RunError, alone, claim_folder, is_untouched
from baselines.runs.folder import RunFolder
from baselines.training.config import DivergenceError, Hyperparameters, Task, TrainConfig
from baselines.training.run_logger import LEAST_STEPS, Listener, Recorder, find_wandb
from mbn_marl.config import expand, make_config
from mbn_marl.engine import BatchEngine
from mbn_marl.errors import ActionError, ConfigError, MbnError, collecting
from mbn_marl.field import Field, FieldSampler, load_fields
from mbn_marl.field.splits import RADII, radius_name, training_settings

# The hyperparameters that decide which networks there are.
NETWORK = ("actor", "network", "hidden", "sharing", "memory")


def train(
    config: TrainConfig,
    out: Path,
    *,
    command: str | None = None,
    force: bool = False,
    resume: bool = False,
    wandb: str | None = None,
    listener: Listener = lambda report: None,
) -> RunFolder:
    """Train one policy and evaluate it; everything is checked before the folder is made."""
    # ``force`` moves a folder that is there aside; ``resume`` continues the interrupted run in it,
    # and leaves a finished one. ``wandb`` is a project of Weights & Biases.
    import torch

    if config.device == "cuda" and not torch.cuda.is_available():
        raise ConfigError("training", ["device: torch finds no GPU here; allowed: cpu"])
    if wandb is not None:
        find_wandb()
    algorithm, (task, hyperparameters) = find_algorithm(config.algorithm), prepare(config)
    command = command or config.command
    if resume := resume and not (out.is_dir() and is_untouched(out)):
        RunFolder.open(out)
    else:
        algorithm.trainer.check(task, hyperparameters)
        claim_folder(out, force=force)
    with _running(RunFolder(out)), alone(out, "mbn train"):
        begin = RunFolder.resume if resume else RunFolder.create
        run = begin(out, resolve(task, hyperparameters), task.field, command)
        if not run.finished:
            try:
                recorder = Recorder(run, task, listener, wandb)
                seeds = seeds_of(config, hyperparameters)
                while recorder.learner < len(seeds) and recorder.left > 0:
                    seed, steps = seeds[recorder.learner], recorder.left
                    steps = -(-steps // (len(seeds) - recorder.learner))
                    own = replace(config, steps=steps, seed=seed)
                    part = replace(task, config=own, field=task.field_of(seed))
                    recorder.begin(part)
                    algorithm.trainer.train(part, hyperparameters, recorder)
                recorder.conclude()
            except ValueError as error:
                if isinstance(error, MbnError) and not isinstance(error, ActionError):
                    raise
                what = str(error).splitlines()[0]
                raise DivergenceError(
                    f"{out}: the learner diverged: its numbers are most likely no longer finite; a "
                    f"smaller learning rate may help ({what})"
                ) from error
    return run


def notes(config: TrainConfig) -> list[str]:
    """Return what a user should know before a run: skipped hyperparameters, a rounded budget."""
    task, hyperparameters = prepare(config)
    name, steps = config.algorithm, config.steps
    lines = [
        f"skipped: {argument} = {value}, since {name} has no such argument"
        for argument, value in hyperparameters.skipped.items()
    ]
    count = len(seeds_of(config, hyperparameters))
    part = replace(task, config=replace(config, steps=-(-steps // count)))
    budget = find_algorithm(name).trainer.budget(part, hyperparameters)
    if (whole := budget.env_steps * count) > steps:
        bound = "" if budget.exact and count == 1 else "up to "
        lines.append(
            f"steps: {name} learns from whole {budget.unit}, so this run takes "
            f"{bound}{whole:,} env-steps, not {steps:,}"
        )
    return lines


def seeds_of(config: TrainConfig, hyperparameters: Hyperparameters) -> list[int]:
    """Return a seed for each learner of a run: its own, and others of their number."""
    count = max(1, min(hyperparameters.learners, config.steps // LEAST_STEPS))
    more = [np.random.SeedSequence((config.seed, k)).generate_state(1) for k in range(1, count)]
    return [config.seed, *(int(seed) for (seed,) in more)]


def prepare(config: TrainConfig) -> tuple[Task, Hyperparameters]:
    problems: list[str] = []
    recorded: dict[str, Any] = {}
    with collecting(problems):
        hyperparameters: Hyperparameters = find_algorithm(config.algorithm).resolve(
            config.hyperparameters,
            setting=config.setting,
            num_envs=config.num_envs,
            file=config.hyperparams,
        )
        recorded = expand(hyperparameters.environment)
    with collecting(problems):
        fixed = training_settings(config.tier)
        settings = {**recorded, **fixed, **expand(config.environment)}
        made = make_config(settings)
        problems += [
            f"environment.{name}: {settings[name]!r}; allowed with tier {config.tier}: {value!r}"
            for name, value in fixed.items()
            if settings[name] != value
        ]
        if fixed and radius_name(made.comm_radius) is None:
            allowed = ", ".join(RADII)
            where = f"allowed with tier {config.tier}: {allowed}"
            problems.append(f"environment.comm_radius: {made.comm_radius}; {where}")
    if problems:
        raise ConfigError("training", problems)
    fields = load_fields(config.field)
    if isinstance(fields, FieldSampler):
        if getattr(hyperparameters, "network", None) != "entities":
            allowed = "with setting G, or network=entities"
            problem = f"field: {config.field} is random fields; allowed: {allowed}"
            raise ConfigError("training", [problem])
        # Runs with other seeds train on other fields.
        fields = fields.model_copy(update={"seed": (fields.seed + config.seed) % 2**63})
    elif config.tier is not None:
        raise ConfigError("training", [f"tier: {config.tier}; allowed on random fields"])
    BatchEngine(fields, 1, **settings)  # raises where field, team and settings do not fit
    task = Task(config, fields, settings)
    first, last = EVALUATION_SEED, EVALUATION_SEED + EVALUATIONS - 1
    for one in map(task.field_of, seeds_of(config, hyperparameters)):
        if isinstance(one, FieldSampler) and first <= one.seed <= last:
            problem = f"seed: {config.seed} gives fields of evaluations, {first:,} to {last:,}"
            raise ConfigError("training", [f"{problem}; allowed: another"])
    if config.transferred_from is not None:
        _check_source(open_run(str(config.transferred_from)), task, hyperparameters)
    return task, hyperparameters


@contextmanager
def _running(run: RunFolder) -> Iterator[None]:
    # Give torch one thread, and name the run in errors that its user or its disk causes. The
    # networks are small, and comparisons take a process for each core.
    import torch

    threads, hook = torch.get_num_threads(), threading.excepthook

    def quiet(arguments: threading.ExceptHookArgs) -> None:
        # TensorBoard's thread passes its errors on to its next call: they are shown there.
        if not isinstance(arguments.exc_value, OSError):
            hook(arguments)

    torch.set_num_threads(1)
    threading.excepthook = quiet
    try:
        yield
    except KeyboardInterrupt:
        if run.finished or not (run.path / "config.json").is_file():
            raise
        state = run.unfinished or "trained, but not evaluated"
        raise KeyboardInterrupt(f"{run.path} is {state}; continue with --resume") from None
    except (ConnectionError, InterruptedError):  # not about files
        raise
    except OSError as error:
        raise RunError(
            f"{run.path} could not be written to ({error}); what was saved before is as it was: "
            f"--resume continues from {run.saved_steps:,} env-steps"
        ) from error
    finally:
        threading.excepthook = hook
        torch.set_num_threads(threads)


def sizes(theirs: Field, ours: Field) -> dict[str, tuple[Any, Any]]:
    return {
        "robots": (len(theirs.starts), len(ours.starts)),
        "ROIs": (len(theirs.rois), len(ours.rois)),
        "arena": (theirs.arena, ours.arena),
    }


def _check_source(source: RunFolder, task: Task, hyperparameters: Hyperparameters) -> None:
    if not (source.finished or (source.path / CARD).is_file()):
        raise RunError(f"{source.path} is not finished; resume it first (--resume)")
    config, environment = source.config, make_config(task.settings)
    trained = make_config(config["environment"])  # an older run lacks newer settings
    asked = hyperparameters.model_dump(mode="json", exclude={"source", "num_envs"})
    if task.config.setting == "C":
        assert isinstance(task.field, Field)  # no algorithm with setting C takes random ones
        compared = {
            "algorithm": (config["algorithm"], task.config.algorithm),
            **sizes(source.field, task.field),
            "environment": tuple(one.model_dump(mode="json") for one in (trained, environment)),
        }
    else:
        asked = {name: asked[name] for name in NETWORK}
        seen = acts_on(source.fields, trained)
        here = acts_on(task.field, environment)
        compared = {name: (seen.get(name), here.get(name)) for name in {**seen, **here}}
    # The zoo's first have no other network, and no memory.
    theirs = {"network": "mlp", "memory": 0, **config["hyperparameters"]}
    if theirs["network"] == "entities":  # the policy is given a memory, and what its team sees
        for name, none in {"memory": 0, "actor": "decentralized"}.items():
            if theirs.get(name) == none:
                asked.pop(name, None)
    compared |= {f"hyperparameters.{name}": (theirs.get(name), asked[name]) for name in asked}
    if problems := [
        f"{name}: the policy's run has {theirs}, this run {ours}"
        for name, (theirs, ours) in compared.items()
        if theirs != ours
    ]:
        raise ConfigError(f"from: {source.path}", problems)


def found_anywhere(field: str) -> str:
    return str(Path(field).resolve()) if Path(field).is_file() else field


def resolve(task: Task, hyperparameters: Hyperparameters) -> Mapping[str, Any]:
    paths = {
        name: str(path if str(path).startswith(PREFIX) else path.resolve())
        for name in ("hyperparams", "transferred_from")
        if (path := getattr(task.config, name)) is not None
    }
    return {
        **asdict(task.config),
        **paths,
        "field": found_anywhere(task.config.field),
        "environment": make_config(task.settings).model_dump(mode="json"),
        "hyperparameters": hyperparameters.model_dump(mode="json"),
    }
