"""The command `decant pour`: one chosen pour, which is planned only, tried with an empty pourer, or weighed."""

from __future__ import annotations

import dataclasses
import json
import math
import sys
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from orchestrator.cli.command_options import (
    Assignments,
    Campaign,
    EnableMotion,
    InProcess,
    OtherLaboratory,
    SceneName,
)
from orchestrator.cli.console import (
    RefusalError,
    check_output,
    print_message,
    print_note,
)

if TYPE_CHECKING:
    from actors.arm.arm_interface import Executed, PlannedPour
    from orchestrator.learning.campaign_plan import CampaignPlan
    from orchestrator.learning.single_action import DeliveredMasses
    from sim_engine.action import Action
    from sim_engine.scene import Scene

RECORD = "pour.json"


def pour(
    campaign: Campaign,
    assignments: Assignments = None,
    scene: SceneName = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Plan, check and show the whole path of the arm; move nothing.")
    ] = False,
    connect: Annotated[
        bool, typer.Option("--connect", help="With --dry-run: also check whether the arm is at home.")
    ] = False,
    png: Annotated[Path | None, typer.Option(help="Draw the arm's path from the side and from above.")] = None,
    empty: Annotated[
        bool, typer.Option("--empty", help="Run the whole cycle with an empty pourer, without weighing.")
    ] = False,
    slow: Annotated[float, typer.Option(min=0.05, max=1.0, help="With --empty: fraction of the planned speed.")] = 1.0,
    laboratory: OtherLaboratory = None,
    in_process: InProcess = False,
    enable_motion: EnableMotion = False,
) -> None:
    """Pour once with a given action on the campaign's bench, only plan the pour, or try it with an empty pourer.

    A pour with liquid is recorded in a journal and weighed, as a small run; `--empty` writes a record, pour.json.
    """
    from orchestrator.cli.motion_control import require_flag

    _check_options(dry_run=dry_run, connect=connect, empty=empty, slow=slow)
    check_output(png, "--png", ".png")
    chosen = _chosen(campaign, laboratory, assignments or [], scene)
    bench = chosen.plan.laboratory
    if chosen.path is None and (dry_run or empty or png is not None):
        raise RefusalError(
            f"laboratory {bench.name} has no arm whose path could be planned; its bench is made of numbers"
        )
    if png is not None:
        _draw(chosen, png)
    if dry_run:
        _dry_run(chosen, connect=connect)
        return
    again = f"decant pour {campaign}" + ("" if laboratory is None else f" --laboratory {laboratory}")
    require_flag(bench, enabled=enable_motion, again=f"{again} … --enable-motion")
    if empty:
        assert chosen.path is not None
        pour_empty(chosen, chosen.path.slowed(slow), slow=slow)
        return
    pour_weighed(chosen, in_process=in_process, again=f"Another pour: {again} …")


@dataclass(frozen=True)
class Chosen:
    """One pour, planned.

    Attributes:
        plan: the campaign that it is taken from.
        path: of the arm; None on a simulated bench.
    """

    plan: CampaignPlan
    scene: Scene
    action: Action
    path: PlannedPour | None


def _check_options(*, dry_run: bool, connect: bool, empty: bool, slow: float) -> None:
    if connect and not dry_run:
        raise RefusalError("--connect: goes with --dry-run; any other pour connects anyway")
    if dry_run and empty:
        raise RefusalError("--dry-run moves nothing, --empty moves the arm: choose one")
    if slow != 1.0 and not empty:
        raise RefusalError(
            "--slow: goes with --empty; a pour with liquid is as fast as its action says: choose a slower action"
        )


def _chosen(path: Path, laboratory: Path | None, assignments: list[str], scene_name: str | None) -> Chosen:
    """`chosen_pour` of a campaign's file."""
    from orchestrator.cli.foreground_run import read_campaign

    return chosen_pour(read_campaign(path, laboratory), assignments, scene_name)


