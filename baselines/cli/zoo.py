"""``mbn zoo``: the trained policies that come with the package."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import arg


@dataclass(frozen=True)
class Zoo:
    """List the trained policies that `mbn evaluate` and `mbn render` take as zoo:NAME."""

    add: Annotated[Path | None, arg(metavar="RUN")] = None
    """Make an entry of this finished run: evaluate its policy and write its card."""
    out: Path | None = None
    """The folder to make; by default the package's own, named as the run's field, or as its label
    if it was trained on random fields."""

    def run(self, command_line: str) -> None:
        """Print the cards, after adding one if a run is named."""
        from baselines.policies.trained import ENTRIES, entry_names, read_card
        from baselines.runs.folder import RunFolder
        from baselines.zoo.make import make_entry
        from mbn_marl.errors import ConfigError
        from mbn_marl.field import FieldSampler

        if self.add is not None:
            run = RunFolder.open(self.add)
            sampled, config = isinstance(run.fields, FieldSampler), run.config
            name = (config["label"] or config["algorithm"]) if sampled else run.field.name
            print_cards([make_entry(run, self.out or ENTRIES / name)])
        elif self.out is not None:
            raise ConfigError("zoo", ["out: allowed with --add"])
        else:
            print_cards([read_card(name) for name in entry_names()])


def print_cards(cards: list[Mapping[str, Any]]) -> None:
    """Print cards as a table, one a row: returns with sampled and with mean actions."""
    from baselines.compare.text_table import TextTable

    headings = ("policy", "algorithm", "env-steps", "sampled\nactions", "success", "mean\nactions")
    lines = tuple(
        (
            f"zoo:{card['name']}",
            card["algorithm"],
            f"{card['env_steps']:,}",
            f"{card['stochastic']['return_mean']:,.0f}",
            f"{card['stochastic']['success_rate']:.0%}",
            f"{card['deterministic']['return_mean']:,.0f}",
            "-" if card["optimum"] is None else f"{card['optimum']:,.0f}",
        )
        for card in cards
    )
    TextTable("", (*headings, "optimum"), lines).print("")
