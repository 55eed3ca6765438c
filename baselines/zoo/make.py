"""Make an entry of the zoo from a finished run."""

import shlex
from pathlib import Path
from typing import Any

from baselines.evaluation.evaluate import EVALUATION_SEED, evaluate_both, unseen
from baselines.policies.load import CARD, load_trained
from baselines.policies.shielded import information_of
from baselines.runs.files import RunError, read_json, reading, replacing_folder, write_json
from baselines.runs.folder import RunFolder
from mbn_marl.errors import ConfigError
from mbn_marl.field import catalogue_names, sampler_names, save_field
from mbn_marl.files import free_name

EPISODES = 100
# Bytes of an entry's files together.
LARGEST = 1_000_000


def make_entry(run: RunFolder, path: Path, *, force: bool = False) -> dict[str, Any]:
    if not run.finished:
        raise RunError(f"{run.path} is not finished; resume it first (--resume)")
    config, field = run.config, run.config["field"]
    if field not in (known := [*catalogue_names(), *sampler_names()]):
        allowed = ", ".join(known)
        raise ConfigError(str(run.path), [f"field: {field}; allowed: {allowed}"])
    if path.exists() and not force:
        allowed = "choose another --out, or pass --force to move it aside"
        raise RunError(f"{path} already exists; {allowed}")
    card = make_card(run, path.name)
    for name in ("hyperparams", "transferred_from"):
        config[name] = None if config[name] is None else Path(config[name]).name
    with replacing_folder(path) as folder:
        write_json(folder / "config.json", config)
        save_field(run.fields, folder / "field.yaml")
        load_trained(run).save(folder / "policy")
        write_json(folder / CARD, card)
        size = sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())
        if size > LARGEST:
            raise ConfigError(str(run.path), [f"{size:,} bytes; allowed: up to {LARGEST:,}"])
        if path.exists():
            path.rename(free_name(path))
    return card


def make_card(run: RunFolder, name: str) -> dict[str, Any]:
    """Evaluate a run's policy; return how it was trained and what it does, as JSON values."""
    config, trained = run.config, run.evaluation
    with reading(run.path / "evaluation.json"):
        budget = {key: trained[key] for key in ("env_steps", "seconds")}
    fields = unseen(run.fields, EVALUATION_SEED)
    where = load_trained(run), fields, config["environment"]
    evaluations = evaluate_both(*where, episodes=EPISODES, seed=EVALUATION_SEED)
    return {
        "name": name,
        **{key: config[key] for key in ("algorithm", "setting", "field", "seed")},
        **budget,
        "command": plain_command(run.command),
        "versions": read_json(run.path / "versions.json"),
        "information": information_of(where[0], where[2], run),
        **{key: evaluation.summary() for key, evaluation in evaluations.items()},
    }


def plain_command(command: str) -> str:
    words, kept = iter(shlex.split(command)), []
    for word in words:
        if word in ("--out", "-o"):
            next(words)
        elif word not in ("--force", "--resume") and not word.startswith("--out="):
            kept.append(word)
    return shlex.join(kept)
