"""Runs side by side: what was asked differently, and what came of it."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from orchestrator.journal import JOURNAL_NAME, JournalReader
from orchestrator.pour_rows import Row

_MISSING = object()


def differing_settings(runs: Sequence[Path]) -> dict[str, list[Any]]:
    """Settings in which runs differ: place in the plan → its value in each run, None where a run hasn't got it.

    Where a whole section is missing in one run, the section stands there, not all that is in it.

    Raises:
        RunError: a journal can't be read.
    """
    plans = []
    for run in runs:
        with JournalReader(run / JOURNAL_NAME) as journal:
            plans.append(journal.header.fingerprint)
    found: dict[str, list[Any]] = {}
    _compare("", plans, found)
    return found


def _compare(place: str, values: Sequence[Any], found: dict[str, list[Any]]) -> None:
    if all(value == values[0] for value in values):
        return
    if all(isinstance(value, Mapping) for value in values):
        for key in dict.fromkeys(key for value in values for key in value):
            _compare(f"{place}.{key}" if place else key, [value.get(key, _MISSING) for value in values], found)
        return
    same_length = all(isinstance(value, list) and len(value) == len(values[0]) for value in values)
    if same_length and any(isinstance(part, Mapping) for part in values[0]):
        for index, parts in enumerate(zip(*values, strict=True)):
            _compare(f"{place}[{index}]", parts, found)
        return
    found[place] = [None if value is _MISSING else value for value in values]


def outcomes(run: Row) -> dict[str, Any]:
    """What a run came to, one value for each line of a comparison: by θ, and by receiver."""
    theta = {f"θ* {name}": value for name, value in (run["theta"] or {}).items()}
    shown: dict[str, Any] = {
        name: run[name] for name in ("state", "simulations", "pours", "spilled_g", "test_discrepancy")
    }
    for receiver, advice in (run["recommended"] or {}).items():
        shown |= {f"{receiver}: {name}": advice[name] for name in ("strategy", "best_loss", "predicted_loss")}
        shown |= {f"{receiver}: {name}": value for name, value in advice["action"].items()}
    return shown | theta
