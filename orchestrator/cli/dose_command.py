"""The command `decant dose`: pours wanted amounts, or predicts them.

Only simulated benches pour wanted amounts; the command refuses every laboratory with an arm before anything starts.
"""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from orchestrator.cli.command_options import Campaign, InProcess, OtherLaboratory, Quiet, Seed
from orchestrator.cli.console import BAD_INPUT, FAILED, RefusalError, Refused, print_message, print_note

if TYPE_CHECKING:
    from actors.dosing.dose_series import DoseForecast
    from actors.interfaces import DoseTarget
    from orchestrator.strategies.campaign_plan import CampaignPlan
    from orchestrator.strategies.dispense import Dispensed, Dose
    from sim_engine.action import Action
    from sim_engine.scene import Scene

STAGE = "dose"


def dose(
    campaign: Campaign,
    amount: Annotated[
        list[str], typer.Option(help="Wanted in the receiver, for example '50 g'. Repeatable, one dose each.")
    ],
    tolerance: Annotated[
        str,
        typer.Option(help="Excess to avoid: the cup turns back as soon as more has an estimated probability of 1 %."),
    ] = "1 g",
    receiver: Annotated[
        str | None,
        typer.Option(
            metavar="NAME", help="Name of one of the campaign's receivers; default: the first.", show_default=False
        ),
    ] = None,
    dry_run: Annotated[
        bool,
        typer.Option("--dry-run", help="Predict amount, time, spill risk and content of the source; pour nothing."),
    ] = False,
    seed: Seed = None,
    laboratory: OtherLaboratory = None,
    in_process: InProcess = False,
    quiet: Quiet = False,
) -> None:
    """Pour wanted amounts: the tilt is decided from the balance while the liquid flows.

    Works on simulated benches only, which have no arm (configs/laboratories/twin.yaml). Hardware and virtual arms are
    refused. The pourer is a straight cup, and it holds the campaign's load before every dose.

    The doses are recorded in a journal and weighed, as a small run.
    """
    targets = _targets(amount, tolerance)
    plan, scene, action = _chosen(campaign, laboratory, receiver, targets)
    plan = dataclasses.replace(plan, seed=plan.seed if seed is None else seed)
    if dry_run:
        for target in targets:
            _predict(scene, target, plan.seed)
        print_message("nothing was poured")
        return
    options = "".join(
        f" {name} '{value}'"
        for name, value in (("--laboratory", laboratory), ("--receiver", receiver))
        if value is not None
    )
    again = f"Another dose: decant dose {campaign}{options} --amount '{amount[0]}'"
    _pour(plan, scene, action, targets, in_process=in_process, again=again)


def _targets(amounts: list[str], tolerance: str) -> list[DoseTarget]:
    from actors.interfaces import DoseTarget
    from sim_engine.settings.quantity import QuantityError, parse_quantity

    with Refused(QuantityError, at="--tolerance: "):
        limit = parse_quantity(tolerance, "kg", "1 g")
    with Refused(QuantityError, at="--amount: "):
        wanted = [parse_quantity(text, "kg", "50 g") for text in amounts]
    if limit <= 0.0 or min(wanted) <= limit:
        raise RefusalError("--amount: every amount should be larger than the tolerance, and both above 0", BAD_INPUT)
    return [DoseTarget(amount, limit) for amount in wanted]


def _chosen(
    path: Path, laboratory: Path | None, receiver: str | None, targets: list[DoseTarget]
) -> tuple[CampaignPlan, Scene, Action]:
    """The campaign, its scene, and an action in the middle of the searched ranges.

    Raises:
        RefusalError: the campaign can't be read, it has no bench that pours wanted amounts, or a dose is impossible
            (exit code 2).
    """
    from actors.dosing.simulated_dose import check_dose
    from actors.interfaces import InvalidActionError
    from orchestrator.cli.foreground_run import read_campaign
    from orchestrator.config.campaign_checks import check_vessels
    from orchestrator.runs.stages import named_scenes

    plan = read_campaign(path, laboratory)
    if not plan.laboratory.pours:
        raise RefusalError(f"laboratory {plan.laboratory.name} has no bench: it simulates and plans", BAD_INPUT)
    if plan.laboratory.arm is not None:
        raise RefusalError(
            f"laboratory {plan.laboratory.name} has an arm, and wanted amounts are poured on simulated benches only; "
            "name a laboratory without an arm, for example --laboratory configs/laboratories/twin.yaml",
            BAD_INPUT,
        )
    found = list(named_scenes(plan).values())
    names = [scene.receiver.name for scene, _ in found]
    if receiver is not None and receiver not in names:
        known = ", ".join(dict.fromkeys(names))
        raise RefusalError(f"--receiver {receiver}: the campaign has no such receiver; there are {known}", BAD_INPUT)
    scene, space = found[0 if receiver is None else names.index(receiver)]
    # the receiver has to hold the amount, not the load: see `check_dose`
    if problems := check_vessels(scene, plan.source, wanted=0.0):
        raise RefusalError("\n".join(map(str, problems)), BAD_INPUT)
    for target in targets:
        with Refused(InvalidActionError, at=f"--amount '{1e3 * target.amount:g} g': "):
            check_dose(scene, target)
    return plan, scene, scene.action({axis.name: axis.decode(0.5) for axis in space.axes})


