"""The report of a study: figure and table files, and one self-contained HTML page.

- `write_report` writes all files from the finished cells; an unfinished study is allowed.
- `plain_words` describes the differences between strategies in sentences: which one is better, by how much, and where
  the data does not decide.

Figures and tables are defined in the other modules of this package.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from pathlib import Path

from orchestrator.results import html_report as page
from orchestrator.results.loss_units import deployment_unit
from orchestrator.results.wording import ResultTable, TableRow, minutes
from orchestrator.study.report.calibration_figures import draw_calibrations
from orchestrator.study.report.cell_results import Gathered, gather
from orchestrator.study.report.deployment_figures import draw_deployments, draw_finals
from orchestrator.study.report.figure_panels import Drawn, level_words, write_csv
from orchestrator.study.report.statistics import ALL, FEWEST, Estimate
from orchestrator.study.report.study_tables import StudyTable, tables
from orchestrator.study.study_folder import finished_results, told, write_whole
from orchestrator.study.study_plan import Level, StudyPlan, cells_of


def plain_words(shown: Sequence[StudyTable]) -> list[str]:
    """Write a sentence for each pair of strategies at each level: over all receivers, after the last pour in the
    table."""
    rows = [row for table in shown if table.name == "table-effects" for row in table.rows]
    last: dict[tuple[str, str, str, str], tuple[str, Estimate, str]] = {}
    for compared, of, level, receiver, _, difference, better, _ in rows:
        assert isinstance(difference, Estimate)
        kind = str(of).partition(" after ")[0]
        last[str(compared), kind, str(level), str(receiver)] = (str(of), difference, str(better))
    everywhere = {(compared, kind, level) for compared, kind, level, receiver in last if receiver == ALL}
    return [
        _sentence(compared, of, level, receiver, difference, better)
        for (compared, kind, level, receiver), (of, difference, better) in last.items()
        if receiver == ALL or (compared, kind, level) not in everywhere
    ]


def _sentence(compared: str, of: str, level: str, receiver: str, difference: Estimate, better: str) -> str:
    first, _, second = compared.partition(" − ")
    into = {ALL: ", over all receivers", "—": ""}.get(receiver, f", into {receiver}")
    where = f"At {level_words(level)}{into}, {of}{' pours' if of[-1:].isdigit() else ''}"
    size = f"{compared}: {difference.text()}, better in {better}"
    if math.isnan(difference.low):
        return f"{where}: there are too few repetitions for an interval ({size})."
    if difference.low <= 0.0 <= difference.high:
        return f"{where}: nothing tells {first} from {second} ({size})."
    return f"{where}: {first} is {'better' if difference.high < 0.0 else 'worse'} than {second} ({size})."


REPORT, PAGE = "report", "index.html"

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
    """Write figures, tables and the page of all finished cells.

    Args:
        folder: folder of the study.

    Returns:
        Path of the page.

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
    path = report / PAGE
    write_whole(path, _page(study, found, told(results), drawn, shown, report))
    return path


def _page(
    study: StudyPlan, found: Gathered, code: str, drawn: Sequence[Drawn], shown: Sequence[StudyTable], report: Path
) -> str:
    return page.render(
        "study.html.j2",
        title=f"Study {study.name}",
        kicker="Report of a study: strategies side by side, repeated",
        heading=f"Study {study.name}",
        unfinished=f"Unfinished: {found.finished} of {found.cells} cells are there." * (found.finished < found.cells),
        lead=_summary(study, found),
        words=plain_words(shown),
        open=_unknown(study, found),
        tables=[(one.name, one.title, one.caption, _table(one)) for one in shown],
        figures=[
            (one.name, one.title, page.Picture.of(report / f"{one.name}.png", one.title, _caption(one), wide=True))
            for one in drawn
        ],
        resampled=_RESAMPLED,
        settings=[*_settings(study), code],
        footer="Every number of every figure and table lies beside this page as CSV, the figures as PNG and SVG.",
    )


def _caption(one: Drawn) -> str:
    counterpart = f"Counterpart of the paper's figure {one.number}. " if one.number else ""
    return f"{one.caption} {counterpart}Numbers: {one.name}.csv."


def _unknown(study: StudyPlan, found: Gathered) -> list[str]:
    """Limitations that a reader must consider."""
    counts = [arm.repetitions for arm in study.calibrations] + [arm.repetitions for arm in study.deployments]
    notes = ["All benches are VIRTUAL: what a real robot, cup and liquid would do is not in these numbers."]
    if counts and min(counts) < FEWEST:
        notes.append(
            f"Some strategies have {min(counts)} repetitions: below {FEWEST} no difference is tested, and intervals "
            "are wide or missing. Such numbers show that everything works, and nothing more."
        )
    if found.finished < found.cells:
        notes.append("Cells are missing: what is compared may change when they are there.")
    receivers = sorted({scene.receiver.name for arm in study.deployments for scene in arm.plan.scenes})
    if receivers:
        notes.append(f"It holds for these receivers ({', '.join(receivers)}), this liquid and these ranges of actions.")
    return notes


def _summary(study: StudyPlan, found: Gathered) -> str:
    losses = (
        "" if not study.deployments else f" Deployments minimise: {deployment_unit(study.deployments[0].plan).label}."
    )
    return (
        f"{found.simulations:,} simulations and {found.pours:,} pours on virtual benches, {minutes(found.cpu_s)} of "
        f"CPU time of simulation, {minutes(found.seconds)} of all cells one after the other. Nothing of this was "
        f"poured by a physical robot.{losses}"
    )


def _settings(study: StudyPlan) -> list[str]:
    lines = [f"Seed {study.seed}; {study.pour_count} calibration pours, {study.holdout} of them for testing."]
    train = study.pour_count - study.holdout
    for arm in study.calibrations:
        axes = ", ".join(f"{axis.name} {axis.lower:g} to {axis.upper:g}" for axis in arm.plan.parameters.axes)
        lines.append(
            f"{arm.label}: {arm.plan.settings.simulations_on(train)} simulations, {arm.repetitions} repetitions, "
            f"searching {axes}; at {level_words(*arm.levels)}{_AS_IN_THE_PAPER.get(arm.label, '')}."
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


def _table(one: StudyTable) -> ResultTable:
    cells = [[v.text() if isinstance(v, Estimate) else str(v) for v in row] for row in one.rows]
    columns = range(len(one.header))
    numbers = frozenset(i for i in columns if any(isinstance(row[i], int | float | Estimate) for row in one.rows))
    return ResultTable(one.title, one.header, [TableRow(row) for row in cells], numbers)
