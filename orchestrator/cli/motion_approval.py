"""Approval of motion on hardware: the operator at the terminal reads what will move and types the laboratory's name.

`arm_campaign` does this for a campaign, `confirm` for other commands. `Envelope` summarises the planned paths of
representative actions. Without approval, no command moves hardware; virtual laboratories need none.
"""

from __future__ import annotations

import math
import sys
import termios
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from actors.arm.arm_geometry import JOINT_NAMES
from actors.arm.arm_interface import PathReport
from actors.arm.arm_settings import ArmSpec
from actors.interfaces import InvalidActionError
from actors.optimizer.questions import Linear
from orchestrator.cli.console import BAD_INPUT, RefusalError, Refused, mention, say
from orchestrator.config.yaml.yaml_errors import shown_path
from orchestrator.runs.safety_approval import SafetyRecordError, accepted_checksum
from orchestrator.strategies.calibration.action_prior import actions_all_over
from sim_engine.action import Action
from sim_engine.scene import Scene
from sim_engine.search_space import Space

if TYPE_CHECKING:
    from actors.laboratory_settings import LaboratorySpec
    from orchestrator.runs.stages import StageDefinition
    from orchestrator.strategies.campaign_plan import CampaignPlan

CORNERS, INTERIOR = 32, 12
"""Number of corner and interior actions of each space whose paths are planned, in addition to the middle."""


@dataclass(frozen=True)
class Envelope:
    """Extremes of the paths of several actions.

    Attributes:
        reports: reports of the executable paths.
        refused: reasons of the others, one text each.
    """

    reports: tuple[PathReport, ...]
    refused: tuple[str, ...] = ()

    @property
    def worst(self) -> PathReport:
        """The extremes of all paths in one report.

        Raises:
            ValueError: no path can be executed.
        """
        if not self.reports:
            raise ValueError("no path can be executed")
        fastest = max(self.reports, key=lambda r: r.joint_speed)
        low = np.min([r.low for r in self.reports], axis=0)
        high = np.max([r.high for r in self.reports], axis=0)
        return PathReport(
            joint_speed=fastest.joint_speed,
            fastest_joint=fastest.fastest_joint,
            tool_speed=max(r.tool_speed for r in self.reports),
            tilt=max(r.tilt for r in self.reports),
            tilt_speed=max(r.tilt_speed for r in self.reports),
            singularity=min(r.singularity for r in self.reports),
            clearance=min(r.clearance for r in self.reports),
            low=(float(low[0]), float(low[1]), float(low[2])),
            high=(float(high[0]), float(high[1]), float(high[2])),
            duration=max(r.duration for r in self.reports),
            deviation=max(r.deviation for r in self.reports),
        )


def envelope(arm: ArmSpec, pours: Iterable[tuple[Scene, Action]]) -> Envelope:
    """Plan the paths of actions and collect their reports."""
    reports, refused = [], []
    for scene, action in pours:
        try:
            reports.append(arm.plan(scene, action).report)
        except (InvalidActionError, ValueError) as error:
            refused.append(f"{action.display()}: {error}")
    return Envelope(tuple(reports), tuple(refused))


def campaign_pours(plan: CampaignPlan, stages: Sequence[StageDefinition]) -> list[tuple[Scene, Action]]:
    """Return representative actions of the spaces that the stages search: middle, corners and interior."""
    calibrating, deploying = _pouring(stages)
    cases: list[tuple[Scene, Action]] = []
    if plan.calibration is not None and calibrating:
        for scene in plan.calibration.poured:
            cases += _from_all_over(scene, plan.calibration.actions, plan.calibration.constraints)
    if plan.deployment is not None and deploying:
        for scene in plan.deployment.scenes:
            cases += _from_all_over(scene, plan.deployment.actions, plan.deployment.constraints)
    return cases


def _from_all_over(scene: Scene, actions: Space, constraints: Sequence[Linear]) -> list[tuple[Scene, Action]]:
    found = []
    for values in actions_all_over(actions, constraints, corners=CORNERS, drawn=INTERIOR):
        try:
            found.append((scene, scene.action(values)))
        except ValueError:
            continue  # the values do not form a valid action
    return found


def pour_count(plan: CampaignPlan, stages: Sequence[StageDefinition]) -> int:
    """Return the largest number of pours that the stages may request."""
    from orchestrator.runs.stages import CONFIRMATION

    calibrating, deploying = _pouring(stages)
    count = plan.calibration.pour_count if plan.calibration is not None and calibrating else 0
    if plan.deployment is None:
        return count
    confirming = sum(stage.name.startswith(CONFIRMATION) for stage in stages)
    return count + plan.deployment.pours * deploying + plan.deployment.confirm * confirming


def _pouring(stages: Sequence[StageDefinition]) -> tuple[bool, int]:
    """Return whether the stages include calibration pours, and the number of deployments that pour."""
    from orchestrator.runs.stages import CONFIRMATION, DEPLOYMENT

    names = [stage.name for stage in stages if stage.pours and not stage.name.startswith(CONFIRMATION)]
    deploying = sum(name.startswith(DEPLOYMENT) for name in names)
    return deploying < len(names), deploying


