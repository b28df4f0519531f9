"""Makes docs/library.ipynb of docs/tutorials/notebook.md: the same text and examples, executed, with their pictures.

    python docs/make_notebook.py

The page is the source. Where it saves a figure, the notebook shows it.
"""

from __future__ import annotations

import os
import re
import tempfile
from pathlib import Path

import nbformat
from nbclient import NotebookClient

DOCS = Path(__file__).resolve().parent
PAGE, NOTEBOOK = DOCS / "tutorials" / "notebook.md", DOCS / "library.ipynb"

CELL = re.compile(r"^\S*/ipykernel_\d+/\d+\.py:\d+: ", flags=re.MULTILINE)
"""Where a warning was issued: a file of the kernel, which has another name each time."""

SHOWN = re.compile(r"^(.*)\.savefig\(.*\)$", flags=re.MULTILINE)


def notebook() -> nbformat.NotebookNode:
    """The page as a notebook that has not been executed."""
    book = nbformat.v4.new_notebook()
    book.metadata["kernelspec"] = {"name": "python3", "display_name": "Python 3", "language": "python"}
    cells = [nbformat.v4.new_code_cell("%matplotlib inline")]
    for number, piece in enumerate(
        re.split(r"```python\n(.*?)```\n", PAGE.read_text(encoding="utf-8"), flags=re.DOTALL)
    ):
        text = piece.strip()
        if text:
            cells.append(nbformat.v4.new_code_cell(SHOWN.sub(r"\1", text)) if number % 2 else _text(text))
    book.cells = cells
    for place, cell in enumerate(cells):
        cell["id"] = f"cell-{place}"
    return book


def _text(text: str) -> nbformat.NotebookNode:
    return nbformat.v4.new_markdown_cell(text)


def executed(folder: Path) -> nbformat.NotebookNode:
    """The notebook with what its cells put out, run in a folder of its own."""
    book = notebook()
    NotebookClient(book, timeout=900, kernel_name="python3", resources={"metadata": {"path": str(folder)}}).execute()
    for cell in book.cells:
        cell.metadata = {}  # times of execution
        if cell.cell_type == "code":
            cell.outputs = _joined(cell.outputs)
    return book


def _joined(outputs: list[nbformat.NotebookNode]) -> list[nbformat.NotebookNode]:
    """What a cell printed in one piece; in how many it came is chance."""
    joined: list[nbformat.NotebookNode] = []
    for output in outputs:
        if output.output_type == "stream":
            output.text = CELL.sub("", output.text)
        last = joined[-1] if joined else None
        if last is not None and output.output_type == last.output_type == "stream" and output.name == last.name:
            last.text += output.text
        else:
            joined.append(output)
    return joined


def main() -> None:
    """Write the notebook."""
    os.environ["PYTHONPATH"] = str(DOCS.parent)
    with tempfile.TemporaryDirectory() as folder:
        nbformat.write(executed(Path(folder)), NOTEBOOK)
    print(f"{NOTEBOOK.name}: {NOTEBOOK.stat().st_size / 1e3:.0f} kB")


if __name__ == "__main__":
    main()
