"""Brings figures and tables of a study into the pages of evidence.

    python docs/make_study.py runs/study-NAME/report

Figures go to docs/images/study (benches) or docs/images/paper-study. Tables are between
`<!-- study: NAME/TABLE ... -->` and `<!-- end of study -->`. What follows the table's name selects rows:
`mismatch=small/large; strategy=D3`. A column with one selected value is left out, and so are those after `without=`.
"""

from __future__ import annotations

import csv
import re
import shutil
import sys
from pathlib import Path

DOCS = Path(__file__).parent
PAGES, IMAGES = sorted((DOCS / "evidence").glob("*.md")), DOCS / "images"
MARKED = re.compile(
    r"(<!-- study: (?P<study>\w+)/(?P<name>[\w-]+)(?P<wanted>[^>]*) -->\n).*?(?P<end><!-- end of study -->)", re.DOTALL
)
FIGURES = {
    "benches": ("study", ("3b", "6")),
    "paper": ("paper-study", ("6",)),
}
"""Folder of the images, and the figures that the pages show, by the name of the study."""


def table(path: Path, wanted: dict[str, set[str]]) -> str:
    """A CSV of the report as Markdown, a mean and its interval in one cell."""
    without = wanted.pop("without", set())
    with path.open(encoding="utf-8") as file:
        reader = csv.DictReader(file)
        rows = [row for row in reader if all(row[name] in some for name, some in wanted.items())]
        names = list(reader.fieldnames or [])
    shown = [name for name in names if not name.endswith((", low", ", high")) and len(wanted.get(name, "12")) > 1]
    shown = [name for name in shown if name not in without]
    found = [[cell(row, name) if f"{name}, low" in names else row[name] for name in shown] for row in rows]
    lines = [f"| {' | '.join(shown)} |", f"|{'---|' * len(shown)}"]
    return "\n".join([*lines, *(f"| {' | '.join(cells)} |" for cells in found)]) + "\n"


def cell(row: dict[str, str], name: str) -> str:
    """'1.23 [0.80, 1.71]'."""
    mean, low, high = (float(row[key]) for key in (name, f"{name}, low", f"{name}, high"))
    return f"{mean:.2f} [{low:.2f}, {high:.2f}]" if low == low else f"{mean:.2f}"


def fill(text: str, report: Path, study: str) -> str:
    """The page with the tables of a study as its report has them."""

    def filled(match: re.Match[str]) -> str:
        if match["study"] != study:
            return match[0]
        wanted: dict[str, set[str]] = {}
        for part in match["wanted"].strip(" ;").split(";"):
            if part.strip():
                name, _, values = part.strip().partition("=")
                wanted[name.strip()] = {value.strip() for value in values.split("/")}
        return match[1] + table(report / f"{match['name']}.csv", wanted) + match["end"]

    return MARKED.sub(filled, text)


def main() -> None:
    """Write them."""
    report = Path(sys.argv[1]).resolve()
    study = report.parent.name.removeprefix("study-")
    folder, numbers = FIGURES[study]
    (IMAGES / folder).mkdir(parents=True, exist_ok=True)
    for number in numbers:
        shutil.copyfile(report / f"figure-{number}.png", IMAGES / folder / f"figure-{number}.png")
    for page in PAGES:
        page.write_text(fill(page.read_text(encoding="utf-8"), report, study), encoding="utf-8")


if __name__ == "__main__":
    main()
