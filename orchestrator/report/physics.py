"""The solver's physical cases for people: a table in the terminal, figures, and the page docs/validation.md."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from orchestrator.report import style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from rich.table import Table

    from sim_engine.validation.result import CaseResult, Figure, Series
    from sim_engine.validation.suite import Case

PAGE_NAME, DATA_NAME, IMAGES = "validation.md", "validation.json", "images"

SHOWN_UNITS = {"1": (1.0, ""), "m": (1e3, "mm"), "m³": (1e6, "mL")}
"""Factor and name of what people see of an SI unit; others are shown as they are."""

PANELS_ABREAST = 3
"""More panels than these go into further rows."""

AGAIN = "decant physics --full --write docs"

REFERENCES = (("--", "o"), (":", "s"), ("-.", "^"), ((0, (6, 2)), "D"))
"""Line style, or marker where there are few points, of several references in a panel."""

COLOURS = (style.MEASURED, style.PREDICTED, style.GOOD, style.BEST, style.FALLING, style.ESCAPED)

INTRODUCTION = """# Validation

<!-- written by `decant physics`; edit the cases, not this page -->

What the solver does in cases whose outcome is known: from theory, from experiments, from other solvers. Every quantity
is measured, not assumed, and judged by a criterion that was set beforehand; what fails is shown as failing. The page is
written by

```
decant physics --full --write docs
```