def arm_campaign(plan: CampaignPlan, stages: Sequence[StageDefinition], *, armed: bool, verb: str) -> str | None:
    """Check the approval of motion before a campaign: hardware needs the flag, a safety record, and a typed name.

    Args:
        plan: campaign with its laboratory.
        stages: stages to run.
        armed: whether `--arm` was given.
        verb: name of the command, for messages.

    Returns:
        The checksum of the accepted safety settings; None without hardware.

    Raises:
        RefusalError: motion is not enabled (exit code 2).
    """
    laboratory = plan.laboratory
    if not any(stage.pours for stage in stages):
        return None
    if laboratory.mode != "hardware":
        if armed:
            mention(
                f"note: --arm has nothing to arm: laboratory {laboratory.name} is {laboratory.mode}, and moves nothing"
            )
        return None
    require_flag(laboratory, armed=armed, again=f"decant {verb} {plan.source.name} --arm")
    assert laboratory.arm is not None
    checksum = accepted(plan)
    mention(f"planning paths from all over the actions of {plan.name} …")
    found = envelope(laboratory.arm, campaign_pours(plan, stages))
    if not found.reports:
        raise RefusalError(
            f"none of {len(found.refused)} actions could be poured by this arm; the first: {found.refused[0]}",
            BAD_INPUT,
        )
    confirm(laboratory, [f"pours          up to {pour_count(plan, stages)}", *envelope_lines(found)])
    return checksum


def require_flag(laboratory: LaboratorySpec, *, armed: bool, again: str) -> None:
    """Refuse to move hardware without `--arm`.

    Raises:
        RefusalError: exit code 2.
    """
    if laboratory.mode == "hardware" and not armed:
        raise RefusalError(
            f"laboratory {laboratory.name} is hardware: an arm would move. Try it without moving first "
            f"('decant doctor', 'decant pour --dry-run'); then arm this one run: {again}",
            BAD_INPUT,
        )


def accepted(plan: CampaignPlan) -> str:
    """Return the checksum of the accepted safety settings of the laboratory's hardware.

    Raises:
        RefusalError: no settings have been accepted (exit code 2).
    """
    with Refused(SafetyRecordError):
        checksum = accepted_checksum(plan.laboratory_source or plan.source)
    if checksum is None:
        raise RefusalError(
            f"laboratory {plan.laboratory.name}: nobody has accepted the controller's safety settings. Run "
            f"'decant doctor {shown_path(plan.laboratory_source or plan.source)}' first; it says how",
            BAD_INPUT,
        )
    return checksum


def envelope_lines(found: Envelope) -> list[str]:
    """Describe the extremes of the paths for the operator."""
    lines = report_lines(found.worst)
    total = len(found.reports) + len(found.refused)
    lines.append(
        f"planned        {len(found.reports)} of {total} actions from all over; others stay within their limits"
    )
    if found.refused:
        lines.append(f"refused        {len(found.refused)}; such pours are refused again before anything moves, e.g.")
        lines.append(f"               {found.refused[0].splitlines()[0]}")
    return lines


def report_lines(report: PathReport) -> list[str]:
    """Describe one path's report, or the extremes of several, for the operator."""
    low, high = ([f"{1e3 * v:.0f}" for v in corner] for corner in (report.low, report.high))
    turned, turning = math.degrees(report.tilt), math.degrees(report.tilt_speed)
    return [
        "box            " + ", ".join(f"{n} {a} … {b} mm" for n, a, b in zip("xyz", low, high, strict=True)),
        f"tool, pourer   up to {1e3 * report.tool_speed:.0f} mm/s",
        *(
            [f"joints         up to {math.degrees(report.joint_speed):.0f} deg/s, {JOINT_NAMES[report.fastest_joint]}"]
            if report.joint_speed > 0.0
            else []
        ),
        f"tilt           up to {turned:.0f} deg, at up to {turning:.0f} deg/s",
        f"clearance      at least {1e3 * report.clearance:.0f} mm between pourer and receiver"
        if report.clearance > 0.0
        else "clearance      pourer and receiver don't touch",
        f"one pour       up to {report.duration:.1f} s in motion",
    ]


def announce(laboratory: str, arm: str, lines: Sequence[str], lasting: str = "") -> None:
    """Print what hardware will do, before the laboratory's name is typed."""
    say(f"\nHARDWARE: laboratory {laboratory}, {arm}. This will move:\n")
    for line in lines:
        say(f"  {line}")
    say(
        "\nA software stop is not a safety function: keep the emergency stop within reach, and everybody out of the "
        f"box.\nType the laboratory's name ({laboratory}) to arm it{lasting}; anything else ends here."
    )


def confirm(laboratory: LaboratorySpec, lines: Sequence[str]) -> None:
    """Print what hardware will do, and require the laboratory's name to be typed.

    Raises:
        RefusalError: stdin is not a terminal, or another text was typed (exit code 2).
    """
    assert laboratory.arm is not None
    if not sys.stdin.isatty():
        raise RefusalError(
            f"laboratory {laboratory.name} is hardware, and is armed by somebody who reads what it will do and types "
            "its name: that needs a terminal, with nothing piped into it",
            BAD_INPUT,
        )
    announce(laboratory.name, laboratory.arm.title, lines, " for this run")
    termios.tcflush(sys.stdin.fileno(), termios.TCIFLUSH)  # discard keys that were pressed before this text was shown
    print("> ", end="", file=sys.stderr, flush=True)
    typed = sys.stdin.readline()
    if typed.strip() != laboratory.name:
        raise RefusalError(f"not armed: '{typed.strip()}' was typed; nothing has moved", BAD_INPUT)
    say(f"armed, for this run only: {laboratory.name}")
