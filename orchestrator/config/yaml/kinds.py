"""What a YAML file describes, by its keys: so that a file of another kind gets one error and not one per key."""

from __future__ import annotations

from typing import Any

from orchestrator.config.yaml.errors import Problem
from orchestrator.config.yaml.source import Document
from sim_engine.vessel.spec import VESSELS

TELLING = {
    "study": {"mismatch", "compared", "campaign"},
    "campaign": {"calibration", "deployment", "seed", "liquid", "pourer", "receiver", "laboratory"},
    "vessel": {"profile", "mesh", "inner", "wall", "up"},
    "laboratory": {"bench", "mode", "simulators", "arm", "cell"},
}
"""Top-level keys that only one kind of file has, or that give away what was meant; looked for in this order."""

NEEDED = {
    "study": "a study has keys such as campaign, mismatch, calibration, deployment",
    "campaign": "a campaign has keys such as laboratory, liquid, calibration, deployment",
    "vessel": "a vessel has a name and a profile or mesh",
    "laboratory": "a laboratory has keys such as mode, simulators, arm, bench",
}


def kind_of(data: Any) -> str | None:
    """'study', 'campaign', 'vessel' or 'laboratory'; None if no key tells."""
    keys = set(data) if isinstance(data, dict) else set()
    return next((kind for kind in TELLING if keys & telling(kind)), None)


def telling(kind: str) -> set[str]:
    """Keys that tell a kind of file, with those that packages add."""
    return TELLING[kind] | (set(VESSELS.names) if kind == "vessel" else set())


def wrong_kind(document: Document, wanted: str) -> Problem | None:
    """The problem with a file that plainly is of another kind than the one wanted; None otherwise."""
    found = kind_of(document.data)
    keys = set(document.data) if isinstance(document.data, dict) else set()
    if found is None or found == wanted or keys & telling(wanted):
        return None
    return Problem(document.path, 0, 0, "", f"describes a {found}, but a {wanted} is needed here ({NEEDED[wanted]})")