def _predict(scene: Scene, target: DoseTarget, seed: int) -> None:
    from actors.dosing.simulated_dose import forecast

    print(forecast_text(target, forecast(scene, target, seed)))


def forecast_text(target: DoseTarget, predicted: DoseForecast) -> str:
    """A forecast in a few lines.

    Args:
        target: the dose.
        predicted: its forecast.
    """
    low, high = (1e3 * value for value in predicted.interval)
    fine, clean = 1e3 * predicted.fine_flow, 1e3 * predicted.clean_flow
    risk = f"the last stream has {fine:.1f} g/s and leaves the lip cleanly"
    if fine < clean:
        risk = f"the last stream has {fine:.1f} g/s only; a part may run down the outside of the pourer"
    lines = [
        f"{1e3 * target.amount:g} g: {low:.1f} to {high:.1f} g expected (90 %), weighed after "
        f"{predicted.duration:.0f} s, in 95 % of the doses within {predicted.longest:.0f} s",
        f"  source: holds enough with a probability of {100.0 * predicted.enough:.0f} %",
        f"  spill risk: {risk}",
    ]
    for end, count in predicted.ends.items():
        if end != "reached":
            lines.append(f"  {count} of {sum(predicted.ends.values())} predicted doses end otherwise: {end}")
    return "\n".join(lines)


def _pour(
    plan: CampaignPlan, scene: Scene, action: Action, targets: list[DoseTarget], *, in_process: bool, again: str
) -> None:
    """As a small run of its own: journalled and weighed."""
    from orchestrator.cli.campaign_commands import run_directory
    from orchestrator.cli.foreground_run import check_laboratory_answers, run_in_front_of_people
    from orchestrator.cli.pour_command import plan_of_scene
    from orchestrator.journal.codec import result_of
    from orchestrator.run_service import RunRequest, RunResources
    from orchestrator.runs.stages import StageDefinition
    from orchestrator.strategies.dispense import Dispense, Dispensed

    small = dataclasses.replace(
        plan_of_scene(plan, scene, pours=len(targets)),
        name=f"{plan.name}-dose",
        # the recording shows the motions of an arm, and there is none
        outputs=plan.outputs.model_copy(update={"recording": False}),
    )

    def build(results: object, stage_seed: int) -> Dispense:
        return Dispense(scene, action, targets, stage_seed)

    request = RunRequest(small, [StageDefinition(STAGE, build, pours=True)])
    resources = RunResources(in_process=in_process)
    check_laboratory_answers(request, resources)
    directory = run_directory(small, resume=False, run_id=None)
    finished, _ = run_in_front_of_people(
        dataclasses.replace(request, folder=directory),
        resources,
        again=again,
        not_resumed="these doses are not resumed; what was weighed of them",
    )
    result: Dispensed = result_of(finished.results, STAGE, Dispensed)
    for one in result.doses:
        print(dose_text(one))
    print_note(f"run: {directory}")
    if any(one.received_g is None for one in result.doses) or len(result.doses) < len(targets):
        raise RefusalError("not every dose was poured", FAILED)


def dose_text(dose: Dose) -> str:
    """A dose in one line.

    Args:
        dose: completed.
    """
    if dose.received_g is None:
        return f"dose {dose.number}, {dose.wanted_g:g} g: {dose.end}"
    time = "" if dose.duration_s is None else f" after {dose.duration_s:.1f} s"
    error = dose.received_g - dose.wanted_g
    end = "" if dose.end == "reached" else f"; {dose.end}"
    return f"dose {dose.number}, {dose.wanted_g:g} g: {dose.received_g:.1f} g weighed ({error:+.1f} g){time}{end}"
