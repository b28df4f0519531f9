"""Reads a run's folder as rows of the catalogue: the plan from the journal's header, the outcomes from its entries.

Vessels are not built, and meshes and plug-ins may be missing.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from orchestrator.catalogue.annotations import AnnotationsError, read_remarks
from orchestrator.journal.codec import CodecError, decode_outcome, decode_request, from_json
from orchestrator.journal.journal import JOURNAL_NAME, Entry, JournalReader, Kind
from orchestrator.journal.run_record import Row, pour_row
from orchestrator.requests import Outcome, Pour, Poured
from orchestrator.run_errors import RunError
from orchestrator.runs.prior_data import scenes_in
from sim_engine.outcome import Loss

_KINDS = (
    Kind.CAMPAIGN_STATE,
    Kind.REQUESTED,
    Kind.FINISHED,
    Kind.POUR_STARTED,
    Kind.POUR_WITHDRAWN,
    Kind.POUR_FINISHED,
    Kind.STAGE_CLOSED,
)


@dataclass(frozen=True)
class RunRead:
    """The catalogue's content of a run.

    Attributes:
        run, pours: rows, by the names of the columns.
        problem: why a part of it could not be read; empty otherwise.
    """

    run: Row
    pours: list[Row] = field(default_factory=list)
    problem: str = ""


UNREADABLE = "unreadable"
"""The state of a run of which only the folder is known."""


def read_run(directory: Path) -> RunRead:
    """Read a run, also while it is being written. Errors are stored in `problem` and never raised."""
    row: Row = {}
    try:
        remarks = read_remarks(directory)
        row |= {"tags": remarks.tags, "notes": [note.text for note in remarks.notes]}
        with JournalReader(directory / JOURNAL_NAME) as journal:
            return _Reading(journal, {"run": directory.name, "path": str(directory), **row}).read()
    except (RunError, CodecError, AnnotationsError, OSError) as error:
        return unreadable(directory, str(error), row)
    except Exception as error:  # damaged content can cause any error, and must not hide other runs
        return unreadable(directory, f"{directory}: its journal is damaged ({type(error).__name__}: {error})", row)


def unreadable(directory: Path, problem: str, remarks: Row | None = None) -> RunRead:
    """An unreadable run: its folder, the time of its last change, and the reason.

    Args:
        remarks: its tags and notes.
    """
    row: Row = {"run": directory.name, "path": str(directory), "state": UNREADABLE, "reason": problem}
    with contextlib.suppress(OSError):
        row["begun"] = row["ended"] = directory.stat().st_mtime
    return RunRead(row | (remarks or {}), problem=problem)


class _Reading:
    """One pass over a journal."""

    def __init__(self, journal: JournalReader, row: Row) -> None:
        self._journal = journal
        self._run = row
        self._plan = journal.header.fingerprint
        self._scenes = {str(scene["name"]): scene for scene in scenes_in(self._plan)}
        deployment = self._plan.get("deployment") or {}
        self._deployed = {str(scene["name"]) for scene in deployment.get("scenes", ())}
        simple = bool(deployment) and deployment.get("objectives") is None
        self._loss = Loss(**deployment["loss"]) if simple else None
        self._pours: dict[int, Row] = {}

    def read(self) -> RunRead:
        laboratory, last, simulations = self._plan.get("laboratory") or {}, self._journal.header.created, 0
        state, reason = "queued", ""
        results: dict[str, Mapping[str, Any]] = {}
        pours: dict[int, tuple[str, Pour]] = {}
        for entry in self._journal.entries(kinds=_KINDS):
            last, body = entry.t, entry.body
            match entry.kind:
                case Kind.CAMPAIGN_STATE:
                    state, reason = body["after"], body["reason"]
                case Kind.STAGE_CLOSED:
                    results[entry.stage] = body["result"]
                case Kind.FINISHED:
                    simulations += body["outcome"]["type"] in ("Simulated", "Failed")
                case Kind.REQUESTED if body["request"]["type"] == "Pour":
                    request = decode_request(body["request"])
                    assert isinstance(request, Pour)
                    pours[body["id"]] = (entry.stage, request)
                case Kind.POUR_WITHDRAWN:
                    self._pours.pop(body["id"], None)
                case Kind.POUR_STARTED | Kind.POUR_FINISHED:
                    self._pours[body["id"]] = self._pour(entry, *pours[body["id"]])
        scenes = self._scenes.values()
        rows = list(self._pours.values())
        self._run |= {
            "campaign": self._journal.header.name,
            "mode": laboratory.get("mode", "virtual"),
            "begun": self._journal.header.created,
            "ended": last,
            "state": state,
            "reason": reason,
            "laboratory": laboratory.get("name"),
            "seed": self._plan.get("seed"),
            "liquid": _names(scene["liquid"]["name"] for scene in scenes),
            "pourer": _names(scene["pourer"]["name"] for scene in scenes),
            "receiver": _names(scene["receiver"]["name"] for scene in scenes),
            "strategy": _names(filter(None, (self._strategy(part) for part in ("calibration", "deployment")))),
            "simulations": simulations,
            "pours": sum(row["outcome"] == "weighed" for row in rows),
            "failed_pours": sum(row["outcome"] == "failed" for row in rows),
            "open_pours": sum(row["outcome"] == "open" for row in rows),
            "spilled_g": sum(row.get("spilled_g") or 0.0 for row in rows),
        }
        self._run |= _result_columns(results, {name: scene["receiver"]["name"] for name, scene in self._scenes.items()})
        return RunRead(self._run, rows)

    def _pour(self, entry: Entry, stage: str, pour: Pour) -> Row:
        written = entry.body.get("outcome")
        outcome = None if written is None else decode_outcome(written)
        scene = self._scenes.get(pour.scene, {})
        calibrating = pour.purpose == "calibration" or pour.scene not in self._deployed
        row = pour_row(pour, outcome)
        row |= {"predicted_loss": row.pop("predicted"), "reason": row.pop("failed", "")}
        return row | {
            "run": self._run["run"],
            "path": self._run["path"],
            "campaign": self._journal.header.name,
            "mode": (self._plan.get("laboratory") or {}).get("mode", "virtual"),
            "time": entry.t,
            "stage": stage,
            "id": entry.body["id"],
            "purpose": pour.purpose,
            "strategy": self._strategy("calibration" if calibrating else "deployment"),
            "pourer": scene.get("pourer", {}).get("name", ""),
            "receiver": scene.get("receiver", {}).get("name", pour.scene),
            "liquid": scene.get("liquid", {}).get("name", ""),
            "outcome": "open" if outcome is None else "weighed" if isinstance(outcome, Poured) else "failed",
            "loss": self._measured_loss(outcome, calibrating),
            "loss_name": "" if calibrating else "objectives" if self._loss is None else self._loss.name,
            "predicted_deviation": None if pour.predicted is None else pour.predicted.deviation,
            "seconds": entry.body.get("seconds"),
        }

    def _measured_loss(self, outcome: Outcome | None, calibrating: bool) -> float | None:
        if calibrating or self._loss is None or not isinstance(outcome, Poured):
            return None  # weighted objectives need the plan: use `decant.open_run(run).pours`
        weighed, particles = outcome.measurement, (self._plan.get("parameters") or {}).get("particles", 0)
        return self._loss(weighed.fractions, loaded_mass=weighed.loaded, particles=int(particles))

    def _strategy(self, part: str) -> str:
        return str(((self._plan.get(part) or {}).get("settings") or {}).get("strategy", ""))


def _names(found: Iterator[str]) -> list[str]:
    return list(dict.fromkeys(found))


def _result_columns(results: Mapping[str, Mapping[str, Any]], receivers: Mapping[str, str]) -> Row:
    """θ*, its discrepancy, and recommendations, from encoded results; their kinds need not be installed."""
    row: Row = {"theta": None, "test_discrepancy": None, "recommended": {}}
    for written in results.values():
        result = from_json(written)
        match result.get("kind"):
            case "calibration":
                row["theta"] = (result.get("found") or {}).get("theta")
            case "evaluation":
                row["test_discrepancy"] = (result.get("discrepancy") or {}).get("theta", {}).get("test")
            case "deployment" if result.get("recommended"):
                advice, losses = result["recommended"], [p.get("loss") for p in result.get("pours", ())]
                row["recommended"][receivers.get(result["scene"], result["scene"])] = {
                    "strategy": result["strategy"],
                    "action": advice["action"],
                    "predicted_loss": advice["predicted_loss"],
                    "best_loss": min((loss for loss in losses if loss is not None), default=None),
                    "loss": result["loss"],
                }
    return row
