"""Comparing runs that are there already."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path

from baselines.compare.html import comparison_page
from baselines.compare.markdown import PAGE, write_comparison
from baselines.compare.records import find_records
from baselines.compare.results import Results
from baselines.compare.summary import Comparison, summarise
from baselines.runs.provenance import write_provenance
from baselines.runs.report_path import Place
from mbn_marl.files import claim_file, replacing


def report_comparison(
    paths: Sequence[Path],
    out: Path,
    *,
    command: str,
    force: bool = False,
    note: Callable[[str], None] = lambda text: None,
) -> Comparison:
    """Compare the finished runs at ``paths``, wherever they were trained.

    Args:
        paths: run folders, or folders that hold some.
        out: an ``.html`` file for one self-contained page; otherwise see :meth:`Place.of`.
        command: the exact command, recorded in the folder or on the page.
        force: move a report that is already there aside.
        note: receives the folders at ``paths`` that are left out, and why.

    Raises:
        RunError: a path holds no run, a run is not finished, or something is at ``out`` already.
        MbnError: there is a page at ``out`` already.
        ConfigError: naming everything that keeps the runs from being compared.
    """
    results = Results.of(find_records(paths, note))
    if is_page(out):
        if not force and out.exists():
            claim_file(out)  # raises before the work
        comparison = summarise(results)
        page = comparison_page(results, comparison, command)
        with replacing(claim_file(out, force=force)) as temporary:
            temporary.write_text(page, encoding="utf-8")
        return comparison
    place = Place.of(out, PAGE)
    place.claim(force=force)
    write_provenance(place.folder, command)
    return write_comparison(results, place)


def is_page(out: Path) -> bool:
    """Return whether a comparison at ``out`` is one self-contained page."""
    return out.suffix.lower() == ".html"
