"""`first_day`: the first day of a rig: its steps, its explanations, and what the command refuses."""

from __future__ import annotations

import json
import math
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from actors.dosing.cup_flow import flow_of
from actors.dosing.pour_response import PourHypotheses, fall_time, respond
from orchestrator.campaigns.shipped import shipped
from orchestrator.cli.app import app
from orchestrator.recordings import first_day as protocol
from orchestrator.recordings import rig_diagnosis
from orchestrator.recordings.first_day import first_day, practice_day
from orchestrator.recordings.recording_file import PourRecording, load_recordings, write_recording
from orchestrator.recordings.rig_diagnosis import diagnose
from sim_engine.errors import InvalidArgumentError
from sim_engine.liquids import Liquid
from sim_engine.scene import Scene
from sim_engine.vessel.shapes import cylinder

BEAKER = cylinder("beaker", inner_radius=0.040, inner_height=0.100)
SAMPLES = shipped("recordings/dose-1.yaml").parent


def test_the_day_has_ten_pours_with_one_miss_and_five_doses() -> None:
    steps = first_day(BEAKER, 998.0)
    pours = [one for one in steps if one.amount is None]
    assert len(pours) == 10
    assert [one.amount for one in steps if one.amount is not None] == [0.020, 0.020, 0.050, 0.050, 0.100]
    assert [one.name for one in pours if one.misses] == ["10-miss"]
    assert len({one.fill for one in pours if one.name[3:].startswith("slow")}) == 3
    assert all(0.3 < one.angle < math.radians(89) for one in pours)


def test_a_pourer_that_is_too_small_is_refused_with_the_size_it_needs() -> None:
    with pytest.raises(InvalidArgumentError, match="needs one of 179 g"):
        first_day(cylinder("shot", inner_radius=0.02, inner_height=0.05), 998.0)


def _poured(folder: Path, name: str, full: float, tilts: tuple[float, float], grip: float) -> PourRecording:
    """A pour of the tilting-cup equation without a lip, of a cup that is held more tilted than reported [deg]."""
    scene = Scene(name, BEAKER, cylinder("jar", inner_radius=0.05, inner_height=0.1), Liquid(mass=0.5 * full))
    times = np.arange(0.0, 9.0, 0.05)
    angles = np.radians(np.interp(times, [0.0, 4.0, 8.0, 9.0], [tilts[0], tilts[1], tilts[1], 0.0]))
    truth = PourHypotheses(*(np.array([one]) for one in (-math.radians(grip), 1.0, scene.liquid.volume, 0.35, 0.6)))
    at = times[::2]
    shown, _ = respond(flow_of(scene), truth, times, angles, at, fall_time(0.13))
    columns = {
        "tilt_deg": [*zip(times, np.degrees(angles), strict=True)],
        "mass_g": [(float(t), round(1e3 * float(m), 1)) for t, m in zip(at, shown[0], strict=True)],
    }
    path = write_recording(
        folder / f"{name}.yaml",
        scene,
        columns,
        recorded={"how": "computed"},
        placement={"height": "80 mm"},
        balance={"step": "0.1 g"},
    )
    return load_recordings([path])[0]


