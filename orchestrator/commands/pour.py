"""`decant pour`: one pour that a person has chosen; planned only, with an empty pourer and slowly, or for real."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from actors.arm.protocol import PathReport, PlannedPour
from orchestrator.commands.arming import accepted, confirm, report_lines, require_flag
from orchestrator.commands.common import check_output, read_campaign
from orchestrator.commands.single import scene_to_simulate, wanted_in
from orchestrator.commands.speaking import BAD_INPUT, FAILED, RefusalError, Refused, mention, print_json, say

if TYPE_CHECKING:
    from orchestrator.plan import CampaignPlan
    from orchestrator.stages import StageDefinition
    from orchestrator.strategies.one_pour import WeighedPour
    from sim_engine.action import Action
    from sim_engine.task import Scene

STAGE = "pour"


@dataclass(frozen=True)
class Chosen:
    """One pour, planned.

    Attributes:
        plan: the campaign that it is taken from.
        path: of the arm; None on a bench of numbers.
    """

    plan: CampaignPlan
    scene: Scene
    action: Action
    path: PlannedPour | None


def pour(
    path: Path,
    *,
    assignments: list[str] | None,
    scene: str | None,
    dry_run: bool,
    connect: bool,
    png: Path | None,
    empty: bool,
    slow: float,
    arm: bool,
    laboratory: Path | None,
    in_process: bool,
    as_json: bool,
) -> None:
    """One pour.

    Args:
        path: campaign.
        assignments: of the action, `name=value`.
        scene: 'calibration', 'transfer' or a receiver's name; the first receiver if not given.
        dry_run: plan and check the whole path, and move nothing.
        connect: with `dry_run`: also read where the arm stands.
        png: picture of the path.
        empty: the whole cycle with an empty pourer, nothing weighed.
        slow: with `empty`, fraction of the planned speed.
        arm: whether `--arm` was given.
        laboratory: file in place of the campaign's.
        in_process: without Ray.
        as_json: print the result as JSON.

    Raises:
        RefusalError: it can't be made (exit code 2), or did not go as it should (1).
    """
    _check_options(dry_run=dry_run, connect=connect, empty=empty, slow=slow)
    check_output(png, "--png", ".png")
    chosen = _chosen(path, laboratory, assignments or [], scene)
    bench = chosen.plan.laboratory
    if chosen.path is None and (dry_run or empty or png is not None):
        raise RefusalError(
            f"laboratory {bench.name} has no arm whose path could be planned; its bench is made of numbers",
            BAD_INPUT,
        )
    if png is not None:
        _draw(chosen, png)
    if dry_run:
        _dry_run(chosen, connect=connect, as_json=as_json)
        return
    verb = f"decant pour {path}" + ("" if laboratory is None else f" --laboratory {laboratory}")
    require_flag(bench, armed=arm, again=f"{verb} … --arm")
    if empty:
        from orchestrator.commands.pour_empty import pour_empty

        assert chosen.path is not None
        pour_empty(chosen.plan, chosen.action, chosen.path.slowed(slow), slow=slow, as_json=as_json)
        return
    _pour(chosen, in_process=in_process, again=f"Another pour: {verb} …", as_json=as_json)


def _check_options(*, dry_run: bool, connect: bool, empty: bool, slow: float) -> None:
    if connect and not dry_run:
        raise RefusalError("--connect: goes with --dry-run; any other pour connects anyway", BAD_INPUT)
    if dry_run and empty:
        raise RefusalError("--dry-run moves nothing, --empty moves the arm: choose one", BAD_INPUT)
    if slow != 1.0 and not empty:
        raise RefusalError(
            "--slow: goes with --empty; a pour with liquid is as fast as its action says: choose a slower action",
            BAD_INPUT,
        )


def _chosen(path: Path, laboratory: Path | None, assignments: list[str], scene_name: str | None) -> Chosen:
    """The pour that is asked for, its path planned and checked.

    Raises:
        RefusalError: it can't be made (exit code 2).
    """
    from actors.protocols import InvalidActionError
    from orchestrator.config.campaign.assignments import assigned_action
    from orchestrator.config.campaign.check import check_vessels

    plan = read_campaign(path, laboratory)
    scene, space = scene_to_simulate(plan, scene_name)
    with Refused(ValueError, at="--set: "):
        action = assigned_action(assignments, fixed=scene.fixed, space=space)
    problems = check_vessels(scene, plan.source, wanted_in(plan, scene, scene_name))
    if problems:
        raise RefusalError("\n".join(map(str, problems)), BAD_INPUT)
    if not plan.laboratory.pours:
        raise RefusalError(f"laboratory {plan.laboratory.name} has no bench: it simulates and plans", BAD_INPUT)
    planned = None
    if plan.laboratory.arm is not None:
        try:
            planned = plan.laboratory.arm.plan(scene, action)
        except (InvalidActionError, ValueError) as error:
            raise RefusalError(f"{action.display()}: {error}", BAD_INPUT) from None
    return Chosen(plan, scene, action, planned)


def report_json(report: PathReport) -> dict[str, Any]:
    """SI units."""
    return dataclasses.asdict(report)


def _draw(chosen: Chosen, png: Path) -> None:
    from actors.arm.joint_path import PourPath
    from actors.arm.spec import UrArmSpec
    from orchestrator.report.arm_path import path_png
    from sim_engine.vessel.build import build_vessel

    arm = chosen.plan.laboratory.arm
    if not isinstance(chosen.path, PourPath) or not isinstance(arm, UrArmSpec):
        raise RefusalError("--png: draws the joints of an arm, and this arm's path has none", BAD_INPUT)
    pourer, receiver = build_vessel(chosen.scene.pourer), build_vessel(chosen.scene.receiver)
    drawn = path_png(
        png,
        chosen.path,
        arm,
        pourer,
        receiver,
        title=f"{chosen.scene.pourer.name} into {chosen.scene.receiver.name}, laboratory {chosen.plan.laboratory.name}",
        note=chosen.action.display(),
    )
    mention(f"picture: {drawn}")


def _dry_run(chosen: Chosen, *, connect: bool, as_json: bool) -> None:
    planned, laboratory = chosen.path, chosen.plan.laboratory
    assert planned is not None
    assert laboratory.arm is not None
    mention(f"{chosen.scene.name}: {chosen.action.display()}; laboratory {laboratory.name}, {laboratory.mode}")
    home = _stands_at_home(chosen) if connect else None
    if as_json:
        print_json(
            {
                "mode": laboratory.mode,
                "action": chosen.action.values(),
                "report": report_json(planned.report),
                "phases": [{"name": n, "start": a, "end": b} for n, a, b in planned.phases],
                "at_home": home,
            }
        )
    else:
        for line in [*report_lines(planned.report), *_way_lines(planned)]:
            print(line)
    say("nothing was moved")


def _way_lines(planned: PlannedPour) -> list[str]:
    tilts = "  ".join(f"{name} {end - start:.2f} s" for name, start, end in planned.phases)
    return [
        f"approach       {planned.approach_time:.1f} s",
        f"pour           {planned.pour_time:.1f} s: {tilts}",
        f"retreat        {planned.retreat_time:.1f} s",
    ]


def _stands_at_home(chosen: Chosen) -> bool:
    """Read where the arm stands.

    Raises:
        RefusalError: it can't be read.
    """
    from actors.protocols import LaboratoryError
    from orchestrator.commands.hands_on import reached

    with Refused(LaboratoryError, code=FAILED), reached(chosen.plan.laboratory) as ready:
        assert ready.arm is not None
        check = ready.arm.look().at_home()
    say(f"the arm stands {check.found}" + (f" → {check.advice}" if check.advice else ""))
    return check.state == "ok"


def _pour(chosen: Chosen, *, in_process: bool, again: str, as_json: bool) -> None:
    """As a small run of its own: journalled, with the operator's questions, weighed."""
    from orchestrator.commands.campaigns import run_directory
    from orchestrator.commands.common import check_laboratory_answers, run_in_front_of_people
    from orchestrator.commands.people import check_somebody_is_there
    from orchestrator.results import learnt_by
    from orchestrator.stages import StageDefinition
    from orchestrator.strategies.one_pour import OnePour, OnePoured

    plan = dataclasses.replace(
        _only(chosen),
        name=f"{chosen.plan.name}-pour",
        outputs=dataclasses.replace(chosen.plan.outputs, figures=False),
    )
    build: Callable[..., OnePour] = lambda results, seed: OnePour(chosen.scene, chosen.action, seed)  # noqa: E731
    stages: list[StageDefinition] = [StageDefinition(STAGE, build, pours=True)]
    checksum = None
    if plan.laboratory.mode == "hardware":
        assert chosen.path is not None
        checksum = accepted(chosen.plan)
        confirm(plan.laboratory, ["pours          1", *report_lines(chosen.path.report)])
    check_somebody_is_there(plan.laboratory)
    check_laboratory_answers(plan, stages, in_process=in_process)
    directory = run_directory(plan, resume=False, run_id=None)
    finished = run_in_front_of_people(
        plan,
        directory,
        resume=False,
        stages=stages,
        in_process=in_process,
        again=again,
        not_resumed="this pour is not resumed; what was weighed of it",
        checksum=checksum,
    )
    result = learnt_by(finished.result.results, STAGE, OnePoured)
    if result.weighed is None:
        raise RefusalError(result.failed or "nothing was poured", FAILED)
    if as_json:
        about = {"run": str(directory), "mode": plan.laboratory.mode, "action": chosen.action.values()}
        print_json({**about, **result.weighed.model_dump()})
    else:
        print(told(result.weighed))


def _only(chosen: Chosen) -> CampaignPlan:
    """The campaign without everything that this pour isn't of."""
    plan = chosen.plan
    if plan.deployment is not None and chosen.scene in plan.deployment.scenes:
        deployment = dataclasses.replace(plan.deployment.with_settings(pours=1), scenes=(chosen.scene,))
        return dataclasses.replace(plan, calibration=None, deployment=deployment)
    return dataclasses.replace(plan, deployment=None)


def told(weighed: WeighedPour) -> str:
    """What was weighed, in a line."""
    spillage = weighed.spillage
    r = (
        "too little was poured to speak of spillage"
        if spillage is None
        else f"spillage {100 * spillage:.2f} % of poured"
    )
    parts = {"loaded": weighed.loaded, "spilled": weighed.spilled, "retained": weighed.retained}
    masses = ", ".join(f"{name} {1e3 * mass:.1f} g" for name, mass in parts.items())
    return f"{masses}, delivered {weighed.delivered_g:.1f} g ({weighed.delivered_ml:.1f} mL); {r}"
