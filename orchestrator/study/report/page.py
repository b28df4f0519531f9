"""The report of a study: figures and tables as files, and one page that needs nothing beside it."""

from __future__ import annotations

import base64
import html
from collections.abc import Callable, Sequence
from pathlib import Path

from orchestrator.report.units import deployment_unit
from orchestrator.study.cells import cells_of
from orchestrator.study.code import told
from orchestrator.study.folder import finished_results, write_whole
from orchestrator.study.plan import Level, StudyPlan
from orchestrator.study.report.calibrations import draw_calibrations
from orchestrator.study.report.deployments import draw_deployments
from orchestrator.study.report.drawing import Drawn, write_csv
from orchestrator.study.report.finals import draw_finals
from orchestrator.study.report.gather import Gathered, gather
from orchestrator.study.report.intervals import Estimate
from orchestrator.study.report.tables import Table, tables

REPORT, PAGE = "report", "index.html"

_STYLE = """body{font:16px/1.5 system-ui,sans-serif;max-width:62rem;margin:2rem auto;padding:0 1rem;color:#222}
img{max-width:100%}figure{margin:2rem 0}figcaption,.note{color:#555;font-size:.9rem}
table{border-collapse:collapse;font-size:.9rem}td,th{padding:.25rem .7rem;border-bottom:1px solid #ddd}
td,th{text-align:left}"""

_RESAMPLED = (
    "A repetition resamples the pours: errors of grip and placement, the liquid's initial positions and the balance's "
    "noise; which of the calibration's actions are kept for testing; and the strategies' own seeds. Actions of the "
    "calibration pours are the same in every repetition, so that C1's grid is simulated once and scored for each. "
    "C1 to C4 of a repetition share its pours; D1 and D3 simulate with the θ* that C4 found in it. Intervals of means "
    "are Student's t over repetitions, those of differences Student's t of the repetitions' differences: they cover "
    "95 % where repetitions scatter about normally, and those of shares end at 0 and 100 %."
)

_AS_IN_THE_PAPER = {
    "C4-paper": ". As in the paper: the surrogate is over θ alone, and takes the action's influence for noise",
    "D2-paper": ". As in the paper: the surrogate has a zero mean",
    "D3-paper": ". As in the paper: a surrogate of the residual around the simulations' mean, always trusted",
}


def write_report(study: StudyPlan, folder: Path) -> Path:
    """Write figures, tables and the page of what is finished.

    Args:
        folder: of the study.

    Returns:
        The page.

    Raises:
        StudyError: a result can't be read.
    """
    results = finished_results(folder, cells_of(study))
    found = gather(study, results)
    report = folder / REPORT
    report.mkdir(parents=True, exist_ok=True)
    drawn: list[Drawn] = []
    drawers: tuple[Callable[[StudyPlan, Gathered], list[Drawn]], ...] = (
        draw_calibrations,
        draw_deployments,
        draw_finals,
    )
    for draw in drawers:
        drawn += draw(study, found)
    for one in drawn:
        one.save(report)
    shown = tables(study, found)
    for table in shown:
        write_csv(report / f"{table.name}.csv", *table.flat())
    page = report / PAGE
    write_whole(page, _page(study, found, told(results), drawn, shown, report))
    return page


def _page(
    study: StudyPlan, found: Gathered, code: str, drawn: Sequence[Drawn], shown: Sequence[Table], report: Path
) -> str:
    title = html.escape(f"Study {study.name}")
    parts = [
        f'<!doctype html><html lang="en"><head><meta charset="utf-8"><title>{title}</title>',
        f"<style>{_STYLE}</style></head><body><h1>{title}</h1>",
    ]
    if found.finished < found.cells:
        parts.append(f"<p><b>Unfinished: {found.finished} of {found.cells} cells are there.</b></p>")
    parts.append(f"<p>{html.escape(_summary(study, found))}</p>")
    for table in shown:
        parts.append(_table(table))
    for one in drawn:
        counterpart = f"Counterpart of the paper's figure {one.number}. " if one.number else ""
        picture = base64.b64encode((report / f"{one.name}.svg").read_bytes()).decode("ascii")
        parts.append(
            f'<figure id="{one.name}"><h2>{html.escape(one.title)}</h2>'
            f'<img alt="{html.escape(one.title)}" src="data:image/svg+xml;base64,{picture}">'
            f"<figcaption>{html.escape(one.caption)} {counterpart}Numbers: {one.name}.csv.</figcaption></figure>"
        )
    parts.append(f"<h2>What a repetition is</h2><p>{html.escape(_RESAMPLED)}</p>")
    parts.append("<h2>Settings</h2>" + "".join(f"<p>{html.escape(line)}</p>" for line in [*_settings(study), code]))
    return "\n".join([*parts, "</body></html>\n"])


def _summary(study: StudyPlan, found: Gathered) -> str:
    losses = (
        "" if not study.deployments else f" Deployments minimise: {deployment_unit(study.deployments[0].plan).label}."
    )
    return (
        f"{found.simulations:,} simulations and {found.pours:,} pours on virtual benches, {found.cpu_s / 3600:.1f} CPU "
        f"hours of simulation, {found.seconds / 3600:.1f} hours of all cells one after the other. Nothing of this was "
        f"poured by a physical robot.{losses}"
    )


def _settings(study: StudyPlan) -> list[str]:
    lines = [f"Seed {study.seed}; {study.pour_count} calibration pours, {study.holdout} of them for testing."]
    train = study.pour_count - study.holdout
    for arm in study.calibrations:
        axes = ", ".join(f"{axis.name} {axis.lower:g} to {axis.upper:g}" for axis in arm.plan.parameters.axes)
        lines.append(
            f"{arm.label}: {arm.plan.settings.simulations_on(train)} simulations, {arm.repetitions} repetitions, "
            f"searching {axes}; at {', '.join(arm.levels)} mismatch{_AS_IN_THE_PAPER.get(arm.label, '')}."
        )
    for each in study.deployments:
        paper = _AS_IN_THE_PAPER.get(each.label, "")
        lines.append(
            f"{each.label}: {each.plan.settings.spending}; {each.repetitions} repetitions into each receiver{paper}."
        )
    if study.confirm and study.deployments:
        lines.append(f"Each deployment's recommended action is poured {study.confirm} more times.")
    return [*lines, *(_level(level) for level in study.levels)]


def _level(level: Level) -> str:
    liquid = ", ".join(f"{name} {value:g}" for name, value in level.bench.liquid.of_the_solver().items())
    error, noise = level.bench.pose_error, level.bench.pose_noise
    off = ", ".join(f"{1e3 * value:g}" for value in (error.x, error.y, error.z))
    scatter = ", ".join(f"{1e3 * value:g}" for value in (noise.x, noise.y, noise.z))
    return (
        f"Mismatch '{level.name}': hidden θ {liquid}; receiver off by {off} mm (x, y, height), tilt by "
        f"{error.tilt:.3g} rad, speed × {error.speed_factor:g}; from pour to pour ± {scatter} mm, "
        f"{noise.tilt:.3g} rad, × {noise.speed_factor:g}."
    )


def _table(table: Table) -> str:
    head = "".join(f"<th>{html.escape(name)}</th>" for name in table.header)
    body = "".join(
        "<tr>"
        + "".join(f"<td>{html.escape(v.text() if isinstance(v, Estimate) else str(v))}</td>" for v in row)
        + "</tr>"
        for row in table.rows
    )
    return (
        f'<section id="{table.name}"><h2>{html.escape(table.title)}</h2><table><tr>{head}</tr>{body}</table>'
        f'<p class="note">{html.escape(table.caption)}</p></section>'
    )
