"""The report of a study: figure and table files, and one self-contained HTML page.

- `write_report` writes all files from the finished cells; an unfinished study is allowed.
- `tables` makes the tables: discrepancies of the calibrations, losses of the deployments, effects.
- `plain_words` describes the differences between strategies in sentences: which one is better, by how much, and where
  the data does not decide.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from orchestrator.learning.calibration.calibration_base import Calibrated
from orchestrator.learning.calibration.calibration_scores import UNCALIBRATED
from orchestrator.reports import html_report as page
from orchestrator.reports.loss_units import deployment_unit
from orchestrator.reports.wording import ResultRow, ResultTable, minutes
from orchestrator.study.calibration_figures import (
    Drawn,
    d1_iterations,
    draw_calibrations,
    is_ours,
    level_words,
    write_csv,
)
from orchestrator.study.deployment_figures import CAPTION, Losses, draw_deployments
from orchestrator.study.study_folder import code_summary, finished_results, write_whole
from orchestrator.study.study_plan import Level, StudyPlan, cells_of
from orchestrator.study.study_statistics import (
    ALL,
    FEWEST,
    RANDOM,
    SHARE,
    Effect,
    Estimate,
    Gathered,
    Key,
    at_pour,
    effect,
    estimate,
    gather,
    mean,
    tests_of,
)

TABLE_POURS = (1, 3, 15)

_PAIRED = (
    "Mean differences, paired by repetition, level and receiver [95 % t interval of these differences]; below 0 the "
    "first is better. C1 to C4 of a repetition share its weighed pours and the seeds that they are scored with. "
    "Deployments share the bench's systematic errors, and all but D2 and D1-uncalibrated the θ* of the repetition; the "
    "chance errors of their pours are drawn for each, but final actions' pours share them one by one. Probability: "
    "that chance alone gives such a difference (sign changes of the repetitions' differences); '—' below five "
    "repetitions. Many rows are tested: one in twenty is below 0.05 by chance."
)
_EFFECT_COLUMNS = ("compared", "of", "mismatch", "receiver", "repetitions", "difference", "better in", "probability")
TableRow = list[str | int | float | Estimate]


@dataclass(frozen=True)
class StudyTable:
    """A table. Its cells are texts, numbers, or estimates (three columns in CSV)."""

    name: str
    title: str
    caption: str
    header: Sequence[str]
    rows: Sequence[TableRow]

    def flat(self) -> tuple[list[str], list[list[object]]]:
        """Header and rows for CSV."""
        header: list[str] = []
        for i, name in enumerate(self.header):
            wide = any(isinstance(row[i], Estimate) for row in self.rows)
            header += [name, f"{name}, low", f"{name}, high"] if wide else [name]
        rows: list[list[object]] = []
        for row in self.rows:
            flat: list[object] = []
            for value in row:
                flat += [value.mean, value.low, value.high] if isinstance(value, Estimate) else [value]
            rows.append(flat)
        return header, rows


def tables(study: StudyPlan, pooled: Gathered) -> list[StudyTable]:
    """All tables for which there is data."""
    shown = []
    if pooled.calibrated:
        shown.append(_calibrations(study, pooled))
    if rows := [*_calibration_effects(study, pooled), *_deployment_effects(study, pooled)]:
        shown.append(StudyTable("table-effects", "Who gains how much", _PAIRED, _EFFECT_COLUMNS, rows))
    if pooled.finals:
        shown.append(_finals(pooled, Losses(study, pooled, final=True)))
    if pooled.losses:
        shown.append(_deployments(pooled, Losses(study, pooled)))
    if pooled.calibrated or pooled.losses:
        shown.append(_beside_the_paper(study, pooled))
    return shown


PAPER = "Lopez-Guevara et al., CoRL 2017"

PAPER_BUDGETS = {
    "C1": "2,800 simulations (10 × 10 θ)",
    "C2": "504 simulations (18 θ)",
    "C3": "1,652 simulations (59 iterations)",
    "C4": "108 simulations",
    "D1": "5, 10 or 15 iterations, one pour",
    "D2": "15 pours",
    "D3": "37 simulations, then 15 pours",
}
"""Budgets of the paper's strategies: 28 training pours, three repetitions of a deployment into each of three cups."""

PAPER_FINDINGS = {
    "3b": "the spillage varied little between the θ* of C1 to C4; C2's θ* was the least uncertain, with a small bias",
    "3c": "C4 needed by far the fewest simulations: 108, where C3 took 1,652, C2 504 and C1 2,800",
    "4": "the discrepancy over the number of particles and cohesion was nearly flat in one direction",
    "5b": "D2 spilled least into cup 1, the easy one, and D3 into cup 2, the hard one; cup 3 showed no significant "
    "difference (three repetitions, 15 pours)",
    "6": "D2 spilled least into cup 1, the easy one, and D3 into cup 2, the hard one; cup 3 showed no significant "
    "difference (three repetitions, after 3, 9 and 15 pours)",
    "7": "a simulation took about 25 s and a pour about 90 s; at such costs D3 was ahead of D1",
}
"""What the paper reports of the counterpart of a figure."""