def chosen_pour(plan: CampaignPlan, assignments: list[str], scene_name: str | None = None) -> Chosen:
    """The pour that is asked for, its path planned and checked.

    Args:
        plan: of the campaign.
        assignments: `name=value` texts.
        scene_name: see `scene_to_simulate`.

    Raises:
        RefusalError: it can't be made (exit code 2).
    """
    from actors.interfaces import InvalidActionError
    from actors.places import all_places
    from orchestrator.campaigns.campaign_checks import check_action
    from orchestrator.cli.simulate_command import scene_and_action

    scene, action = scene_and_action(plan, assignments, scene_name)
    if not plan.laboratory.pours:
        raise RefusalError(f"laboratory {plan.laboratory.name} has no bench: it simulates and plans")
    try:
        planned = check_action(scene, action, plan.laboratory.expected_arm, all_places(plan.laboratory.places))
    except InvalidActionError as error:
        raise RefusalError(f"{action.display()}: {error}") from None
    return Chosen(plan, scene, action, planned)


def _draw(chosen: Chosen, png: Path) -> None:
    from actors.arm.arm_settings import arm_kind
    from actors.arm.planned_pour import PourPath
    from orchestrator.reports import figure_style
    from orchestrator.reports.pour_figures import draw_path
    from sim_engine.vessel.vessel import build_vessel

    arm = chosen.plan.laboratory.expected_arm
    kind = None if arm is None else arm_kind(arm)
    shown = None if kind is None else kind.figure()
    if kind is None or shown is None or not isinstance(chosen.path, PourPath):
        raise RefusalError("--png: draws the joints of an arm, and this arm's path has none")
    pourer, receiver = build_vessel(chosen.scene.pourer), build_vessel(chosen.scene.receiver)
    figure = draw_path(
        chosen.path,
        shown,
        kind.workspace(),
        pourer,
        receiver,
        title=f"{chosen.scene.pourer.name} into {chosen.scene.receiver.name}, laboratory {chosen.plan.laboratory.name}",
        note=chosen.action.display(),
    )
    print_note(f"picture: {figure_style.save(figure, png)}")


def _dry_run(chosen: Chosen, *, connect: bool) -> None:
    from orchestrator.runs.motion_approval import report_lines

    planned, laboratory = chosen.path, chosen.plan.laboratory
    assert planned is not None
    assert laboratory.arm is not None
    print_note(f"{chosen.scene.name}: {chosen.action.display()}; laboratory {laboratory.name}, {laboratory.mode}")
    if connect:
        _tell_whether_at_home(chosen)
    for line in [*report_lines(planned.report), *_way_lines(planned)]:
        print(line)
    print_message("nothing was moved")


def _way_lines(planned: PlannedPour) -> list[str]:
    tilts = "  ".join(f"{name} {end - start:.2f} s" for name, start, end in planned.phases)
    return [
        f"approach       {planned.approach_time:.1f} s",
        f"pour           {planned.pour_time:.1f} s: {tilts}",
        f"retreat        {planned.retreat_time:.1f} s",
    ]


def _tell_whether_at_home(chosen: Chosen) -> None:
    """Read where the arm stands.

    Raises:
        RefusalError: it can't be read.
    """
    from actors.arm.arm_settings import arm_kind
    from actors.laboratory import reached

    with reached(chosen.plan.laboratory) as ready:
        assert ready.arm is not None
        check = arm_kind(ready.arm).diagnostics().at_home()
    print_message(f"the arm stands {check.found}" + (f" → {check.advice}" if check.advice else ""))


def pour_weighed(chosen: Chosen, *, in_process: bool, again: str) -> Path:
    """Pour as a small run of its own: journalled, with the operator's questions, weighed.

    Args:
        chosen: campaign, scene and action.
        in_process: without Ray.
        again: the next command, for the message after an interruption.

    Returns:
        The folder of the run.

    Raises:
        RefusalError: refused (exit code 2).
        SystemExit: nothing was weighed (exit code 4).
    """
    from orchestrator.cli.foreground_run import conclude, resources_with_operator, run_at_terminal
    from orchestrator.learning.single_action import SingleResult
    from orchestrator.records.codec import result_of
    from orchestrator.runs.run_tasks import pour_task
    from orchestrator.runs.stages import POUR

    request = pour_task(chosen.plan, chosen.scene, chosen.action)
    motion = "pours          1", None if chosen.path is None else chosen.path.report
    finished, published = run_at_terminal(
        request,
        resources_with_operator(request, in_process=in_process, motion=motion),
        again=lambda folder: again,
        not_resumed="this pour is not resumed; what was weighed of it",
    )
    result = result_of(finished.results, POUR, SingleResult)
    if result.weighed is not None:
        print(told(result.weighed))
    conclude(published.summary.verdict)
    return finished.directory


