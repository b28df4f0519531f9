"""The command `decant simulate`: predicts one pour, or all pours of a table of weighed pours, without a laboratory.

`PredictionInputs` holds θ with draws of its posterior, and makes the simulations of a pour.
"""

from __future__ import annotations

import dataclasses
import statistics
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from orchestrator.cli.command_options import Assignments, Campaign, Json, Parameters, Receiver, SceneName, Thetas
from orchestrator.cli.console import (
    FAILED,
    RefusalError,
    Refused,
    check_output,
    print_json,
    print_note,
    print_warning,
    stdout_for_results,
    waiting_for,
)

if TYPE_CHECKING:
    from orchestrator.campaigns.pour_table import RecordTable
    from orchestrator.learning.campaign_plan import CampaignPlan, RecordedPour, RecordSet
    from orchestrator.reports.prediction_scores import ScoredRow
    from sim_engine.action import Action
    from sim_engine.liquids import SimulationParameters
    from sim_engine.model_validity import ModelValidity
    from sim_engine.outcome import PourOutcome, SimulatedPour
    from sim_engine.prediction_band import CalibrationResidual, SampleStatistics
    from sim_engine.scene import PourTask, Scene
    from sim_engine.search_space import Space
    from sim_engine.simulator import PourSimulator


def simulate(
    campaign: Campaign,
    assignments: Assignments = None,
    source: Annotated[
        Path | None,
        typer.Option(
            "--from", help="Table of weighed pours (CSV, .xlsx), as for a calibration: predict and score all of them."
        ),
    ] = None,
    parameters: Parameters = None,
    receiver: Receiver = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the initial positions; the first if several.")] = 0,
    seeds: Annotated[
        int, typer.Option(min=1, max=1000, help="Number of seeds per pour: SEED, SEED + 1, … Their spread is shown.")
    ] = 3,
    thetas: Thetas = None,
    scene: SceneName = None,
    as_json: Json = False,
    rrd: Annotated[Path | None, typer.Option(help="Write a Rerun recording.")] = None,
    png: Annotated[
        Path | None, typer.Option(help="Draw four moments of the pour; with --from: measured over predicted.")
    ] = None,
    csv: Annotated[Path | None, typer.Option(help="With --from: write a table of the predictions as CSV.")] = None,
) -> None:
    """Simulate one pour of a campaign's scene with several seeds, and print the fate of the liquid.

    Values of `--set` without a unit are in deg, deg/s, deg/s^2, mm and s; values that the campaign fixes can be left
    out. With `--json`, fractions are of the load: received + spilled + retained + in_flight + escaped = 1. They are of
    the first seed, as are the recording and the picture. 'prediction' contains means and standard deviations of all
    seeds, and the interval that should contain nine pours in ten.

    With `--from`, every pour of a table is predicted, and the predictions are scored: mean |measured − predicted|
    spillage, Spearman's rank correlation, and the number of pours within their intervals. The scene is the one that
    refers to the file, else calibration's, unless `--scene` names another.
    """
    options = SimulateOptions(assignments, parameters, receiver, thetas, seed, seeds, scene, csv, rrd, png, as_json)
    if source is None:
        if csv is not None:
            raise RefusalError(f"--csv {csv}: goes with --from, a table of weighed pours")
        _simulate_pour(campaign, options)
        return
    if assignments:
        raise RefusalError("--set: the table given with --from says what is poured; remove one of them")
    if rrd is not None:
        raise RefusalError(f"--rrd {rrd}: records one pour; it does not go with --from")
    _predict_table(campaign, options, source)


@dataclass(frozen=True)
class SimulateOptions:
    """Options of `simulate` that its two forms share."""

    assignments: list[str] | None
    parameters: Path | None
    receiver: Path | None
    thetas: int | None
    seed: int
    seeds: int
    scene: str | None
    csv: Path | None
    rrd: Path | None
    png: Path | None
    as_json: bool


