"""Made-up runs to compare, and a comparison that is trained in seconds."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from baselines.compare.records import RunRecord
from baselines.compare.variants import CompareConfig, Variant
from baselines.runs.files import write_json
from baselines.runs.folder import RunFolder
from mbn_marl.config import NavigationConfig
from mbn_marl.field import Field, load_fields

BOUND = 20  # steps

TINY: Mapping[str, Any] = {"num_worlds": 4, "rollout_steps": 16, "hidden": [8]}
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


def _measured(spl: float, success: float, bounded: bool) -> dict[str, Any]:
    makespan = BOUND * success / spl if success else None
    gap = None if makespan is None else makespan / BOUND - 1.0
    bounds = {"gap": gap, "spl": success and spl} if bounded else {"gap": None, "spl": None}
    mean = 150_000.0 * success
    return {"success_rate": success, "makespan": makespan, "return_mean": mean, **bounds}


def make_run(
    folder: Path,
    spl: float = 0.5,
    *,
    bounded: bool = True,
    field_object: Field | None = None,
    **changes: Any,
) -> RunRecord:
    """A finished run, which passes from 300 of 400 env-steps on if ``spl`` is more than 0.7.

    Others have a success rate of ``spl`` at the bound, and of half of it with mean actions.
    """
    request = {"algorithm": "mappo", "setting": "N", "label": None, "field": "field_03", "seed": 0}
    budget = {"steps": 400, "evaluate_every": 100, "episodes": 2, "tier": None}
    learning = {
        "environment": NavigationConfig().model_dump(mode="json"),
        "hyperparameters": {"gamma": 0.99},
    }
    config = {**request, **budget, **learning, **changes}
    fields = field_object or load_fields(config["field"])
    label = config["label"] or config["algorithm"]
    field_name = Path(config["field"]).stem
    path = folder / f"{label}-{field_name}-{config['seed']}-{len(list(folder.iterdir()))}"
    run = RunFolder.create(path, config, fields, "mbn train")
    passes = spl > 0.7
    sampled = _measured(spl, 1.0 if passes else spl, bounded)
    mean = sampled if passes else _measured(spl / 2, spl / 2, bounded)
    none = _measured(spl, 0.0, bounded)
    final = {"env_steps": 400, "policy_env_steps": 300, "seconds": 10.0 + config["seed"]}
    write_json(path / "evaluation.json", {**final, "stochastic": sampled, "deterministic": mean})
    history = [
        {
            **{"env_steps": steps, "seconds": steps / 100, **one},
            **{f"deterministic_{name}": value for name, value in other.items()},
        }
        for steps, one, other in ((100, sampled, none), (300, sampled, mean), (400, sampled, mean))
    ]
    write_json(path / "evaluations.json", history)
    return RunRecord.read(run)


def make_runs(
    folder: Path, scores: Mapping[str, Sequence[float]], **changes: Any
) -> list[RunRecord]:
    """Runs of algorithms with the SPL of each seed."""
    return [
        make_run(folder, spl, algorithm=name, seed=seed, **changes)
        for name, found in scores.items()
        for seed, spl in enumerate(found)
    ]