def told(weighed: DeliveredMasses) -> str:
    """What was weighed, in a line."""
    spillage = "too little was poured to speak of spillage"
    if weighed.spillage is not None:
        spillage = f"spillage {100 * weighed.spillage:.2f} % of poured"
    parts = ("loaded", "spilled", "retained", "delivered")
    masses = ", ".join(f"{name} {getattr(weighed, f'{name}_g'):.1f} g" for name in parts)
    return f"{masses} ({weighed.delivered_ml:.1f} mL); {spillage}"


def pour_empty(chosen: Chosen, path: PlannedPour, *, slow: float) -> None:
    """Approach, tilt, return, retreat.

    Args:
        chosen: campaign, scene and action.
        path: slowed already; planned again if the arm reports a geometry of its own.
        slow: by what.

    Raises:
        RefusalError: refused (exit code 2), or stopped on the way (1).
    """
    from actors.arm.arm_settings import arm_kind
    from actors.laboratory import reached
    from orchestrator.cli.motion_control import EmptyCycle, confirm, connected
    from orchestrator.runs.motion_approval import report_lines, required_checksum
    from orchestrator.runs.run_folder import create_run

    plan, action, laboratory = chosen.plan, chosen.action, chosen.plan.laboratory
    assert laboratory.arm is not None
    hardware = laboratory.mode == "hardware"
    if hardware and not sys.stdin.isatty():
        raise RefusalError("--empty asks a person before the arm moves: run it in a terminal")
    checksum = required_checksum(plan) if hardware else None
    lines = [f"one cycle      with an EMPTY pourer, at {100 * slow:g} % of its speed", *report_lines(path.report)]
    if hardware:
        confirm(laboratory, lines)
    else:
        print_message(f"laboratory {laboratory.name}, virtual: no hardware moves\n" + "\n".join(lines))
    try:
        directory = create_run(dataclasses.replace(plan, name=f"{plan.name}-empty"))
        with reached(laboratory) as ready:
            assert ready.arm is not None
            # this command announces each movement itself, by counting down before it lets the arm move
            driver = ready.with_values(arm=ready.arm.with_values(warning_time=0.0))
            with connected(driver, checksum) as (arm, facts):
                fitted = ready.arm.fitted_to(facts)  # the path shown is that of the expected lengths
                path = arm_kind(fitted).plan(chosen.scene, action).slowed(slow)
                cycle = EmptyCycle(arm, path, ready.arm.on_clock(laboratory.arm.warning_time), ask=hardware)
                executed = cycle.run()
    except OSError as error:
        raise RefusalError(f"{plan.outputs.folder}: can't be written: {error.strerror}") from None
    record = {
        "mode": laboratory.mode,
        "laboratory": laboratory.name,
        "date": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        "robot": {name: getattr(facts, name) for name in ("model", "serial", "version", "checksum", "calibration")},
        "action": action.values(),
        "slow": slow,
        "planned": dataclasses.asdict(path.report),
        "tracking": dict(executed.tracking),
        "executed_s": float(executed.times[-1]),
    }
    (directory / RECORD).write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
    print(_told(executed))
    print_message(f"record: {directory / RECORD}")


def _told(executed: Executed) -> str:
    tracking = executed.tracking
    parts = [f"the cycle was completed; the pour took {executed.times[-1]:.1f} s"]
    if "rms_angle" in tracking:
        parts.append(
            f"joints followed within {math.degrees(tracking['rms_angle']):.2f} deg rms, "
            f"{math.degrees(tracking['max_angle']):.2f} deg at most"
        )
    return "; ".join(parts)
