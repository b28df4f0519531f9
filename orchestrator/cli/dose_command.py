"""The command `decant dose`: pours wanted amounts, or predicts them; `decant run` pours a campaign's own series."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from orchestrator.cli.command_options import Campaign, InProcess, Json, OtherLaboratory, Seed
from orchestrator.cli.console import (
    BAD_INPUT,
    FAILED,
    RefusalError,
    Refused,
    print_json,
    print_message,
    print_note,
    print_warning,
)

if TYPE_CHECKING:
    from actors.dosing.dose_series import DoseForecast
    from actors.interfaces import DoseSource
    from orchestrator.learning.campaign_plan import CampaignPlan, DispensePlan, PlannedDose
    from orchestrator.learning.dispense import Dose, KnownSource
    from sim_engine.scene import Scene


def dose(
    campaign: Campaign,
    amount: Annotated[
        list[str] | None,
        typer.Option(
            help="Wanted in the receiver, for example '50 g'. Repeatable, one dose each. With --dry-run, by default "
            "the campaign's own series.",
            show_default=False,
        ),
    ] = None,
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
    as_json: Json = False,
) -> None:
    """Pour wanted amounts: the tilt is decided from the balance while the liquid flows.

    The source holds the campaign's load at first, and is filled again when it holds too little. The doses are recorded
    in a journal and weighed, as a small run. A whole series belongs to the section 'dispense' of a campaign: 'decant
    run' pours it, 'decant dose --dry-run' predicts it.
    """
    plan = dose_plan(campaign, laboratory, receiver, amount, tolerance, as_left=as_left, dry_run=dry_run)
    plan = dataclasses.replace(plan, seed=plan.seed if seed is None else seed)
    if dry_run:
        _predict(plan, as_json=as_json)
        return
    assert amount is not None
    options = "".join(
        f" {name} '{value}'"
        for name, value in (("--laboratory", laboratory), ("--receiver", receiver))
        if value is not None
    )
    again = f"Another dose: decant dose {campaign}{options} --amount '{amount[0]}'"
    pour_doses(plan, in_process=in_process, as_json=as_json, again=again)


def _planned_doses(amounts: Sequence[str], tolerance: str, receiver: str) -> tuple[PlannedDose, ...]:
    from orchestrator.learning.campaign_plan import PlannedDose
    from sim_engine.settings.quantity import QuantityError, parse_quantity

    with Refused(QuantityError, at="--tolerance: "):
        limit = parse_quantity(tolerance, "kg", "1 g")
    with Refused(QuantityError, at="--amount: "):
        wanted = [parse_quantity(text, "kg", "50 g") for text in amounts]
    if limit <= 0.0 or min(wanted) <= limit:
        raise RefusalError("--amount: every amount should be larger than the tolerance, and both above 0", BAD_INPUT)
    return tuple(PlannedDose(amount, limit, receiver) for amount in wanted)


def dose_plan(
    path: Path,
    laboratory: Path | None,
    receiver: str | None,
    amounts: Sequence[str] | None,
    tolerance: str,
    *,
    as_left: bool,
    dry_run: bool,
) -> CampaignPlan:
    """The campaign with nothing but a series of doses.

    Args:
        path: of the campaign.
        laboratory: another laboratory.
        receiver: name of the receiver; the first unless given.
        amounts, tolerance: with units.
        as_left: the source holds what earlier doses have left.
        dry_run: the campaign's own series is possible.

    Raises:
        RefusalError: the campaign can't be read, it has no bench, or a dose is impossible (exit code 2).
    """
    from orchestrator.campaigns.campaign_checks import check_campaign
    from orchestrator.cli.foreground_run import read_campaign
    from orchestrator.learning.campaign_plan import DispensePlan

    plan = read_campaign(path, laboratory)
    if not plan.laboratory.pours:
        raise RefusalError(f"laboratory {plan.laboratory.name} has no bench: it simulates and plans", BAD_INPUT)
    series = plan.dispense
    if not amounts:
        if series is None or not dry_run:
            hint = f"; 'decant run {path}' pours its own series" if series is not None else ", for example '50 g'"
            raise RefusalError(f"--amount: name the wanted amount{hint}", BAD_INPUT)
        if as_left:
            series = dataclasses.replace(series, as_left=True)
    else:
        found = _scenes(plan)
        names = [scene.receiver.name for scene in found]
        if receiver is not None and receiver not in names:
            known = ", ".join(dict.fromkeys(names))
            text = f"--receiver {receiver}: the campaign has no such receiver; there are {known}"
            raise RefusalError(text, BAD_INPUT)
        scene = found[0 if receiver is None else names.index(receiver)]
        doses = _planned_doses(amounts, tolerance, scene.receiver.name)
        series = DispensePlan((scene,), doses, 0.0, as_left, plan.laboratory.name)
    small = dataclasses.replace(plan, name=f"{plan.name}-dose", calibration=None, deployment=None, dispense=series)
    problems = check_campaign(small, as_written=not amounts, warn=print_warning)
    if problems:
        raise RefusalError("\n".join(map(str, problems)), BAD_INPUT)
    return small


def _scenes(plan: CampaignPlan) -> list[Scene]:
    """Scenes to pour doses in; searched dimensions have the middle of their ranges."""
    from orchestrator.runs.stages import named_scenes

    if plan.dispense is not None:
        return list(plan.dispense.scenes)
    return [
        dataclasses.replace(scene, fixed={**scene.fixed, **{axis.name: axis.decode(0.5) for axis in space.axes}})
        for scene, space in named_scenes(plan).values()
    ]


def _known(plan: DispensePlan) -> dict[str, KnownSource]:
    from orchestrator.materials.vessel_account import VesselAccount

    if not plan.as_left:
        return {}
    try:
        return VesselAccount.open().known(plan)
    except OSError as error:
        raise RefusalError(f"the content of the sources is not known: {error}", FAILED) from None


def _predict(plan: CampaignPlan, *, as_json: bool) -> None:
    """Predict one dose after the other; each leaves the source with its expected content."""
    from actors.interfaces import DoseTarget
    from actors.laboratory import predicted_dose
    from orchestrator.learning.dispense import FILL_DEVIATION, WEIGHED_DEVIATION, Dispense, KnownSource
    from orchestrator.learning.trials import SeedStream

    assert plan.dispense is not None
    series, known = plan.dispense, _known(plan.dispense)
    strategy, seeds = Dispense(series, plan.seed, known), SeedStream(plan.seed, "predict doses")
    count = 20 if len(series.doses) == 1 else 8
    rows: list[dict[str, Any]] = []
    total, filled = 0.0, 0
    for number, planned in enumerate(series.doses, start=1):
        source = strategy.next_source(planned)
        scene = series.scene(source.name, planned.receiver)
        target = DoseTarget(planned.amount, planned.limit, planned.position, source)
        found = predicted_dose(plan.laboratory, scene, target, seeds.next() % 2**32, count)
        left = max(source.mass - found.amount, 0.0)
        deviation = max(source.deviation, FILL_DEVIATION) + WEIGHED_DEVIATION
        strategy.assume(source.name, KnownSource(mass=left, deviation=deviation))
        total, filled = total + found.duration, filled + source.fill
        rows.append(_row(number, planned, source, found, left))
        if not as_json:
            print(forecast_text(planned, source, found))
    if as_json:
        print_json({"doses": rows})
    elif len(rows) > 1:
        times = "once" if filled == 1 else f"{filled} times"
        print(f"{len(rows)} doses: {total:.0f} s of pouring and weighing; sources filled {times}")
    print_message("nothing was poured")


def _row(number: int, planned: PlannedDose, source: DoseSource, found: DoseForecast, left: float) -> dict[str, Any]:
    return {
        "number": number,
        "wanted_g": 1e3 * planned.amount,
        "position": planned.position,
        "source": source.name,
        "filled": source.fill,
        "expected_g": 1e3 * found.amount,
        "interval_g": [1e3 * value for value in found.interval],
        "duration_s": found.duration,
        "longest_s": found.longest,
        "enough": found.enough,
        "fine_flow_g_s": 1e3 * found.fine_flow,
        "clean_flow_g_s": 1e3 * found.clean_flow,
        "left_g": 1e3 * left,
        "reachable_tolerance_g": 1e3 * found.reachable,
        "ends": {str(end): count for end, count in found.ends.items()},
    }


def forecast_text(planned: PlannedDose, source: DoseSource, predicted: DoseForecast) -> str:
    """A forecast in a few lines.

    Args:
        planned: the dose.
        source: of the dose.
        predicted: its forecast.
    """
    low, high = (1e3 * value for value in predicted.interval)
    fine, clean = 1e3 * predicted.fine_flow, 1e3 * predicted.clean_flow
    risk = f"the last stream has {fine:.1f} g/s and leaves the lip cleanly"
    if clean == 0.0:
        risk = f"a pump's stream has {fine:.1f} g/s and runs down no lip"
    elif fine < clean:
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
        if end != "reached":
            lines.append(f"  {count} of {sum(predicted.ends.values())} predicted doses end otherwise: {end}")
    return "\n".join(lines)


def pour_doses(plan: CampaignPlan, *, in_process: bool, as_json: bool, again: str) -> Path:
    """Pour a series of doses as a small run of its own: journalled and weighed.

    Args:
        plan: a campaign with nothing but the series.
        in_process: without Ray.
        as_json: print the doses as JSON.
        again: the next command, for the message after an interruption.

    Returns:
        The folder of the run.

    Raises:
        RefusalError: refused (exit code 2), or not every dose was poured (1).
    """
    from orchestrator.cli.campaign_commands import run_directory
    from orchestrator.cli.foreground_run import (
        check_laboratory_answers,
        check_somebody_is_there,
        run_in_front_of_people,
    )
    from orchestrator.cli.motion_control import confirm
    from orchestrator.learning.dispense import Dispensed
    from orchestrator.records.codec import result_of
    from orchestrator.runs.motion_approval import (
        SafetyRecordError,
        campaign_pours,
        envelope,
        envelope_lines,
        required_checksum,
    )
    from orchestrator.runs.run_service import RunRequest, RunResources
    from orchestrator.runs.stages import DOSES, dispense_stages

    assert plan.dispense is not None
    if plan.laboratory.arm is None:  # the recording shows the motions of an arm, and there is none
        plan = dataclasses.replace(plan, outputs=plan.outputs.model_copy(update={"recording": False}))
    assert plan.dispense is not None
    request = RunRequest(plan, dispense_stages(plan.dispense))
    checksum = ""
    if plan.laboratory.mode == "hardware":
        lines = [f"doses          {len(plan.dispense.doses)}"]
        if plan.laboratory.arm is not None:
            with Refused(SafetyRecordError):
                checksum = required_checksum(plan)
            lines += envelope_lines(envelope(plan.laboratory.arm, campaign_pours(plan, request.stages)))
        confirm(plan.laboratory, lines)
    resources = RunResources(in_process=in_process, approved_checksum=checksum)
    check_somebody_is_there(plan.laboratory)
    check_laboratory_answers(request, resources)
    directory = run_directory(plan, resume=False, run_id=None)
    finished, _ = run_in_front_of_people(
        dataclasses.replace(request, folder=directory),
        resources,
        again=again,
        not_resumed="these doses are not resumed; what was weighed of them",
    )
    result: Dispensed = result_of(finished.results, DOSES, Dispensed)
    if as_json:
        doses = [one.model_dump(mode="json", exclude={"signals"}) for one in result.doses]
        print_json({"run": str(directory), "doses": doses})
    else:
        for one in result.doses:
            print(dose_text(one))
    print_note(f"run: {directory}")
    if any(one.received_g is None for one in result.doses):
        raise RefusalError("not every dose was poured", FAILED)
    return directory


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
    sure = "" if dose.half_interval_g is None else f" ± {dose.half_interval_g:.1f} g"
    return f"dose {dose.number}, {dose.wanted_g:g} g: {dose.received_g:.1f} g{sure} weighed ({error:+.1f} g){time}{end}"
