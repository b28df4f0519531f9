"""Validate the solver against theory, experiments and other solvers; each case has a criterion.

    python -m benchmarks.validation                              # quick resolutions
    python -m benchmarks.validation outflow walls --full         # all resolutions and seeds, whole and mirrored
    python -m benchmarks.validation --full --json > results.json # half an hour; docs/make_validation.py makes the page

Exit code 1 if a criterion is not met, 2 for a name that no case has.
"""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
from collections.abc import Mapping, Sequence
from contextlib import redirect_stdout
from typing import Any

from rich.console import Console
from rich.table import Table

from sim_engine.simulator import PourSimulator
from sim_engine.solver_fingerprint import solver_fingerprint

from . import cases as suite
from .case_result import CaseResult, Figure

WIDTH = 160
"""Of the table where the output is no terminal."""

SHOWN_UNITS = {"1": (1.0, ""), "m": (1e3, "mm"), "m³": (1e6, "mL")}
"""Factor and name of the display unit of an SI unit; other units are displayed unchanged."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the cases that the arguments name; return the exit code."""
    parser = argparse.ArgumentParser(
        prog="python -m benchmarks.validation", description=(__doc__ or "").splitlines()[0]
    )
    parser.add_argument("cases", nargs="*", metavar="CASE", help="names of cases; default: all")
    parser.add_argument("--full", action="store_true", help="all resolutions and seeds; takes half an hour")
    parser.add_argument("--json", action="store_true", help="write the results as JSON")
    options = parser.parse_args(arguments)
    try:
        wanted = {suite.case(name).name for name in options.cases}
    except KeyError as error:
        parser.error(str(error.args[0]))
    chosen = [case for case in suite.CASES if not wanted or case.name in wanted]
    records: dict[str, dict[str, Any]] = {}
    simulator = PourSimulator()
    try:
        for case in chosen:
            print(f"{case.name}: {case.title} …", file=sys.stderr, flush=True)
            with redirect_stdout(sys.stderr):
                records[case.name] = case_record(case, case.run(simulator, *case.efforts(options.full)))
    finally:
        simulator.close()
    rows = [(record["title"], row) for record in records.values() for row in record["measurements"]]
    if options.json:
        print(json.dumps({"solver": solver_fingerprint(), "full": options.full, "cases": records}, indent=1))
    else:
        console = Console()
        console = console if console.is_terminal else Console(width=WIDTH)
        console.print(results_table(rows))
    judged = [row["passed"] for _, row in rows if row["judged"]]
    failed = judged.count(False)
    end = f"all {len(judged)} criteria are met" if judged else "nothing was judged"
    print(f"{failed} of {len(judged)} criteria are not met" if failed else end, file=sys.stderr)
    return 1 if failed else 0


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


def _curves(figure: Figure) -> dict[str, Any]:
    """JSON-ready, with five digits."""

    def short(value: Any) -> Any:
        if isinstance(value, float):
            return float(f"{value:.5g}")
        return [short(number) for number in value] if isinstance(value, list | tuple) else value

    stored = dataclasses.asdict(figure)
    stored["series"] = [{name: short(value) for name, value in series.items()} for series in stored["series"]]
    return {name: list(value) if isinstance(value, tuple) else value for name, value in stored.items()}


def case_record(case: suite.Case, result: CaseResult) -> dict[str, Any]:
    """The record of a case, JSON-ready."""
    return {
        "title": case.title,
        "about": case.about,
        "cpu_s": round(result.cpu_s, 1),
        "figure": None if result.figure is None else _curves(result.figure),
        "measurements": [m.as_json() for m in result.measurements],
    }


if __name__ == "__main__":
    sys.exit(main())