def _simulate_pour(path: Path, options: SimulateOptions) -> None:
    """Simulate one pour with several seeds; their mean and spread are the prediction."""
    from orchestrator.campaigns.action_assignments import assigned_action
    from orchestrator.campaigns.campaign_checks import check_vessels
    from orchestrator.campaigns.file_loading import load_vessel
    from orchestrator.cli.foreground_run import read_campaign
    from sim_engine.prediction_band import band_of, spreads
    from sim_engine.simulator import InvalidSceneError, PourSimulator

    plan = read_campaign(path)
    known = prediction_inputs(plan, options)
    vessel = None if options.receiver is None else load_vessel(options.receiver)
    scene, space = scene_to_simulate(plan, options.scene)
    if vessel is not None:
        scene = dataclasses.replace(scene, name=f"{scene.pourer.name} into {vessel.name}", receiver=vessel)
    with Refused(ValueError, at="--set: "):
        action = assigned_action(options.assignments or [], fixed=scene.fixed, space=space)
    known = known.at(scene)
    check_output(options.rrd, "--rrd", ".rrd")
    check_output(options.png, "--png", ".png")
    wanted = wanted_in(plan, scene, options.scene)
    problems = check_vessels(scene, plan.source, wanted, warn=print_warning)
    if problems:
        raise RefusalError("\n".join(map(str, problems)))
    frame_rate = 20.0 if options.rrd or options.png else 0.0
    tasks = known.tasks(scene, action, options.seed, options.seeds, frame_rate)
    simulator = PourSimulator()
    with Refused(InvalidSceneError, at="with shapes that the vessels may have, " if scene.uncertain else ""):
        for task in tasks if scene.uncertain else tasks[:1]:  # refuse before Taichi starts
            simulator.prepare(task)
    regime = _regimes(tasks[0])
    runs = _simulated_pour(simulator, tasks)
    outcomes = [run.outcome for run in runs]
    _show(tasks[0], runs[0], options)
    over_seeds, where = spreads(outcomes), band_of(outcomes, known.residual)
    received = over_seeds.get("received")
    delivered = None if received is None else received.mean * scene.liquid.mass
    if options.as_json:
        from orchestrator.cli.command_results import PredictionOutput, SimulateOutput

        seeds = [task.seed for task in tasks]
        print_json(
            SimulateOutput(
                **outcomes[0].as_json(),
                action=action.values(),
                theta=known.theta,
                thetas=len(known.drawn),
                scene=scene.name,
                delivered_g=None if delivered is None else 1e3 * delivered,
                delivered_ml=None if delivered is None else scene.liquid.millilitres(delivered),
                prediction=PredictionOutput.model_validate({"band": where, "seeds": seeds, **over_seeds}),
                regimes=None if regime is None else regime.as_json(),
                not_covered=[] if regime is None else [gap.as_json() for gap in regime.not_covered],
            )
        )
    else:
        print_note(f"{scene.name}: {action.display()}")
        amount = "" if delivered is None else f"{1e3 * delivered:.1f} g, {scene.liquid.millilitres(delivered):.1f} mL"
        print(told(outcomes, over_seeds, amount))
        if where is not None:
            spilled = over_seeds["spillage"].percent()
            print(f"spilled / poured {spilled}, a pour: {where.percent()}   ({known.said(scene)})")
    bad = [f"seed {o.seed}: this outcome must not be used: {o.invalid}" for o in outcomes if o.invalid is not None]
    if bad:
        raise RefusalError("\n".join(bad), FAILED)


def wanted_in(plan: CampaignPlan, scene: Scene, name: str | None) -> float | None:
    """Return the volume that a scene's receiver must hold if less than the load is requested [m³]; None for all of it.

    Args:
        plan: the campaign.
        scene: a scene from `scene_to_simulate`, perhaps with another receiver.
        name: name that was passed to `scene_to_simulate`.
    """
    if plan.deployment is None or name in ("calibration", "transfer"):
        return None
    return plan.deployment.wanted(scene)


def _simulated_pour(simulator: PourSimulator, tasks: list[PourTask]) -> list[SimulatedPour]:
    """Run simulations one after the other, then close the simulator."""
    begin = time.monotonic()
    runs: list[SimulatedPour] = []

    def doing() -> str:
        if len(runs) == len(tasks):
            return "stopping the simulator …"
        note = "" if runs else "; the first pour ever also compiles kernels, about 8 s"
        return f"simulating seed {len(runs) + 1} of {len(tasks)}, {time.monotonic() - begin:.0f} s so far{note}"

    with stdout_for_results(), waiting_for(doing):
        try:
            for task in tasks:
                runs.append(simulator.simulate(task))
        finally:
            simulator.close()
    return runs


