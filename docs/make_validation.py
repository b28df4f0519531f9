"""Make docs/evidence/validation.md with its pictures from the results of the solver's cases.

    python -m benchmarks.validation --full --json > results.json
    python docs/make_validation.py results.json            # also draws the pictures of these cases
    python docs/make_validation.py                         # writes the page again from docs/data/validation.json
    python docs/make_validation.py --draw                  # and draws all pictures

Cases that are not in the results keep their previous values.
"""

from __future__ import annotations

import json
import re
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from matplotlib.axes import Axes

from orchestrator.reports import figure_style

DOCS = Path(__file__).resolve().parent
sys.path.insert(0, str(DOCS.parent))

from benchmarks.validation.__main__ import shown  # noqa: E402
from benchmarks.validation.case_result import Figure, Series  # noqa: E402
from benchmarks.validation.cases import CASES, PLAIN, describe  # noqa: E402

PAGE_NAME, DATA_NAME, IMAGES = "evidence/validation.md", "data/validation.json", "images"

PANELS_ABREAST = 3
"""Maximum number of panels per row."""

CHARACTER = 0.066
"""Width of a character in a legend [inch]."""

LINE = 0.2
"""Height of a legend's line [inch]."""

FEW = 20
"""Number of points from which a reference is drawn as a line."""

MOST_PLACES = 5
"""Maximum number of labelled points of a logarithmic axis; with more points, round numbers are labelled."""

AGAIN = "python -m benchmarks.validation --json"

REFERENCES = (("--", "o"), (":", "s"), ("-.", "^"), ((0, (6, 2)), "D"))
"""Line style, or marker for few points, of several references in a panel."""

MIRRORED = ", mirrored"
"""End of the names of what is measured with half of a liquid and its mirror image."""

SHORT_DASHES = (0, (2, 1))
"""Style of curves of mirrored liquids."""

INTRODUCTION = """# The solver

<!-- written by docs/make_validation.py; edit the cases, not this page -->

{met} of {judged} criteria are met in {cases} cases whose outcome is known from theory, experiments or other solvers.
{failed}

Criteria were set before the measurements. See also: vessels that were really tilted ([recordings](recordings.md)) and
[resolution](particles.md). These commands measure everything and write the page:

<!-- needs: checkout and minutes -->
```
python -m benchmarks.validation --full --json > results.json
python docs/make_validation.py results.json
```

[validation.json](../data/validation.json) has all values. A case has rows for the quantities that fail, with these
values, and one for all that pass, with its first quantity and the value that is farthest from its reference, with N.
N: particles. *Mirrored*: one half of the liquid is simulated, the other is its mirror image.
θ unless a case says otherwise: {theta}.
"""


