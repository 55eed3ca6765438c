"""Tables of the site that are made from the code, so that they cannot say anything else.

``observation-table NAME`` lists the entries of an observation, ``settings-table`` the settings of
the environment, ``fields-table`` the catalogue.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from itertools import groupby
from typing import ClassVar

from docutils import nodes
from docutils.statemachine import StringList
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective

from mbn_marl.config import LIMITS, NUMBERS, NavigationConfig, make_config
from mbn_marl.engine import Entry
from mbn_marl.engine.mdp.observations import observation_table
from mbn_marl.field import catalogue_names, load_field

Rows = Sequence[Sequence[str]]

FIELD = "field_03"
"""Whose observations are listed: three robots, six ROIs."""


class Table(SphinxDirective):
    """A table whose rows a subclass makes, written as Markdown."""

    headings: ClassVar[Sequence[str]]

    def rows(self) -> Rows:
        """The cells, as Markdown."""
        raise NotImplementedError

    def run(self) -> list[nodes.Node]:
        lines = [self.headings, ["---"] * len(self.headings), *self.rows()]
        text = [
            "| " + " | ".join(cell.replace("|", r"\|") for cell in line) + " |" for line in lines
        ]
        container = nodes.Element()
        self.state.nested_parse(StringList(text, self.get_source_info()[0]), 0, container)
        return list(container.children)


class ObservationTable(Table):
    """The entries of one robot's observation, neighbours of one kind in a row."""

    required_arguments = 1
    headings = ("index", "entries", "low", "high", "unit")

    def rows(self) -> Rows:
        """A row for each run of entries of the same thing with the same bounds and unit."""
        field = load_field(FIELD)
        config = make_config({"observation": self.arguments[0]})
        table = observation_table(config, len(field.starts), len(field.rois), field.arena)
        return list(_runs(table))


def _runs(table: Sequence[Entry]) -> Iterator[list[str]]:
    for key, run in groupby(table, lambda entry: (_subject(entry.name), *entry[2:])):
        entries = list(run)
        first, last = entries[0].offset, entries[-1].offset
        index = str(first) if first == last else f"{first} to {last}"
        names = ", ".join(f"`{entry.name}`" for entry in entries)
        yield [index, names, f"{key[1]:g}", f"{key[2]:g}", key[3]]


def _subject(name: str) -> str:
    """The subject of an entry: ``other_1`` of ``other_1_dx``, ``own`` of ``own_x``."""
    return name.rsplit("_", 1)[0]


class SettingsTable(Table):
    """The settings of the environment, as the table in ``config.py`` describes them."""

    headings = ("setting", "default", "meaning")

    def rows(self) -> Rows:
        return [
            [f"`{name}`", f"`{getattr(field.default, 'name', field.default)!r}`", _meaning(name)]
            for name, field in NavigationConfig.model_fields.items()
        ]


def _meaning(name: str) -> str:
    """The description of a setting, as Markdown."""
    text = NavigationConfig.model_fields[name].description or ""
    text = " ".join(text.split()).replace("``", "`").replace(":class:", "")
    return f"{text} May be drawn." if name in (*NUMBERS, *LIMITS) else text


class FieldsTable(Table):
    """The catalogue."""

    headings = ("field", "starts", "ROIs", "corners", "area, units²", "proved makespan, steps")

    def rows(self) -> Rows:
        fields = [load_field(name) for name in catalogue_names()]
        return [
            [
                f"`{field.name}`",
                str(len(field.starts)),
                str(len(field.rois)),
                str(len(field.vertices)),
                f"{field.polygon.area:,.0f}",
                str(field.optimal_makespan),
            ]
            for field in fields
        ]


def setup(app: Sphinx) -> dict[str, bool]:
    app.add_directive("observation-table", ObservationTable)
    app.add_directive("settings-table", SettingsTable)
    app.add_directive("fields-table", FieldsTable)
    return {"parallel_read_safe": True}