def _beside_the_paper(study: StudyPlan, pooled: Gathered) -> StudyTable:
    train = study.pour_count - study.holdout
    rows: list[TableRow] = []
    for calibrated in study.calibrations:
        if calibrated.label in PAPER_BUDGETS:
            ours = f"{calibrated.plan.settings.simulations_on(train):,} simulations"
            rows.append([calibrated.label, PAPER_BUDGETS[calibrated.label], ours, "—", str(calibrated.repetitions)])
    for deployed in study.deployments:
        if strategy := PAPER_BUDGETS.get("D1" if d1_iterations(deployed.label) else deployed.label):
            spending = deployed.plan.settings.spending
            rows.append([deployed.label, strategy, spending, "3", str(deployed.repetitions)])
    each = pooled.cpu_s / max(pooled.simulations, 1)
    rows.append(["a simulation", "25 s", f"{each:.2g} s of CPU time", "—", "—"])
    rows.append(["a pour", "90 s, of it 2 to 5 s of the robot", "virtual", "—", "—"])
    caption = (
        f"{PAPER}, as far as it states its values. Its losses are not listed: they are of other cups, of a real liquid "
        "and of one robot."
    )
    header = ("of", "in the paper", "here", "repetitions in the paper", "repetitions here")
    return StudyTable("table-paper", "The paper's values beside these", caption, header, rows)


def _calibrations(study: StudyPlan, pooled: Gathered) -> StudyTable:
    rows: list[TableRow] = []
    for name, scores in pooled.calibrated.items():
        spent = "0" if name in (UNCALIBRATED, RANDOM) else f"{mean([float(n) for n in scores.simulations]):.0f}"
        if name == "C1":
            spent += " (scored from one grid)"
        values = [mean(test) for test in scores.test]
        trained = [mean(train) for train in scores.train]
        rows.append(
            [
                name,
                spent,
                len(scores.test),
                estimate(trained, SHARE).scaled(100),
                estimate(values, SHARE).scaled(100),
                _thetas(scores.results),
            ]
        )
    return StudyTable(
        "table-calibration",
        "Discrepancy of the calibrated simulators",
        f"Mean |measured − simulated| of the normalised spillage, mean over repetitions [95 % t interval], at "
        f"{study.compared} mismatch. Uncalibrated: searched parameters at their defaults. Repetitions weigh the same "
        f"{study.pour_count} actions again, and keep {study.holdout} of them for testing: test pours recur between "
        "repetitions. C1's share one simulated grid, too: its interval has the chance of pours, and none of the grid's "
        "simulations.",
        ("strategy", "simulations", "repetitions", "training pours [%]", "test pours [%]", "θ*, mean ± deviation"),
        rows,
    )


PAIRS = (
    ("C4", "C3"),
    ("C4", "C2"),
    ("C4", "C1"),
    ("C4", "C4-paper"),
    ("C4", UNCALIBRATED),
    ("C4", RANDOM),
    ("C4-active", "C4"),
    ("C4-paper", "C3"),
    ("C3", "C2"),
)
"""Pairs of calibrations whose test discrepancies are compared; calibrations of packages are compared with C4."""

ARMS = (("D3", "D2"), ("D3", "D3-paper"), ("D3-paper", "D2"), ("D3-paper", "D2-paper"), ("D2", "D2-paper"))
"""Pairs of deployments whose losses are compared; deployments of packages are compared with D3 and D2."""

FINAL_PAIRS = (
    *(("D3", "D2"), ("D3", "D3-paper"), ("D3-paper", "D2"), ("D3", "D1")),
    *((strategy, "D1-uncalibrated") for strategy in ("D1", "D2", "D3")),
)
"""Pairs whose recommended actions are compared, as `ARMS`; D1 is the one with the most iterations."""


def _calibration_effects(study: StudyPlan, pooled: Gathered) -> list[TableRow]:
    rows: list[TableRow] = []
    for first, second in (*PAIRS, *((name, "C4") for name in pooled.calibrated if not is_ours(name))):
        if first in pooled.calibrated and second in pooled.calibrated:
            gain = effect(tests_of(pooled, first), tests_of(pooled, second), SHARE)
            rows.append(_effect_row(f"{first} − {second}", "test discrepancy [%]", study.compared, "—", gain, 100.0))
    return rows