def draw(figure: Figure, path: Path) -> Path:
    """Write a case's figure.

    Args:
        figure: its curves.
        path: path of the PNG; its folder is made if needed.
    """
    panels = len(figure.titles)
    columns = min(panels, PANELS_ABREAST)
    rows = -(-panels // columns)
    wide, high = (6.2, 3.9) if panels == 1 else (3.4, 2.7)
    styles = _curve_styles(figure)
    abreast = max(1, min(int(wide * columns / (0.55 + CHARACTER * max(map(len, styles), default=1))), len(styles)))
    legend = LINE * -(-len(styles) // abreast)
    canvas, axes = figure_style.new_figure(rows, columns, size=(wide * columns, high * rows + legend), squeeze=False)
    for number, place in enumerate(axes.flat):
        if number < panels:
            _panel(place, figure, number, styles)
        else:
            place.set_visible(False)
    # Below the panels, because inside it would cover curves.
    handles = {n: h for place in axes.flat for h, n in zip(*place.get_legend_handles_labels(), strict=True)}
    names = [name for name in styles if name in handles]
    canvas.legend(
        [handles[name] for name in names], names, loc="outside lower center", ncols=abreast,
        fontsize=8.5, frameon=False,
    )  # fmt: skip
    return figure_style.save(canvas, path)


@dataclass(frozen=True)
class CaseFigureStyle:
    """Style of the curves with one name, the same in all panels.

    Attributes:
        colour, line, marker: '' for none. No two names of a figure share all three.
    """

    colour: str
    line: Any = "-"
    marker: str = ""


def _curve_styles(figure: Figure) -> dict[str, CaseFigureStyle]:
    """Styles by name. Measured curves differ in colour; references have their subject's colour and another style, and
    mirrored liquids the colour of the whole ones."""
    shades = figure_style.MEASURED, figure_style.PREDICTED, figure_style.GOOD
    colours = (*shades, figure_style.BEST, figure_style.FALLING, figure_style.ESCAPED)
    measured = list(dict.fromkeys(s.name.removesuffix(MIRRORED) for s in figure.series if s.kind == "measured"))
    styles = {name: CaseFigureStyle(colour) for name, colour in zip(measured, colours * 4, strict=False)}
    styles |= {name + MIRRORED: replace(style, line=SHORT_DASHES) for name, style in styles.items()}
    of_subject = {_subject(name): styles[name].colour for name in reversed(measured)}
    references = iter(REFERENCES * 4)
    for series in figure.series:
        if series.name not in styles:
            line, marker = next(references)
            few = 2 < len(series.x) < FEW
            colour = of_subject.get(_subject(series.name), figure_style.INK)
            styles[series.name] = CaseFigureStyle(colour, "", marker) if few else CaseFigureStyle(colour, line)
    return styles


def _panel(axes: Axes, figure: Figure, number: int, styles: Mapping[str, CaseFigureStyle]) -> None:
    for series in (s for s in figure.series if s.panel == number):
        look = styles[series.name]
        above = 3 if series.kind == "reference" else 2
        axes.plot(
            series.x, series.y, color=look.colour, ls=look.line or "none", marker=look.marker or None, ms=5,
            mfc="white", lw=1.2 if series.kind == "reference" else 1.6, label=series.name, zorder=above,
        )  # fmt: skip
    figure_style.dress(
        axes, title=figure.titles[number], x=figure.x_labels[number], y=figure.y_labels[number], grid="both"
    )
    if figure.log_x:
        axes.set_xscale("log")
        places = sorted({x for s in figure.series if s.panel == number and s.kind == "measured" for x in s.x})
        if len(places) > MOST_PLACES:
            places = figure_style.log_ticks(places[0], places[-1])
        axes.set_xticks(places, [figure_style.number(x) for x in places])
        axes.minorticks_off()


def _subject(name: str) -> str:
    """The common name of a curve and its reference: 'cone' of 'cone, 2,000 particles' and of 'cone, at rest'."""
    return name.split(", ", maxsplit=1)[0]


def figure_of(record: Mapping[str, Any]) -> Figure | None:
    """The figure from the curves in a record, to draw it again without measuring."""
    stored = record.get("figure")
    if stored is None:
        return None
    series = [Series(s["name"], tuple(s["x"]), tuple(s["y"]), s["kind"], s["panel"]) for s in stored["series"]]
    titles, x_labels, y_labels = (tuple(stored[name]) for name in ("titles", "x_labels", "y_labels"))
    return Figure(titles, x_labels, y_labels, tuple(series), stored["log_x"])


def kept_records(folder: Path) -> dict[str, dict[str, Any]]:
    """Records of cases that earlier runs wrote into a folder."""
    path = folder / DATA_NAME
    return dict(json.loads(path.read_text(encoding="utf-8"))["cases"]) if path.is_file() else {}


def write_page(
    folder: Path, records: Mapping[str, Mapping[str, Any]], order: Sequence[str], *, fingerprint: str, theta: str
) -> Path:
    """Write the page and its data.

    Args:
        folder: folder of the page.
        records: `case_record`s by case.
        order: order of the cases on the page.
        fingerprint: fingerprint of the current solver; cases measured with another one are marked.
        theta: θ of the cases, as text.

    Raises:
        OSError: it can't be written.
    """
    sorted_records = {name: records[name] for name in order if name in records}
    data = {"solver": fingerprint, "theta": theta, "cases": sorted_records}
    text = json.dumps(data, indent=1, ensure_ascii=False)
    # One line per curve; one line per number would be tens of thousands of lines.
    text = re.sub(r"\[\s+([-+\d.eE,\s]+?)\s+\]", lambda found: f"[{' '.join(found[1].split())}]", text)
    page = folder / PAGE_NAME
    for path in (folder / DATA_NAME, page):
        path.parent.mkdir(parents=True, exist_ok=True)
    (folder / DATA_NAME).write_text(text + "\n", encoding="utf-8")
    page.write_text(page_text(sorted_records, theta, fingerprint), encoding="utf-8")
    return page


def page_text(records: Mapping[str, Mapping[str, Any]], theta: str, fingerprint: str) -> str:
    """The page of some records, in their order; see `write_page`."""
    judged = [m for record in records.values() for m in record["measurements"] if m["judged"]]
    failing = {
        name: sum(m["judged"] and not m["passed"] for m in record["measurements"]) for name, record in records.items()
    }
    missed = ", ".join(f"{name} ({count})" for name, count in failing.items() if count)
    parts = [
        INTRODUCTION.format(
            met=len(judged) - sum(failing.values()),
            judged=len(judged),
            cases=len(records),
            failed=f"Not met: {missed}." if missed else "None fails.",
            theta=theta,
        )
    ]
    older = {name for name, record in records.items() if record["solver"] != fingerprint}
    if older:
        parts.append(f"† Measured before the solver's sources last changed; again: `{AGAIN} CASE`\n")
    rows = [row for name, record in records.items() for row in _criteria(name, record)]
    if rows:
        head = (
            "| case | quantity | N | measured | reference | criterion | met | mirrored |",
            "|---|---|---:|---:|---:|---|---|---|",
        )
        parts.append("\n".join([*head, *rows]) + "\n")
    for name, record in records.items():
        if not _has_section(record):
            continue
        parts.append(f"## {record['title']}\n\n{record['about']}{' †' if name in older else ''}\n")
        if record["image"] is not None:
            parts.append(f"![{record['title']}](../{IMAGES}/{record['image']})\n")
    return "\n".join(parts)


def _has_section(record: Mapping[str, Any]) -> bool:
    """Whether there is more to show of a case than its row."""
    return record["image"] is not None or any(m["judged"] and not m["passed"] for m in record["measurements"])


def _criteria(case: str, record: Mapping[str, Any]) -> list[str]:
    """Rows of the table of the criteria.

    A row has all numbers of particles of a quantity, or of quantities whose names differ in one word. Of several
    quantities it has the values that fail, or else the one with the largest difference from its reference. What passes
    in a case has one row, of its first quantity. Mirrored liquids that pass are counted in the last column.
    """
    rows: list[list[Mapping[str, Any]]] = []
    for m in record["measurements"]:
        if m["judged"]:
            row = next((row for row in rows if _comparable(row[-1], m)), None)
            if row is None:
                whole = {**m, "name": m["name"].removesuffix(MIRRORED)}
                place = next((k for k, row in enumerate(rows, 1) if _comparable(row[-1], whole)), len(rows))
                rows.insert(place, [m])
            else:
                row.append(m)
    anchor = re.sub(r"[^\w -]", "", record["title"].lower()).replace(" ", "-")
    lines = []
    shown_rows: list[tuple[list[Mapping[str, Any]], str]] = []
    for row in rows:
        whole = next(
            (n for n, (other, _) in reversed(list(enumerate(shown_rows))) if _same_criterion(other, row)), None
        )
        if whole is not None and row[0]["name"].endswith(MIRRORED) and all(m["passed"] for m in row):
            shown_rows[whole] = shown_rows[whole][0], f"{len(row)} of {len(row)}"
        else:
            shown_rows.append((row, " "))
    passing = [(row, mirrored) for row, mirrored in shown_rows if all(m["passed"] for m in row)]
    for row, mirrored in shown_rows:
        others = passing[1:] if passing and row is passing[0][0] else []
        if any(row is other for other, _ in passing[1:]):
            continue
        names = list(dict.fromkeys(m["name"] for m in row))
        chosen = [m for m in row if not m["passed"]]
        if len(names) == 1 or row[0]["reference"] is None:
            chosen = row
        elif not chosen:
            chosen = [max(row, key=lambda m: abs(m["value"] - m["reference"]))]
        values = [shown(m["value"], m["unit"]) for m in chosen]
        if chosen is row:
            values = [*(value.split()[0] for value in values[:-1]), values[-1]]
            values = [v if m["passed"] else f"{v} (**fails**)" for v, m in zip(values, row, strict=True)]
        else:
            words = dict(zip(names, _differing(names), strict=True))
            places = [f"{words[m['name']]}, {m['particles']:,}" for m in chosen]
            values = [f"{value} ({place})" for value, place in zip(values, places, strict=True)]
        references = "; ".join(dict.fromkeys(shown(m["reference"], m["unit"]) for m in chosen))
        numbers = "; ".join(f"{n:,}" for n in dict.fromkeys(m["particles"] for m in row))
        count = sum(len(other) for other, _ in [(row, ""), *others])
        met = f"{count - sum(not m['passed'] for m in row)} of {count}"
        both = [int(text.split()[0]) for _, text in [(row, mirrored), *others] if text.strip()]
        mirrored_met = f"{sum(both)} of {sum(both)}" if both else " "
        quantity = _joined(names) + (f", and {len(others)} more" if others else "")
        name = f"[{case}](#{anchor})" if _has_section(record) else f"{case}: {record['title'].lower()}"
        cells = name, quantity, numbers, "; ".join(values), references, row[0]["criterion"]
        lines.append(
            f"| {' | '.join(cells)} | {met if all(m['passed'] for m in row) else f'**{met}**'} | {mirrored_met} |"
        )
    return lines


def _same_criterion(whole: Sequence[Mapping[str, Any]], mirrored: Sequence[Mapping[str, Any]]) -> bool:
    return all(whole[0][key] == mirrored[0][key] for key in ("criterion", "unit"))


def _comparable(row: Mapping[str, Any], other: Mapping[str, Any]) -> bool:
    """Whether two measurements share a row: the same criterion and unit, and at most one word of the names differs."""
    if any(row[key] != other[key] for key in ("criterion", "unit")):
        return False
    words, others = row["name"].split(), other["name"].split()
    return len(words) == len(others) and sum(a != b for a, b in zip(words, others, strict=True)) <= 1


def _differing(names: Sequence[str]) -> list[str]:
    """The word of each name in which it differs from the others."""
    columns = zip(*map(str.split, names), strict=True)
    return [word.rstrip(",") for column in columns if len(set(column)) > 1 for word in column]


def _joined(names: Sequence[str]) -> str:
    """A common name: 'kept at 60°, 70°' of 'kept at 60°' and 'kept at 70°'."""
    columns = zip(*map(str.split, names), strict=True)
    return " ".join(", ".join(dict.fromkeys(c)).replace(",,", ",") for c in columns)


def main(arguments: Sequence[str], folder: Path = DOCS) -> None:
    """Write page, data and pictures; see the top of this file."""
    stored = kept_records(folder)
    results = [json.loads(Path(name).read_text(encoding="utf-8")) for name in arguments if name != "--draw"]
    measured: dict[str, Any] = {}
    for result in results:
        for name, record in result["cases"].items():
            image = None if record["figure"] is None else f"validation-{name}.png"
            measured[name] = {"solver": result["solver"], "image": image, **record}
    for name, record in (stored | measured if "--draw" in arguments else measured).items():
        figure = figure_of(record)
        if figure is not None and record["image"] is not None:
            print(draw(figure, folder / IMAGES / record["image"]))
        else:
            print(f"{name}: no curves are kept")
    order = [case.name for case in CASES]
    before = json.loads((folder / DATA_NAME).read_text(encoding="utf-8"))["solver"] if stored else ""
    solver = results[-1]["solver"] if results else before
    print(write_page(folder, stored | measured, order, fingerprint=solver, theta=describe(PLAIN)))


if __name__ == "__main__":
    main(sys.argv[1:])