def told(outcomes: list[PourOutcome], over_seeds: Mapping[str, SampleStatistics], delivered: str = "") -> str:
    """Format the outcomes in one line: mean ± standard deviation over the seeds.

    Args:
        outcomes: one for each seed.
        over_seeds: their means and deviations.
        delivered: mean amount in the receiver; '' if it is unknown.
    """
    from sim_engine.prediction_band import FRACTIONS

    first = outcomes[0]
    shown = {name: over_seeds[name].percent(2 if name == "escaped" else 1) for name in FRACTIONS if name in over_seeds}
    fractions = "  ".join(f"{name.replace('_', ' ')} {text}" for name, text in shown.items())
    dribbled = statistics.fmean(outcome.dribbled for outcome in outcomes)
    fractions += f"  down the outside {100 * dribbled:.1f} %" if dribbled else ""
    fractions += f"  delivered {delivered}" if delivered else ""
    valid = sum(outcome.invalid is None for outcome in outcomes)
    seeds = (
        "1 seed, so no spread; --seeds 5 would tell it" if valid == 1 else f"mean ± standard deviation, {valid} seeds"
    )
    cpu_s = sum(outcome.cpu_s for outcome in outcomes)
    particles = f"{first.particles} particles, {1e3 * first.spacing:.2f} mm apart, {cpu_s:.1f} CPU s"
    return f"{fractions or 'no outcome that could be used'}   ({seeds}; {particles})"


def _regimes(task: PourTask) -> ModelValidity | None:
    """Return the model validity of a pour; effects that the simulator lacks are printed on stderr."""
    from orchestrator.reports.validity_warnings import numbers_line, regimes_of

    try:
        validity = regimes_of(task.scene, task.action, task.parameters.particles, task.parameters.lip_adhesion)
    except (ValueError, OSError) as error:
        print_note(f"note: whether something is not simulated could not be worked out: {error}")
        return None
    print_note(f"{numbers_line(validity)} (Reynolds, Weber and Bond numbers)")
    for gap in validity.not_covered:
        print_note(f"not simulated, {gap.kind}: {gap.text}")
    return validity


def scene_to_simulate(plan: CampaignPlan, name: str | None = None) -> tuple[Scene, Space]:
    """Return a scene of the campaign with its action space: the named one, deployment's first, or calibration's.

    Args:
        name: 'calibration', 'transfer', or a receiver's name.

    Raises:
        RefusalError: the campaign has no such scene.
    """
    from orchestrator.runs.stages import named_scenes

    scenes = named_scenes(plan)
    if name is None:
        return next(iter(scenes.values()))
    if name not in scenes:
        raise RefusalError(f"--scene {name}: the campaign has no such scene; there are {', '.join(scenes)}")
    return scenes[name]


def _show(task: PourTask, pour: SimulatedPour, options: SimulateOptions) -> None:
    if options.rrd is not None:
        from orchestrator.live_view.simulation_view import simulation_rrd

        print_note(f"recording: {simulation_rrd(options.rrd, task, pour)} (open it with: rerun {options.rrd})")
    if options.png is not None:
        from orchestrator.reports import figure_style
        from orchestrator.reports.pour_figures import simulation_figure

        print_note(f"picture: {figure_style.save(simulation_figure(task, pour), options.png)}")