def _deployment_effects(study: StudyPlan, pooled: Gathered) -> Iterator[TableRow]:
    for final, pairs in ((False, ARMS), (True, FINAL_PAIRS)):
        if not (pooled.finals if final else pooled.losses):
            continue
        losses = Losses(study, pooled, final=final)
        longest = max(
            filter(d1_iterations, losses.strategies), key=lambda strategy: d1_iterations(strategy) or 0, default=""
        )
        named = {"D1": longest}
        pairs_shown = [(named.get(first, first), named.get(second, second)) for first, second in pairs]
        pairs_shown += [
            (strategy, rival) for strategy in losses.strategies if not is_ours(strategy) for rival in ("D3", "D2")
        ]
        shown: list[tuple[str, Callable[[str, Sequence[str], str], Mapping[int, float]]]] = [
            (f"least {losses.unit.label} after {pour}", functools.partial(losses.after, pour=pour))
            for pour in losses.checkpoints(TABLE_POURS)
        ]
        if final:
            shown = [(f"{losses.unit.label} of the final action", losses.final)]
        groups = {name: [name] for name in losses.receivers}
        if len(groups) > 1:
            groups[ALL] = losses.receivers
        for (first, second), level, (of, values), (name, group) in itertools.product(
            pairs_shown, losses.levels, shown, groups.items()
        ):
            if first in losses.strategies and second in losses.strategies:
                gain = effect(values(level, group, first), values(level, group, second), losses.range)
                if gain.difference.count:
                    yield _effect_row(f"{first} − {second}", of, level, name, gain, losses.unit.factor)


def _effect_row(compared: str, of: str, level: str, receiver: str, gain: Effect, factor: float) -> TableRow:
    chance = "—" if gain.probability is None else f"{gain.probability:.3f}"
    count = gain.difference.count
    return [compared, of, level, receiver, count, gain.difference.scaled(factor), f"{gain.better} of {count}", chance]


def _thetas(results: Sequence[Calibrated]) -> str:
    texts, thetas = [], [result.found for result in results if result.found is not None]
    for name in thetas[0].searched if thetas else ():
        values = [getattr(theta.theta, name) for theta in thetas]
        texts.append(f"{name} {np.mean(values):.3g} ± {np.std(values):.2g}")
    return ", ".join(texts)


def _deployments(pooled: Gathered, losses: Losses) -> StudyTable:
    pours = losses.checkpoints(TABLE_POURS)
    rows: list[TableRow] = []
    for place in itertools.product(losses.levels, losses.receivers, losses.strategies):
        if curves := pooled.best_so_far(Key(*place)):
            rows.append([*place, len(curves), *(losses.mean(at_pour(curves, pour)) for pour in pours)])
    return StudyTable(
        "table-deployment",
        f"Least {losses.unit.label} so far",
        "Mean over repetitions [95 % t interval]. D1 pours once: its number stays, while the least of several pours, "
        "each with its chance, is partly luck.",
        ("mismatch", "receiver", "strategy", "repetitions", *(f"after {n} pour{'s' * (n > 1)}" for n in pours)),
        rows,
    )


def _finals(pooled: Gathered, losses: Losses) -> StudyTable:
    rows: list[TableRow] = []
    for level, receiver, strategy in itertools.product(losses.levels, losses.receivers, losses.strategies):
        if by_repetition := pooled.finals.get(Key(level, receiver, strategy)):
            pours = [pour for some in by_repetition.values() for pour in some]
            spilled = estimate([mean([pour.spillage for pour in some]) for some in by_repetition.values()], SHARE)
            loss = losses.mean(list(losses.final(level, [receiver], strategy).values()))
            lost = f"{sum(not pour.made for pour in pours)} of {len(pours)}"
            rows.append([level, receiver, strategy, len(by_repetition), loss, spilled.scaled(100.0), lost])
    header = ("mismatch", "receiver", "strategy", "repetitions", losses.unit.label, "spilled / poured [%]", "not made")
    return StudyTable("table-final", "The recommended action, poured again", CAPTION, header, rows)


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
        return f"{where}: the data do not separate {first} from {second} ({size})."
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

