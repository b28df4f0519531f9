"""`recording_file`: recorded pours: their files, what is refused, replay, fit, and export from runs."""

from __future__ import annotations

import contextlib
import functools
import json
import math
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from actors.dosing.cup_flow import CupFlow
from actors.dosing.pour_response import PourHypotheses, displayed, respond
from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.campaigns.shipped import shipped
from orchestrator.campaigns.yaml.yaml_errors import ConfigError
from orchestrator.cli.app import app
from orchestrator.recordings.recording_export import export_recordings
from orchestrator.recordings.recording_file import PourRecording, load_recording, load_recordings
from orchestrator.recordings.recording_fit import Fit, fit_recordings, judge_recording, read_values
from orchestrator.recordings.recording_replay import ReplayValues, replay_recording
from orchestrator.recordings.time_series import arrivals, read_series
from orchestrator.reports.publishing import publish_run
from orchestrator.runs.run_service import RunResources, RunService
from orchestrator.runs.run_tasks import run_task
from sim_engine.hydrostatics import tilting_cup_outflow
from sim_engine.liquids import Liquid, SimulationParameters
from sim_engine.vessel.shapes import cylinder
from sim_engine.vessel.vessel import build_vessel
from tests.support.small_campaign import series, write_campaign
from tests.support.workbooks import workbook

SAMPLES = shipped("recordings/dose-1.yaml").parent
ARRIVALS = Path(__file__).parents[2] / "data" / "balance-arrivals"

HEAD = """\
recorded: {how: test}
pourer: {name: beaker, profile: {unit: mm, inner: [[0, 0], [40, 0], [40, 100]], wall: 3 mm, floor: 3 mm}}
receiver: {name: bowl, profile: {unit: mm, inner: [[0, 0], [50, 0], [50, 60]], wall: 3 mm, floor: 3 mm}}
liquid: {name: water, mass: 300 g}
"""

ROWS = [f"{k / 10:.1f},{min(3 * k, 80)},{180 + max(0, k - 20):.1f}" for k in range(60)]


def decant(*arguments: str) -> Result:
    return CliRunner().invoke(app, ["recording", *arguments], catch_exceptions=False)


def written(folder: Path, rows: list[str], header: str = "time_s,tilt_deg,mass_g", more: str = "") -> Path:
    path = folder / "pour.yaml"
    path.write_text(HEAD + more, encoding="utf-8")
    (folder / "pour.csv").write_text("\n".join([header, *rows]) + "\n", encoding="utf-8")
    return path


def without_tilt(row: str) -> str:
    return f"{row.split(',', maxsplit=1)[0]},,{row.split(',')[2]}"


def changed(line: int, text: str) -> list[str]:
    """The rows with another line of the file, from 2."""
    return [text if number == line else row for number, row in enumerate(ROWS, start=2)]


# ---- files


def test_a_recording_keeps_the_times_of_tilt_and_mass(tmp_path: Path) -> None:
    rows = ["0,0,", "0.04,,181.4", "0.05,0.5,", "0.11,,181.4", "0.10,1,"]
    path = written(tmp_path, [*rows[:3], rows[4], rows[3], "0.2,40,", "0.21,,183.4", "0.3,0,183.6"])
    found = load_recording(path)
    assert found.tilt_times.tolist() == [0.0, 0.05, 0.1, 0.2, 0.3]
    assert found.read_times.tolist() == [0.04, 0.11, 0.21, 0.3]
    assert found.net == pytest.approx([0.0, 0.0, 2e-3, 2.2e-3])
    assert not found.warnings


def test_readings_of_a_few_steps_near_zero_are_no_damage(tmp_path: Path) -> None:
    """A tared balance shows 0.1, 0.6, 0.1 g before anything flows."""
    masses = [0.1, 0.1, 0.6, 0.1, 0.1, *np.linspace(0.1, 60.0, 20).round(1), 60.0, 60.0]
    rows = [f"{0.1 * k:.1f},{min(3.0 * k, 60.0):g},{mass:g}" for k, mass in enumerate(masses)]
    assert load_recording(written(tmp_path, rows)).read_times[2] == pytest.approx(0.2)


