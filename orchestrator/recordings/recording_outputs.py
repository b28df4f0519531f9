"""What the commands `decant recording` return, as models that `--json` prints: `OUTPUTS` by command."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from orchestrator.cli.command_results import CommandOutput


class RecordingExportOutput(CommandOutput):
    """Result of the export of a run's pours."""

    recordings: list[Path]
    """Files of the recorded pours (YAML), each with a CSV file of the same name."""

    left_out: list[str]
    """Reasons why pours could not be exported."""


class RecordingReplayOutput(CommandOutput):
    """The replay of a recorded pour. Masses are without the receiver."""

    recording: Path
    readings: int
    measured_g: float
    """Mass at the end."""

    onset: dict[str, float] | None
    """Time [s] and recorded tilt [deg] at which the readings have risen; null if nothing flowed."""

    arrivals: dict[str, float]
    """How readings arrived: interval, longest gap, step, and number of readings that repeat while the mass rises."""

    fitted: dict[str, Any]
    """Values that differ from the file's, and the recordings that they were fitted on."""

    simulation: dict[str, Any] | None
    """Particle simulation of the recorded tilt: mass at the end, RMS of the readings, onset; null without it."""

    estimator: dict[str, Any]
    """Estimator of doses over the readings: mass and lag with 90 % intervals, innovation, coverage."""

    warnings: list[str]


class RecordingReplaysOutput(CommandOutput):
    """Replays of recorded pours."""

    replays: list[RecordingReplayOutput]


class RecordingFitOutput(CommandOutput):
    """Quantities that were fitted to recorded pours, and predictions of readings that were not."""

    fitted: dict[str, dict[str, Any]]
    """Value, 90 % interval and unit of each quantity, and whether the readings identify it."""

    fitted_on: list[str]
    """Names of the recordings."""

    until_s: float | None
    """Readings after this time were not fitted."""

    rms_g: list[float]
    """RMS of the residuals of each recording."""

    held_readings: list[float] | None
    """Share of the readings that repeat the one before while the mass rises, with its 90 % interval."""

    judged: list[dict[str, Any]]
    """Predicted and measured mass, RMS and coverage of each judged recording."""


class FirstDayOutput(CommandOutput):
    """What the recordings of a first day show."""

    main: str | None
    """Quantity that explains the pours best; null if none does better than the tolerances of a rig in order."""

    describes: bool
    """Whether half of the doses or more are as predicted from the pours."""

    explanations: list[dict[str, Any]]
    """Name, evidence and value of each quantity; empty if fewer than four pours have readings while they flow."""

    doses: list[dict[str, Any]]
    """Predicted mass with its 90 % interval, weighed and wanted mass of each dose."""

    missed_g: float | None
    """Mass in the receiver after the deliberate miss."""

    dose_error_g: list[float] | None
    """Mean and largest distance of the weighed from the wanted amount."""

    replays: list[RecordingReplayOutput]


OUTPUTS = {
    "recording export": RecordingExportOutput,
    "recording replay": RecordingReplaysOutput,
    "recording fit": RecordingFitOutput,
    "recording first-day": FirstDayOutput,
}