def _predict_table(path: Path, options: SimulateOptions, source: Path) -> None:
    """Predict all pours of a table with simulations in this process."""
    from orchestrator.cli.foreground_run import read_campaign
    from orchestrator.reports.prediction_scores import scores
    from sim_engine.prediction_band import LEVEL
    from sim_engine.simulator import PourSimulator

    plan = read_campaign(path)
    known = prediction_inputs(plan, options)
    scene, records = _scene(plan, options, source)
    known = known.at(scene)
    table, pours = _pours(scene, records, source)
    check_output(options.csv, "--csv", ".csv")
    check_output(options.png, "--png", ".png")
    simulator = PourSimulator()
    tasks = [known.tasks(scene, pour.action, options.seed, options.seeds) for pour in pours]
    _check(simulator, table, source, [some if scene.uncertain else some[:1] for some in tasks])
    text = known.said(scene)
    print_note(f"{scene.name}: {len(pours)} pours, {len(tasks[0])} simulations each, {text}")
    outcomes = _simulated(simulator, tasks)
    rows = [
        _row(row.line, pour, some, known.residual) for row, pour, some in zip(table.rows, pours, outcomes, strict=True)
    ]
    dimensions = [name for name in table.dimensions if name in table.varying()] or list(table.dimensions)
    by_split = scores(rows)
    if options.csv is not None:
        from orchestrator.reports.prediction_scores import write_scored

        print_note(f"table: {write_scored(options.csv, rows, dimensions)}")
    if options.png is not None:
        from orchestrator.reports import figure_style
        from orchestrator.reports.prediction_scores import draw_scored

        title = f"{scene.pourer.name} into {scene.receiver.name}, {len(rows)} weighed pours"
        print_note(f"picture: {figure_style.save(draw_scored(rows, title=title, note=text), options.png)}")
    if options.as_json:
        from orchestrator.cli.command_results import SimulateTableOutput
        from sim_engine.prediction_band import resolution_shift

        left, shift = known.residual, resolution_shift(known.theta.particles)
        measured = left is not None and left.here
        left_shift = None if left is None else left.shift
        print_json(
            SimulateTableOutput(
                scene=scene.name,
                from_=source,
                scores=by_split,
                level=LEVEL,
                theta=known.theta,
                thetas=len(known.thetas),
                simulations=sum(map(len, outcomes)),
                cpu_s=sum(outcome.cpu_s for some in outcomes for outcome in some),
                bands={"discrepancy_shift": left_shift, "resolution_shift": 0.0 if measured else shift},
                pours=rows,
            )
        )
    else:
        for split, score in by_split.items():
            print(f"{split}: {score.text()}")
    lost = sum(row.lost for row in rows)
    if lost:
        print_note(f"{lost} of {sum(map(len, outcomes))} simulations could not be used, and are left out")
    if all(row.predicted is None for row in rows):
        raise RefusalError("no simulation could be used", FAILED)


def _scene(plan: CampaignPlan, options: SimulateOptions, source: Path) -> tuple[Scene, RecordSet | None]:
    """Select the scene of the pours: the named one, the one whose file this is, calibration's, or the first.

    Returns:
        The scene, and the records that define how such a file is read, if the campaign has any.
    """
    from orchestrator.campaigns.file_loading import load_vessel

    calibration = plan.calibration
    sets = {} if calibration is None else {"calibration": calibration.records, "transfer": calibration.transfer}
    name, same = options.scene, source.absolute().resolve()
    if name is None:
        names = [key for key, records in sets.items() if records is not None and records.path.resolve() == same]
        name = names[0] if names else ("calibration" if calibration is not None else None)
    scene, _ = scene_to_simulate(plan, name)
    if options.receiver is not None:
        vessel = load_vessel(options.receiver)
        scene = dataclasses.replace(scene, name=f"{scene.pourer.name} into {vessel.name}", receiver=vessel)
    records = sets.get(name or "") or sets.get("calibration")
    return scene, records


def _pours(scene: Scene, records: RecordSet | None, source: Path) -> tuple[RecordTable, list[RecordedPour]]:
    """Convert the table's rows to actions of the scene.

    Raises:
        RefusalError: the table has problems; lists them by line and column (exit code 2).
    """
    from orchestrator.campaigns.pour_table import read_records
    from orchestrator.campaigns.yaml.yaml_errors import ConfigError, Problem
    from sim_engine.vessel.shapes import ProfileShape

    radius = None if records is None else records.lip_radius
    if radius is None and isinstance(scene.pourer.shape, ProfileShape):
        radius = scene.pourer.shape.outline().inner[-1][0]
    table = read_records(
        source,
        loaded=scene.liquid.mass,
        lip_radius=radius,
        columns=None if records is None else records.columns,
        split="test",
    )
    if table.assumed:
        print_note(f"note: {table.assumed}")
    problems = list(table.problems)
    pours: list[RecordedPour] = []
    for row in () if problems else table.rows:
        try:
            pours.append(row.pour(scene.fixed))
        except ValueError as error:
            problems.append(Problem(source, row.line, 1, "", f"makes no action of scene '{scene.name}': {error}"))
            break  # all rows have the same problem
    if problems:
        raise RefusalError(str(ConfigError(problems)))
    return table, pours


