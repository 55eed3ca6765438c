"""Made-up runs to compare, and a comparison that is trained in seconds."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from baselines.compare.records import RunRecord
from baselines.compare.variants import CompareConfig, Variant
from baselines.runs.files import write_json
from baselines.runs.folder import RunFolder
from mbn_marl.config import NavigationConfig
from mbn_marl.field import Field, load_field

OPTIMA = {"field_01": 158_800.0, "field_03": 159_490.0}

TINY: Mapping[str, Any] = {
    "num_worlds": 4,
    "rollout_steps": 16,
    "hidden": [8],
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


def _made_up(share: float, field: Field, seed: int) -> tuple[list[dict[str, Any]], dict[str, Any]]:
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
) -> RunRecord:
    """A finished run whose mean actions reach ``share`` of the optimum, sampled ones half of it."""
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
    return RunRecord.read(run)
