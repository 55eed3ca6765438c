"""``mbn fields``: fields as a table or as a figure, and random ones as files."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from tyro.conf import Positional, arg

from baselines.cli.options import check_options

if TYPE_CHECKING:
    from mbn_marl.field import Field


@dataclass(frozen=True)
class Fields:
    """List fields: robots, ROIs, edges, area, proved optimum. Or make random ones."""

    fields: Positional[Annotated[tuple[str, ...], arg(metavar="FIELD")]] = ()
    """Names or files; by default the whole catalogue."""
    generate: Annotated[tuple[str, ...], arg(metavar="FAMILY ...")] = ()
    """Random fields instead: of the families convex, concave, corridors, obstacles, farm."""
    seed: int = 0
    """Of the first random field of each family; the next one has the next seed."""
    count: int = 1
    """How many random fields of each family."""
    robots: int = 3
    """Of each random field."""
    rois: int = 6
    """Of each random field."""
    size: tuple[float, float] | None = None
    """The longest side of random fields, from and to, units; by default 110 420, or more."""
    out: Annotated[Path | None, arg(aliases=["-o"])] = None
    """The folder to write random fields to, each as a field file."""
    figure: Path | None = None
    """Draw them in this file (.png, .pdf or .svg), side by side."""
    force: bool = False
    """If files to write exist, move them aside."""

    def run(self, command_line: str) -> None:
        """Print the table; write what is asked for."""
        from mbn_marl.field import catalogue_names, load_field

        self._check()
        made = [self._make(family, k) for k in range(self.count) for family in self.generate]
        fields = made or [load_field(name) for name in self.fields or catalogue_names()]
        self._print(fields)
        if self.out is not None:
            self._write(fields, self.out)
        if self.figure is not None:
            self._draw(fields, self.figure)

    def _check(self) -> None:
        names = ("seed", "count", "robots", "rois", "size", "out")
        own = [name for name in names if getattr(self, name) != getattr(Fields, name)]
        wrong: dict[str, object] = {
            f"{', '.join(own)}: only with --generate": own and not self.generate,
            "generate: not with names or files": self.generate and self.fields,
            f"count: at least 1, not {self.count}": self.count < 1,
        }
        check_options("fields", wrong)

    def _make(self, family: str, k: int) -> Field:
        from mbn_marl.field import generate

        seed = self.seed + k
        return generate(family, seed, robots=self.robots, rois=self.rois, size=self.size)

    def _print(self, fields: Sequence[Field]) -> None:
        from baselines.compare.text_table import TextTable
        from mbn_marl.optimum import optimal_return

        lines = []
        for field in fields:
            makespan, optimum = field.optimal_makespan, optimal_return(field)
            counts = (field.starts, field.rois, field.holes, field.edges)
            best = "-" if optimum is None else f"{optimum:,.0f}"
            area = f"{field.polygon.area:,.0f}"
            lines.append(
                (field.name, *(str(len(one)) for one in counts), area, str(makespan or "-"), best)
            )
        headings = ("field", "robots", "ROIs", "holes", "edges", "area", "makespan", "return")
        title = "fields (makespan, return: proved optima, released rewards, no wind)"
        TextTable("", headings, tuple(lines)).print(title)

    def _write(self, fields: Sequence[Field], folder: Path) -> None:
        from mbn_marl.field import save_field
        from mbn_marl.files import check_free, claim_file

        paths = [folder / f"{field.name}.yaml" for field in fields]
        for path in paths:
            check_free(path, force=self.force)
        folder.mkdir(parents=True, exist_ok=True)
        for field, path in zip(fields, paths, strict=True):
            save_field(field, claim_file(path, force=self.force))
        print(f"{len(paths)} written to {folder}")

    def _draw(self, fields: Sequence[Field], path: Path) -> None:
        from mbn_marl.files import claim_file
        from mbn_marl.render import figures

        alone = len(fields) == 1
        figure = figures.field_figure(fields[0]) if alone else figures.fields_figure(fields)
        place = claim_file(figures.check_name(path), force=self.force)
        print(f"written to {figures.save(figure, place)}")
