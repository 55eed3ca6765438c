"""Running the notebooks: ``python -m docs.extensions.notebooks`` renews the outputs they keep."""

from __future__ import annotations

import os
from pathlib import Path

import nbformat
from nbclient import NotebookClient
from nbformat import NotebookNode

FOLDER = Path(__file__).parents[1] / "notebooks"
SECONDS = 300
"""The longest that a cell may take."""
ONE_THREAD = {"OMP_NUM_THREADS": "1", "NUMBA_NUM_THREADS": "1"}
"""On a busy machine, several threads mostly wait for each other."""


def notebooks() -> list[Path]:
    return sorted(FOLDER.glob("*.ipynb"))


def run(path: Path) -> NotebookNode:
    """The notebook at ``path``, run from top to bottom, with its new outputs.

    What libraries write to stderr is left out: it depends on what else is installed.

    Raises:
        CellExecutionError: a cell raised an error.
    """
    notebook = nbformat.read(path, as_version=4)
    client = NotebookClient(notebook, timeout=SECONDS, record_timing=False, coalesce_streams=True)
    client.execute(cwd=FOLDER, env={**os.environ, **ONE_THREAD})
    for cell in notebook.cells:
        if cell.cell_type == "code":
            cell.outputs = [output for output in cell.outputs if output.get("name") != "stderr"]
    notebook.metadata = {"kernelspec": notebook.metadata["kernelspec"]}
    return notebook


def texts(notebook: NotebookNode) -> list[list[str]]:
    """The output of each code cell as text; nothing for cells tagged ``varies``."""
    cells = [cell for cell in notebook.cells if cell.cell_type == "code"]
    return [
        []
        if "varies" in cell.metadata.get("tags", ())
        else [
            output.get("text") or output.get("data", {}).get("text/plain", "")
            for output in cell.outputs
        ]
        for cell in cells
    ]


if __name__ == "__main__":
    for path in notebooks():
        nbformat.write(run(path), path)
