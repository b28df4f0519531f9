"""The conditions of catalogue queries, declared once for the command line, the API and notebooks.

This module imports nothing heavy: `decant --help` needs it. `orchestrator.catalogue.queries` executes the queries.
"""

from __future__ import annotations

from pathlib import Path
from typing import TypedDict

CONDITIONS = {
    "since": "Begun (of a pour: weighed) at that date or later: 2030-03-01, 2030-03 (a month), 7d (ago).",
    "until": "… at that date or before; a day or month counts to its end.",
    "campaign": "Name of the campaign.",
    "pourer": "Vessel that was poured from, by name.",
    "receiver": "Vessel that was poured into, by name.",
    "liquid": "What was poured, by name.",
    "strategy": "C1 to C4, D1 to D3, or one of a package.",
    "mode": "'virtual' or 'real'.",
    "state": "finished, paused, failed, unknown, interrupted …",
    "tag": "A tag of the run.",
}
"""Conditions in addition to words, for the command line, the API and notebooks. Names may contain * and ?."""


class Conditions(TypedDict, total=False):
    """`CONDITIONS`, as keywords."""

    since: str | None
    until: str | None
    campaign: str | None
    pourer: str | None
    receiver: str | None
    liquid: str | None
    strategy: str | None
    mode: str | None
    state: str | None
    tag: str | None


class PourConditions(Conditions, total=False):
    """Conditions for pours."""

    run: str | Path | None
