"""What a journal says afterwards of a campaign that was struck: its state, its pours, its weights, its decisions."""

from __future__ import annotations

import contextlib
from pathlib import Path
from typing import Any

from orchestrator.records.journal import JOURNAL_NAME, Entry, JournalReader, Kind
from orchestrator.records.states import State
from tests.support.command_process import timeless


def entries(directory: Path) -> list[Entry]:
    """The journal as far as it goes; empty before there is one."""
    with contextlib.suppress(Exception), JournalReader(directory / JOURNAL_NAME) as journal:
        return list(journal.entries())
    return []


def kinds(directory: Path) -> list[str]:
    """Of its entries; a journal that is laid out and has none yet is one too."""
    with contextlib.suppress(Exception), JournalReader(directory / JOURNAL_NAME) as journal:
        return [entry.kind for entry in journal.entries()] or ["header"]
    return []


def state(directory: Path) -> State | None:
    """The campaign's last written state."""
    with contextlib.suppress(Exception), JournalReader(directory / JOURNAL_NAME) as journal:
        return journal.state()
    return None


def unknown_pours(directory: Path) -> set[tuple[str, int]]:
    """Pours that have begun and have no outcome."""
    begun: dict[int, tuple[str, int]] = {}
    for entry in entries(directory):
        if entry.kind == Kind.POUR_STARTED:
            begun[entry.body["id"]] = (entry.stage, entry.body["id"])
        elif entry.kind in (Kind.POUR_FINISHED, Kind.POUR_WITHDRAWN):
            begun.pop(entry.body["id"], None)
    return set(begun.values())


def weights(directory: Path) -> dict[str, str]:
    """What was weighed by stage and number of the pour, as an operator would type it."""
    numbers: dict[int, int] = {}
    found = {}
    for entry in entries(directory):
        if entry.kind == Kind.REQUESTED and entry.body["request"]["type"] == "Pour":
            numbers[entry.body["id"]] = entry.body["request"]["number"]
        elif entry.kind == Kind.POUR_FINISHED and "measurement" in entry.body["outcome"]:
            m = entry.body["outcome"]["measurement"]
            grams = " ".join(repr(round(1e3 * m[name], 12)) for name in ("spilled", "retained", "loaded"))
            found[f"{entry.stage} {numbers[entry.body['id']]}"] = f"weighed {grams}"
    return found


def record(directory: Path) -> list[Any]:
    """Requests, decisions, what was told and concluded, in order; times, attempts and what was noted aside."""
    outcomes: dict[int, Any] = {}
    found: list[Any] = []
    for entry in entries(directory):
        body = entry.body
        match entry.kind:
            case Kind.POUR_FINISHED if "measurement" in body["outcome"]:
                measured = body["outcome"]["measurement"]
                outcomes[body["id"]] = [round(1e3 * measured[k], 9) for k in ("loaded", "spilled", "retained")]
            case Kind.FINISHED | Kind.POUR_FINISHED:
                outcomes[body["id"]] = rounded(timeless(body["outcome"]))
            case Kind.TOLD:
                found.append([entry.stage, str(entry.kind), body["id"], outcomes[body["id"]]])
            case Kind.STAGE_OPENED | Kind.ASKED | Kind.REQUESTED | Kind.DECISION | Kind.STAGE_CLOSED:
                found.append([entry.stage, str(entry.kind), rounded(timeless(body))])
    return found


def rounded(data: Any) -> Any:
    """To nine digits: a weight that was typed in grams is not the last bit of one that was weighed."""
    if isinstance(data, float):
        return float(f"{data:.9g}")
    if isinstance(data, dict):
        return {key: rounded(value) for key, value in data.items()}
    return [rounded(value) for value in data] if isinstance(data, list) else data


def first_difference(ours: list[Any], theirs: list[Any]) -> str | None:
    """Where two records part, in words."""
    for number, (a, b) in enumerate(zip(ours, theirs, strict=False)):
        if a != b:
            return f"entry {number}: {str(a)[:300]} instead of {str(b)[:300]}"
    return None if len(ours) == len(theirs) else f"{len(ours)} entries instead of {len(theirs)}"
