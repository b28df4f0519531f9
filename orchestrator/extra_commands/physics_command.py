"""Validation of the solver in physical cases, with a table, figures and the page docs/evidence/validation.md.

The cases themselves are in `sim_engine.validation`.
"""

from __future__ import annotations

import dataclasses
import json
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from orchestrator.cli.command_options import Json, add_command
from orchestrator.cli.console import FAILED, RefusalError, print_json, print_message, stdout_for_results

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from rich.progress import TaskID
    from rich.table import Table

    from sim_engine.validation.case_result import CaseResult, Figure
    from sim_engine.validation.cases import Case

PAGE_NAME, DATA_NAME, IMAGES = "evidence/validation.md", "data/validation.json", "images"

SHOWN_UNITS = {"1": (1.0, ""), "m": (1e3, "mm"), "m³": (1e6, "mL")}
"""Factor and name of the display unit of an SI unit; other units are displayed unchanged."""

PANELS_ABREAST = 3
"""Maximum number of panels per row."""

CHARACTER = 0.075
"""Width of a character in a legend [inch]."""

FEW = 20
"""Number of points from which a reference is drawn as a line."""

MOST_PLACES = 5
"""Maximum number of labelled points of a logarithmic axis; with more points, round numbers are labelled."""

AGAIN = "decant validate-solver --full --write docs"

REFERENCES = (("--", "o"), (":", "s"), ("-.", "^"), ((0, (6, 2)), "D"))
"""Line style, or marker for few points, of several references in a panel."""

INTRODUCTION = """# Validation

<!-- written by `decant validate-solver`; edit the cases, not this page -->

Results of the solver in cases whose outcome is known from theory, experiments or other solvers. Criteria were set
beforehand. This command measures everything and writes the page:

<!-- needs: checkout and minutes -->
```
decant validate-solver --full --write docs
```

`decant validate-solver CASE` runs one case. Comparisons with liquids that were really poured: [real
recordings](recordings.md). All values are in [validation.json](../data/validation.json). A row of several quantities
has the values that fail; if all pass, the one with the largest difference from its reference.

θ of all cases unless they say otherwise: {theta}.
N is the number of particles.
"""


def validate_solver(
    cases: Annotated[list[str] | None, typer.Argument(help="Names of cases; default: all.")] = None,
    full: Annotated[bool, typer.Option("--full", help="Use all resolutions and seeds; takes several minutes.")] = False,
    pours: Annotated[int | None, typer.Option(min=1, help="Number of random pours in the case 'walls'.")] = None,
    write: Annotated[
        Path | None,
        typer.Option(
            help="Folder for the page validation.md, its data and figures. Cases that are not run keep their "
            "previous results."
        ),
    ] = None,
    list_cases: Annotated[bool, typer.Option("--list", help="List the cases and exit.")] = False,
    as_json: Json = False,
) -> None:
    """Validate the solver against theory, experiments and other solvers; each case has a criterion.

    Exit code 1 if a criterion is not met.
    """
    from rich.console import Console
    from rich.progress import Progress

    from orchestrator.reports.console_view import PLAIN_WIDTH
    from sim_engine.simulator import PourSimulator
    from sim_engine.solver_fingerprint import solver_fingerprint
    from sim_engine.validation.cases import CASES, PLAIN, CaseEffort, describe

    if list_cases:
        for case in CASES:
            print(f"{case.name:14}{case.about}")
        return
    chosen = _chosen(cases or [])
    if write is not None and not write.is_dir():
        raise RefusalError(f"--write {write}: there is no such folder")
    fingerprint = solver_fingerprint()
    records: dict[str, dict[str, Any]] = {}
    simulator = PourSimulator()
    try:
        for case in chosen:
            print_message(f"{case.name}: {case.title} …")
            image = None
            # a bar is shown only after the first report of progress, which short cases don't make
            with stdout_for_results(), Progress(console=Console(stderr=True), transient=True) as bars:
                bar = bars.add_task(case.name, total=None, visible=False)

                def tell(done: int, total: int, bars: Progress = bars, bar: TaskID = bar) -> None:
                    bars.update(bar, completed=done, total=total, visible=True)

                result = case.run(simulator, CaseEffort(full, pours, tell))
                if write is not None and result.figure is not None:
                    image = draw(result.figure, write / IMAGES / f"validation-{case.name}.png")
            records[case.name] = case_record(case, result, image, fingerprint)
    finally:
        simulator.close()
    if write is not None:
        together = {**kept_records(write), **records}
        theta = describe(PLAIN)
        order = [case.name for case in CASES]
        page = write_page(write, together, order, fingerprint=fingerprint, theta=theta)
        print_message(f"page: {page}")
    rows = [(record["title"], m) for record in records.values() for m in record["measurements"]]
    if as_json:
        from orchestrator.cli.command_results import ValidateSolverOutput

        print_json(ValidateSolverOutput(solver=fingerprint, full=full, cases=records))
    else:
        console = Console()
        console = console if console.is_terminal else Console(width=PLAIN_WIDTH + 40)
        console.print(results_table(rows))
    judged = [m for _, m in rows if m["judged"]]
    failed = sum(not m["passed"] for m in judged)
    if failed:
        raise RefusalError(f"{failed} of {len(judged)} criteria are not met", FAILED)
    print_message(f"all {len(judged)} criteria are met" if judged else "nothing was judged")


