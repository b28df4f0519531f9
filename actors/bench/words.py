"""What a person beside the arm is asked before it moves, and after it has stopped. Words only."""

from __future__ import annotations

import math

from actors.arm.protocol import PlannedPour
from actors.arm.spec import ArmSpec
from actors.operator import Question


def grams(mass: float) -> str:
    """'12.34 g'."""
    return f"{1e3 * mass:.2f} g"


def start_question(spec: ArmSpec, path: PlannedPour) -> Question:
    """Whether a whole pour may begin."""
    report = path.report
    return Question(
        f"Hands out of the cell. The arm will pour: {report.duration:.1f} s, tilting the pourer to "
        f"{math.degrees(report.tilt):.0f}° at up to {math.degrees(report.tilt_speed):.0f}°/s, no point of it faster "
        f"than {1e3 * report.tool_speed:.0f} mm/s. It moves {spec.announcement:g} s after you say so. May it?",
        "yes or no",
        about="start",
        hands=False,
        details={
            "duration_s": report.duration,
            "tilt_deg": math.degrees(report.tilt),
            "tilt_speed_deg_s": math.degrees(report.tilt_speed),
            "tool_speed_mm_s": 1e3 * report.tool_speed,
            "clearance_mm": 1e3 * report.clearance,
        },
    )


def stopped_question(error: Exception, problem: str, *, begun: bool) -> Question:
    """Whether the cause of a stop was seen to.

    Args:
        error: that told of the stop.
        problem: why it is asked, or asked again.
        begun: whether anything may have been poured.
    """
    details: dict[str, float | str] = {}
    tilt, phase = getattr(error, "tilt", None), getattr(error, "phase", None)
    if phase is not None:
        details["phase"] = phase
    if tilt is not None:
        details["tilt_deg"] = math.degrees(tilt)
    stands = f" The pourer stands at {math.degrees(tilt):.0f}°." if tilt is not None else ""
    poured = "" if begun else " Nothing was poured."
    return Question(
        f"The arm was stopped, and holds still.{stands}{poured} Find out why, and mend it. Shall the robot be made "
        "ready again? It doesn't move yet; 'no' leaves everything as it is.",
        "yes or no",
        problem,
        about="recover",
        hands=False,
        details=details,
    )


def unsafe_question(problem: str) -> Question:
    """Whether to look again if the arm keeps still."""
    return Question(
        "Keep hands out of the cell, or press the emergency stop first: it can't be seen that the arm keeps still. "
        "Mend that. Shall it be looked at again?",
        "yes or no",
        problem,
        about="unsafe",
        hands=False,
    )


def upright_question(spec: ArmSpec) -> Question:
    """Whether a stopped arm may bring the pourer upright."""
    return Question(
        f"Hands out of the cell. The arm will bring the pourer upright at {math.degrees(spec.untilt_speed):.0f}°/s, "
        f"wait, and go home. It moves {spec.announcement:g} s after you say so. May it?",
        "yes or no",
        about="untilt",
        hands=False,
    )


def way_home_question(spec: ArmSpec) -> Question:
    """Whether a stopped arm may go home."""
    return Question(
        f"Hands out of the cell. The arm will go home, the pourer upright. It moves {spec.announcement:g} s after you "
        "say so. May it?",
        "yes or no",
        about="home",
        hands=False,
    )