@pytest.mark.parametrize(("grip", "main"), [(1.2, "grip"), (0.1, None)])
def test_pours_of_three_fills_show_a_grip(
    grip: float, main: str | None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(rig_diagnosis, "TIME_STEP", 0.1)
    monkeypatch.setattr(rig_diagnosis, "FACTORS", ())
    steps = [(0.85, (10.0, 28.0)), (0.55, (40.0, 53.0)), (0.55, (41.0, 53.0)), (0.25, (58.0, 70.0))]
    found = diagnose([_poured(tmp_path, f"0{k}", full, tilts, grip) for k, (full, tilts) in enumerate(steps)])
    values = {one.name: one for one in found.explanations}
    assert (found.main and found.main.name) == main
    assert float(values["grip"].text.split(" deg")[0]) == pytest.approx(grip, abs=0.35)
    assert not values["height"].stands_out


@pytest.mark.slow
def test_a_practice_day_finds_a_higher_rim_and_writes_a_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # four pours and a miss instead of ten, one dose, and coarse steps: seconds instead of a minute
    kept = ("slow-full-1", "slow-low-1", "slow-middle", "calm-1", protocol.MISS)
    monkeypatch.setattr(protocol, "_POURS", tuple(one for one in protocol._POURS if one[0] in kept))
    monkeypatch.setattr(protocol, "DOSES", (0.020,))
    monkeypatch.setattr(protocol, "HOLD", 4.0)
    monkeypatch.setattr(rig_diagnosis, "TIME_STEP", 0.1)
    monkeypatch.setattr(rig_diagnosis, "FACTORS", (30.0,))
    day = tmp_path / "day"
    arguments = [str(day), "--practise", "--wrong", "height", "--seed", "51003", "--particles", "0"]
    result = CliRunner().invoke(app, ["recording", "first-day", *arguments])
    assert result.exit_code == 0, result.output
    document = json.loads((day / "first-day.json").read_text(encoding="utf-8"))
    assert document["main"] == "height"
    assert float(document["explanations"][0]["text"].split(" mm")[0]) == pytest.approx(2.0, abs=0.7)
    (dose,) = document["doses"]
    low, high = dose["interval_g"]  # holds nine of ten doses, and this is one
    assert low - 0.5 <= dose["weighed_g"] <= high + 0.5
    assert document["missed_g"] < 0.5
    page = (day / "first-day.html").read_text(encoding="utf-8")
    assert "Which quantity explains the difference? height: +" in page
    assert "measure the inner height of the pourer" in page


def test_a_day_without_readings_while_pours_flow_is_replayed_but_not_explained(tmp_path: Path) -> None:
    for name in ("dose-1", "dose-2"):
        for one in SAMPLES.glob(f"{name}.*"):
            shutil.copyfile(one, tmp_path / one.name)
    result = CliRunner().invoke(app, ["recording", "first-day", str(tmp_path), "--particles", "0"])
    assert result.exit_code == 0, result.output
    assert "unknown: fewer than 4 pours have readings while they flow" in result.output
    assert (tmp_path / "first-day.html").is_file()


def test_the_gain_of_two_weights_is_the_second(tmp_path: Path) -> None:
    scene = load_recordings([SAMPLES])[0].scene
    columns = {"tilt_deg": [(0.0, 0.0), (1.0, 60.0), (2.0, 0.0)], "mass_g": [(0.0, 0.0), (2.0, 69.09)]}
    path = write_recording(tmp_path / "pour.yaml", scene, columns, recorded={"how": "weighed"}, balance={"zero": "0 g"})
    (recording,) = load_recordings([path])
    assert recording.gain == pytest.approx(0.06909)
    assert not recording.warnings, "nothing is missing between the two"


def test_recordings_of_two_pourers_are_no_day(tmp_path: Path) -> None:
    pours = [replace(load_recordings([SAMPLES])[0], path=tmp_path / f"0{k}-slow.yaml") for k in range(5)]
    narrow = cylinder("other", inner_radius=0.03, inner_height=0.1)
    other = replace(pours[4], scene=replace(pours[4].scene, pourer=narrow))
    with pytest.raises(InvalidArgumentError, match="another pourer"):
        diagnose([*pours[:4], other])


@pytest.mark.slow
@pytest.mark.parametrize(
    ("seed", "wrong", "sign"),
    [(51_000, "lag", 1), (51_001, "holds", 1), (51_007, "grip", -1), (51_008, "height", -1), (51_009, "viscosity", -1)],
)
def test_a_wrong_quantity_of_the_practice_bench_is_found(seed: int, wrong: str, sign: int, tmp_path: Path) -> None:
    found = diagnose(practice_day(tmp_path, seed, wrong, sign))
    assert found.main is not None
    assert found.main.name == wrong
    assert found.describes


@pytest.mark.slow
def test_nothing_stands_out_on_a_practice_bench_in_order(tmp_path: Path) -> None:
    assert diagnose(practice_day(tmp_path, 51_010)).main is None


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["empty"], "has no recorded pour"),
        (["day", "--practise", "--campaign", "x.yaml"], "leave out --campaign"),
        (["day", "--wrong", "grip"], "goes with --practise"),
        (["day", "--practise", "--wrong", "colour"], "known are lag, holds, grip, height, viscosity"),
        (["day", "--lag", "0 s"], "should be above 0"),
        (["day", "--campaign", str(shipped("campaigns/quickstart.yaml"))], "placement: receiver"),
    ],
)
def test_bad_input_is_refused_before_anything_starts(
    arguments: list[str], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    result = CliRunner().invoke(app, ["recording", "first-day", *arguments], catch_exceptions=False)
    assert result.exit_code == 2
    assert message in result.output
    assert not list(tmp_path.glob("day/*"))
