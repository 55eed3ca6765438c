"""Where a report goes: a page, and a folder beside it or around it."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from baselines.runs.files import claim_folder
from mbn_marl.files import check_free, claim_file


@dataclass(frozen=True)
class Place:
    """The Markdown page of a report, and the folder of everything else."""

    page: Path
    folder: Path

    @classmethod
    def of(cls, out: Path, page: str) -> Place:
        """Return where ``out`` says: ``NAME.md`` is the page, beside its folder ``NAME``.

        Any other path is the folder, and ``page`` the name of the page in it.
        """
        if out.suffix == ".md":
            return cls(out, out.with_suffix(""))
        return cls(out / page, out)

    def claim(self, *, force: bool) -> None:
        """Make the folder; with ``force`` move what is there aside, or else raise an MbnError."""
        beside = self.page.parent != self.folder
        if beside:
            check_free(self.page, force=force)
        claim_folder(self.folder, force=force)
        if beside:
            claim_file(self.page, force=force)

    def link(self, name: str) -> str:
        """Return the link from the page to a file of the folder."""
        return (self.folder / name).relative_to(self.page.parent).as_posix()
