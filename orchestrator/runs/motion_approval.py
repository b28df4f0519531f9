"""Approval of motion on hardware: the accepted safety settings of a controller, and the limits of what will move.

- The safety settings that an operator has accepted are kept in a small file next to the laboratory's file, for review.
  Decant can't judge safety settings. It only detects that they differ from the accepted ones.
- `envelope` gives the limits of the paths of actions from all over a campaign's action spaces. The command line and the
  daemon show it before an operator enables the motion of one run.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path

import numpy as np

from actors.arm.arm_interface import PathReport
from actors.arm.arm_settings import ArmSettings, SafetyRecord
from actors.arm.pour_feasibility import path_of
from actors.interfaces import InvalidActionError
from actors.optimizer.questions import Linear
from orchestrator.learning.calibration.action_prior import actions_all_over
from orchestrator.learning.campaign_plan import CampaignPlan
from orchestrator.learning.run_errors import RunError
from orchestrator.runs.stages import CONFIRMATION, DEPLOYMENT, DOSES, StageDefinition
from sim_engine.action import Action
from sim_engine.errors import shown_path
from sim_engine.scene import Scene
from sim_engine.search_space import Space

SUFFIX = ".safety.json"
_CHECKSUM = re.compile(r"[0-9A-F]{8}")


class SafetyRecordError(RunError):
    """The record can't be read, or there is none; the text gives the reason."""

    exit_code = 2


def record_path(laboratory: Path) -> Path:
    """Path of the record of a laboratory's file: NAME.safety.json next to NAME.yaml."""
    return laboratory.with_name(laboratory.stem + SUFFIX)


def read_record(laboratory: Path) -> SafetyRecord | None:
    """The accepted safety settings of a laboratory.

    Args:
        laboratory: the laboratory's file.

    Returns:
        None if none were accepted.

    Raises:
        SafetyRecordError: the record exists but is invalid.
    """
    path = record_path(laboratory)
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise SafetyRecordError(
            f"{path}: {error}. Restore it, or accept the settings anew: {_accept(laboratory)}"
        ) from None
    names = {field.name for field in fields(SafetyRecord)}
    if not isinstance(data, dict) or set(data) != names or not all(isinstance(v, str) for v in data.values()):
        raise SafetyRecordError(
            f"{path}: should hold {', '.join(sorted(names))}, each a text. Restore it, or accept the settings anew: "
            f"{_accept(laboratory)}"
        )
    record = SafetyRecord(**data)
    if not _CHECKSUM.fullmatch(record.checksum.upper()):
        raise SafetyRecordError(f"{path}: checksum '{record.checksum}' should be eight hexadecimal digits")
    return record


