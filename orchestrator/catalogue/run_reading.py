"""The catalogue's rows: their columns, and their content, read from a run's folder.

- `RUNS` and `POURS` declare the columns once; `PreviousRun` and `PreviousPour` are models of the rows.
- `read_run` reads the plan from the journal's header, and the outcomes from its entries. Vessels are not built, and
  meshes and plug-ins may be missing.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import statistics
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, Field, create_model

from orchestrator.campaigns.prior_data import scenes_in
from orchestrator.catalogue.annotations import AnnotationsError, Note, read_notes
from orchestrator.learning.run_errors import RunError
from orchestrator.learning.stage_result import DOSE, displayed_action
from orchestrator.records.codec import CodecError, from_json
from orchestrator.records.events import StageClosed
from orchestrator.records.run_record import Row, RunPour, RunState, read_record
from orchestrator.records.verdict import verdict_of
from sim_engine.action import ACTION_DIMENSIONS
from sim_engine.outcome import Loss

ColumnType = Literal["text", "texts", "integer", "number", "time", "values"]
"""'texts' are several texts, 'values' a mapping; both are stored as JSON in the index and in CSV."""


@dataclass(frozen=True)
class Column:
    """One column.

    Attributes:
        unit: unit of its numbers; empty without one.
        meaning: description in one line.
    """

    name: str
    type: ColumnType
    meaning: str
    unit: str = ""


ACTION_COLUMNS = tuple(displayed_action(dict.fromkeys(ACTION_DIMENSIONS)))
"""Columns of an action, in display units."""

_WHICH_RUN = (
    Column("run", "text", "name of the run's folder"),
    Column("campaign", "text", "name of the campaign"),
    Column("mode", "text", "'virtual', or 'hardware' for a real bench"),
)

RUNS = (
    *_WHICH_RUN,
    Column("path", "text", "the run's folder"),
    Column("begun", "time", "when its journal was begun"),
    Column("ended", "time", "when the last entry was written; of a run that goes on, until now"),
    Column(
        "state",
        "text",
        "of the campaign, as in its journal; 'interrupted' where its process died without a word; "
        "'unreadable' if its journal is missing or damaged",
    ),
    Column("verdict", "text", "what it reached: 'complete', 'incomplete' or 'nothing'"),
    Column("reached", "values", "the verdict with its counts and reasons, as in `summary.json`"),
    Column("reason", "text", "why it is in that state, where there is something to report"),
    Column("laboratory", "text", "name of the laboratory"),
    Column("seed", "integer", "of every random choice"),
    Column("liquid", "texts", "names of the liquids"),
    Column("pourer", "texts", "names of the vessels that were poured from"),
    Column("receiver", "texts", "names of the vessels that were poured into"),
    Column("strategy", "texts", "of calibration and deployment"),
    Column("simulations", "integer", "that were finished, failed ones included"),
    Column("pours", "integer", "that were weighed"),
    Column("failed_pours", "integer", "that failed, or were lost"),
    Column("open_pours", "integer", "that had begun and have no outcome: under way, or UNKNOWN"),
    Column("spilled_g", "number", "next to the receiver, of all weighed pours together", "g"),
    Column("test_discrepancy", "number", "mean |measured − simulated| spillage of θ* on pours kept for testing", "1"),
    Column("theta", "values", "θ*, in SI units"),
    Column("recommended", "values", "by receiver: action to use from now on (display units), expected and best loss"),
    Column("notes", "texts", "written by people: `decant runs note`"),
)
"""Columns of the table of runs."""

POURS = (
    *_WHICH_RUN,
    Column("path", "text", "the run's folder"),
    Column("time", "time", "when it was weighed, or had failed; when it began where it has no outcome"),
    Column("stage", "text", "of the campaign"),
    Column("id", "integer", "of the request within the run"),
    Column("number", "integer", "of the pour within its stage, from 1"),
    Column("purpose", "text", "'calibration', or 'pour' where something is minimised"),
    Column("strategy", "text", "that asked for it"),
    Column("pourer", "text", "vessel that was poured from"),
    Column("receiver", "text", "vessel that was poured into"),
    Column("liquid", "text", "what was poured"),
    *(
        Column(name, "number", dimension.meaning, dimension.display_unit)
        for name, dimension in zip(ACTION_COLUMNS, ACTION_DIMENSIONS.values(), strict=True)
    ),
    Column("outcome", "text", "'weighed', 'failed', or 'open': begun, no outcome; UNKNOWN once its process has died"),
    Column("loaded_g", "number", "in the pourer before", "g"),
    Column("spilled_g", "number", "next to the receiver", "g"),
    Column("retained_g", "number", "left in the pourer", "g"),
    Column("delivered_g", "number", "in the receiver: neither spilled nor left in the pourer", "g"),
    Column("spillage", "number", "spilled / poured; empty where less than 5 % was poured", "1"),
    Column("loss", "number", "what the deployment minimised, as measured", "of loss_name"),
    Column("predicted_loss", "number", "what its strategy expected", "of loss_name"),
    Column("predicted_deviation", "number", "how well that was known: its standard deviation", "of loss_name"),
    Column("loss_name", "text", "which loss, see `loss` of a campaign; or which objective"),
    Column("reason", "text", "why it failed"),
    Column("seconds", "number", "from its request to its outcome", "s"),
    Column("prediction_error", "number", "(loss − expected) / standard deviation of a single pour as predicted", "SD"),
    Column("dose_error_g", "number", "received − wanted", "g"),
    Column("onset_deg", "number", "tilt at which a dose began to flow, beyond what the vessel's shape predicts", "deg"),
    Column("film_g", "number", "what stuck in the receiver before the pour", "g"),
    Column("missing_g", "number", "of the liquid that was poured back before: left the receiver, did not arrive", "g"),
    Column("empty_pourer_g", "number", "weight of the empty pourer, as weighed last", "g"),
    Column("zero_g", "number", "mean reading after the tare, before the pour", "g"),
    Column("reading_noise_g", "number", "standard deviation of these readings, with the rounding of the display", "g"),
)
"""Columns of the table of pours; one row for each pour that had begun."""

TABLES: dict[str, tuple[Column, ...]] = {"run": RUNS, "pour": POURS}
"""The columns of both tables: for the index, tables, their reference and the API."""

_TYPES: dict[str, Any] = {
    "text": str | None,
    "texts": list[str],
    "integer": int | None,
    "number": float | None,
    "time": float | None,
    "values": dict[str, Any],
}


def _row(name: str, columns: tuple[Column, ...], about: str) -> type[BaseModel]:
    fields: dict[str, Any] = {}
    for column in columns:
        unit = "seconds since 1970" if column.type == "time" else column.unit
        fields[column.name] = (_TYPES[column.type], Field(description=column.meaning + (f" [{unit}]" if unit else "")))
    return create_model(name, __doc__=about, **fields)


PreviousRun = _row("PreviousRun", TABLES["run"], "One run of this machine, made by the daemon or the command line.")
PreviousPour = _row("PreviousPour", TABLES["pour"], "One pour that has started.")
PreviousRunDetail = create_model(
    "PreviousRunDetail",
    __base__=PreviousRun,
    __doc__="One run with its notes and its pours.",
    notes=(list[Note], ...),
    list_of_pours=(list[PreviousPour], ...),  # type: ignore[valid-type]
)


FEWEST_READINGS, STEP = 4, 1e-3
"""Number of readings at rest that have a scatter, and the step of a display that shows equal ones [g]."""

UNREADABLE = "unreadable"
"""The state of a run of which only the folder is known; its reason is why it can't be read."""