@pytest.mark.parametrize(
    ("header", "rows", "message"),
    [
        ("time_s,tilt_deg", [], "pour.csv:1:1: has no column of the mass; name one 'mass_g' or 'mass [unit]'"),
        ("time_s,mass_g", ["0,180", "1,181"], "has no tilt; a recorded pour needs the column tilt_deg"),
        ("time_s,tilt_deg,mass_st", [], "pour.csv:1:17: mass_st: unknown unit 'st'"),
        ("time_s,tilt,mass_g", [], "tilt: has no unit; write 'tilt_deg' or 'tilt [deg]' if that is what is meant"),
        ("time_s,tilt_deg,mas_g", [], "mas_g: unknown column; did you mean 'mass_g'?"),
        ("time_s;tilt_deg;mass_g", [], "pour.csv:2:1: has 1 cell, the header 3 (59 more lines"),
        ("time_s,tilt_deg,mass_g,mass_kg", [], "mass_kg: stands twice in the header (as 'mass_g'); keep one"),
        ("", changed(12, "0.85,30,180"), "pour.csv:12:1: time: the time goes back, from 0.9 s to 0.85 s; sort"),
        ("", changed(12, "0.9,30,180"), "pour.csv:12:5: tilt: the tilt at 0.9 s stands in line 11 already"),
        (
            "",
            changed(12, "1.0,30,nan"),
            "pour.csv:12:8: mass_g: 'nan' is not a number; write it like 12.5; leave",
        ),
        ("", changed(12, "1.0,30"), "pour.csv:12:1: has 2 cells, the header 3"),
        ("", changed(12, "1.0,x,180"), "pour.csv:12:5: tilt_deg: 'x' is not a number"),
        ("", changed(12, ",30,180"), "pour.csv:12:1: time: has no time; give every line its time"),
        ("", changed(12, "1.0,300,180"), "pour.csv:12:5: tilt: the tilt is 300°, beyond 180°"),
        (
            "",
            changed(12, "1.0,30,1800"),
            "pour.csv:12:8: mass: this reading is 1800 g, and those next to it are 180 and 180 g: it was damaged",
        ),
        (
            "",
            [*ROWS[:10], *(f"{k / 10},30,1800" for k in range(10, 20))],
            "pour.csv:12:8: mass: the readings have risen by 1620 g, and the pourer held 300",
        ),
        ("", ["0,0,", "1,30,", "2,,180"], "has fewer than two readings of the mass"),
    ],
)
def test_what_is_no_recording_is_refused_with_its_line(
    tmp_path: Path, header: str, rows: list[str], message: str
) -> None:
    path = written(tmp_path, rows or ROWS, header or "time_s,tilt_deg,mass_g")
    result = CliRunner().invoke(app, ["validate", str(path)])
    assert result.exit_code == 2
    assert message in result.stderr
    assert "Traceback" not in result.stderr


def test_keys_of_the_yaml_file_are_checked_with_their_place(tmp_path: Path) -> None:
    path = written(tmp_path, ROWS, more="placement: {heigth: 80 mm}\nfill_deviation: 1\n")
    with pytest.raises(ConfigError) as error:
        load_recording(path)
    assert "pour.yaml:5:13: placement.heigth: unknown key; did you mean 'height'?" in str(error.value)
    assert "pour.yaml:6:17: fill_deviation: 1 has no unit" in str(error.value)
    path.write_text(HEAD.replace("recorded: {how: test}\n", "series: pour.csv\n"), encoding="utf-8")
    with pytest.raises(ConfigError, match="key 'recorded' is missing"):
        load_recording(path)


@pytest.mark.parametrize(
    ("rows", "line", "message"),
    [
        (
            [*ROWS[:30], *map(without_tilt, ROWS[30:45]), *ROWS[45:]],
            47,
            "no tilt for 1.6 s before this line: the tilt is taken as a straight line",
        ),
        ([*ROWS[:30], *(r.rsplit(",", 1)[0] + "," for r in ROWS[30:45]), *ROWS[45:]], 47, "no mass for 1.6 s before"),
        ([*ROWS[:30], *map(without_tilt, ROWS[30:])], 42, "the tilt ends at 2.9 s"),
        (changed(52, "5.0,80,190"), 52, "the mass falls by 19 g while pouring"),
    ],
)
def test_what_is_unusual_is_a_warning_with_its_line(tmp_path: Path, rows: list[str], line: int, message: str) -> None:
    path = written(tmp_path, rows)
    (warning,) = load_recording(path).warnings
    assert (warning.line, warning.path.name) == (line, "pour.csv")
    assert message in warning.message
    result = CliRunner().invoke(app, ["validate", str(path)])
    assert result.exit_code == 0
    assert message in result.stderr