def write_record(laboratory: Path, record: SafetyRecord) -> Path:
    """Store the accepted settings.

    Raises:
        OSError: the file can't be written.
    """
    path = record_path(laboratory)
    path.write_text(json.dumps(asdict(record), indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
    return path


def accepted_checksum(laboratory: Path) -> str | None:
    """Accepted checksum of a laboratory; None if none was accepted.

    Args:
        laboratory: the file that describes the laboratory; the campaign's file if it contains the laboratory.

    Raises:
        SafetyRecordError: the record is invalid.
    """
    record = read_record(laboratory)
    return None if record is None else record.checksum.upper()


def required_checksum(plan: CampaignPlan) -> str:
    """Checksum that was accepted for the hardware of a campaign's laboratory.

    Raises:
        SafetyRecordError: none was accepted, or the record can't be read.
    """
    laboratory = plan.laboratory_source or plan.source
    checksum = accepted_checksum(laboratory)
    if checksum is None:
        raise SafetyRecordError(
            f"laboratory {plan.laboratory.name}: the controller's safety settings have not been accepted. Run "
            f"'decant robot check {shown_path(laboratory)}' first; it says how"
        )
    return checksum


def _accept(laboratory: Path) -> str:
    return f"decant robot check {laboratory} --accept-safety"


CORNERS, INTERIOR = 32, 12
"""Actions of each space whose paths are planned for the envelope, in addition to its middle."""


@dataclass(frozen=True)
class Envelope:
    """Limits of the paths of some actions.

    Attributes:
        reports: of the paths that can be executed.
        refused: why the others can't, one text each.
    """

    reports: tuple[PathReport, ...]
    refused: tuple[str, ...] = ()

    @property
    def worst(self) -> PathReport:
        """The extremes of all of them in one.

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
            joint_name=fastest.joint_name,
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


def envelope(arm: ArmSettings, pours: Iterable[tuple[Scene, Action]]) -> Envelope:
    """Plan paths, and see what they keep within."""
    reports, refused = [], []
    for scene, action in pours:
        try:
            path = path_of(scene, action, arm)
            assert path is not None
            reports.append(path.report)
        except InvalidActionError as error:
            refused.append(f"{action.display()}: {error}")
    return Envelope(tuple(reports), tuple(refused))


def campaign_pours(plan: CampaignPlan, stages: Sequence[StageDefinition]) -> list[tuple[Scene, Action]]:
    """Actions from all over the spaces that the stages' pours are chosen from: middle, corners, and some between."""
    calibrating, deploying = _pouring(stages)
    cases: list[tuple[Scene, Action]] = []
    if plan.calibration is not None and calibrating:
        for scene in plan.calibration.poured:
            cases += _from_all_over(scene, plan.calibration.actions, plan.calibration.constraints)
    if plan.deployment is not None and deploying:
        for scene in plan.deployment.scenes:
            cases += _from_all_over(scene, plan.deployment.actions, plan.deployment.constraints)
    if plan.dispense is not None and any(stage.name == DOSES for stage in stages):
        cases += [(scene, scene.action({})) for scene in plan.dispense.scenes]
    return cases + [(scene, scene.action({})) for scene in filter(None, [plan.pour])]


def _from_all_over(scene: Scene, actions: Space, constraints: Sequence[Linear]) -> list[tuple[Scene, Action]]:
    cases = []
    for values in actions_all_over(actions, constraints, corners=CORNERS, drawn=INTERIOR):
        try:
            cases.append((scene, scene.action(values)))
        except ValueError:
            continue  # no such action
    return cases


def pour_count(plan: CampaignPlan, stages: Sequence[StageDefinition]) -> int:
    """How many pours the stages may ask for."""
    calibrating, deploying = _pouring(stages)
    count = plan.calibration.pour_count if plan.calibration is not None and calibrating else 0
    if plan.dispense is not None and any(stage.name == DOSES for stage in stages):
        count += len(plan.dispense.doses)
    count += plan.pour is not None
    if plan.deployment is None:
        return count
    confirming = sum(stage.name.startswith(CONFIRMATION) for stage in stages)
    return count + plan.deployment.pours * deploying + plan.deployment.confirm * confirming


def _pouring(stages: Sequence[StageDefinition]) -> tuple[bool, int]:
    """Whether the calibration's pours are among the stages, and how many deployments that pour."""
    names = [
        stage.name
        for stage in stages
        if stage.pours and not stage.name.startswith(CONFIRMATION) and stage.name != DOSES
    ]
    deploying = sum(name.startswith(DEPLOYMENT) for name in names)
    return deploying < len(names), deploying


def envelope_lines(paths: Envelope) -> list[str]:
    """The limits of the paths as text."""
    lines = report_lines(paths.worst)
    total = len(paths.reports) + len(paths.refused)
    lines.append(
        f"planned        {len(paths.reports)} of {total} actions from all over; others stay within their limits"
    )
    if paths.refused:
        lines.append(f"refused        {len(paths.refused)}; such pours are refused again before anything moves, e.g.")
        lines.append(f"               {paths.refused[0].splitlines()[0]}")
    return lines


def report_lines(report: PathReport) -> list[str]:
    """One path's report, or many's extremes, for people."""
    low, high = ([f"{1e3 * v:.0f}" for v in corner] for corner in (report.low, report.high))
    turned, turning = math.degrees(report.tilt), math.degrees(report.tilt_speed)
    return [
        "box            " + ", ".join(f"{n} {a} … {b} mm" for n, a, b in zip("xyz", low, high, strict=True)),
        f"tool, pourer   up to {1e3 * report.tool_speed:.0f} mm/s",
        *(
            [f"joints         up to {math.degrees(report.joint_speed):.0f} deg/s, {report.fastest}"]
            if report.joint_speed > 0.0
            else []
        ),
        f"tilt           up to {turned:.0f} deg, at up to {turning:.0f} deg/s",
        f"clearance      at least {1e3 * report.clearance:.0f} mm between pourer and receiver"
        if report.clearance > 0.0
        else "clearance      pourer and receiver don't touch",
        f"one pour       up to {report.duration:.1f} s in motion",
    ]
