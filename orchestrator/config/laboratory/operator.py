"""The person at the bench as written in a laboratory's file: who answers, and how long that may take."""

from __future__ import annotations

from typing import Annotated, Literal

from actors.operator import OperatorSpec
from orchestrator.config.yaml.quantities import Quantity
from orchestrator.config.yaml.sections import Section
from orchestrator.config.yaml.source import Place, Report

_OPERATOR = OperatorSpec()

Patience = Annotated[float, Quantity("s", "30 min", 0.0, 7 * 86400.0, positive=True)]


class OperatorSection(Section):
    """Who refills, wipes, places, and says when it is done."""

    answers: Literal["person", "virtual"] | None = None
    """A 'person' at the terminal, or a 'virtual' one; unless given, whoever fits the laboratory's mode."""

    time: Annotated[float, Quantity("s", "85 s", 0.0, 3600.0)] = _OPERATOR.time
    """What a virtual one takes for all its work around one pour, in bench time."""

    reminder: Patience = _OPERATOR.reminder
    """After which an open question is asked again."""

    deadline: Patience = _OPERATOR.deadline
    """After which it is given up: nothing moves then, and the campaign pauses."""


def resolve_operator(section: OperatorSection, place: Place, report: Report, *, mode: str) -> OperatorSpec | None:
    """The operator of a file; what is wrong goes to the report, and then there is none.

    Args:
        section: as written.
        place: where it stands.
        report: takes problems.
        mode: of the laboratory, 'virtual' or 'hardware'.
    """
    before = len(report.problems)
    if mode == "hardware" and section.answers == "virtual":
        report.add(
            place.at("answers"),
            "where an arm moves, a person has to say that no hand is in its way; write 'person', or remove the key",
        )
    if mode == "hardware" and "time" in section.model_fields_set:
        report.add(place.at("time"), "is a virtual operator's; a person takes the time that it takes; remove the key")
    if section.reminder > section.deadline:
        report.add(place.at("reminder"), "comes after the deadline; it should be shorter")
    if len(report.problems) > before:
        return None
    return OperatorSpec(
        answers=section.answers or ("person" if mode == "hardware" else "virtual"),
        time=section.time,
        reminder=section.reminder,
        deadline=section.deadline,
    )
