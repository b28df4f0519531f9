"""`decant simulate --from`: a table of weighed pours is predicted in one go, and the predictions are scored."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from orchestrator.commands.common import check_output, read_campaign
from orchestrator.commands.single import scene_to_simulate
from orchestrator.commands.speaking import (
    BAD_INPUT,
    FAILED,
    RefusalError,
    Refused,
    mention,
    print_json,
    stdout_for_results,
)
from orchestrator.commands.waiting import waiting_for

if TYPE_CHECKING:
    from orchestrator.commands.foretelling import SimulateOptions
    from orchestrator.config.campaign.records import Table
    from orchestrator.plan import CampaignPlan, RecordedPour, RecordSet
    from orchestrator.scoring import ScoredRow
    from sim_engine.outcome import PourOutcome
    from sim_engine.pour import PourSimulator
    from sim_engine.task import PourTask, Scene


def predict_table(path: Path, options: SimulateOptions, source: Path) -> None:
    """All pours of a table, in the simulator of this process."""
    from orchestrator.commands.foretelling import foretelling
    from orchestrator.scoring import scores
    from sim_engine.backend import BackendError, require_backend
    from sim_engine.bands import LEVEL
    from sim_engine.pour import PourSimulator

    plan = read_campaign(path)
    known = foretelling(plan, options.parameters, options.thetas, options.seeds)
    scene, records = _scene(plan, options, source)
    table, pours = _pours(scene, records, source)
    check_output(options.csv, "--csv", ".csv")
    check_output(options.png, "--png", ".png")
    with Refused(BackendError, at="--backend: "):
        require_backend(options.backend)
    simulator = PourSimulator(options.backend)
    tasks = [known.tasks(scene, pour.action, options.seed, options.seeds) for pour in pours]
    _check(simulator, table, source, [some if scene.uncertain else some[:1] for some in tasks])
    said = known.said(scene)
    mention(f"{scene.name}: {len(pours)} pours, {len(tasks[0])} simulations each, {said}")
    outcomes = _simulated(simulator, tasks)
    rows = [
        _row(row.line, pour, some, known.discrepancy)
        for row, pour, some in zip(table.rows, pours, outcomes, strict=True)
    ]
    dimensions = [name for name in table.dimensions if name in table.varying()] or list(table.dimensions)
    found = scores(rows)
    if options.csv is not None:
        from orchestrator.report.scored import write_scored

        mention(f"table: {write_scored(options.csv, rows, dimensions)}")
    if options.png is not None:
        from orchestrator.report.scored import draw_scored

        title = f"{scene.pourer.name} into {scene.receiver.name}, {len(rows)} weighed pours"
        mention(f"picture: {draw_scored(options.png, rows, title=title, note=said)}")
    if options.as_json:
        print_json(
            {
                "scene": scene.name,
                "from": source,
                "scores": {split: one.as_json() for split, one in found.items()},
                "level": LEVEL,
                "theta": known.theta.model_dump(),
                "thetas": len(known.thetas),
                "simulations": sum(map(len, outcomes)),
                "cpu_s": sum(outcome.cpu_s for some in outcomes for outcome in some),
                "bands": known.as_json(),
                "pours": [_row_json(row, dimensions) for row in rows],
            }
        )
    else:
        for split, one in found.items():
            print(f"{split}: {one.text()}")
    lost = sum(row.lost for row in rows)
    if lost:
        mention(f"{lost} of {sum(map(len, outcomes))} simulations could not be used, and are left out")
    if all(row.predicted is None for row in rows):
        raise RefusalError("no simulation could be used", FAILED)


def _scene(plan: CampaignPlan, options: SimulateOptions, source: Path) -> tuple[Scene, RecordSet | None]:
    """Where the pours were made: the scene named, else that whose file this is, else calibration's, else the first.

    Returns:
        The scene, and the records that say how such a file is read, if the campaign has any.
    """
    import dataclasses

    from orchestrator.config.load import load_vessel
    from orchestrator.config.yaml.errors import ConfigError

    calibration = plan.calibration
    sets = {} if calibration is None else {"calibration": calibration.records, "transfer": calibration.transfer}
    name, same = options.scene, source.absolute().resolve()
    if name is None:
        own = [key for key, records in sets.items() if records is not None and records.path.resolve() == same]
        name = own[0] if own else ("calibration" if calibration is not None else None)
    scene, _ = scene_to_simulate(plan, name)
    if options.receiver is not None:
        with Refused(ConfigError):
            vessel = load_vessel(options.receiver)
        scene = dataclasses.replace(scene, name=f"{scene.pourer.name} into {vessel.name}", receiver=vessel)
    records = sets.get(name or "") or sets.get("calibration")
    return scene, records


def _pours(scene: Scene, records: RecordSet | None, source: Path) -> tuple[Table, list[RecordedPour]]:
    """The table's pours as actions of the scene.

    Raises:
        RefusalError: with everything that is wrong with the table, by line and column (exit code 2).
    """
    from orchestrator.config.campaign.records import read_records
    from orchestrator.config.yaml.errors import ConfigError, Problem
    from sim_engine.vessel.spec import ProfileShape

    radius = None if records is None else records.lip_radius
    if radius is None and isinstance(scene.pourer.shape, ProfileShape):
        radius = scene.pourer.shape.inner[-1][0]
    table = read_records(
        source,
        loaded=scene.liquid.mass,
        lip_radius=radius,
        columns=None if records is None else records.columns,
        split="test",
    )
    problems = list(table.problems)
    pours: list[RecordedPour] = []
    for row in () if problems else table.rows:
        try:
            pours.append(row.pour(scene.fixed))
        except ValueError as error:
            problems.append(Problem(source, row.line, 1, "", f"makes no action of scene '{scene.name}': {error}"))
            break  # the same holds for all of them
    if problems:
        raise RefusalError(str(ConfigError(problems)), BAD_INPUT)
    return table, pours


def _check(simulator: PourSimulator, table: Table, source: Path, tasks: Sequence[Sequence[PourTask]]) -> None:
    """Refuse what can't be poured before Taichi starts.

    Raises:
        RefusalError: with every line at which the vessels touch, or can't be built (exit code 2).
    """
    from orchestrator.config.yaml.errors import ConfigError, Problem
    from sim_engine.pour import InvalidSceneError

    problems, begin, done = [], time.monotonic(), 0

    def doing() -> str:
        return f"checking motions, {done} of {len(tasks)}, {time.monotonic() - begin:.0f} s so far"

    with waiting_for(doing):
        for row, some in zip(table.rows, tasks, strict=True):
            try:
                for task in some:
                    simulator.prepare(task)
            except InvalidSceneError as error:
                problems.append(Problem(source, row.line, 1, "", str(error)))
            done += 1
    if problems:
        raise RefusalError(str(ConfigError(problems)), BAD_INPUT)


def _simulated(simulator: PourSimulator, tasks: Sequence[Sequence[PourTask]]) -> list[list[PourOutcome]]:
    """Pour after pour; Taichi ends with them."""
    begin, total, done = time.monotonic(), sum(map(len, tasks)), 0
    found: list[list[PourOutcome]] = []

    def doing() -> str:
        spent = time.monotonic() - begin
        left = f", about {spent / done * (total - done):.0f} s left" if done > 2 else ""
        return f"simulation {done + 1} of {total}, {spent:.0f} s so far{left}"

    with stdout_for_results(), waiting_for(doing):
        try:
            for some in tasks:
                outcomes = []
                for task in some:
                    outcomes.append(simulator.simulate(task).outcome)
                    done += 1
                found.append(outcomes)
        finally:
            simulator.close()
    return found


def _row(line: int, pour: RecordedPour, outcomes: Sequence[PourOutcome], discrepancy: float | None) -> ScoredRow:
    from orchestrator.scoring import ScoredRow
    from sim_engine.bands import band_of
    from sim_engine.losses import normalised_spillage
    from sim_engine.spread import Spread

    usable = [outcome for outcome in outcomes if outcome.invalid is None]
    values = [r for outcome in usable if (r := normalised_spillage(outcome.fractions)) is not None]
    return ScoredRow(
        line,
        pour.split,
        pour.action,
        pour.normalised_spillage,
        Spread.of(values),
        band_of(outcomes, discrepancy),
        len(outcomes) - len(values),
    )


def _row_json(row: ScoredRow, dimensions: Sequence[str]) -> dict[str, object]:
    return {
        "line": row.line,
        "split": row.split,
        "action": {name: getattr(row.action, name) for name in dimensions},
        "measured": row.measured,
        "predicted": None if row.predicted is None else row.predicted.as_json(),
        "band": None if row.band is None else row.band.as_json(),
        "inside": row.held,
    }