θ of all cases unless they say otherwise: {theta}.
N is the number of particles.
"""


def shown(value: float | None, unit: str) -> str:
    """A quantity as people read it, from its SI value: '39.8 mm', '0.92'; '—' for None."""
    if value is None:
        return "—"
    factor, name = SHOWN_UNITS.get(unit, (1.0, unit))
    number = f"{value * factor:.4g}" if abs(value * factor) < 1000 else f"{value * factor:,.0f}".replace(",", " ")
    return f"{number} {name}".rstrip()


def verdict(row: Mapping[str, Any]) -> str:
    """'pass', 'FAIL', or '' for what is only reported."""
    if not row["judged"]:
        return ""
    return "pass" if row["passed"] else "FAIL"


def results_table(rows: Sequence[tuple[str, Mapping[str, Any]]]) -> Table:
    """The terminal's table.

    Args:
        rows: case title and `Measurement.as_json` of every measurement, case by case.
    """
    from rich.table import Table

    table = Table(box=None, pad_edge=False)
    for heading, justify in (("case", "left"), ("quantity", "left"), ("N", "right"), ("measured", "right")):
        table.add_column(heading, justify="right" if justify == "right" else "left")
    for heading in ("reference", "criterion", ""):
        table.add_column(heading)
    before = ""
    for title, row in rows:
        word = verdict(row)
        table.add_row(
            title if title != before else "",
            row["name"],
            f"{row['particles']:,}".replace(",", " "),
            shown(row["value"], row["unit"]),
            shown(row["reference"], row["unit"]),
            row["criterion"],
            f"[bold red]{word}[/]" if word == "FAIL" else f"[green]{word}[/]",
        )
        before = title
    return table


def draw(figure: Figure, path: Path) -> Path:
    """Write a case's figure.

    Args:
        figure: its curves.
        path: of the PNG; its folder is made if needed.
    """
    panels = len(figure.titles)
    columns = min(panels, PANELS_ABREAST)
    rows = -(-panels // columns)
    size = (1.2 + 5.2 * columns, 3.8 * rows)
    canvas, axes = style.new_figure(rows, columns, size=size, squeeze=False)
    for number, place in enumerate(axes.flat):
        if number < panels:
            _panel(place, figure, number)
        else:
            place.set_visible(False)
    return style.save(canvas, path)


def _panel(axes: Axes, figure: Figure, number: int) -> None:
    here = [s for s in figure.series if s.panel == number]
    measured = [s for s in here if s.kind == "measured"]
    colours = dict(zip(map(id, measured), COLOURS * 4, strict=False))
    of_subject = {_subject(s): colours[id(s)] for s in reversed(measured)}
    looks = iter(REFERENCES * 4)
    for series in here:
        if series.kind == "reference":
            line, marker = next(looks)
            few = len(series.x) < 20 and len(series.x) > 2
            axes.plot(
                series.x, series.y, color=of_subject.get(_subject(series), style.INK), lw=1.2, ls="" if few else line,
                marker=marker if few else None, ms=4, mfc="white", label=series.name, zorder=3,
            )  # fmt: skip
        else:
            colour = colours[id(series)]
            axes.plot(series.x, series.y, color=colour, lw=1.4, label=series.name)
            if series.spread:
                low, high = ([y + side * s for y, s in zip(series.y, series.spread, strict=True)] for side in (-1, 1))
                axes.fill_between(series.x, low, high, color=colour, alpha=0.18, lw=0)
    if figure.log_x if isinstance(figure.log_x, bool) else figure.log_x[number]:
        axes.set_xscale("log")
        places = sorted({x for s in figure.series if s.panel == number and s.kind == "measured" for x in s.x})
        axes.set_xticks(places, [f"{x:,g}".replace(",", " ") for x in places])
        axes.minorticks_off()
    style.dress(axes, title=figure.titles[number], x=figure.x_labels[number], y=figure.y_labels[number], grid="both")
    axes.legend(fontsize=8, framealpha=0.85, edgecolor="none")


def _subject(series: Series) -> str:
    """What a curve and its reference have in common: 'cone' of 'cone, 2,000 particles' and of 'cone, at rest'."""
    return series.name.split(", ", maxsplit=1)[0]


def case_record(case: Case, result: CaseResult, image: Path | None, fingerprint: str) -> dict[str, Any]:
    """What is kept of a case between runs, JSON-ready; the image by its file name, the solver by its fingerprint."""
    return {
        "solver": fingerprint,
        "title": case.title,
        "about": case.about,
        "cpu_s": round(result.cpu_s, 1),
        "image": None if image is None else image.name,
        "measurements": [m.as_json() for m in result.measurements],
    }


def kept_records(folder: Path) -> dict[str, dict[str, Any]]:
    """Records of cases that earlier runs wrote into a folder."""
    path = folder / DATA_NAME
    return dict(json.loads(path.read_text(encoding="utf-8"))["cases"]) if path.is_file() else {}


def write_page(
    folder: Path, records: Mapping[str, Mapping[str, Any]], order: Sequence[str], *, fingerprint: str, theta: str
) -> Path:
    """Write the page and the data that it was made from.

    Args:
        folder: of the page.
        records: `case_record`s by case.
        order: of the cases on the page.
        fingerprint: of the solver as it is now; cases that another one measured are marked.
        theta: of the cases, as people read it.

    Raises:
        OSError: it can't be written.
    """
    sorted_records = {name: records[name] for name in order if name in records}
    data = {"solver": fingerprint, "theta": theta, "cases": sorted_records}
    (folder / DATA_NAME).write_text(json.dumps(data, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    page = folder / PAGE_NAME
    page.write_text(page_text(sorted_records, theta, fingerprint), encoding="utf-8")
    return page


def page_text(records: Mapping[str, Mapping[str, Any]], theta: str, fingerprint: str) -> str:
    """The page of some records, in their order, see `write_page`."""
    rows = [m for record in records.values() for m in record["measurements"]]
    judged = [m for m in rows if m["judged"]]
    failed = sum(not m["passed"] for m in judged)
    parts = [INTRODUCTION.format(theta=theta)]
    parts.append(f"{len(judged) - failed} of {len(judged)} criteria are met.\n")
    for name, record in records.items():
        parts.append(f"## {record['title']}\n\n{record['about']} (`decant physics {name}`)\n")
        if record["solver"] != fingerprint:
            parts.append(f"Measured before the solver's sources last changed; again: `{AGAIN} {name}`\n")
        lines = ["| quantity | N | measured | reference | criterion | |", "|---|---:|---:|---:|---|---|"]
        for m in record["measurements"]:
            word = {"FAIL": "**fails**"}.get(verdict(m), verdict(m))
            lines.append(
                f"| {m['name']} | {m['particles']:,} | {shown(m['value'], m['unit'])} | "
                f"{shown(m['reference'], m['unit'])} | {m['criterion']} | {word} |"
            )
        parts.append("\n".join(lines) + "\n")
        if record["image"] is not None:
            parts.append(f"![{record['title']}]({IMAGES}/{record['image']})\n")
    return "\n".join(parts)
