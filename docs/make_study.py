"""Brings a study's figures and tables into docs/evidence/results.md.

    python docs/make_study.py runs/study-benches/report

Figures go to docs/images/study; tables stand between `<!-- study: NAME ... -->` and `<!-- end of study -->`.
What follows the name picks rows: `mismatch=small/large; strategy=D3`. A column of one wanted value is left out.
"""

from __future__ import annotations

import csv
import re
import shutil
import sys
from pathlib import Path

DOCS = Path(__file__).parent
PAGE, IMAGES = DOCS / "evidence" / "results.md", DOCS / "images" / "study"
MARKED = re.compile(r"(<!-- study: (?P<name>[\w-]+)(?P<wanted>[^>]*) -->\n).*?(<!-- end of study -->)", re.DOTALL)
FIGURES = ("3b", "6", "final")
"""Those that the page shows."""


def table(path: Path, wanted: dict[str, set[str]]) -> str:
    """A CSV of the report as Markdown, a mean and its interval in one cell."""
    with path.open(encoding="utf-8") as file:
        reader = csv.DictReader(file)
        rows = [row for row in reader if all(row[name] in some for name, some in wanted.items())]
        names = list(reader.fieldnames or [])
    shown = [name for name in names if not name.endswith((", low", ", high")) and len(wanted.get(name, "12")) > 1]
    lines = [f"| {' | '.join(shown)} |", f"|{'---|' * len(shown)}"]
    for row in rows:
        cells = [cell(row, name) if f"{name}, low" in names else row[name] for name in shown]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join(lines) + "\n"


def cell(row: dict[str, str], name: str) -> str:
    """'1.23 [0.80, 1.71]'."""
    mean, low, high = (float(row[key]) for key in (name, f"{name}, low", f"{name}, high"))
    return f"{mean:.1f} [{low:.1f}, {high:.1f}]" if low == low else f"{mean:.1f}"


def fill(text: str, report: Path) -> str:
    """The page with its tables as the report has them."""

    def filled(match: re.Match[str]) -> str:
        wanted: dict[str, set[str]] = {}
        for part in match["wanted"].strip(" ;").split(";"):
            if part.strip():
                name, _, values = part.strip().partition("=")
                wanted[name.strip()] = {value.strip() for value in values.split("/")}
        return match[1] + table(report / f"{match['name']}.csv", wanted) + match[4]

    return MARKED.sub(filled, text)


def main() -> None:
    """Write them."""
    report = Path(sys.argv[1])
    IMAGES.mkdir(parents=True, exist_ok=True)
    for number in FIGURES:
        if number == "final" and not (report / "figure-final.png").is_file():
            continue  # the study has no `confirm`
        shutil.copyfile(report / f"figure-{number}.png", IMAGES / f"figure-{number}.png")
    PAGE.write_text(fill(PAGE.read_text(encoding="utf-8"), report), encoding="utf-8")


if __name__ == "__main__":
    main()
