"""The command `decant simulate`: predicts one pour, without a laboratory.

`PredictionInputs` holds θ with draws of its posterior, and makes the simulations of a pour.
"""

from __future__ import annotations

import dataclasses
import statistics
import time
from collections.abc import Mapping
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
    from orchestrator.cli.command_results import SimulateOutput
    from orchestrator.learning.campaign_plan import CampaignPlan
    from sim_engine.action import Action
    from sim_engine.liquids import SimulationParameters
    from sim_engine.model_validity import ModelValidity
    from sim_engine.outcome import PourOutcome, SimulatedPour
    from sim_engine.prediction_band import CalibrationResidual, SampleStatistics
    from sim_engine.scene import PourTask, Scene
    from sim_engine.search_space import Space
    from sim_engine.simulator import PourSimulator
    from sim_engine.vessel.shapes import VesselSpec


def simulate(
    campaign: Campaign,
    assignments: Assignments = None,
    parameters: Parameters = None,
    receiver: Receiver = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the initial positions; the first if several.")] = 0,
    seeds: Annotated[
        int, typer.Option(min=1, max=1000, help="Number of seeds per pour: SEED, SEED + 1, … Their spread is shown.")
    ] = 3,
    thetas: Thetas = None,
    scene_name: SceneName = None,
    as_json: Json = False,
    rrd: Annotated[Path | None, typer.Option(help="Write a Rerun recording.")] = None,
    png: Annotated[Path | None, typer.Option(help="Draw four moments of the pour.")] = None,
) -> None:
    """Simulate one pour of a campaign's scene with several seeds, and print the fate of the liquid.

    Values of `--set` without a unit are in deg, deg/s, deg/s^2, mm and s; values that the campaign fixes can be left
    out. An action that the laboratory's arm can't make is simulated with a warning. With `--json`, fractions are of the
    load: received + spilled + retained + in_flight + escaped = 1. They are of the first seed, as are the recording and
    the picture. 'prediction' contains means and standard deviations of all seeds, and the interval that should contain
    nine pours in ten.
    """
    from orchestrator.campaigns.file_loading import load_discrepancy, load_parameters, load_vessel
    from orchestrator.cli.foreground_run import read_campaign, read_draws
    from sim_engine.simulator import InvalidSceneError, PourSimulator

    plan = read_campaign(campaign)
    draws = read_draws(parameters, thetas, seeds, plan.parameters)
    inputs = PredictionInputs(plan.parameters)
    if parameters is not None:
        inputs = PredictionInputs(load_parameters(parameters, plan.parameters), draws, load_discrepancy(parameters))
    check_output(rrd, "--rrd", ".rrd")
    check_output(png, "--png", ".png")
    vessel = None if receiver is None else load_vessel(receiver)
    scene, action = scene_and_action(plan, assignments or [], scene_name, vessel)
    inputs = inputs.at(scene)
    frame_rate = 20.0 if rrd or png else 0.0
    tasks = inputs.tasks(scene, action, seed, seeds, frame_rate)
    simulator = PourSimulator()
    with Refused(InvalidSceneError, at="with shapes that the vessels may have, " if scene.uncertain else ""):
        for task in tasks if scene.uncertain else tasks[:1]:  # refuse before Taichi starts
            simulator.prepare(task)
    _warn_of_arm(plan, scene, action)
    regime = _regimes(tasks[0])
    runs = _simulated_pour(simulator, tasks)
    outcomes = [run.outcome for run in runs]
    _show(tasks[0], runs[0], rrd, png)
    if as_json:
        print_json(_output(tasks, outcomes, inputs, regime))
    else:
        print_note(f"{scene.name}: {action.display()}")
        _print_prediction(scene, outcomes, inputs)
    bad = [f"seed {o.seed}: this outcome must not be used: {o.invalid}" for o in outcomes if o.invalid is not None]
    if bad:
        raise RefusalError("\n".join(bad), FAILED)


def _delivered(scene: Scene, over_seeds: Mapping[str, SampleStatistics]) -> float | None:
    """Mean mass in the receiver [kg]; None if it is undefined."""
    received = over_seeds.get("received")
    return None if received is None else received.mean * scene.liquid.mass


