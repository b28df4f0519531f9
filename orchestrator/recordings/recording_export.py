"""Recorded pours from the journal of a run: `export_recordings`.

A dose has its tilts, its readings and the readings while the receiver was put on. A pour on hardware with the balance
below the receiver has its tilts and readings. Any other pour has the tilts that the arm executed, and two readings: 0
before the pour and the weighed mass after it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from actors.arm.arm_settings import arm_kind
from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.campaigns.yaml.yaml_errors import ConfigError
from orchestrator.learning.campaign_plan import CampaignPlan
from orchestrator.learning.run_errors import RunError
from orchestrator.recordings.recording_file import write_recording
from orchestrator.records.run_record import RunPour, read_record
from orchestrator.runs.run_folder import RESOLVED
from orchestrator.runs.stages import scenes_of
from sim_engine.scene import Scene

if TYPE_CHECKING:
    from actors.interfaces import DoseSource

FOLDER = "recordings"
"""Folder of a run for its recorded pours."""

Pairs = Sequence[tuple[float, float]]


def export_recordings(
    directory: Path, to: Path | None = None, plan: CampaignPlan | None = None
) -> tuple[list[Path], list[str]]:
    """Write the pours and doses of a run as recorded pours. Files that exist are kept.

    Args:
        directory: of the run, finished or not.
        to: folder for the files; 'recordings' in the run's folder unless given.
        plan: of the run; read from its folder unless given.

    Returns:
        The YAML files of all recorded pours of the run, and a reason for each pour that could not be exported.

    Raises:
        RunError: the journal or the plan can't be read.
        OSError: a file can't be written.
    """
    try:
        plan = plan or load_campaign(directory / RESOLVED)
    except ConfigError as error:
        raise RunError(f"{directory}: its campaign can't be read: {error}") from error
    scenes, record = scenes_of(plan), read_record(directory)
    to = to or directory / FOLDER
    to.mkdir(parents=True, exist_ok=True)
    written, left_out = [], []
    for pour in record.weighed:
        kind = "pour" if pour.request.dose is None else "dose"
        number = sum(weighed.stage == pour.stage and weighed.id <= pour.id for weighed in record.weighed)
        path = to / f"{pour.stage}-{kind}-{number}.yaml".replace("/", "-").replace(" ", "-")
        if path.exists():
            written.append(path)
            continue
        try:
            written.append(_export(path, pour, scenes[pour.request.scene], plan, directory.name))
        except ValueError as error:
            left_out.append(f"{pour.stage}, {kind} {pour.request.number}: {error}")
    return written, left_out


def _export(path: Path, pour: RunPour, scene: Scene, plan: CampaignPlan, run: str) -> Path:
    """Write one pour.

    Raises:
        ValueError: its tilt is not recorded, or its vessel can't be written.
    """
    measured, request = pour.measured, pour.request
    assert measured is not None, "the pour was weighed"
    notes: Mapping[str, Any] = measured.notes
    dose: Mapping[str, Any] = notes.get("dose") or {}
    signals = dose or notes.get("signals") or {}
    balance = {"model": _balance(plan), **({"step": f"{signals['step_g']:g} g"} if signals.get("step_g") else {})}
    if signals.get("times") and signals.get("read_at"):
        tilt: Pairs = list(zip(signals["times"], signals["tilt_deg"], strict=True))
        end = signals.get("duration") or math.inf  # an arm may take the receiver of a dose away then
        mass = [
            *zip(signals.get("placed_at", ()), signals.get("placed_g", ()), strict=True),
            *(pair for pair in zip(signals["read_at"], signals["readings_g"], strict=True) if pair[0] <= end),
        ]
        how = "tilt and readings as they arrived, on one clock"
        if dose:
            balance["zero"] = "0 g"
    else:
        tilt = _executed(notes, plan)
        mass = [(0.0, 0.0), (tilt[-1][0], 1e3 * measured.delivered)]
        how = "tilt from the arm's encoders; the mass is 0 before the pour and the weighed one after it"
        balance["zero"] = "0 g"
    source: DoseSource | None = None if request.dose is None else request.dose.source
    action = request.action
    lengths = {"x_offset": action.x_offset, "y_offset": action.y_offset, "height": action.height}
    liquid = scene.liquid.model_copy(update={"mass": measured.loaded})
    return write_recording(
        path,
        Scene(path.stem, scene.pourer, scene.receiver, liquid),
        {"tilt_deg": _once(tilt), "mass_g": _once(mass)},
        recorded={"how": f"{how} ({notes.get('mode', 'virtual')})", "run": f"{run}, {pour.stage} {request.number}"},
        placement={name: f"{1e3 * value:.6g} mm" for name, value in lengths.items() if value},
        balance=balance,
        fill_deviation=None if source is None else max(source.deviation, 1e-6),
    )


def _balance(plan: CampaignPlan) -> str:
    """The balance in words."""
    settings = plan.laboratory.balance
    if settings is None:
        return "simulated"
    return " ".join(filter(None, (settings.kind, str(getattr(settings, "dialect", "")))))


def _executed(notes: Mapping[str, Any], plan: CampaignPlan) -> Pairs:
    """Times [s] and tilts [deg] that the arm executed.

    Raises:
        ValueError: they are not recorded.
    """
    record, arm = notes.get("executed") or {}, plan.laboratory.arm
    kind = None if arm is None else arm_kind(arm)
    figure = None if kind is None else kind.figure()
    executed = None if figure is None else figure.executed(record)
    if kind is None or executed is None:
        raise ValueError("its tilt is not recorded: simulated benches execute the planned motion")
    times, joints = executed
    if len(times) < 2:
        raise ValueError("its arm reported no motion")
    tilt = np.degrees(kind.pourer_motion(joints, times).tilt(times))
    every = max(len(times) // 1000, 1)
    return [(float(t), round(float(a), 3)) for t, a in zip(times[::every], tilt[::every], strict=True)]


def _once(pairs: Pairs) -> Pairs:
    """The first value of each time; a run's clock has milliseconds."""
    series: dict[float, float] = {}
    for time, value in sorted(pairs, key=lambda pair: pair[0]):
        if math.isfinite(value):
            series.setdefault(round(float(time), 4), float(value))
    return list(series.items())