def test_readings_after_the_last_tilt_are_left_out_and_not_simulated(tmp_path: Path) -> None:
    rows = [*ROWS[:30], *map(without_tilt, ROWS[30:])]
    assert load_recording(written(tmp_path, rows)).read_times[-1] == pytest.approx(3.9)


@pytest.mark.parametrize(
    ("header", "rows", "more"),
    [
        # github.com/Opentrons/opentrons, hardware_testing: seconds since 1970, a weight in one of two columns
        (
            "time,relative-time,grams,unstable-grams,tilt_deg",
            [f"{1.7e9 + k / 10:.3f},{k / 10},{180 + max(0, k - 45)},,{k}" for k in range(60)],
            "columns: {time_s: time, mass_g: grams}\n",
        ),
        # balances behind serial loggers print kilograms (for example with the columns timestamp, weight, unit)
        (
            "time_ms,tilt_rad,mass_kg",
            [f"{100 * k},{math.radians(k)},{0.18 + max(0, k - 45) / 1000}" for k in range(60)],
            "",
        ),
    ],
)
def test_the_clocks_and_units_of_other_programs_are_read(
    tmp_path: Path, header: str, rows: list[str], more: str
) -> None:
    found = load_recording(written(tmp_path, rows, header, more))
    assert found.tilt_times[:3] == pytest.approx([0.0, 0.1, 0.2], abs=1e-6)
    assert found.tilts[-1] == pytest.approx(math.radians(59.0))
    assert found.readings[-1] == pytest.approx(0.194)


TABLE = [["time_s", "tilt_deg", "mass_g"], *([float(cell) for cell in row.split(",")] for row in ROWS)]
EUROPEAN = "\n".join(["time_s;tilt_deg;mass_g", *(row.replace(",", ";").replace(".", ",") for row in ROWS)])


@pytest.mark.parametrize(
    ("content", "note"),
    [
        (EUROPEAN.encode(), "semicolons between cells, decimal commas"),
        (EUROPEAN.replace(";", "\t").encode("utf-16"), "text in UTF-16, tabs between cells, decimal commas"),
        ("\n".join(["# bench 2", "Time [s],Tilt (deg),weight [g]", *ROWS]).encode(), "1 comment line left out"),
        (workbook(TABLE, names=("Pour", "Notes")), "sheet 'Pour', the first of 2"),
    ],
    ids=["Excel in Europe", "Unicode text", "comments and units", "workbook"],
)
def test_a_recording_is_read_in_the_dialects_of_all_tables(tmp_path: Path, content: bytes, note: str) -> None:
    plain = load_recording(written(tmp_path, ROWS))
    (tmp_path / "pour.csv").write_bytes(content)
    read = load_recording(tmp_path / "pour.yaml")
    assert read.tilts.tolist() == plain.tilts.tolist()
    assert read.readings == pytest.approx(plain.readings)
    assert read.read_times.tolist() == plain.read_times.tolist()
    assert note in "\n".join(map(str, read.warnings))


@pytest.mark.parametrize(
    ("content", "message"),
    [
        ("time_s;tilt_deg;mass_g\n0;0;1,180\n1;50;1,191", "pour.csv:2:5: mass_g: '1,180' may be 1.180 or 1180"),
        (workbook(TABLE, hidden=["9"]), "pour.csv:9:1: row 9 is hidden"),
        ("Pour 7\n\n" + "\n".join(["time_s,tilt_deg,mass_g", *ROWS]), "stands above the header, which is in line 3"),
        ("\n".join(["time,tilt,mass", "s,deg,g", *ROWS]), "pour.csv:2:1: has the units of the columns; write them in"),
    ],
    ids=["thousands", "hidden row", "title", "units below"],
)
def test_a_recording_in_doubt_is_refused_with_one_error(tmp_path: Path, content: str | bytes, message: str) -> None:
    written(tmp_path, ROWS)
    (tmp_path / "pour.csv").write_bytes(content.encode() if isinstance(content, str) else content)
    with pytest.raises(ConfigError) as error:
        load_recording(tmp_path / "pour.yaml")
    assert message in str(error.value)
    assert len(error.value.problems) == 1, "one cause, one message"


