"""Answer the six questions of the study of ten worlds (docs/evidence/calibration.md) from its finished cells.

    python benchmarks/study_questions.py [runs/study-benches] [--write] [--intervals]

Each value belongs to a world, a virtual bench with its ground truth: the mean over its repetitions (and receivers) of
differences paired by repetition. The mean over the worlds has a 95 % t interval. `--write` puts the table into
docs/evidence/calibration.md. `--intervals` only counts the pours of D3 in their 90 % intervals; with `--write` it
stores this table in docs/data/results.json.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from machine import ROOT, write_table
from players import by_turn, coverage

from orchestrator.learning.calibration.calibration_scores import UNCALIBRATED
from orchestrator.reports.stage_views import deployments_of
from orchestrator.study.study_command import read_study
from orchestrator.study.study_folder import CellResult, finished_results
from orchestrator.study.study_plan import cells_of
from orchestrator.study.study_statistics import (
    LEVEL,
    RANDOM,
    Estimate,
    Gathered,
    Key,
    estimate,
    gather,
    mean,
    running_least,
    tests_of,
)
from sim_engine.prediction_band import LEVEL as INTERVAL

PAGE = ROOT / "docs" / "evidence" / "calibration.md"
BEGIN, END = "<!-- measured: worlds -->\n", "<!-- end of measured -->"
STUDY = ROOT / "configs" / "studies" / "benches.yaml"
COMMAND = "python benchmarks/study_questions.py"
NEAR = 0.005
"""'Within half a point', and the largest excess error allowed for six active pours compared with twelve."""

ByWorld = dict[str, float]


@dataclass(frozen=True)
class Answer:
    """One question with its answer."""

    question: str
    by_world: ByWorld
    yes: Callable[[Estimate, ByWorld], bool]
    unit: str = "points"

    def row(self) -> str:
        """Return the row of the table."""
        found = estimate(list(self.by_world.values()))
        factor = 100.0 if self.unit == "points" else 1.0
        better = sum(value < 0.0 for value in self.by_world.values())
        shown = f"{factor * found.mean:.2f} ({factor * found.low:.2f} … {factor * found.high:.2f}) {self.unit}"
        said = "yes" if self.yes(found, self.by_world) else "no"
        return f"| {self.question} | {shown} | {better} of {found.count} | {said} |"


def calibrated(found: Gathered, levels: list[str], first: str, second: str) -> ByWorld:
    """Return the test discrepancy of one calibration minus that of another."""
    a, b = tests_of(found, first), tests_of(found, second)
    return _by_world(levels, {number: a[number] - b[number] for number in a.keys() & b.keys()})


def _by_world(levels: list[str], differences: Mapping[int, float]) -> ByWorld:
    grouped = {level: [d for n, d in differences.items() if n // LEVEL == i] for i, level in enumerate(levels)}
    return {level: mean(values) for level, values in grouped.items() if values}


def deployed(
    found: Gathered, levels: list[str], receivers: list[str], value: Callable[[Key], dict[int, float]]
) -> ByWorld:
    """Return a deployment's value for D3 minus that for D2, by bench."""
    by_world: ByWorld = {}
    for level in levels:
        differences = []
        for receiver in receivers:
            ours, theirs = (value(Key(level, receiver, strategy)) for strategy in ("D3", "D2"))
            differences += [ours[n] - theirs[n] for n in ours.keys() & theirs.keys()]
        if differences:
            by_world[level] = mean(differences)
    return by_world


