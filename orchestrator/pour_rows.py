"""Requests of a journal with what came of them, and pours as rows of a table in the units that people read."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from orchestrator.codec import decode_outcome, decode_request
from orchestrator.journal import JournalReader, Kind
from orchestrator.requests import Failed, Outcome, Pour, Poured, Request
from orchestrator.strategies.display import displayed_action
from sim_engine.losses import normalised_spillage

Row = dict[str, Any]


@dataclass(frozen=True)
class Answer:
    """A request and what came of it.

    Attributes:
        id: unique within the campaign.
        time: when it was answered (seconds since 1970).
        seconds: from start to end.
    """

    stage: str
    id: int
    request: Request
    outcome: Outcome
    time: float
    seconds: float


def answers(journal: JournalReader, kind: type[Request]) -> Iterator[Answer]:
    """Requests of one kind that were answered, in that order."""
    requests: dict[int, Request] = {}
    for entry in journal.entries(kinds=(Kind.REQUESTED, Kind.FINISHED, Kind.POUR_FINISHED)):
        key, body = entry.body["id"], entry.body
        if entry.kind == Kind.REQUESTED:
            if body["request"]["type"] == kind.__name__:
                requests[key] = decode_request(body["request"])
        elif key in requests:
            yield Answer(entry.stage, key, requests[key], decode_outcome(body["outcome"]), entry.t, body["seconds"])


def pour_row(pour: Pour, outcome: Outcome | None) -> Row:
    """Number, action in display units, prediction, masses [g] and spillage r of a pour; None: it has no outcome yet."""
    row: Row = {"number": pour.number, **displayed_action(pour.action.values())}
    row["predicted"] = None if pour.predicted is None else pour.predicted.mean
    match outcome:
        case Poured(weighed):
            row |= {"loaded_g": 1e3 * weighed.loaded, "spilled_g": 1e3 * weighed.spilled}
            row |= {"retained_g": 1e3 * weighed.retained, "spillage": normalised_spillage(weighed.fractions)}
        case Failed(kind, reason):
            row["failed"] = f"{kind}: {reason}"
    return row