def _output(
    tasks: list[PourTask], outcomes: list[PourOutcome], inputs: PredictionInputs, regime: ModelValidity | None
) -> SimulateOutput:
    """The output of --json."""
    from orchestrator.cli.command_results import PredictionOutput, SimulateOutput
    from sim_engine.prediction_band import band_of, spreads

    scene, over_seeds = tasks[0].scene, spreads(outcomes)
    delivered = _delivered(scene, over_seeds)
    prediction = {"band": band_of(outcomes, inputs.residual), "seeds": [task.seed for task in tasks], **over_seeds}
    return SimulateOutput(
        **outcomes[0].as_json(),
        action=tasks[0].action.values(),
        theta=inputs.theta,
        thetas=len(inputs.drawn),
        scene=scene.name,
        delivered_g=None if delivered is None else 1e3 * delivered,
        delivered_ml=None if delivered is None else scene.liquid.millilitres(delivered),
        prediction=PredictionOutput.model_validate(prediction),
        regimes=None if regime is None else regime.as_json(),
        not_covered=[] if regime is None else [gap.as_json() for gap in regime.not_covered],
    )


def _print_prediction(scene: Scene, outcomes: list[PourOutcome], inputs: PredictionInputs) -> None:
    """Print the fate of the liquid, and the interval that should contain nine pours in ten."""
    from sim_engine.prediction_band import band_of, spreads

    over_seeds = spreads(outcomes)
    delivered = _delivered(scene, over_seeds)
    amount = "" if delivered is None else f"{1e3 * delivered:.1f} g, {scene.liquid.millilitres(delivered):.1f} mL"
    print(told(outcomes, over_seeds, amount))
    if (interval := band_of(outcomes, inputs.residual)) is not None:
        spilled = over_seeds["spillage"].percent()
        print(f"spilled / poured {spilled}, a pour: {interval.percent()}   ({inputs.said(scene)})")


def _warn_of_arm(plan: CampaignPlan, scene: Scene, action: Action) -> None:
    """Warn of an action that the laboratory's arm can't make."""
    from actors.arm.pour_feasibility import path_of
    from actors.interfaces import InvalidActionError

    if plan.laboratory.arm is not None:
        try:
            path_of(scene, action, plan.laboratory.expected_arm)
        except InvalidActionError as error:
            print_warning(f"{action.display()}: {error}")


def scene_and_action(
    plan: CampaignPlan, assignments: list[str], scene_name: str | None = None, receiver: VesselSpec | None = None
) -> tuple[Scene, Action]:
    """Return the scene and the action that the options of a command select, with vessels that hold the liquid.

    Args:
        plan: the campaign.
        assignments: `name=value` texts.
        scene_name: see `scene_to_simulate`.
        receiver: instead of the scene's.

    Raises:
        RefusalError: the scene, a value or a vessel is invalid.
    """
    from orchestrator.campaigns.action_assignments import assigned_action
    from orchestrator.campaigns.campaign_checks import check_vessels

    scene, space = scene_to_simulate(plan, scene_name)
    if receiver is not None:
        scene = dataclasses.replace(scene, name=f"{scene.pourer.name} into {receiver.name}", receiver=receiver)
    with Refused(ValueError, at="--set: "):
        action = assigned_action(assignments, fixed=scene.fixed, space=space)
    deployed = plan.deployment is not None and scene_name not in ("calibration", "transfer")
    volume = plan.deployment.wanted(scene) if deployed and plan.deployment is not None else None
    problems = check_vessels(scene, plan.source, volume, warn=print_warning)
    if problems:
        raise RefusalError("\n".join(map(str, problems)))
    return scene, action


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
    half = " (half of them simulated, mirrored)" if first.mirrored else ""
    particles = f"{first.particles} particles{half}, {1e3 * first.spacing:.2f} mm apart, {cpu_s:.1f} CPU s"
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


def _show(task: PourTask, pour: SimulatedPour, rrd: Path | None, png: Path | None) -> None:
    if rrd is not None:
        from orchestrator.live_view.simulation_view import simulation_rrd

        print_note(f"recording: {simulation_rrd(rrd, task, pour)} (open it with: rerun {rrd})")
    if png is not None:
        from orchestrator.reports import figure_style
        from orchestrator.reports.pour_figures import simulation_figure

        print_note(f"picture: {figure_style.save(simulation_figure(task, pour), png)}")


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
        else:
            parts.append("the errors of an uncalibrated simulator on ten benches")
        text = f"intervals from {', '.join(parts[:-1])} and {parts[-1]}"
        return text if self.residual is not None else f"uncalibrated: {text}"