_FORMS = {
    "C4-paper": ". As in the paper: the surrogate is over θ alone, and takes the action's influence for noise",
    "D1-uncalibrated": ". The simulator keeps its defaults: the baseline of the other deployments",
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
    pooled = gather(study, results)
    report = folder / REPORT
    report.mkdir(parents=True, exist_ok=True)
    figures = [*draw_calibrations(study, pooled), *draw_deployments(study, pooled)]
    for figure in figures:
        figure.save(report)
    shown = tables(study, pooled)
    for table in shown:
        write_csv(report / f"{table.name}.csv", *table.flat())
    path = report / PAGE
    write_whole(path, _page(study, pooled, code_summary(results), figures, shown, report))
    return path


def _page(
    study: StudyPlan, pooled: Gathered, code: str, figures: Sequence[Drawn], shown: Sequence[StudyTable], report: Path
) -> str:
    return page.render(
        "study.html.j2",
        title=f"Study {study.name}",
        kicker="Report of a study: strategies side by side, repeated",
        heading=f"Study {study.name}",
        unfinished=f"Unfinished: {pooled.finished} of {pooled.cells} cells are there."
        * (pooled.finished < pooled.cells),
        lead=_summary(study, pooled),
        words=plain_words(shown),
        open=_unknown(study, pooled),
        tables=[(table.name, table.title, table.caption, _table(table)) for table in shown],
        figures=[
            (fig.name, fig.title, page.Picture.of(report / f"{fig.name}.png", fig.title, _caption(fig), wide=True))
            for fig in figures
        ],
        resampled=_RESAMPLED,
        settings=[*_settings(study), code],
        footer="Every number of every figure and table is in a CSV file next to this page, the figures as PNG and SVG.",
    )


def _caption(figure: Drawn) -> str:
    counterpart = ""
    if figure.number:
        counterpart = f"Counterpart of figure {figure.number} of {PAPER}: {PAPER_FINDINGS[figure.number]}. "
    return f"{figure.caption} {counterpart}Numbers: {figure.name}.csv."


def _unknown(study: StudyPlan, pooled: Gathered) -> list[str]:
    """Limitations that a reader must consider."""
    counts = [compared.repetitions for compared in study.calibrations] + [
        compared.repetitions for compared in study.deployments
    ]
    notes = ["All benches are VIRTUAL: what a real robot, cup and liquid would do is not in these numbers."]
    if counts and min(counts) < FEWEST:
        notes.append(
            f"Some strategies have {min(counts)} repetitions: below {FEWEST} no difference is tested, and intervals "
            "are wide or missing. Such numbers show that everything works, and nothing more."
        )
    if pooled.finished < pooled.cells:
        notes.append("Cells are missing: what is compared may change when they are there.")
    receivers = sorted({scene.receiver.name for compared in study.deployments for scene in compared.plan.scenes})
    if receivers:
        notes.append(f"It holds for these receivers ({', '.join(receivers)}), this liquid and these ranges of actions.")
    return notes


def _summary(study: StudyPlan, pooled: Gathered) -> str:
    losses = (
        "" if not study.deployments else f" Deployments minimise: {deployment_unit(study.deployments[0].plan).label}."
    )
    return (
        f"{pooled.simulations:,} simulations and {pooled.pours:,} pours on virtual benches, {minutes(pooled.cpu_s)} of "
        f"CPU time of simulation, {minutes(pooled.seconds)} of all cells one after the other. Nothing of this was "
        f"poured by a physical robot.{losses}"
    )


def _settings(study: StudyPlan) -> list[str]:
    lines = [f"Seed {study.seed}; {study.pour_count} calibration pours, {study.holdout} of them for testing."]
    train = study.pour_count - study.holdout
    for compared in study.calibrations:
        axes = ", ".join(f"{axis.name} {axis.lower:g} to {axis.upper:g}" for axis in compared.plan.parameters.axes)
        lines.append(
            f"{compared.label}: {compared.plan.settings.simulations_on(train)} simulations, "
            f"{compared.repetitions} repetitions, searching {axes}; "
            f"at {level_words(*compared.levels)}{_FORMS.get(compared.label, '')}."
        )
    for each in study.deployments:
        paper = _FORMS.get(each.label, "")
        lines.append(
            f"{each.label}: {each.plan.settings.spending}; {each.repetitions} repetitions into each receiver{paper}."
        )
    if study.confirm and study.deployments:
        lines.append(f"Each deployment's recommended action is poured {study.confirm} more times.")
    return [*lines, *(_level(level) for level in study.levels)]


def _level(level: Level) -> str:
    liquid = ", ".join(f"{name} {value:g}" for name, value in level.bench.theta.of_the_solver().items())
    error, noise = level.bench.pose_error, level.bench.pose_noise
    off = ", ".join(f"{1e3 * value:g}" for value in (error.x, error.y, error.z))
    scatter = ", ".join(f"{1e3 * value:g}" for value in (noise.x, noise.y, noise.z))
    return (
        f"Mismatch '{level.name}': true θ {liquid}; receiver off by {off} mm (x, y, height), tilt by "
        f"{error.tilt:.3g} rad, speed × {error.speed_factor:g}; from pour to pour ± {scatter} mm, "
        f"{noise.tilt:.3g} rad, × {noise.speed_factor:g}."
    )


def _table(table: StudyTable) -> ResultTable:
    cells = [[v.text() if isinstance(v, Estimate) else str(v) for v in row] for row in table.rows]
    columns = range(len(table.header))
    numbers = frozenset(i for i in columns if any(isinstance(row[i], int | float | Estimate) for row in table.rows))
    return ResultTable(table.title, table.header, [ResultRow(row) for row in cells], numbers)