@dataclass(frozen=True)
class RunRows:
    """The catalogue's content of a run: rows by the names of the columns, its posterior (JSON; '' without one), and its
    notes."""

    run: Row
    pours: list[Row] = field(default_factory=list)
    posterior: str = ""
    notes: tuple[Note, ...] = ()


def read_run(directory: Path) -> RunRows:
    """Read a run, also while it is being written. A run that can't be read is `UNREADABLE`; nothing is raised."""
    notes: tuple[Note, ...] = ()
    try:
        notes = read_notes(directory)
        return RunRows(*_rows(directory), notes=notes)
    except (RunError, CodecError, AnnotationsError, OSError) as error:
        return unreadable(directory, str(error), notes)
    except Exception as error:  # damaged content can cause any error, and must not hide other runs
        return unreadable(directory, f"{directory}: its journal is damaged ({type(error).__name__}: {error})", notes)


def unreadable(directory: Path, problem: str, notes: tuple[Note, ...]) -> RunRows:
    """An unreadable run: its folder, the time of its last change, and the reason."""
    row: Row = {"run": directory.name, "path": str(directory), "state": UNREADABLE, "reason": problem}
    with contextlib.suppress(OSError):
        row["begun"] = row["ended"] = directory.stat().st_mtime
    return RunRows(row, notes=notes)


def _rows(directory: Path) -> tuple[Row, list[Row], str]:
    """The row of a run, those of its pours, and its posterior."""
    record = read_record(directory)
    plan = record.header.fingerprint
    laboratory = plan.get("laboratory") or {}
    scenes = {str(scene["name"]): scene for scene in scenes_in(plan)}
    about = {
        "run": directory.name,
        "path": str(directory),
        "campaign": record.header.name,
        "mode": laboratory.get("mode", "virtual"),
    }
    pours = [about | _pour(pour, plan, scenes) for pour in record.pours if pour.state != "asked"]
    outcomes = [row["outcome"] for row in pours]
    verdict = verdict_of(record)
    run = about | {
        "begun": record.header.created,
        "ended": record.ended,
        "state": str(record.state),
        "verdict": verdict.word,
        "reached": verdict.model_dump(mode="json"),
        "reason": record.reason,
        "laboratory": laboratory.get("name"),
        "seed": plan.get("seed"),
        **{key: _different(s[key]["name"] for s in scenes.values()) for key in ("liquid", "pourer", "receiver")},
        "strategy": _different(filter(None, (_strategy(plan, stage) for stage in ("calibration", "deployment")))),
        "simulations": record.simulations,
        "pours": outcomes.count("weighed"),
        "failed_pours": outcomes.count("failed"),
        "open_pours": outcomes.count("open"),
        "spilled_g": sum(row.get("spilled_g") or 0.0 for row in pours),
    }
    receivers = {name: scene["receiver"]["name"] for name, scene in scenes.items()}
    return run | _result_columns(record.closed.values(), receivers), pours, _posterior(directory, record)


