"""``mbn plan``: the proved optimum of a field; ``mbn warmup``: the engine, compiled."""

import json
import re
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from tyro.conf import Positional, arg

from baselines.cli.options import OptionalOutput, Writes, check_options
from baselines.compare.text_table import TextTable, shown
from baselines.runs.files import claim_folder, read_json, write_arrays, write_json
from mbn_marl.config import Condition, Observation, make_config
from mbn_marl.errors import ConfigError, FieldError, MbnError, collecting
from mbn_marl.field import Field, load_field
from mbn_marl.files import replacing

if TYPE_CHECKING:
    from mbn_marl.planning import Plan as FoundPlan


@dataclass(frozen=True)
class Plan(Writes):
    """Find the fewest steps in which the robots can visit every ROI, and prove it."""

    field: Positional[Annotated[str, arg(metavar="FIELD")]]
    """A name of `mbn fields`, or a field file."""
    n_robots: int | None = None
    """Team size; by default as many as the field has starts."""
    wind: tuple[float, float] = (0.0, 0.0)
    """Speed (units/step per step) and direction (degrees from +x) of the wind."""
    write: bool = False
    """Write a proved optimum into the field file, as its `optimal_makespan`."""
    time_limit: float = 60.0
    """Seconds after which the best interval so far is returned."""
    out: OptionalOutput = None
    """The folder to write; by default runs/plan-FIELD."""

    def run(self, command_line: str) -> None:
        from mbn_marl.planning import plan
        from mbn_marl.planning.problem import make_problem

        changed = self.n_robots is not None or any(self.wind)
        wrong = {
            f"time_limit: more than 0 seconds, not {self.time_limit}": not self.time_limit > 0.0,
            f"write: allowed with a field file of yours, not {self.field}": (
                self.write and not Path(self.field).is_file()
            ),
            "write: allowed without --n-robots and --wind": self.write and changed,
        }
        settings: dict[str, Any] = {"n_robots": self.n_robots, "wind": self.wind}
        problems: list[str] = []
        with collecting(problems):
            field = load_field(self.field)
            make_problem(field, make_config(settings))  # before anything is moved
        check_options("plan", wrong, problems)
        folder = self.out or Path(f"runs/plan-{field.name}")
        if self.write and not self.force:
            makespan = proved_makespan(folder, field, settings)
            if makespan is not None:
                write_optimum(Path(self.field), makespan)
                print(f"written to {self.field}: optimal_makespan: {makespan}, as in {folder}")
                return
        claim_folder(folder, force=self.force)
        found = plan(field, time_limit=self.time_limit, **settings)
        print_plan(found)
        numbers = {"command": command_line, "settings": settings, **found.to_json()}
        write_json(folder / "plan.json", numbers)
        names = ["plan.json"]
        if found.makespan is not None:
            names += _write_plan(found, folder, settings)
        print(f"written to {folder}: {', '.join(names)}")
        self._keep_optimum(found, changed)

    def _keep_optimum(self, found: "FoundPlan", changed: bool) -> None:
        path, line = Path(self.field), f"optimal_makespan: {found.makespan}"
        if self.write and not found.optimal:
            raise MbnError(f"{path} is left as it is, since this plan is not proved optimal")
        if self.write:
            write_optimum(path, found.makespan)
            print(f"written to {path}: {line}")
        elif path.is_file() and not (changed or found.field.optimal_makespan) and found.optimal:
            print(f"to keep it, add this line to {path} (--write does): {line}")


def proved_makespan(folder: Path, field: Field, settings: Mapping[str, Any]) -> int | None:
    path = folder / "plan.json"
    found = read_json(path) if path.is_file() else None
    wanted = {"field": field.to_dict(), "settings": settings, "optimal": True}
    wanted = json.loads(json.dumps(wanted))
    if not isinstance(found, dict) or any(found.get(name) != wanted[name] for name in wanted):
        return None
    makespan = found.get("makespan")
    return makespan if isinstance(makespan, int) else None


def write_optimum(path: Path, makespan: int | None) -> None:
    """Write a proved optimum into a field file, which has to be a block of YAML."""
    path = path.resolve()  # a link stays one
    text = path.read_bytes().decode()
    end = "\r\n" if "\r\n" in text else "\n"
    line = f"optimal_makespan: {makespan}"
    new, count = re.subn(r"^optimal_makespan:[ \t]*[\w~]*", line, text, count=1, flags=re.MULTILINE)
    if not count:
        new = f"{text.removesuffix(end)}{end}{line}{end}"
    try:
        with replacing(path) as temporary:
            temporary.write_bytes(new.encode())
            temporary.chmod(path.stat().st_mode)
            if load_field(temporary).optimal_makespan != makespan:
                raise FieldError(str(path), ["another field"])
    except FieldError:
        problem = f"write: this file has no lines of YAML to add to; add {line} yourself"
        raise ConfigError(str(path), [problem]) from None


def _write_plan(found: "FoundPlan", folder: Path, settings: dict[str, Any]) -> list[str]:
    from baselines.evaluation.rollout import write_episode
    from mbn_marl.episode import play

    kind = ", proved optimal" if found.optimal else ""
    episode = play(found.field, make_config(settings), found.actions, source=f"plan{kind}")
    write_episode(episode, folder / "episode.json")
    write_arrays(folder / "plan.npz", {"actions": found.actions, "positions": found.trail})
    title = f"{found.field.name}: {found.makespan} steps{', optimal' if found.optimal else ''}"
    write_episode(episode, folder / "plan.png", title)
    return ["plan.npz", "plan.png", "episode.json"]


def print_plan(found: "FoundPlan") -> None:
    none = found.makespan is None
    lines = [
        ("makespan", "none was found" if none else f"{found.makespan} steps"),
        ("proved lower bound", f"{found.makespan_lower_bound} steps"),
        ("optimal", "yes, proved" if found.optimal else "not proved"),
        ("return", shown(found.return_)),
    ]
    for robot, rois in enumerate(found.assignment):
        lines.append((f"robot_{robot} visits", ", ".join(f"w{roi + 1}" for roi in rois) or "-"))
    lines.append(("took", f"{found.seconds:.2f} s"))
    TextTable("", (f"plan of {found.field.name}", ""), lines, words=2).print()


@dataclass(frozen=True)
class Warmup:
    """Compile the engine ahead of its first use, into NUMBA_CACHE_DIR or beside the sources."""

    observation: tuple[Observation, ...] = ("relative",)
    """The kinds of observation to compile for."""
    condition: tuple[Condition, ...] = ("calm",)
    """The named conditions to compile for."""

    def run(self, command_line: str) -> None:
        from mbn_marl import BatchEngine

        for observation in self.observation:
            for condition in self.condition:
                start = time.perf_counter()
                how: dict[str, Any] = {"observation": observation, "condition": condition}
                how |= {"autoreset": "disabled", "max_steps": 1}
                for threads in (1, 2):
                    engine = BatchEngine("field_03", 2, threads=threads, **how)
                    engine.reset(seed=0)
                    engine.step(engine.sample_actions())
                engine.reset_worlds([True, False])
                engine.step(engine.sample_actions(), [True, False])
                engine.state()
                engine.metrics()
                seconds = time.perf_counter() - start
                print(f"{observation}, {condition}: {seconds:.1f} s")
