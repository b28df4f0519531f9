"""The command `decant report`: writes the page of a run again from its folder."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from orchestrator.cli.command_options import RunFolder, run_folder
from orchestrator.cli.console import FAILED, RefusalError, check_output, print_note, print_warning


def report(
    run: RunFolder,
    output: Annotated[
        Path | None, typer.Option("--output", "-o", help="Other file than report.html in the run's folder.")
    ] = None,
    pdf: Annotated[bool, typer.Option("--pdf", help="Also write every figure of a run as PDF, for LaTeX.")] = False,
) -> None:
    """Write the report of a run: one self-contained HTML file, suitable for printing.

    It contains the settings, the work done, θ* with its region, every pour, figures and costs. It recommends an action
    with its expected deviation, and lists open questions. Runs that are paused, failed or unknown have reports too,
    which state this.
    """
    from orchestrator.records.journal import JOURNAL_NAME

    check_output(output, "--output", ".html")
    folder = run_folder(run)
    if (folder / JOURNAL_NAME).is_file():
        page = _of_run(folder, output, (".svg", ".pdf") if pdf else (".svg",))
    elif folder.suffix in (".yaml", ".yml"):
        raise RefusalError(f"{folder}: is a file, no run's folder; for a study: decant study run {folder} --report")
    else:
        raise RefusalError(_nothing_there(folder))
    print_note(f"report  {page}")


def _nothing_there(folder: Path) -> str:
    from orchestrator.records.journal import JOURNAL_NAME
    from orchestrator.records.journal_check import check_journal, has_begun

    if has_begun(folder / JOURNAL_NAME):
        return f"{folder}: {check_journal(folder / JOURNAL_NAME).verdict}"
    near = sorted(path.parent.name for path in folder.absolute().parent.glob(f"*/{JOURNAL_NAME}"))
    hint = f"; runs there: {', '.join(near)}" if near else ""
    return f"{folder}: no run is here; name a run's folder (with its {JOURNAL_NAME}){hint}"


def _of_run(folder: Path, output: Path | None, formats: tuple[str, ...]) -> Path:
    from orchestrator.campaigns.file_loading import load_campaign
    from orchestrator.campaigns.yaml.yaml_errors import ConfigError
    from orchestrator.learning.run_errors import RunError
    from orchestrator.records.journal import JOURNAL_NAME
    from orchestrator.records.journal_check import check_journal
    from orchestrator.records.run_record import read_result
    from orchestrator.reports.html_report import REPORT_NAME
    from orchestrator.reports.publishing import publish_if_missing, report_on, write_reduced_report
    from orchestrator.runs.run_folder import RESOLVED, missing_plugins, read_versions

    check = check_journal(folder / JOURNAL_NAME)
    for problem in check.problems:
        print_warning(problem)
    try:
        try:
            plan = load_campaign(folder / RESOLVED)
            result = read_result(folder)
        except (ConfigError, RunError) as error:
            reason = f"Its campaign or its results can't be read: {error}"
            if missing := missing_plugins(read_versions(folder)):
                reason = f"Not installed here: {'; '.join(missing)}. Install what is missing for the whole report."
            print_warning(f"the report is reduced to what the journal has. {reason}")
            return write_reduced_report(output or folder / REPORT_NAME, folder, reason)
        print_note("drawing the figures …")
        if publish_if_missing(plan, result):
            print_note("summary.json and theta.json were not those of the finished run, and are written now")
        return report_on(plan, result, output, formats)[0]
    except RunError as error:
        raise RefusalError(str(error), FAILED) from None
    except OSError as error:
        raise RefusalError(f"{error.filename or folder}: {error.strerror}", FAILED) from None
    except (LookupError, TypeError, ValueError, AttributeError):
        if not check.problems:
            raise
        raise RefusalError(f"{folder}: no report can be made of damaged records; {check.verdict}", FAILED) from None