def _chosen(names: list[str]) -> list[Case]:
    from sim_engine.validation.cases import CASES, case

    try:
        wanted = {case(name).name for name in names}
    except KeyError as error:
        raise RefusalError(str(error.args[0])) from None
    return [entry for entry in CASES if not names or entry.name in wanted]


def shown(value: float | None, unit: str) -> str:
    """A quantity in its display unit, from its SI value: '39.8 mm', '0.92'; '—' for None."""
    if value is None:
        return "—"
    factor, name = SHOWN_UNITS.get(unit, (1.0, unit))
    number = f"{value * factor:.4g}" if abs(value * factor) < 1000 else f"{value * factor:,.0f}".replace(",", " ")
    return f"{number} {name}".rstrip()


def verdict(row: Mapping[str, Any]) -> str:
    """'pass', 'FAIL', or '' if the row is not judged."""
    if not row["judged"]:
        return ""
    return "pass" if row["passed"] else "FAIL"


def results_table(rows: Sequence[tuple[str, Mapping[str, Any]]]) -> Table:
    """The table for the terminal.

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
        path: path of the PNG; its folder is made if needed.
    """
    from orchestrator.reports import figure_style

    panels = len(figure.titles)
    columns = min(panels, PANELS_ABREAST)
    rows = -(-panels // columns)
    wide, high = (6.2, 3.9) if panels == 1 else (3.4, 2.7)
    canvas, axes = figure_style.new_figure(rows, columns, size=(wide * columns, 0.5 + high * rows), squeeze=False)
    styles = _curve_styles(figure)
    for number, place in enumerate(axes.flat):
        if number < panels:
            _panel(place, figure, number, styles)
        else:
            place.set_visible(False)
    # Below the panels, because inside it would cover curves.
    handles = {n: h for place in axes.flat for h, n in zip(*place.get_legend_handles_labels(), strict=True)}
    names = [name for name in styles if name in handles]
    room = wide * columns / (0.55 + CHARACTER * max(map(len, names), default=1))
    canvas.legend(
        [handles[name] for name in names], names, loc="outside lower center", ncols=max(1, min(int(room), len(names))),
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
    """Styles by name. Measured curves differ in colour; references have their subject's colour and another style."""
    from orchestrator.reports import figure_style

    shades = figure_style.MEASURED, figure_style.PREDICTED, figure_style.GOOD
    colours = (*shades, figure_style.BEST, figure_style.FALLING, figure_style.ESCAPED)
    measured = list(dict.fromkeys(s.name for s in figure.series if s.kind == "measured"))
    styles = {name: CaseFigureStyle(colour) for name, colour in zip(measured, colours * 4, strict=False)}
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
    from orchestrator.reports import figure_style

    for series in (s for s in figure.series if s.panel == number):
        look = styles[series.name]
        above = 3 if series.kind == "reference" else 2
        axes.plot(
            series.x, series.y, color=look.colour, ls=look.line or "none", marker=look.marker or None, ms=5,
            mfc="white", lw=1.2 if series.kind == "reference" else 1.6, label=series.name, zorder=above,
        )  # fmt: skip
        if series.spread:
            low, high = ([y + side * s for y, s in zip(series.y, series.spread, strict=True)] for side in (-1, 1))
            axes.fill_between(series.x, low, high, color=look.colour, alpha=0.18, lw=0)
    figure_style.dress(
        axes, title=figure.titles[number], x=figure.x_labels[number], y=figure.y_labels[number], grid="both"
    )
    if figure.log_x if isinstance(figure.log_x, bool) else figure.log_x[number]:
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
    from sim_engine.validation.case_result import Figure, Series

    stored = record.get("figure")
    if stored is None:
        return None
    series = [
        Series(s["name"], tuple(s["x"]), tuple(s["y"]), s["kind"], s["panel"], tuple(s["spread"]))
        for s in stored["series"]
    ]
    titles, x_labels, y_labels = (tuple(stored[name]) for name in ("titles", "x_labels", "y_labels"))
    log_x = stored["log_x"] if isinstance(stored["log_x"], bool) else tuple(stored["log_x"])
    return Figure(titles, x_labels, y_labels, tuple(series), log_x)


def _curves(figure: Figure) -> dict[str, Any]:
    """JSON-ready, with five digits."""

    def short(value: Any) -> Any:
        if isinstance(value, float):
            return float(f"{value:.5g}")
        return [short(number) for number in value] if isinstance(value, list | tuple) else value

    stored = dataclasses.asdict(figure)
    stored["series"] = [{name: short(value) for name, value in series.items()} for series in stored["series"]]
    return {name: list(value) if isinstance(value, tuple) else value for name, value in stored.items()}


def case_record(case: Case, result: CaseResult, image: Path | None, fingerprint: str) -> dict[str, Any]:
    """The stored record of a case, JSON-ready; the image by its file name, the solver by its fingerprint."""
    return {
        "solver": fingerprint,
        "title": case.title,
        "about": case.about,
        "cpu_s": round(result.cpu_s, 1),
        "image": None if image is None else image.name,
        "figure": None if result.figure is None else _curves(result.figure),
        "measurements": [m.as_json() for m in result.measurements],
    }


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
    failed = sum(not m["passed"] for m in judged)
    parts = [INTRODUCTION.format(theta=theta)]
    parts.append(f"{len(judged) - failed} of {len(judged)} criteria are met.\n")
    older = {name for name, record in records.items() if record["solver"] != fingerprint}
    if older:
        parts.append(f"† Measured before the solver's sources last changed; again: `{AGAIN} CASE`\n")
    rows = [row for name, record in records.items() for row in _criteria(name, record)]
    if rows:
        head = ("| case | quantity | N | measured | reference | criterion | met |", "|---|---|---:|---:|---:|---|---|")
        parts.append("\n".join([*head, *rows]) + "\n")
    for name, record in records.items():
        parts.append(f"## {record['title']}\n\n{record['about']}{' †' if name in older else ''}\n")
        if record["image"] is not None:
            parts.append(f"![{record['title']}](../{IMAGES}/{record['image']})\n")
    return "\n".join(parts)


def _criteria(case: str, record: Mapping[str, Any]) -> list[str]:
    """Rows of the table of the criteria.

    A row has all numbers of particles of a quantity, or of quantities whose names differ in one word. Of several
    quantities it has the values that fail, or else the one with the largest difference from its reference.
    """
    rows: list[list[Mapping[str, Any]]] = []
    for m in record["measurements"]:
        if m["judged"]:
            row = next((row for row in rows if _comparable(row[-1], m)), None)
            if row is None:
                rows.append([m])
            else:
                row.append(m)
    anchor = re.sub(r"[^\w -]", "", record["title"].lower()).replace(" ", "-")
    lines = []
    for row in rows:
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
            places = [f"{words[m['name']]}, N = {m['particles']:,}" for m in chosen]
            values = [f"{value} ({place})" for value, place in zip(values, places, strict=True)]
        references = "; ".join(dict.fromkeys(shown(m["reference"], m["unit"]) for m in chosen))
        numbers = "; ".join(f"{n:,}" for n in dict.fromkeys(m["particles"] for m in row))
        met = f"{sum(m['passed'] for m in row)} of {len(row)}"
        cells = f"[{case}](#{anchor})", _joined(names), numbers, "; ".join(values), references, row[0]["criterion"]
        lines.append(f"| {' | '.join(cells)} | {met if all(m['passed'] for m in row) else f'**{met}**'} |")
    return lines


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


def register(app: typer.Typer) -> None:
    """Add the command, if the cases are installed."""
    if find_spec("sim_engine.validation") is None:
        return
    add_command(
        app,
        validate_solver,
        "decant validate-solver",
        "decant validate-solver outflow walls --full",
        "decant validate-solver --full --write docs",
        name="validate-solver",
    )
