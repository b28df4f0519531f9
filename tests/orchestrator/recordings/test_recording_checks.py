"""`recording_checks`: recorded pours that cannot be: refused with the likely cause; right ones pass without a word.

The wrong ones are the shipped dose with one column misread, as a person or a program misreads it. Public reports:

- gandalf15/HX711#8, olkal/HX711_ADC#80: a load cell that hangs upside down, whose mass falls when it is loaded
- RobTillaart/HX711#60: a scale that is calibrated in kilograms, where grams are usual
- databrickslabs/tempo#84: logs of several clocks, regularised by filling cells with the value above
"""

from __future__ import annotations

import math
import shutil
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from orchestrator.campaigns.shipped import shipped
from orchestrator.campaigns.yaml.yaml_errors import ConfigError
from orchestrator.recordings.recording_file import PourRecording, load_recording, load_recordings
from orchestrator.recordings.recording_fit import fit_recordings
from tests.orchestrator.recordings.test_recording_file import written

SAMPLES = shipped("recordings/dose-1.yaml").parent


def misread(
    folder: Path,
    *,
    header: str = "time_s,tilt_deg,mass_g",
    time: Callable[[float], float] = float,
    tilt: Callable[[float], float] = float,
    mass: Callable[[float], float] = float,
    filled: bool = False,
    settings: Callable[[str], str] = str,
) -> Path:
    """The shipped dose with other tilts [deg], masses [g] or names of columns; or with filled cells."""
    path = folder / "pour.yaml"
    path.write_text(settings((SAMPLES / "dose-1.yaml").read_text(encoding="utf-8")), encoding="utf-8")
    _, *rows = (SAMPLES / "dose-1.csv").read_text(encoding="utf-8").splitlines()
    lines, above = [header], ["", ""]
    for row in rows:
        moment, *cells = row.split(",")
        changed = [
            f"{change(float(cell)):.7g}" if cell else "" for change, cell in zip((tilt, mass), cells, strict=True)
        ]
        if filled:
            above = [cell or before for cell, before in zip(changed, above, strict=True)]
            changed = above if above[0] else changed
        lines.append(",".join([f"{time(float(moment)):.7g}", *changed]))
    path.with_suffix(".csv").write_text("\n".join(lines) + "\n", encoding="utf-8")
    return path


@pytest.mark.parametrize(
    ("options", "column", "cause"),
    [
        (
            {"tilt": lambda angle: -angle},
            "tilt",
            "these tilts have the other sign",
        ),
        ({"tilt": lambda angle: 90.0 - angle}, "tilt", "these tilts look like angles from the horizontal"),
        ({"tilt": lambda angle: 180.0 - angle}, "tilt", "these tilts look like angles from upside down"),
        ({"tilt": math.radians}, "tilt", "these tilts look like radians; name the column tilt_rad"),
        ({"mass": lambda grams: 1e-3 * grams}, "mass", "these masses look like kilograms"),
        (
            {"mass": lambda grams: 1e-3 * grams, "settings": lambda text: text.replace(", step: 0.1 g", "")},
            "mass",
            "these masses look like kilograms",
        ),
        (
            {"mass": lambda grams: 900.0 - grams},
            "mass",
            "the balance is below the pourer, or its cell hangs upside",
        ),
        ({"header": "time_ms,tilt_deg,mass_g"}, "time", "these times look like seconds; name the column time_s"),
        ({"time": lambda time: time / 60.0}, "time", "these times look like minutes; name the column time_min"),
        ({"time": lambda time: time / 3600.0}, "time", "these times look like hours; name the column time_h"),
        ({"time": lambda time: 1e3 * time}, "time", "if that is in milliseconds, name the column time_ms"),
        ({"filled": True}, "mass", "every line has a mass, and 63 % of them repeat the one before while it rises"),
        (
            {"settings": lambda text: text.replace("mass: 300 g", "mass: 120 g")},
            "mass",
            "are vessel, fill, and the zero of the tilt those of this pour?",
        ),
    ],
)
def test_a_recording_that_cannot_be_is_refused_with_its_likely_cause(
    tmp_path: Path, options: dict[str, Callable[[float], float]], column: str, cause: str
) -> None:
    with pytest.raises(ConfigError) as error:
        load_recording(misread(tmp_path, **options))  # type: ignore[arg-type]
    (problem,) = error.value.problems
    assert problem.where == column
    assert cause in problem.message
    assert problem.line > 1


def test_the_shipped_recordings_pass_without_a_word() -> None:
    recordings = load_recordings([SAMPLES])
    assert len(recordings) == 4
    assert [warning for recording in recordings for warning in recording.warnings] == []


def changed(folder: Path, **options: Callable[[float], float]) -> PourRecording:
    return load_recording(misread(folder, **options))  # type: ignore[arg-type]


def test_what_is_unusual_but_possible_passes(tmp_path: Path) -> None:
    """A grip that is off, a stream that misses in part or wholly with a splash, tilts a little beyond upright."""
    first = 180.0
    assert changed(tmp_path, tilt=lambda angle: angle - 3.0).warnings == ()
    assert changed(tmp_path, tilt=lambda angle: angle + 3.0).warnings == ()
    assert changed(tmp_path, mass=lambda grams: first + 0.4 * (grams - first)).warnings == ()
    assert changed(tmp_path, mass=lambda grams: first + 0.1 * (grams > first + 20.0)).warnings == ()
    poured_out = [f"{k / 10},{min(3 * k, 120)},180" for k in range(120)]
    assert load_recording(written(tmp_path, poured_out)).gain == pytest.approx(0.0), "all of it missed"


def test_a_fast_balance_that_is_read_with_every_tilt_is_not_taken_for_filled_cells(tmp_path: Path) -> None:
    rows = [f"{k / 10},{min(k, 60)},{180 + max(0.0, 1.5 * (k - 45)):.1f}" for k in range(90)]
    assert load_recording(written(tmp_path, rows)).warnings == ()


def test_a_pour_in_which_nothing_flows_can_be_fitted(tmp_path: Path) -> None:
    """Its grip stays at exactly 0, of which the deviation of the lag was a share."""
    for name in ("dose-1.yaml", "dose-1.csv"):
        shutil.copyfile(SAMPLES / name, tmp_path / name)
    still = load_recording(written(tmp_path, [f"{k / 10},{min(k, 20)},180" for k in range(60)]))
    fit = fit_recordings([still], ("grip", "lag"))
    assert {value.name: value.identified for value in fit.values}["grip"] is False


def test_interpolated_readings_are_refused(tmp_path: Path) -> None:
    """danielhrisca/asammdf#1219: an export of signals of several clocks interpolates all of them."""
    given = load_recording(SAMPLES / "dose-1.yaml")
    path = misread(tmp_path)
    masses = 1e3 * np.interp(given.tilt_times, given.read_times, given.readings)
    rows = zip(given.tilt_times, np.degrees(given.tilts), masses, strict=True)
    text = "\n".join(["time_s,tilt_deg,mass_g", *(f"{time},{angle:.3f},{mass:.3f}" for time, angle, mass in rows)])
    path.with_suffix(".csv").write_text(text, encoding="utf-8")
    with pytest.raises(
        ConfigError, match=r"lie between steps of 0\.1 g: cells look filled with the value above, or interpolated"
    ):
        load_recording(path)
