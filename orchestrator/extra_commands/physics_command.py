"""Validation of the solver in physical cases, with a table. docs/make_validation.py makes the page of the results.

The cases themselves are in `sim_engine.validation`.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from typing import TYPE_CHECKING, Annotated, Any

import typer

from orchestrator.cli.command_options import Json, add_command
from orchestrator.cli.console import FAILED, RefusalError, print_json, print_message, stdout_for_results

if TYPE_CHECKING:
    from rich.table import Table

    from sim_engine.validation.case_result import CaseResult, Figure
    from sim_engine.validation.cases import Case

SHOWN_UNITS = {"1": (1.0, ""), "m": (1e3, "mm"), "m³": (1e6, "mL")}
"""Factor and name of the display unit of an SI unit; other units are displayed unchanged."""


def validate_solver(
    cases: Annotated[list[str] | None, typer.Argument(help="Names of cases; default: all.")] = None,
    full: Annotated[
        bool,
        typer.Option(
            "--full", help="Use all resolutions and seeds, of whole and of mirrored liquids; takes half an hour."
        ),
    ] = False,
    as_json: Json = False,
) -> None:
    """Validate the solver against theory, experiments and other solvers; each case has a criterion.

    Exit code 1 if a criterion is not met.
    """
    from rich.console import Console

    from orchestrator.reports.console_view import PLAIN_WIDTH
    from sim_engine.simulator import PourSimulator
    from sim_engine.solver_fingerprint import solver_fingerprint

    chosen = _chosen(cases or [])
    records: dict[str, dict[str, Any]] = {}
    simulator = PourSimulator()
    try:
        for case in chosen:
            print_message(f"{case.name}: {case.title} …")
            with stdout_for_results():
                result = case.run(simulator, *case.efforts(full))
            records[case.name] = case_record(case, result)
    finally:
        simulator.close()
    rows = [(record["title"], m) for record in records.values() for m in record["measurements"]]
    if as_json:
        from orchestrator.cli.command_results import ValidateSolverOutput

        print_json(ValidateSolverOutput(solver=solver_fingerprint(), full=full, cases=records))
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


def _curves(figure: Figure) -> dict[str, Any]:
    """JSON-ready, with five digits."""

    def short(value: Any) -> Any:
        if isinstance(value, float):
            return float(f"{value:.5g}")
        return [short(number) for number in value] if isinstance(value, list | tuple) else value

    stored = dataclasses.asdict(figure)
    stored["series"] = [{name: short(value) for name, value in series.items()} for series in stored["series"]]
    return {name: list(value) if isinstance(value, tuple) else value for name, value in stored.items()}


def case_record(case: Case, result: CaseResult) -> dict[str, Any]:
    """The record of a case, JSON-ready."""
    return {
        "title": case.title,
        "about": case.about,
        "cpu_s": round(result.cpu_s, 1),
        "figure": None if result.figure is None else _curves(result.figure),
        "measurements": [m.as_json() for m in result.measurements],
    }


def register(app: typer.Typer) -> None:
    """Add the command, if the cases are installed."""
    if find_spec("sim_engine.validation") is None:
        return
    add_command(
        app,
        validate_solver,
        "decant validate-solver",
        "decant validate-solver outflow walls --full",
        name="validate-solver",
    )