def _posterior(directory: Path, record: RunState) -> str:
    if not any(from_json(event.encoded).get("kind") == "calibration" for event in record.closed.values()):
        return ""
    from orchestrator.catalogue.known_posteriors import NoPosteriorError, posterior_of  # slow import

    try:
        return posterior_of(directory, record).model_dump_json()
    except NoPosteriorError:
        return ""


def _pour(pour: RunPour, plan: Mapping[str, Any], scenes: Mapping[str, Any]) -> Row:
    request, deployment = pour.request, plan.get("deployment") or {}
    scene = scenes.get(request.scene, {})
    calibrating = request.calibrates(scene["name"] for scene in deployment.get("scenes", ()))
    minimised = not calibrating and request.dose is None
    # The value of an objective needs the plan: use `decant.open_run(run).pours`.
    objective = deployment.get("objective") or {}
    loss = None if not minimised or objective else Loss(**deployment["loss"])
    measured = None
    if loss is not None and pour.measured is not None:
        particles = int((plan.get("parameters") or {}).get("particles", 0))
        measured = loss(pour.measured.fractions, loaded_mass=pour.measured.loaded, particles=particles)
    row = pour.row()
    return {
        **row,
        "predicted_loss": row.pop("predicted"),
        "reason": row.pop("failed", ""),
        "time": pour.time,
        "stage": pour.stage,
        "id": pour.id,
        "purpose": request.purpose,
        "strategy": "" if request.dose else _strategy(plan, "calibration" if calibrating else "deployment"),
        "pourer": scene.get("pourer", {}).get("name", ""),
        "receiver": scene.get("receiver", {}).get("name", request.scene),
        "liquid": scene.get("liquid", {}).get("name", ""),
        "outcome": "open" if pour.outcome is None else pour.state,
        "loss": measured,
        "loss_name": "" if not minimised else objective["name"] if loss is None else loss.name,
        "predicted_deviation": None if request.predicted is None else request.predicted.deviation,
        "seconds": pour.seconds,
        **_checks(pour, measured),
    }


def _checks(pour: RunPour, loss: float | None) -> Row:
    """What shows the state of the laboratory, see `orchestrator.catalogue.control_charts`."""
    row: Row = {}
    predicted, target = pour.request.predicted, pour.request.dose
    if loss is not None and predicted is not None and (predicted.deviation or predicted.scatter):
        row["prediction_error"] = (loss - predicted.mean) / math.hypot(predicted.deviation, predicted.scatter or 0.0)
    if pour.measured is None:
        return row
    notes = pour.measured.notes
    about, cycle, signals = (notes.get(key) or {} for key in (DOSE, "cycle", "signals"))
    if target is not None and about.get("received") is not None:
        row["dose_error_g"] = 1e3 * (float(about["received"]) - target.amount)
    if onset := (about.get("knowledge") or {}).get("onset_flow"):
        row["onset_deg"] = math.degrees(onset[0])
    row |= {name: cycle[name] for name in ("film_g", "missing_g") if name in cycle}
    row["empty_pourer_g"] = (notes.get("weighings_g") or {}).get("pourer_empty")
    before = [g for t, g in zip(signals.get("read_at", ()), signals.get("readings_g", ()), strict=True) if t < 0.0]
    if len(before) >= FEWEST_READINGS:
        steps = [abs(b - a) for a, b in itertools.pairwise(sorted(before)) if b != a]
        row["zero_g"] = statistics.fmean(before)
        row["reading_noise_g"] = math.hypot(statistics.stdev(before), min(steps, default=STEP) / math.sqrt(12.0))
    return row


def _strategy(plan: Mapping[str, Any], stage: str) -> str:
    return str(((plan.get(stage) or {}).get("settings") or {}).get("strategy", ""))


def _different(names: Iterable[str]) -> list[str]:
    return list(dict.fromkeys(names))


def _result_columns(closed: Iterable[StageClosed], receivers: Mapping[str, str]) -> Row:
    """θ*, its discrepancy, and recommendations, from encoded results; their kinds need not be installed."""
    row: Row = {"theta": None, "test_discrepancy": None, "recommended": {}}
    for event in closed:
        result = from_json(event.encoded)
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