@pytest.mark.parametrize(
    ("content", "message"),
    [
        # rostopic echo -p, in nanoseconds; PlotJuggler; record.py of UR's RTDE client; an Arduino's plotter
        ("%time,field.tilt,field.weight\n1609060363469351911,0,180\n", "%time: unknown column; did you mean 'time_s'?"),
        ("__time,/arm/tilt_deg,mass_g\n0,0,180\n", "/arm/tilt_deg: unknown column; did you mean 'tilt_deg'?"),
        ("timestamp actual_q_5 mass_g\n0.1 0 180\n", "cells are separated by spaces; save it with commas"),
        ("time_s:0,tilt_deg:0,mass_g:180\n", "time_s:0: unknown column; did you mean 'time_s'?"),
        # tables merged by pandas, a logger that was started again, one that lost its power, one that writes the unit
        (
            "time_s,tilt_deg,mass_g\n0,NaN,180\n",
            "2:3: tilt_deg: 'NaN' is not a number; write it like 12.5; leave the cell",
        ),
        ("time_s,tilt_deg,mass_g\n0,0,180\ntime_s,tilt_deg,mass_g\n", "3:1: time_s: 'time_s' is not a number"),
        ("time_s,tilt_deg,mass_g\n0,0,180\n\0\0\0\0\n", "pour.csv:3:1: has 1 cell, the header 3"),
        ("time_s,tilt_deg,mass_g\n0,0,180 g\n", "2:5: mass_g: '180 g' is not a number"),
    ],
)
def test_tables_of_other_loggers_are_refused_where_they_differ(tmp_path: Path, content: str, message: str) -> None:
    written(tmp_path, ROWS)
    (tmp_path / "pour.csv").write_text(content, encoding="utf-8")
    with pytest.raises(ConfigError) as error:
        load_recording(tmp_path / "pour.yaml")
    assert message in str(error.value)


@pytest.mark.parametrize(
    ("header", "row", "message"),
    [
        # M5Stack MiniScale logger: ISO 8601
        ("Time,tilt_deg,Weight_g", "2025-08-05T12:34:56.789,0,12.3", "write seconds from the start of the recording"),
        # weighing programs log whole seconds since 1970
        ("Time,tilt_deg,Weight_g", "1759000000,0,12.3", "does the clock have whole seconds only?"),
        ("Time,tilt_deg,Weight_g", "1759000000000,0,12.3", "if it is in milliseconds, name the column time_ms"),
    ],
)
def test_the_clocks_of_other_programs_that_have_no_seconds_are_refused(
    tmp_path: Path, header: str, row: str, message: str
) -> None:
    rows = [row] * 3
    if "ms" in message:
        rows = [row.replace("000,0", f"{100 * k:03d},{k}", 1) for k in range(3)]
    path = written(tmp_path, rows, header, "columns: {time_s: Time, mass_g: Weight_g}\n")
    with pytest.raises(ConfigError, match=message.replace("?", r"\?")):
        load_recording(path)


# ---- balances


@pytest.mark.parametrize("number", range(1, 7))
def test_real_arrivals_are_read_with_their_own_times(number: int) -> None:
    """Series of real balances; figures of docs/evidence/recordings.md."""
    series = read_series(ARRIVALS / f"series-{number}.csv", {"time_s": "arrival_s", "mass_g": "weight_g"})
    mass = series.columns["mass"]
    step = 1e-4 if number in (3, 6) else 1e-5
    found = arrivals(mass.times, mass.values, step)
    assert found.interval == pytest.approx([0.091, 0.091, 0.095, 0.093, 0.092, 0.119][number - 1], abs=1e-3)
    assert found.longest == pytest.approx([0.317, 0.216, 0.458, 0.227, 0.229, 0.363][number - 1], abs=1e-3)
    assert found.repeated <= 0.2 * found.rising


def test_repeated_readings_while_the_mass_rises_are_counted() -> None:
    times = np.arange(100) * 0.2
    true = 0.01 * times
    held = true.copy()
    held[1::2] = held[::2]
    assert arrivals(times, np.round(true, 4), 1e-4).repeated == 0
    found = arrivals(times, np.round(held, 4), 1e-4)
    assert found.repeated == pytest.approx(0.5 * found.rising, abs=2)


# ---- model, replay, fit


