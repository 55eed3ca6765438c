"""``mbn fields``: fields as a table or as a figure; random ones, or one of a map, as files."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from tyro.conf import Positional, arg

from baselines.cli.options import OptionalOutput, Writes, check_options
from baselines.compare.text_table import TextTable, shown
from mbn_marl.errors import FieldError, collecting
from mbn_marl.field import Field, catalogue_names, generate, load_field, load_map, save_field
from mbn_marl.files import check_free, claim_file
from mbn_marl.optimum import optimal_return


@dataclass(frozen=True)
class Fields(Writes):
    """List fields: robots, ROIs, edges, area, proved optimum. Or make random ones, or a map's."""

    fields: Positional[Annotated[tuple[str, ...], arg(metavar="[FIELD ...]")]] = ()
    """Names or files; by default the whole catalogue."""
    generate: Annotated[tuple[str, ...], arg(metavar="FAMILY ...")] = ()
    """Random fields instead: of the families convex, concave, corridors, obstacles, farm."""
    map: Annotated[str | None, arg(name="from", metavar="MAP")] = None
    """A GeoJSON or WKT file, of which a field is made; MAP#NAME picks one of its polygons."""
    metres_per_unit: float = 1.0
    """The length of a unit, of a map."""
    seed: int = 0
    """Of the first random field of each family; the next one has the next seed."""
    count: int = 1
    """The number of random fields of each family."""
    robots: int = 3
    """Of each random field, or of a map without starts."""
    rois: int = 6
    """Of each random field, or of a map without ROIs."""
    size: tuple[float, float] | None = None
    """The longest side of random fields, from and to, units; by default 110 420, or more."""
    out: OptionalOutput = None
    """The folder to write random fields to, or the field file to make of a map."""
    figure: Path | None = None
    """Draw them in this file (.png, .pdf or .svg), side by side."""

    def run(self, command_line: str) -> None:
        self._check()
        fields, problems = self._made(), list[str]()
        for name in self.fields or (() if fields else catalogue_names()):
            with collecting(problems):
                fields.append(load_field(name))
        paths = list[Path]()
        if self.out is not None:
            random = [self.out / f"{field.name}.yaml" for field in fields]
            paths = random if self.map is None else [self.out]
        for path in paths:
            with collecting(problems):
                check_free(path, force=self.force)
        if problems:
            raise FieldError("fields", problems)
        self._print(fields)
        if self.out is not None:
            for field, path in zip(fields, paths, strict=True):
                save_field(field, claim_file(path, force=self.force))
            print(f"{len(paths)} written to {self.out}")
        if self.figure is not None:
            from mbn_marl.render import figures

            alone = len(fields) == 1
            figure = figures.field_figure(fields[0]) if alone else figures.fields_figure(fields)
            path = claim_file(self.figure, force=self.force)
            print(f"written to {figures.save(figure, path)}")

    def _check(self) -> None:
        def given(*names: str) -> list[str]:
            return [name for name in names if getattr(self, name) != getattr(Fields, name)]

        new = given("seed", "robots", "rois", "out")
        of_sampler = given("count", "size")
        no_yaml = self.out and self.out.suffix not in (".yaml", ".yml")
        wrong: dict[str, object] = {
            f"{', '.join(new)}: only with --generate or --from": (
                new and not (self.generate or self.map)
            ),
            f"{', '.join(of_sampler)}: only with --generate": of_sampler and not self.generate,
            "metres_per_unit: only with --from": given("metres_per_unit") and not self.map,
            "generate: not with names or files": self.generate and self.fields,
            "from: not with --generate, names or files": (
                self.map and (self.generate or self.fields)
            ),
            f"count: at least 1, not {self.count}": self.count < 1,
            f"generate: {', '.join(self.generate)}; allowed: each once": (
                len({*self.generate}) < len(self.generate)
            ),
            f"out: a name that ends in .yaml, not {self.out}": self.map and no_yaml,
        }
        check_options("fields", wrong)
        if self.figure is not None:
            from mbn_marl.render import figures

            check_free(figures.check_name(self.figure), force=self.force)

    def _made(self) -> list[Field]:
        counts: dict[str, Any] = {"robots": self.robots, "rois": self.rois}
        if self.map is not None:
            scale = self.metres_per_unit
            field, notes = load_map(self.map, metres_per_unit=scale, seed=self.seed, **counts)
            print("\n".join(notes))
            return [field]
        return [
            generate(family, self.seed + k, size=self.size, **counts)
            for k in range(self.count)
            for family in self.generate
        ]

    def _print(self, fields: Sequence[Field]) -> None:
        lines = [
            (
                field.name,
                *(str(len(one)) for one in (field.starts, field.rois, field.holes, field.edges)),
                shown(field.polygon.area),
                str(field.optimal_makespan or "-"),
                shown(optimal_return(field)),
            )
            for field in fields
        ]
        headings = ("field", "robots", "ROIs", "holes", "edges", "area", "makespan", "return")
        title = "fields (makespan, return: proved optima, released rewards, no wind)"
        TextTable("", headings, lines).print(title)