def _check(simulator: PourSimulator, table: RecordTable, source: Path, tasks: Sequence[Sequence[PourTask]]) -> None:
    """Refuse invalid pours before Taichi starts.

    Raises:
        RefusalError: lists the lines at which the vessels touch or can't be built (exit code 2).
    """
    from orchestrator.campaigns.yaml.yaml_errors import ConfigError, Problem
    from sim_engine.simulator import InvalidSceneError

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
        raise RefusalError(str(ConfigError(problems)))


def _simulated(simulator: PourSimulator, tasks: Sequence[Sequence[PourTask]]) -> list[list[PourOutcome]]:
    """Run the simulations of all pours, then close the simulator."""
    begin, total, done = time.monotonic(), sum(map(len, tasks)), 0
    by_pour: list[list[PourOutcome]] = []

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
                by_pour.append(outcomes)
        finally:
            simulator.close()
    return by_pour


def _row(
    line: int, pour: RecordedPour, outcomes: Sequence[PourOutcome], residual: CalibrationResidual | None
) -> ScoredRow:
    from orchestrator.reports.prediction_scores import ScoredRow
    from sim_engine.prediction_band import SampleStatistics, band_of

    usable = [outcome for outcome in outcomes if outcome.invalid is None]
    values = [r for outcome in usable if (r := outcome.fractions.spillage) is not None]
    return ScoredRow(
        line,
        pour.split,
        pour.action,
        pour.spillage,
        SampleStatistics.of(values),
        band_of(outcomes, residual),
        len(outcomes) - len(values),
    )


@dataclass(frozen=True)
class PredictionInputs:
    """θ of a prediction.

    Attributes:
        theta: θ of the file, or the campaign's.
        drawn: draws of the posterior that simulations cycle through; empty: θ alone.
        residual: of the calibration, for the scene (`at`); None if it is unknown.
    """

    theta: SimulationParameters
    drawn: tuple[SimulationParameters, ...] = ()
    residual: CalibrationResidual | None = None

    @property
    def thetas(self) -> tuple[SimulationParameters, ...]:
        """All θ that simulations cycle through."""
        return self.drawn or (self.theta,)

    def at(self, scene: Scene) -> PredictionInputs:
        """The same for pours in a scene."""
        return self if self.residual is None else dataclasses.replace(self, residual=self.residual.at(scene))

    def tasks(self, scene: Scene, action: Action, seed: int, seeds: int, frame_rate: float = 0.0) -> list[PourTask]:
        """Return the simulations of one pour. They cycle through θ; uncertain vessel shapes are drawn for each
        simulation.

        Args:
            seed: seed of the first simulation.
            seeds: number of simulations, at least as many as θ.
            frame_rate: frame rate of the first simulation [1/s].
        """
        from sim_engine.scene import PourTask

        turns, count = self.thetas, max(seeds, len(self.thetas))
        return [
            PourTask(scene.drawn(seed + i), action, turns[i % len(turns)], seed + i, 0.0 if i else frame_rate)
            for i in range(count)
        ]

    def said(self, scene: Scene) -> str:
        """Describe the sources of uncertainty in the prediction intervals of a scene's pours."""
        among = f"{len(self.drawn)} θ of the posterior" if self.drawn else "one θ"
        measured = self.residual is not None and self.residual.here
        parts = ["seeds", among, *([] if measured else [f"{self.theta.particles} particles' resolution"])]
        if scene.uncertain:
            parts.insert(1, "shapes that the vessels may have")
        if self.residual is not None:
            parts.append("the residual of calibration")
            return f"intervals from {', '.join(parts[:-1])} and {parts[-1]}"
        return f"intervals from {', '.join(parts[:-1])} and {parts[-1]} alone (the residual of calibration is unknown)"


def prediction_inputs(plan: CampaignPlan, options: SimulateOptions) -> PredictionInputs:
    """Read θ and its posterior as requested on the command line.

    Args:
        plan: campaign with the values of θ that the file does not contain.
        options: of the command.

    Raises:
        ConfigError, RefusalError: the file is invalid, or it lacks the requested posterior.
    """
    from orchestrator.campaigns.file_loading import load_discrepancy, load_parameters
    from orchestrator.cli.foreground_run import read_draws

    draws = read_draws(options.parameters, options.thetas, options.seeds, plan.parameters)
    if options.parameters is None:
        return PredictionInputs(plan.parameters)
    return PredictionInputs(
        load_parameters(options.parameters, plan.parameters), draws, load_discrepancy(options.parameters)
    )