def test_the_response_follows_the_tilting_cup_equation_and_the_lag() -> None:
    vessel, liquid = build_vessel(cylinder("beaker", inner_radius=0.04, inner_height=0.1)), Liquid(mass=0.3)
    times = np.linspace(0.0, 6.0, 241)
    tilts = np.radians(np.interp(times, [0.0, 2.0, 6.0], [40.0, 56.0, 64.0]))
    one = np.ones(2)
    hypotheses = PourHypotheses(0.0 * one, one, 3e-4 * one, np.array([0.05, 0.5]), one)
    shown, past = respond(CupFlow(vessel, liquid), hypotheses, times, tilts, times, 0.0)
    expected = liquid.density * tilting_cup_outflow(vessel, 3e-4, times, tilts)[-1]
    assert past[:, -1] == pytest.approx(expected, rel=0.03)
    steady = displayed(times, 0.01 * times, times, lag=0.5, lag_shape=0.4)
    assert 0.01 * times[-1] - steady[-1] == pytest.approx(0.01 * 0.5, rel=0.01)
    assert shown[1, -1] < shown[0, -1]


def samples() -> list[PourRecording]:
    return load_recordings([SAMPLES])


@functools.cache
def fitted() -> Fit:
    """Grip and lag on the first three samples."""
    return fit_recordings(samples()[:3], ("grip", "lag"))


def test_a_replay_compares_readings_with_simulation_and_estimator() -> None:
    found = replay_recording(samples()[0], parameters=SimulationParameters(particles=200))
    assert found.recording.gain == pytest.approx(0.0496, abs=2e-4)
    assert found.simulated is not None
    assert found.final_difference == pytest.approx(0.0, abs=0.012)
    assert found.rms == pytest.approx(0.0, abs=0.01)
    assert found.onset is not None
    assert found.simulated_onset is not None
    assert found.simulated_onset.tilt == pytest.approx(found.onset.tilt, abs=math.radians(2.5))
    assert found.estimated.final[1] < found.recording.gain + 5e-4
    assert found.estimated.lag[0] == pytest.approx(0.5, abs=0.15)
    assert 0.7 < found.coverage <= 1.0


