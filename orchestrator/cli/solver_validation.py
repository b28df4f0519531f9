"""The command `decant physics`: validates the solver in physical cases, with a table, a page and figures."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from orchestrator.cli.console import BAD_INPUT, FAILED, RefusalError, print_json, say, stdout_for_results

if TYPE_CHECKING:
    from rich.progress import TaskID

    from sim_engine.validation.cases import Case


def physics(
    names: list[str], *, full: bool, pours: int | None, write: Path | None, as_json: bool, list_cases: bool
) -> None:
    """Run cases one after the other and print their results.

    Raises:
        RefusalError: a case is unknown, the page can't be written (exit code 2), or a criterion is not met (1).
    """
    from rich.console import Console
    from rich.progress import Progress

    from orchestrator.cli import solver_report as report
    from orchestrator.results.console_view import PLAIN_WIDTH
    from sim_engine import solver_fingerprint as sources
    from sim_engine.simulator import PourSimulator
    from sim_engine.validation import cases as suite

    if list_cases:
        for case in suite.CASES:
            print(f"{case.name:14}{case.about}")
        return
    cases = _chosen(names)
    if write is not None and not write.is_dir():
        raise RefusalError(f"--write {write}: there is no such folder", BAD_INPUT)
    fingerprint = sources.solver_fingerprint()
    records: dict[str, dict[str, Any]] = {}
    simulator = PourSimulator()
    try:
        for case in cases:
            say(f"{case.name}: {case.title} …")
            image = None
            # a bar is shown only after the first report of progress, which short cases don't make
            with stdout_for_results(), Progress(console=Console(stderr=True), transient=True) as bars:
                bar = bars.add_task(case.name, total=None, visible=False)

                def tell(done: int, total: int, bars: Progress = bars, bar: TaskID = bar) -> None:
                    bars.update(bar, completed=done, total=total, visible=True)

                result = case.run(simulator, suite.CaseEffort(full, pours, tell))
                if write is not None and result.figure is not None:
                    image = report.draw(result.figure, write / report.IMAGES / f"validation-{case.name}.png")
            records[case.name] = report.case_record(case, result, image, fingerprint)
    finally:
        simulator.close()
    if write is not None:
        together = {**report.kept_records(write), **records}
        theta = suite.describe(suite.PLAIN)
        order = [case.name for case in suite.CASES]
        page = report.write_page(write, together, order, fingerprint=fingerprint, theta=theta)
        say(f"page: {page}")
    rows = [(record["title"], m) for record in records.values() for m in record["measurements"]]
    if as_json:
        print_json({"solver": fingerprint, "full": full, "cases": records})
    else:
        console = Console()
        console = console if console.is_terminal else Console(width=PLAIN_WIDTH + 40)
        console.print(report.results_table(rows))
    judged = [m for _, m in rows if m["judged"]]
    failed = sum(not m["passed"] for m in judged)
    if failed:
        raise RefusalError(f"{failed} of {len(judged)} criteria are not met", FAILED)
    say(f"all {len(judged)} criteria are met" if judged else "nothing was judged")


def _chosen(names: list[str]) -> list[Case]:
    from sim_engine.validation import cases as suite

    try:
        wanted = {suite.case(name).name for name in names}
    except KeyError as error:
        raise RefusalError(str(error.args[0]), BAD_INPUT) from None
    return [case for case in suite.CASES if not names or case.name in wanted]
