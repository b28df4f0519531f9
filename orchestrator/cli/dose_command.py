"""The command `decant dose`: pours wanted amounts, or predicts them; `decant run` pours a campaign's own series."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from orchestrator.cli.command_options import Campaign, InProcess, OtherLaboratory, Seed
from orchestrator.cli.console import FAILED, RefusalError, Refused, print_message, print_note

if TYPE_CHECKING:
    from actors.dosing.dose_series import DoseForecast
    from actors.interfaces import DoseSource
    from orchestrator.learning.campaign_plan import CampaignPlan, DispensePlan, PlannedDose
    from orchestrator.learning.dispense import Dose, KnownSource
    from orchestrator.runs.run_service import RunRequest


def dose(
    campaign: Campaign,
    amount: Annotated[
        list[str] | None,
        typer.Option(
            help="Wanted in the receiver, for example '50 g'. Repeatable, one dose each. With --dry-run, by default "
            "the campaign's own series."
        ),
    ] = None,
    tolerance: Annotated[
        str,
        typer.Option(help="Excess to avoid: the cup turns back as soon as more has an estimated probability of 1 %."),
    ] = "1 g",
    receiver: Annotated[
        str | None, typer.Option(metavar="NAME", help="Name of one of the campaign's receivers; default: the first.")
    ] = None,
    as_left: Annotated[
        bool,
        typer.Option("--as-left", help="Begin with what earlier doses have left in the source, not with a full one."),
    ] = False,
    dry_run: Annotated[
        bool,
        typer.Option("--dry-run", help="Predict amount, time, spill risk and content of the source; pour nothing."),
    ] = False,
    seed: Seed = None,
    laboratory: OtherLaboratory = None,
    in_process: InProcess = False,
) -> None:
    """Pour wanted amounts: the tilt is decided from the balance while the liquid flows.

    The source holds the campaign's load at first, and is filled again when it holds too little. The doses are recorded
    in a journal and weighed, as a small run. A whole series belongs to the section 'dispense' of a campaign: 'decant
    run' pours it, 'decant dose --dry-run' predicts it.
    """
    from orchestrator.cli.foreground_run import check_campaign_can_run

    request = _dose_request(campaign, laboratory, receiver, amount, tolerance, as_left=as_left, dry_run=dry_run)
    plan = request.campaign
    check_campaign_can_run(request)
    request = dataclasses.replace(request, campaign=dataclasses.replace(plan, seed=plan.seed if seed is None else seed))
    if dry_run:
        _predict(request.campaign)
        return
    assert amount is not None
    options = "".join(
        f" {name} '{value}'"
        for name, value in (("--laboratory", laboratory), ("--receiver", receiver))
        if value is not None
    )
    again = f"Another dose: decant dose {campaign}{options} --amount '{amount[0]}'"
    pour_doses(request, in_process=in_process, again=again)


def _dose_request(
    path: Path,
    laboratory: Path | None,
    receiver: str | None,
    amounts: Sequence[str] | None,
    tolerance: str,
    *,
    as_left: bool,
    dry_run: bool,
) -> RunRequest:
    """The series of doses of the command's options.

    Raises:
        RefusalError: the campaign can't be read, it has no bench, or a dose is impossible (exit code 2).
    """
    from orchestrator.cli.foreground_run import read_campaign
    from orchestrator.runs.run_tasks import dose_scenes, dose_task
    from sim_engine.settings.quantity import QuantityError, typed_quantity

    plan = read_campaign(path, laboratory)
    if not plan.laboratory.pours:
        raise RefusalError(f"laboratory {plan.laboratory.name} has no bench: it simulates and plans")
    if not amounts:
        if plan.dispense is None or not dry_run:
            hint = ", for example '50 g'" if plan.dispense is None else f"; 'decant run {path}' pours its own series"
            raise RefusalError(f"--amount: name the wanted amount{hint}")
        return dose_task(plan, as_left=as_left)
    if plan.laboratory.vessels:
        text = (
            "single doses have one source; the cups and sources of these mixtures have places: 'decant run' pours them"
        )
        raise RefusalError(f"--amount: {text}")
    scenes = {scene.receiver.name: scene for scene in reversed(dose_scenes(plan))}
    if receiver is not None and receiver not in scenes:
        names = ", ".join(reversed(scenes))
        raise RefusalError(f"--receiver {receiver}: the campaign has no such receiver; there are {names}")
    with Refused(QuantityError, at="--tolerance: "):
        limit = typed_quantity(tolerance, "kg", "1 g")
    with Refused(QuantityError, at="--amount: "):
        wanted = [typed_quantity(text, "kg", "50 g") for text in amounts]
    if limit <= 0.0 or min(wanted) <= limit:
        raise RefusalError("--amount: every amount should be larger than the tolerance, and both above 0")
    return dose_task(plan, wanted, limit, None if receiver is None else scenes[receiver], as_left=as_left)


def _known(plan: DispensePlan) -> dict[str, KnownSource]:
    from orchestrator.materials.vessel_account import VesselAccount

    if not plan.as_left:
        return {}
    try:
        return VesselAccount.open().known(plan)
    except OSError as error:
        raise RefusalError(f"the content of the sources is not known: {error}", FAILED) from None


def _predict(plan: CampaignPlan) -> None:
    """Predict one dose after the other; each leaves the source with its expected content."""
    from actors.interfaces import DoseTarget
    from actors.laboratory import predicted_dose
    from orchestrator.learning.dispense import FILL_DEVIATION, WEIGHED_DEVIATION, KnownSource
    from orchestrator.learning.mixtures import dose_strategy
    from orchestrator.learning.trials import SeedStream

    assert plan.dispense is not None
    series, contents = plan.dispense, _known(plan.dispense)
    strategy, seeds = dose_strategy(series, plan.seed, contents), SeedStream(plan.seed, "predict doses")
    count = 20 if len(series.doses) == 1 else 8
    total, filled = 0.0, 0
    for planned in series.doses:
        source = strategy.next_source(planned)
        scene = series.scene(source.name, planned.receiver)
        target = DoseTarget(planned.amount, planned.limit, planned.position, source)
        forecast = predicted_dose(plan.laboratory, scene, target, seeds.next() % 2**32, count)
        left = max(source.mass - forecast.amount, 0.0)
        deviation = max(source.deviation, FILL_DEVIATION) + WEIGHED_DEVIATION
        strategy.assume(source.name, KnownSource(mass=left, deviation=deviation))
        total, filled = total + forecast.duration, filled + source.fill
        print(forecast_text(planned, source, forecast))
    show_flows(plan)
    if len(series.doses) > 1:
        times = "once" if filled == 1 else f"{filled} times"
        print(f"{len(series.doses)} doses: {total:.0f} s of pouring and weighing; sources filled {times}")
    print_message("nothing was poured")


def show_flows(plan: CampaignPlan) -> None:
    """Print and draw the flow of each source of a campaign's doses that is no straight cup, simulated once.

    Args:
        plan: of a campaign that was checked.

    Raises:
        RefusalError: a picture can't be written (exit code 1).
    """
    from orchestrator.campaigns.dose_flows import dose_flows
    from orchestrator.reports import figure_style
    from orchestrator.reports.run_figures import draw_flow

    for flow in dose_flows(plan):
        if flow.comparison is None:
            continue  # which the checks have reported
        name = figure_style.safe_name(
            f"{plan.name}-{flow.scene.pourer.name}-{flow.scene.liquid.name}-into-{flow.scene.receiver.name}"
        )
        with Refused(OSError, code=FAILED):
            picture = figure_style.save(draw_flow(flow), plan.outputs.folder / f"{name}-flow.png")
        print_note(f"{flow.text()}; picture: {picture}")


def forecast_text(planned: PlannedDose, source: DoseSource, predicted: DoseForecast) -> str:
    """A forecast in a few lines.

    Args:
        planned: the dose.
        source: of the dose.
        predicted: its forecast.
    """
    from actors.interfaces import DoseEnd

    low, high = (1e3 * value for value in predicted.interval)
    fine, clean = 1e3 * predicted.fine_flow, 1e3 * predicted.clean_flow
    risk = f"the last stream has {fine:.1f} g/s and leaves the lip cleanly"
    if fine < clean:
        risk = f"the last stream has {fine:.1f} g/s only; a part may run down the outside of the pourer"
    place = f" into {planned.position}" if planned.position else ""
    filled = "filled before; " if source.fill else ""
    lines = [
        f"{1e3 * planned.amount:g} g{place}: {low:.1f} to {high:.1f} g expected (90 %), weighed after "
        f"{predicted.duration:.0f} s, in 95 % of the doses within {predicted.longest:.0f} s",
        f"  source {source.name}: {filled}{1e3 * source.mass:.0f} g, holds enough with a probability of "
        f"{100.0 * predicted.enough:.0f} %",
        f"  spill risk: {risk}",
    ]
    if predicted.reachable > planned.limit:
        lines.append(
            f"  balance: nine of ten doses are within {1e3 * predicted.reachable:.2g} g as weighed with this balance; "
            f"the tolerance of {1e3 * planned.limit:.2g} g is smaller"
        )
    for end, count in predicted.ends.items():
        if end != DoseEnd.REACHED:
            lines.append(f"  {count} of {sum(predicted.ends.values())} predicted doses end otherwise: {end}")
    return "\n".join(lines)


def pour_doses(request: RunRequest, *, in_process: bool, again: str) -> Path:
    """Pour a series of doses as a small run of its own: journalled and weighed.

    Args:
        request: of `dose_task`.
        in_process: without Ray.
        again: the next command, for the message after an interruption.

    Returns:
        The folder of the run.

    Raises:
        RefusalError: refused (exit code 2).
        SystemExit: not every dose reached its amount (exit code 4).
    """
    from orchestrator.cli.foreground_run import conclude, resources_with_operator, run_at_terminal
    from orchestrator.learning.dispense import Dispensed
    from orchestrator.records.codec import result_of
    from orchestrator.runs.stages import DOSES

    assert request.campaign.dispense is not None
    motion = f"doses          {len(request.campaign.dispense.doses)}", None
    finished, published = run_at_terminal(
        request,
        resources_with_operator(request, in_process=in_process, motion=motion),
        again=lambda folder: again,
        not_resumed="these doses are not resumed; what was weighed of them",
    )
    directory = finished.directory
    result: Dispensed = result_of(finished.results, DOSES, Dispensed)
    for dose in result.doses:
        print(dose_text(dose))
    print_note(f"run: {directory}")
    conclude(published.summary.verdict)
    return directory


def dose_text(dose: Dose) -> str:
    """A dose in one line.

    Args:
        dose: completed.
    """
    from actors.interfaces import DoseEnd

    if dose.received_g is None:
        return f"dose {dose.number}, {dose.wanted_g:g} g: {dose.end}"
    time = "" if dose.duration_s is None else f" after {dose.duration_s:.1f} s"
    error = dose.received_g - dose.wanted_g
    end = f"; {dose.outcome_text}" if dose.outcome == "missed" or dose.by_hand else ""
    end += "" if dose.end in (DoseEnd.MISSED, DoseEnd.REACHED) else f"; {dose.end_text}"
    sure = "" if dose.half_interval_g is None else f" ± {dose.half_interval_g:.1f} g"
    return f"dose {dose.number}, {dose.wanted_g:g} g: {dose.received_g:.1f} g{sure} weighed ({error:+.1f} g){time}{end}"