def test_a_replay_uses_the_grip_of_its_file() -> None:
    one = samples()[0]
    tilted = replace(one, placement=one.placement.with_values(grip=math.radians(3.0)))
    plain, more = (replay_recording(each, particles=False).estimated.predicted for each in (one, tilted))
    early = slice(None, len(plain) // 3)
    assert more[early].max() > plain[early].max() + 1e-4


def test_a_fit_finds_grip_and_lag_and_predicts_another_pour() -> None:
    """The bench of the samples (benchmarks/recordings.py, seed 21000) has a grip of −0.16° and a lag of 0.53 s."""
    doses = samples()
    found = fitted()
    grip, lag = found["grip"], found["lag"]
    assert grip.low < math.radians(-0.16) < grip.high
    assert lag.value == pytest.approx(0.53, abs=0.08)
    assert lag.identified
    judged = judge_recording(found, doses[3])
    assert not judged.fitted
    assert judged.final[1] < judged.measured_final < judged.final[2]
    assert judged.rms < 2e-3
    assert found.replay_values.fitted_on == ("dose-1", "dose-2", "dose-3")


@pytest.mark.slow
def test_a_grip_and_a_lag_that_are_changed_are_found() -> None:
    doses = [
        replace(one, tilts=one.tilts - math.radians(2.0), read_times=one.read_times + 0.3) for one in samples()[:3]
    ]
    plain, found = fitted(), fit_recordings(doses, ("grip", "lag"))
    assert found["grip"].value - plain["grip"].value == pytest.approx(math.radians(2.0), abs=math.radians(0.6))
    assert found["lag"].value - plain["lag"].value == pytest.approx(0.3, abs=0.1)


@pytest.mark.slow
def test_the_end_of_a_fitted_recording_is_judged_apart_from_its_beginning() -> None:
    one = samples()[1]
    found = fit_recordings([one], ("grip", "lag"), until=5.0)
    judged = judge_recording(found, one)
    assert judged.fitted
    assert judged.times[0] > one.tilt_times[0] + 5.0
    assert judged.final[0] == pytest.approx(one.gain, abs=4e-3)
    with pytest.raises(ValueError, match="all its readings were fitted"):
        judge_recording(fit_recordings([one], ("lag",)), one)
    with pytest.raises(ValueError, match="can't be fitted; known are grip, height, fill, lag"):
        fit_recordings([one], ("gripp",))


# ---- commands and runs


@pytest.mark.slow
def test_fit_and_replay_on_the_command_line(tmp_path: Path) -> None:
    for name in ("dose-1", "dose-2"):
        for suffix in (".yaml", ".csv"):
            shutil.copy(SAMPLES / f"{name}{suffix}", tmp_path)
    first, second, values = tmp_path / "dose-1.yaml", tmp_path / "dose-2.yaml", tmp_path / "fit.json"
    result = decant("fit", str(first), "--judge", str(second), "--output", str(values))
    assert result.exit_code == 0, result.output
    document = json.loads(values.read_text(encoding="utf-8"))
    assert set(document["fitted"]) == {"grip", "lag", "flow"}
    assert document["judged"][0]["recording"] == "dose-2"
    assert "fitted on dose-1" in result.stdout
    assert "predicted, not fitted" in result.stdout
    assert read_values(values).lag == pytest.approx(document["fitted"]["lag"]["value"])
    result = decant("replay", str(second), "--particles", "0", "--fitted", str(values), "--png", str(tmp_path / "p"))
    assert result.exit_code == 0, result.output
    measured, estimate = (
        re.search(pattern, result.stdout) for pattern in (r"([\d.]+) g measured", r"([\d.]+) to ([\d.]+) g at the end")
    )
    assert measured is not None
    assert estimate is not None
    assert float(estimate[1]) - 1.0 <= float(measured[1]) <= float(estimate[2]) + 1.0
    assert "given from dose-1" in result.stdout
    assert "predicted by the simulation" not in result.stdout
    assert (tmp_path / "p" / "dose-2.png").stat().st_size > 20_000


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("replay", "gone.yaml"), "gone.yaml: no such file"),
        (("replay", "empty"), "empty: has no recorded pour (.yaml with a .csv of the same name)"),
        (("replay", "pour.yaml", "--fitted", "pour.csv"), "--fitted: pour.csv is no fit"),
        (("fit", "pour.yaml", "--unknown", "gripp"), "gripp: can't be fitted; known are grip"),
        (("fit", "pour.yaml", "--until", "3"), "--until: "),
        (("fit", "pour.yaml", "--until", "0.2 s"), "has 3 readings in the first 0.2 s; 5 are needed"),
        (("fit", "pour.yaml", "--judge", "pour.yaml"), "--judge: pour.yaml is fitted, too; judge another"),
        (("fit", "pour.yaml", "--output", "fit.txt"), "--output fit.txt: should be a .json file"),
        (("export", "empty"), "empty: is no run; name the folder of a run"),
    ],
)
def test_bad_input_of_the_commands(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, arguments: tuple[str, ...], message: str
) -> None:
    monkeypatch.chdir(tmp_path)
    written(tmp_path, ROWS)
    (tmp_path / "empty").mkdir()
    result = decant(*arguments)
    assert result.exit_code == 2, result.output
    assert message in result.stderr
    assert "Traceback" not in result.stderr


SERIES = series(25, 20, outputs="directory: runs, figures: false, recording: false, pour_recordings: true")


@pytest.mark.slow
async def test_a_run_records_its_doses_and_they_can_be_exported_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DECANT_STATE", str(tmp_path / "state"))
    plan = load_campaign(write_campaign(tmp_path, SERIES))
    resources = RunResources(in_process=True)
    with contextlib.closing(RunService().start(run_task(plan), resources)) as handle:
        await handle.wait()
        publish_run(handle)
    run = next((tmp_path / "runs").iterdir())
    doses = load_recordings([run / "recordings"])
    assert [one.gain for one in doses] == pytest.approx([0.025, 0.020], abs=1.5e-3)
    assert [1e3 * one.scene.liquid.mass for one in doses] == pytest.approx([100.0, 73.0], abs=3.0)
    assert all(len(one.placed) > 20 and one.origin.run and one.scene.pourer.name == "beaker" for one in doses)
    assert not any(one.warnings for one in doses)
    assert all(one.read_times[-1] <= one.tilt_times[-1] for one in doses), "the receiver may have been taken away"
    again, left_out = export_recordings(run, tmp_path / "again")
    assert (len(again), left_out) == (2, [])
    assert load_recording(again[0]).net == pytest.approx(doses[0].net)
    found = replay_recording(doses[0], ReplayValues(), particles=False)
    assert found.estimated.final[0] == pytest.approx(doses[0].gain, abs=1e-3)