def answers(found: Gathered, levels: list[str], receivers: list[str]) -> list[Answer]:
    """Return the answers to all six questions."""

    def below_zero(one: Estimate, _: ByWorld) -> bool:
        return one.high < 0.0

    def losses(key: Key) -> dict[int, float]:
        return dict(zip(found.numbers.get(key, []), map(mean, found.losses.get(key, [])), strict=True))

    def until_near(key: Key) -> dict[int, float]:
        both = [
            run for strategy in ("D2", "D3") for run in found.losses.get(Key(key.level, key.receiver, strategy), [])
        ]
        least = min((loss for run in both for loss in run if not math.isnan(loss)), default=math.nan)
        curves = [running_least(run) for run in found.losses.get(key, [])]
        pours = [next((i for i, b in enumerate(c, start=1) if b <= least + NEAR), len(c) + 1) for c in curves]
        return dict(zip(found.numbers.get(key, []), map(float, pours), strict=True))

    def finals(key: Key) -> dict[int, float]:
        return {number: mean([one.loss for one in some]) for number, some in found.finals.get(key, {}).items()}

    return [
        Answer("1. C4 less uncalibrated", calibrated(found, levels, "C4", UNCALIBRATED), below_zero),
        Answer("2. C4 less random θ", calibrated(found, levels, "C4", RANDOM), below_zero),
        Answer(
            "3. C4 on 6 active pours less C4 on 12 stratified ones",
            calibrated(found, levels, "C4-active", "C4"),
            lambda one, _: one.high < NEAR,
        ),
        Answer("4. mean loss of eight pours, D3 less D2", deployed(found, levels, receivers, losses), below_zero),
        Answer(
            "5. pours until near the best, D3 less D2",
            deployed(found, levels, receivers, until_near),
            below_zero,
            "pours",
        ),
        Answer(
            "6. recommended action poured again, D3 less D2",
            deployed(found, levels, receivers, finals),
            lambda one, benches: one.high < 0.01 and max(benches.values()) <= 0.03,
        ),
    ]


def table(found: Gathered, levels: list[str], receivers: list[str]) -> str:
    """Return Markdown: one row per question, and the description of the runs."""
    rows = ["| question | difference, 95 % interval over worlds | first better on | |", "|---|---|---|---|"]
    rows += [one.row() for one in answers(found, levels, receivers)]
    shares = {name: 100.0 * mean(list(tests_of(found, name).values())) for name in found.calibrated}
    means = ", ".join(f"{name} {share:.1f}" for name, share in shares.items())
    lost = {
        strategy: 100.0
        * mean([mean(run) for key, runs in found.losses.items() if key.strategy == strategy for run in runs])
        for strategy in ("D2", "D3")
    }
    return "\n".join(
        [
            *rows,
            "",
            f"Mean |r − c_s| of the pours that only score, in points: {means}. Mean loss of a pour: "
            f"D2 {lost['D2']:.1f} %, D3 {lost['D3']:.1f} %. {found.finished} of {found.cells} cells, "
            f"{found.simulations:,} simulations, {found.pours:,} pours, {found.cpu_s / 3600.0:.1f} CPU hours.",
        ]
    )


def interval_rows(results: Mapping[str, CellResult]) -> list[list[str]]:
    """Return rows: share of D3's pours in their 90 % intervals, and the mean interval score."""
    rows = []
    for cell, one in results.items():
        if cell.startswith("deployment.") and "D3" in cell.split("."):
            for deployed in deployments_of(one.results).values():
                known = [(pour.predicted_interval, pour.loss) for pour in deployed.pours]
                rows.append([(*ends, loss) for ends, loss in known if ends is not None and loss is not None])
    shown = []
    for name, pours in by_turn(rows).items():
        inside, score = coverage(pours, INTERVAL)
        shown.append([name, str(len(pours)), f"{100 * inside:.0f} %", f"{score:.4f}"])
    return shown


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", nargs="?", type=Path, default=ROOT / "runs" / "study-benches")
    parser.add_argument("--study", type=Path, default=STUDY)
    parser.add_argument("--write", action="store_true", help="write the table into docs/evidence/calibration.md")
    parser.add_argument("--intervals", action="store_true", help="count the pours of D3 in their 90 %% intervals")
    asked = parser.parse_args()
    study = read_study(asked.study)
    results = finished_results(asked.folder, cells_of(study))
    if asked.intervals:
        rows = interval_rows(results)
        for row in rows:
            print(" | ".join(row))
        if asked.write:
            head = ["pours", "number", "in their 90 % intervals", "interval score"]
            write_table("study-intervals", head, rows, f"{COMMAND} --intervals", f"D3 of {asked.study.name}")
        return
    found = gather(study, results)
    if not (found.finals and {"C4", "C4-active", UNCALIBRATED, RANDOM} <= found.calibrated.keys()):
        parser.error(f"{asked.folder}: too few cells are finished; first: decant study run {asked.study}")
    receivers = sorted({scene.receiver.name for strategy in study.deployments for scene in strategy.plan.scenes})
    text = table(found, [level.name for level in study.levels], receivers)
    print(text)
    if asked.write:
        before, rest = PAGE.read_text(encoding="utf-8").split(BEGIN)
        PAGE.write_text(f"{before}{BEGIN}{text}\n{END}{rest.split(END, 1)[1]}", encoding="utf-8")


if __name__ == "__main__":
    main()
