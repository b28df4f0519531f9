"""What all figures of a study have in common: colours of the strategies, panels, files."""

from __future__ import annotations

import csv
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from orchestrator.report import style

if TYPE_CHECKING:
    from matplotlib.figure import Figure

COLOURS = {
    "uncalibrated": style.GREY,
    "C1": style.MEASURED,
    "C2": style.PREDICTED,
    "C3": style.GOOD,
    "C4": style.BEST,
    "D1": style.PREDICTED,
    "D2": style.MEASURED,
    "D3": style.BEST,
    "D3-paper": style.GOOD,
}
LINES = ("-", "--", ":", "-.")
"""Of several D1, the longest first."""


@dataclass
class Drawn:
    """One figure.

    Attributes:
        name: of its files.
        number: of its counterpart in the paper; '' without one.
        title, caption: for people.
        header, rows: the numbers in it, as CSV.
    """

    name: str
    number: str
    title: str
    caption: str
    figure: Figure
    header: Sequence[str]
    rows: Sequence[Sequence[object]]

    def save(self, folder: Path) -> None:
        """PNG, SVG and CSV."""
        style.save(self.figure, folder / f"{self.name}.png")
        style.save(self.figure, folder / f"{self.name}.svg")
        write_csv(folder / f"{self.name}.csv", self.header, self.rows)


def write_csv(path: Path, header: Sequence[str], rows: Sequence[Sequence[object]]) -> None:
    """Numbers for other programs."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows(rows)


def colour(arm: str) -> str:
    """Of a strategy; all D1 have one."""
    return COLOURS.get(arm) or COLOURS[arm.split("-", maxsplit=1)[0]]


def line(arm: str, arms: Sequence[str]) -> str:
    """Line style: several D1 are told apart by it."""
    alike = [other for other in arms if colour(other) == colour(arm)]
    return LINES[min(alike[::-1].index(arm), len(LINES) - 1)]
