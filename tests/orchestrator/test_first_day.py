"""The first day of a rig: its steps, its explanations, and what the command refuses."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from orchestrator.cli.app import app
from orchestrator.recordings import rig_diagnosis
from orchestrator.recordings.first_day import first_day, practice_day
from orchestrator.recordings.recording_file import load_recordings
from orchestrator.recordings.rig_diagnosis import explanations
from orchestrator.shipped import shipped
from sim_engine.errors import InvalidArgumentError
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


@pytest.mark.parametrize("wrong", ["grip", "height"])
def test_onsets_of_different_fills_tell_a_grip_from_a_height(wrong: str) -> None:
    pours = load_recordings([SAMPLES])
    ideal = np.array([rig_diagnosis._ideal_onset(one, 0.0) for one in pours])
    taller = np.array([rig_diagnosis._ideal_onset(one, 2e-3) for one in pours])
    shift = taller - ideal if wrong == "height" else np.full(len(pours), -math.radians(1.0))
    held = (np.array([rig_diagnosis._ideal_onset(one, 1e-3) for one in pours]) - ideal) / 1e-3 / np.cos(ideal)
    usual = rig_diagnosis.LIP + held * rig_diagnosis.HOLD[0]
    found = rig_diagnosis._from_onsets(pours, usual + shift, np.eye(len(pours)) * math.radians(0.05) ** 2)
    assert max(found, key=lambda one: one.evidence).name == wrong
    assert any(one.stands_out for one in found)
    found = rig_diagnosis._from_onsets(pours, usual, np.eye(len(pours)) * math.radians(0.05) ** 2)
    assert not any(one.stands_out for one in found)


@pytest.mark.slow
@pytest.mark.parametrize("wrong", ["lag", "holds", "height"])
def test_a_wrong_quantity_of_the_practice_bench_is_found(wrong: str, tmp_path: Path) -> None:
    day = practice_day(tmp_path, 3, wrong)
    found = explanations(day, day[:9])
    assert next(one.name for one in found if one.stands_out) == wrong


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
