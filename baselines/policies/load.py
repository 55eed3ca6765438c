"""From a name to a policy: load it, merge the settings once, fit it to the field once."""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from baselines.algorithms import find_algorithm
from baselines.policies.classical import CLASSICAL, make_classical
from baselines.policies.loaded import LoadedPolicy, needs_field
from baselines.policies.own import FORM, OwnPolicy, import_own, is_own
from baselines.policies.policy import Origin, RandomPolicy, TrainedPolicy
from baselines.runs.files import RunError, reading
from baselines.runs.folder import RunFolder
from mbn_marl.config import CONDITIONS, Condition, expand, make_config
from mbn_marl.engine.validation import reset_problems
from mbn_marl.episode import is_episode_file
from mbn_marl.errors import ConfigError, FieldError, MbnError, unknown
from mbn_marl.field import Field, catalogue_names, load_field

ENTRIES = Path(__file__).parents[1] / "zoo"
PREFIX = "zoo:"
CARD = "card.json"
RANDOM = "random"
# The zoo's policy of each field.
ZOO = "zoo"
NAMES = (*CLASSICAL, RANDOM, ZOO)


def entry_names() -> list[str]:
    found = [path.parent for path in ENTRIES.glob(f"*/{CARD}")]
    # NAME.1 was moved aside for NAME; a label may have dots too.
    return sorted(one.name for one in found if not (one.suffix and one.with_suffix("") in found))


def open_run(source: str) -> RunFolder:
    if not source.startswith(PREFIX):
        return RunFolder.open(Path(source))
    name, known = source.removeprefix(PREFIX), entry_names()
    if name not in known:
        raise MbnError(f"{source}: {unknown('policy', source, [PREFIX + one for one in known])}")
    return RunFolder.open(ENTRIES / name)


def load_trained(run: Path | RunFolder) -> TrainedPolicy:
    folder = run if isinstance(run, RunFolder) else RunFolder.open(run)
    with reading(folder.path / "config.json"):
        algorithm = find_algorithm(folder.config["algorithm"])
        origin = Origin(folder.fields, make_config(folder.config["environment"]))
    while True:
        place = folder.policy
        try:
            policy: TrainedPolicy = algorithm.load_policy(place)
        except RunError:
            if folder.policy == place:
                raise
            continue  # the run has written its next checkpoint meanwhile, and removed this one
        policy.origin = origin
        return policy


def is_trained(source: str) -> bool:
    # A folder that has the name of a policy needs ./ before it, in every directory.
    return source.startswith(PREFIX) or (source not in NAMES and Path(source).is_dir())


def is_policy(source: str) -> bool:
    return source in NAMES or is_own(source) or is_trained(source)


def check_known(source: str) -> None:
    if not is_policy(source):
        others = f"{PREFIX}NAME", FORM, "the folder of a run"
        problem = unknown("policy", source, (*NAMES, *others))
        if source in catalogue_names():
            problem = f"is a field; name a policy, for example: greedy --field {source}"
        elif "/" in source:
            beside = [one.name for one in Path(source).parent.glob("*/")]
            problem, *_ = unknown("folder", Path(source).name, beside).split("; known")
            problem = problem.replace("unknown", "there is no such", 1)
        raise RunError(f"{source}: {problem}")
    if source.startswith(PREFIX):
        open_run(source)


class Source:
    """A policy by name, with what is the same in all fields loaded: weights, or your module."""

    def __init__(self, name: str) -> None:
        check_known(name)
        self.name = name
        self.run = open_run(name) if is_trained(name) else None
        self._trained: Any = None if self.run is None else load_trained(self.run)
        self._own = import_own(name) if self.run is None and is_own(name) else None

    def make(
        self,
        field: str | Path | Field | None = None,
        *,
        seed: int = 0,
        condition: Condition | None = None,
        **asked: Any,
    ) -> LoadedPolicy:
        if problems := reset_problems(seed, 0):
            raise ConfigError("policy", problems)
        place: Any = None if field is None else load_field(field)
        if place is None and self.name in (ZOO, *CLASSICAL):
            raise needs_field(self.name)
        source = Source(f"{PREFIX}{place.name}") if self.name == ZOO else self
        name = self.name if place is None else f"{self.name} in {place.name}"
        policy: Any = RandomPolicy(seed)
        brought = CLASSICAL.get(self.name, {})
        if source.run is not None:
            policy, brought = source._trained, source.run.config["environment"]
            if place is None and isinstance(home := source.run.fields, Field):
                place = home
        elif self._own is not None:
            policy = OwnPolicy(self.name, self._own, place)
            brought = policy.settings
        settings = merge_settings(brought, condition, **asked)
        if self.name in CLASSICAL:
            policy = make_classical(self.name, place, settings)
        return LoadedPolicy(name, policy, settings, place)


def find_policy(
    source: str, field: str | None = None, *, alone: Callable[[str], str] | None = None, **how: Any
) -> LoadedPolicy:
    """Return a command line's policy; ``alone`` names the one for a ``source`` that is a field."""
    if is_episode_file(source):
        raise ConfigError("policy", [f"{source} is an episode; `mbn replay` plays it"])
    if alone is not None and field is None and not is_policy(source):
        if not Path(source).suffix and source not in (known := catalogue_names()):
            problem = unknown("policy or field", source, (*CLASSICAL, RANDOM, *known))
            raise FieldError("field", [f"{source}: {problem}"])
        load_field(source)
        field, source = source, alone(source)
    found = Source(source).make(field, **how)
    _ = found.place  # raises
    return found


def of_zoo(field: str) -> str:
    """Return the zoo's policy for a field of the catalogue if there is one, else random."""
    return f"{PREFIX}{field}" if field in entry_names() else RANDOM


def merge_settings(
    settings: Mapping[str, Any], condition: Condition | None, **asked: Any
) -> dict[str, Any]:
    """Return settings with others in their place; a condition replaces weather and failures."""
    if asked.get("knowledge") == "own":  # which the default observation does not show
        settings = {"observation": "entities", **settings}
    if condition is None:
        return {**settings, **asked}
    weather = {name for one in CONDITIONS if one != "mixed" for name in CONDITIONS[one]}
    others = {name: value for name, value in expand(settings).items() if name not in weather}
    return {**others, **expand({**asked, "condition": condition})}
