"""`recording_verdict`: recordings that cannot be right are refused by `fit` with their likely cause; `replay` warns.

Each case is a shipped recording with one error, as public reports have them:

- erjiang/usbscale#30, oliexdev/openScale#326: a scale that was switched to another unit sends that one
- Jmeyer1292/opw_kinematics#59: an arm whose joint has its zero 90 degrees away
- relffok/mir_robot#3, IFL-CAMP/iiwa_stack#20: the clock of the arm differs from that of the host
"""

from __future__ import annotations

import csv
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from orchestrator.cli.app import app
from orchestrator.recordings.recording_file import PourRecording, load_recordings
from orchestrator.recordings.recording_fit import fit_recordings
from orchestrator.recordings.recording_replay import replay_recording
from orchestrator.recordings.recording_verdict import fit_doubts, replay_doubts, unlikely

SHIPPED = Path("configs/recordings")


def dose(number: int) -> PourRecording:
    return load_recordings([SHIPPED / f"dose-{number}.yaml"])[0]


def with_tilt(by: float) -> Callable[[PourRecording], PourRecording]:
    return lambda recording: replace(recording, tilts=recording.tilts + math.radians(by))


def late(recording: PourRecording) -> PourRecording:
    return replace(recording, tilt_times=recording.tilt_times + 1.0)


@pytest.mark.parametrize("number", [1, 2, 3, 4])
def test_the_shipped_recordings_are_credible(number: int) -> None:
    recording = dose(number)
    assert unlikely([recording], fit_recordings([recording], ("grip", "lag"))) == ""
    assert not replay_doubts(replay_recording(recording, particles=False))


@pytest.mark.parametrize(
    ("change", "doubt", "cause"),
    [
        (
            with_tilt(30.0),
            "grip would have to be -27.8 deg, where 0 ± 1.5 is usual",
            "the zero of the tilt looks about",
        ),
        (with_tilt(90.0), "residuals of 256 g (RMS) in a pour of 49.6 g", "a wrist that is turned by 90°"),
        (late, "residuals of 4.95 g (RMS) in a pour of 49.6 g", "the times of the tilt look about 1 s too late"),
    ],
)
def test_a_fit_that_cannot_be_right_names_the_cause(
    change: Callable[[PourRecording], PourRecording], doubt: str, cause: str
) -> None:
    recording = change(dose(1))
    sentence = unlikely([recording], fit_recordings([recording], ("grip",)))
    assert doubt in sentence
    assert cause in sentence
    assert replay_doubts(replay_recording(recording, particles=False))


def test_ounces_are_refused_by_the_command_and_no_value_is_written(tmp_path: Path) -> None:
    text = (SHIPPED / "dose-1.yaml").read_text(encoding="utf-8")
    (tmp_path / "ounces.yaml").write_text(text.replace("step: 0.1 g", "step: 0.005 g"), encoding="utf-8")
    with (SHIPPED / "dose-1.csv").open(encoding="utf-8", newline="") as stream:
        rows = list(csv.DictReader(stream))
    with (tmp_path / "ounces.csv").open("w", encoding="utf-8", newline="") as stream:
        writer = csv.DictWriter(stream, rows[0])
        writer.writeheader()
        for row in rows:
            grams = row["mass_g"]
            writer.writerow(row | {"mass_g": f"{round(float(grams) / 28.349523 / 0.005) * 0.005:.3f}" if grams else ""})
    values = tmp_path / "values.json"
    command = ["recording", "fit", str(tmp_path / "ounces.yaml"), "--unknown", "grip", "--output", str(values)]
    ended = CliRunner().invoke(app, command)
    assert ended.exit_code == 2
    text = " ".join(ended.output.split())
    assert "no value is found" in text
    assert "these masses look like ounces; name the column mass_oz" in text
    assert "90 % intervals" not in text
    assert not values.exists()


def test_small_values_of_a_good_rig_raise_no_doubt() -> None:
    recording = with_tilt(1.0)(dose(2))
    assert not fit_doubts(fit_recordings([recording], ("grip",)), [recording])


def test_a_mass_that_never_changes_is_no_wrist_that_is_turned() -> None:
    recording = dose(1)
    still = replace(recording, readings=np.full_like(recording.readings, recording.readings[0]))
    sentence = unlikely([still], fit_recordings([still], ("grip",)))
    assert "the balance or its recording stood still, or nothing reached the receiver" in sentence
    assert "wrist" not in sentence
