"""``mbn evaluate``, ``zoo`` and ``export``: trained policies, and classical ones."""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from baselines.cli.options import OptionalOutput, Output, Subject, Writes, check_options
from baselines.compare.text_table import TextTable, shown
from baselines.runs.files import claim_folder, read_json, write_json
from baselines.runs.folder import RunFolder
from mbn_marl.config import make_config
from mbn_marl.field import FieldSampler
from mbn_marl.files import check_ending, check_free, claim_file

ONE_EPISODE = "deterministic:\none episode"
NUMBERS = {
    **{"SPL": ("spl", "{:.1%}"), "success": ("success_rate", "{:.1%}"), "gap": ("gap", "{:.1%}")},
    **{"makespan": ("makespan", "{:.1f}"), "return": ("return_mean", "{:,.0f}")},
}
OF_GAPS = "gap: makespan over the proved optimum; SPL: optimum / makespan, failures 0"


@dataclass(frozen=True, kw_only=True)
class Evaluate(Subject):
    """Evaluate a policy on fresh episodes, with sampled and with mean actions."""

    episodes: int = 100
    """The number of episodes."""
    seed: int | None = None
    """Of the episodes; by default the seed that every run's final evaluation has."""
    json: Path | None = None
    """Write every episode to this file."""
    record: Path | None = None
    """A new folder for the best, the median and the worst sampled episode, for `mbn replay`."""
    shield: bool = False
    """Let robots do only what they could brake after, whatever the policy wants."""

    def run(self, command_line: str) -> None:
        from baselines.evaluation import evaluate
        from baselines.policies.load import find_policy, is_trained, open_run
        from baselines.policies.shielded import Shielded, behind
        from mbn_marl.engine.validation import reset_problems
        from mbn_marl.episode import save_episode

        seed = evaluate.EVALUATION_SEED if self.seed is None else self.seed
        wrong = {
            f"episodes: at least 1, not {self.episodes}": self.episodes < 1,
            "json and record: allowed are two names": self.json and self.json == self.record,
        }
        check_options("evaluation", wrong, reset_problems(seed, 0))
        actor = find_policy(self.source, self.field, seed=seed, **self.asked)
        if is_trained(self.source) and (unfinished := open_run(self.source).unfinished):
            print(unfinished)
        title = f"{actor.name}{behind(self.shield)}{self.weather}"
        policy = Shielded(actor.policy) if self.shield else actor.policy
        if self.json is not None:
            check_free(self.json, force=self.force)
        if self.record is not None:
            claim_folder(self.record, force=self.force)
        where = policy, actor.place, actor.settings
        how: dict[str, Any] = {"episodes": self.episodes, "seed": seed}
        if self.record is not None:
            drawn = ", sampled actions" if policy.draws(deterministic=False) else ""
            how |= {"record": range(self.episodes), "source": title + drawn}
        results = evaluate.evaluate_both(*where, **how)
        one = partial(evaluate.is_one_episode, policy, actor.settings)
        summaries = {name: result.summary() for name, result in results.items()}
        print_evaluations(summaries.values(), title, one)
        if self.json is not None:
            heading: dict[str, Any] = {"command": command_line, "condition": self.condition}
            heading["shield"] = self.shield
            episodes = {name: result.to_json() for name, result in results.items()}
            write_json(claim_file(self.json, force=self.force), {**heading, **episodes})
        if self.record is not None:
            recorded = evaluate.extremes(results["stochastic"])
            for name, episode in recorded.items():
                named = replace(episode, source=f"{episode.source}, {name}")
                save_episode(named, self.record / f"{name}.json")
            print(f"recorded: {', '.join(recorded)} in {self.record}")


def print_evaluations(
    summaries: Iterable[Mapping[str, Any]],
    title: str,
    one: Callable[..., bool] = lambda *, deterministic: False,
) -> None:
    """Print summaries, one a row; ``one`` says if all episodes of a row are the same."""
    lines = []
    for row in summaries:
        episodes = ONE_EPISODE if one(deterministic=row["deterministic"]) else str(row["episodes"])
        actions, *numbers = _cells(row)
        lines.append((actions, episodes, *numbers))
    TextTable(OF_GAPS, ("actions", "episodes", *NUMBERS), lines).print(title)


def _cells(summary: Mapping[str, Any]) -> Iterator[str]:
    yield "mean" if summary["deterministic"] else "sampled"
    for name, form in NUMBERS.values():
        yield shown(summary[name], form)


@dataclass(frozen=True)
class Zoo(Writes):
    """List the trained policies that `mbn evaluate` and `mbn render` take as zoo:NAME."""

    add: Annotated[Path | None, arg(metavar="RUN")] = None
    """Make an entry of this finished run: evaluate its policy and write its card."""
    out: OptionalOutput = None
    """The folder to make; by default the package's own, named as the run's field or label."""

    def run(self, command_line: str) -> None:
        from baselines.policies.load import CARD, ENTRIES, entry_names
        from baselines.zoo.make import make_entry

        check_options("zoo", {"out: allowed with --add": self.out and self.add is None})
        if self.add is None:
            print_cards([read_json(ENTRIES / name / CARD) for name in entry_names()])
            return
        run = RunFolder.open(self.add)
        sampled, config = isinstance(run.fields, FieldSampler), run.config
        name = (config["label"] or config["algorithm"]) if sampled else run.field.name
        print_cards([make_entry(run, self.out or ENTRIES / name, force=self.force)])


def print_cards(cards: Iterable[Mapping[str, Any]]) -> None:
    lines = [
        (f"zoo:{card['name']}", card["information"], *_cells(card[kind]), f"{card['env_steps']:,}")
        for card in cards
        for kind in ("stochastic", "deterministic")
    ]
    headings = ("policy", "information", "actions", *NUMBERS, "env-steps")
    TextTable(OF_GAPS, headings, lines, words=3).print()


@dataclass(frozen=True)
class Export(Writes):
    """Write the mean actions of a trained policy as an ONNX file."""

    policy: Positional[Annotated[str, arg(metavar="POLICY")]]
    """The folder of a run, or zoo:NAME (see `mbn zoo`)."""
    out: Output
    """The .onnx file to write."""
    field: str | None = None
    """A name of `mbn fields`, or a field file; by default that of the run or of zoo:NAME."""

    def run(self, command_line: str) -> None:
        from baselines.policies.export import ALLOWED, export_policy
        from baselines.policies.load import check_known, find_policy, is_trained

        check_ending(self.out, ".onnx")
        check_known(self.policy)
        check_options("export", {f"{self.policy}: {ALLOWED}": not is_trained(self.policy)})
        policy = find_policy(self.policy, self.field)
        metadata, difference = export_policy(policy, self.out, force=self.force)
        shape, returned = (", ".join(map(str, metadata[name])) for name in ("shape", "returns"))
        print(f"takes    {metadata['takes']} ({shape}) of W worlds, raw numbers")
        if metadata["takes"] == "observations":
            config = make_config(policy.settings)
            print(f"         observation={config.observation!r}, one_hot={config.one_hot}")
        print(f"returns  actions ({returned}), means in [-1, 1]")
        print(f"made for {metadata['field']}; all settings are in the file, under mbn_marl")
        print(f"written to {self.out}; differs from the policy by {difference:.0e} at most")
