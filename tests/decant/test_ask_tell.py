"""`ask_tell`: pours that the caller makes: each is asked for once, and its outcome is told once, also over several
processes.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import decant
from orchestrator.cli.app import main
from orchestrator.learning.deployment.deployment_result import Deployed
from tests.support.waiting import PATIENCE

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.filterwarnings("ignore:not simulated")


def vessel(name: str, radius: float, height: float) -> dict[str, Any]:
    inner = [[0, 0], [radius, 0], [radius, height]]
    return {"name": name, "profile": {"unit": "mm", "inner": inner, "wall": "4 mm", "floor": "4 mm"}}


def campaign() -> decant.CampaignPlan:
    """Four pours at actions that need no simulation."""
    content = {
        "name": "mine",
        "seed": 3,
        "laboratory": {"name": "bench", "mode": "external"},
        "liquid": {"name": "water", "mass": "100 g"},
        "pourer": vessel("beaker", 30, 70),
        "motion": {"hold_time": "0.3 s", "return_velocity": "100 deg/s"},
        "deployment": {
            "strategy": "D2",
            "receiver": vessel("bowl", 60, 50),
            "motion": {"max_angle": "120 deg", "height": "115 mm"},
            "actions": {"angular_velocity": ["30 deg/s", "90 deg/s"], "x_offset": ["95 mm", "115 mm"]},
            "pours": 4,
        },
    }
    return decant.build_campaign(content)


def test_what_was_told_is_what_the_campaign_learns_from(tmp_path: Path) -> None:
    asked = []
    with decant.AskTell(campaign(), tmp_path / "run") as session:
        while (pour := session.ask()) is not None:
            assert session.ask() is pour, "it is asked for until it is told"
            asked.append(pour)
            if pour.number == 3:
                session.fail(pour, "the cup fell over")
            else:
                session.tell(pour, spilled_g=1.5 * pour.number, received_g=95.0, notes={"robot": "mine"})
        assert session.ask() is None
    run = session.run
    assert run is not None
    assert [pour.number for pour in asked] == [1, 2, 3, 4]
    assert len({tuple(pour.settings.items()) for pour in asked}) == 4
    assert all(30.0 <= (pour.settings["angular_velocity_deg_s"] or 0.0) <= 90.0 for pour in asked)
    assert run.pours["spilled_g"].dropna().tolist() == pytest.approx([1.5, 3.0, 6.0])
    assert run.pours["failed"].dropna().tolist() == ["pour_failed: the cup fell over"]
    assert run.summary.mode == "external"
    assert "recommended for bowl" in run._repr_html_()
    assert "angular_velocity" in run._repr_html_()
    pytest.importorskip("pyarrow")
    import pandas as pd

    run.save_tables()
    units = pd.read_parquet(run.directory / "tables" / "pours.parquet").attrs["units"]
    assert (units["angular_velocity_deg_s"], units["spilled_g"], units["seconds"]) == ("deg/s", "g", "s")


@pytest.mark.slow
def test_the_recipe_for_a_robot_of_ones_own_learns_where_it_pours_best(tmp_path: Path) -> None:
    recipe = ROOT / "docs" / "recipes" / "own_robot.py"
    ended = subprocess.run(
        [sys.executable, recipe, tmp_path / "run"], timeout=PATIENCE, check=False, capture_output=True, text=True,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
    )  # fmt: skip
    assert ended.returncode == 0, ended.stderr
    (offset,) = re.findall(r"'x_offset_mm': ([\d.]+)", ended.stdout)
    assert abs(float(offset) - 110.0) < 5.0


@pytest.mark.slow
def test_a_pour_that_nothing_was_told_of_is_never_asked_for_as_a_new_one(tmp_path: Path) -> None:
    left = (
        "import os, tests.decant.test_ask_tell as here, decant, sys\n"
        "pour = decant.AskTell(here.campaign(), sys.argv[1]).ask()\n"
        "print(pour.number, flush=True)\n"
        "os._exit(9)"
    )
    env = {**os.environ, "PYTHONPATH": str(ROOT)}
    killed = subprocess.run(
        [sys.executable, "-c", left, str(tmp_path / "run")],
        env=env, timeout=PATIENCE, check=False, capture_output=True, text=True,
    )  # fmt: skip
    assert (killed.returncode, killed.stdout) == (9, "1\n"), killed.stderr
    with decant.AskTell(campaign(), tmp_path / "run") as session:
        first = session.ask()
        assert first is not None
        assert (first.number, first.unknown) == (1, True)
        session.tell(first, spilled_g=2.0, retained_g=0.5)
        second = session.ask()
        assert second is not None
        assert (second.number, second.unknown) == (2, False)
    with decant.AskTell(campaign(), tmp_path / "run") as session:
        again = session.ask()
        assert again is not None
        assert (again.number, again.unknown, again.settings) == (2, True, second.settings)
        session.fail(again, "nobody knows")
        third = session.ask()
        assert third is not None
        assert third.number == 3
        session.close()
        with pytest.raises(decant.InvalidArgumentError, match="continues it"):
            session.ask()
    run = decant.open_run(tmp_path / "run", campaign())
    assert run.pours["spilled_g"].dropna().tolist() == pytest.approx([2.0])


NOT_MEANT: list[tuple[dict[str, Any], str]] = [
    ({"spilled_g": 0.001, "received_g": 0.098}, r"may be grams, .* or kilograms \(98 g received\).*retained_g=99.9"),
    ({"spilled_g": 1.0, "received_g": 0.098}, "or kilograms"),
    ({"spilled_g": float("nan"), "received_g": 98.0}, "spilled_g: nan is not a finite number; is a value missing"),
    ({"spilled_g": 1.0, "retained_g": np.inf}, "retained_g: inf is not a finite number"),
    ({"spilled_g": "1,5", "received_g": 98.0}, "spilled_g: should be a number such as 12.5, and is '1,5'"),
    ({"spilled_g": None, "received_g": 98.0}, "spilled_g: should be a number"),
    ({"spilled_g": True, "received_g": 98.0}, "spilled_g: should be a number"),
    ({"spilled_g": np.array([1.0, 2.0]), "received_g": 98.0}, r"one number, and is a ndarray of shape \(2,\)"),
]
"""Arguments of `tell`, with 100 g loaded."""


def test_what_can_not_be_is_refused_and_nothing_is_told(tmp_path: Path) -> None:
    with decant.AskTell(campaign(), tmp_path / "run") as session:
        pour = session.ask()
        assert pour is not None
        with pytest.raises(decant.InvalidArgumentError, match="300 g spilled and"):
            session.tell(pour, spilled_g=300.0, received_g=0.0)
        with pytest.raises(decant.InvalidArgumentError, match="either received_g or retained_g"):
            session.tell(pour, spilled_g=3.0)
        with pytest.raises(decant.InvalidArgumentError, match="the pour was to have a load of 100 g"):
            session.tell(pour, spilled_g=3.0, received_g=300.0, loaded_g=310.0)
        for masses, reason in NOT_MEANT:
            with pytest.raises(decant.InvalidArgumentError, match=reason):
                session.tell(pour, **masses)
        session.tell(pour, spilled_g=3.0, received_g=97.4)  # more than was loaded, by the noise of a balance
        with pytest.raises(decant.InvalidArgumentError, match="told once"):
            session.tell(pour, spilled_g=3.0, received_g=96.0)
    with pytest.raises(decant.InvalidArgumentError, match="mode: external"):
        decant.AskTell(decant.load_campaign(decant.shipped("campaigns/quickstart.yaml")))


def test_numbers_of_numpy_and_pandas_are_told_as_they_are(tmp_path: Path) -> None:
    import pandas as pd

    row = pd.DataFrame({"spilled": [1.5], "received": [95]}).iloc[0]
    told: list[dict[str, Any]] = [
        {"spilled_g": np.float64(1.5), "received_g": np.int64(95)},
        {"spilled_g": np.array(1.5), "retained_g": np.float32(3.5)},
        {"spilled_g": row["spilled"], "received_g": row["received"], "loaded_g": pd.Series([100.0])[0]},
        {"spilled_g": 1.234, "retained_g": 98.0},  # little was poured, and a text '1.234' could be misread
    ]
    with decant.AskTell(campaign(), tmp_path / "run") as session:
        for masses in told:
            pour = session.ask()
            assert pour is not None
            session.tell(pour, **masses)
        assert session.ask() is None
    assert session.run is not None
    assert session.run.pours["spilled_g"].tolist() == pytest.approx([1.5, 1.5, 1.5, 1.234])
    assert session.run.pours["retained_g"].tolist() == pytest.approx([3.5, 3.5, 3.5, 98.0])


def test_a_mass_that_was_told_wrongly_is_corrected_and_both_stay_in_the_journal(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    folder = tmp_path / "run"
    with decant.AskTell(campaign(), folder) as session:
        for spilled in (3.0, 60.0, 5.0):
            pour = session.ask()
            assert pour is not None
            if pour.number == 2:
                with pytest.raises(decant.RunError, match="is running this campaign"):
                    decant.correct_pour(folder, 1, spilled_g=2.0, received_g=95.0)
            session.tell(pour, spilled_g=spilled, retained_g=1.0)
        session.ask()
    for number, reason in ((4, "no pour 4 has an outcome"), (2, "don't fit a load")):
        with pytest.raises(decant.InvalidArgumentError, match=reason):
            decant.correct_pour(folder, number, spilled_g=260.0, retained_g=1.0)
    with pytest.raises(decant.InvalidArgumentError, match=r"'6,0' may be 6.0, or the masses 6 and 0"):
        decant.correct_pour(folder, 2, answer="weighed 6,0 1")
    assert decant.correct_pour(folder, 2, spilled_g=6.0, retained_g=1.0, by="Ada")
    with decant.AskTell(campaign(), folder) as session:
        while (pour := session.ask()) is not None:
            session.tell(pour, spilled_g=4.0, retained_g=1.0)
    assert session.run is not None
    result = session.run.result.results["deployment:bowl"]
    assert isinstance(result, Deployed)
    assert [pour.spilled_g for pour in result.pours] == pytest.approx([3.0, 6.0, 5.0, 4.0]), "what it has learned from"
    assert session.run.pours["spilled_g"].tolist() == pytest.approx([3.0, 6.0, 5.0, 4.0])
    remarks = [pour.remark for pour in session.run.summary.outcome.pours_made]
    assert remarks[1] == "corrected by Ada, before: 60 g spilled and 1 g retained"
    journal = (folder / "journal.sqlite").read_bytes()
    assert b"pour.corrected" in journal
    # its result stays now, and the record of the pour is right
    monkeypatch.setattr("sys.argv", ["decant", "runs", "correct", str(folder), "4", "weighed 2.0 1.0"])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code in (0, None)
    assert "pour 4 is corrected; its stage has ended, and its result stays" in capsys.readouterr().out
    assert decant.open_run(folder).pours["spilled_g"].tolist() == pytest.approx([3.0, 6.0, 5.0, 2.0])


def test_no_other_program_pours_in_an_external_laboratory(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    with pytest.raises(decant.LaboratoryError, match="is external: a program makes its pours"):
        decant.run(campaign())
    assert not (tmp_path / "runs").exists()
    (tmp_path / "bench.yaml").write_text("name: bench\nmode: external\nbalance: {placement: manual}\n")
    monkeypatch.setattr("sys.argv", ["decant", "validate", str(tmp_path / "bench.yaml")])
    with pytest.raises(SystemExit) as ended:
        main()
    assert ended.value.code == 2
    assert "an external laboratory has no devices of Decant" in capsys.readouterr().err


ACTION: dict[str, str | float] = {"angular_velocity": "40 deg/s", "x_offset": 100}


@pytest.mark.slow
def test_an_added_pour_is_learned_from_and_is_not_one_of_the_campaigns(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with decant.AskTell(campaign(), folder) as session:
        first = session.ask()
        assert first is not None
        with pytest.raises(decant.RunError, match="is running this campaign"):
            decant.add_pour(folder, ACTION, spilled_g=2.0, received_g=97.0)
        session.tell(first, spilled_g=9.0, received_g=90.0)
    decant.add_pour(folder, ACTION, spilled_g=2.0, received_g=97.0, notes={"by": "Ada"})
    decant.add_pour(folder, ACTION | {"x_offset": "112 mm"}, spilled_g=30.0, received_g=68.0)
    with decant.AskTell(campaign(), folder) as session:
        predicted = []
        while (pour := session.ask()) is not None:
            predicted.append(pour.predicted is not None)
            session.tell(pour, spilled_g=5.0, received_g=94.0)
    # Three weighed pours are enough for a surrogate, whoever made them. The first session may have chosen the second
    # pour before it was closed, and thus before the others were added.
    assert len(predicted) == 3
    assert predicted[1:] == [True, True]
    assert session.run is not None
    pours = session.run.pours
    assert sorted(pours["number"]) == [0, 0, 1, 2, 3, 4]
    assert sorted(pours["spilled_g"].round(3)) == [2.0, 5.0, 5.0, 5.0, 9.0, 30.0]
    with pytest.raises(decant.InvalidArgumentError, match="into bowl has ended"):
        decant.add_pour(folder, ACTION, spilled_g=2.0, received_g=97.0)


def test_an_added_pour_that_does_not_fit_is_refused(tmp_path: Path) -> None:
    folder = tmp_path / "run"
    with decant.AskTell(campaign(), folder) as session:
        session.ask()
    fine = {"spilled_g": 1.0, "received_g": 98.0}
    refused: list[tuple[dict[str, str | float], dict[str, float], str]] = [
        (ACTION | {"x_offset": "300 mm"}, fine, "could not have asked"),
        ({"x_offset": 100}, fine, "lacks angular_velocity"),
        (ACTION | {"height": "50 mm"}, fine, "height was 50 mm, here it is 115 mm"),
        (ACTION, {"spilled_g": 80.0, "retained_g": 80.0}, "don't fit a load"),
        (ACTION, {"spilled_g": 1.0}, "either received_g or retained_g"),
    ]
    for action, weighed, why in refused:
        with pytest.raises(decant.DecantError, match=why):
            decant.add_pour(folder, action, **weighed)  # type: ignore[arg-type]
