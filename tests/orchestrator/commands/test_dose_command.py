"""`decant dose`: predicted amounts, doses in a journal, and refusals before anything moves."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from orchestrator.cli.app import app
from orchestrator.journal.run_record import read_result
from orchestrator.runs.prior_data import read_former_run
from orchestrator.shipped import shipped
from orchestrator.strategies.dispense import Dispensed
from tests.support import small_campaign

HARDWARE = shipped("laboratories/ur5e-mettler.yaml")


def decant(*arguments: str) -> Result:
    return CliRunner().invoke(app, list(arguments), catch_exceptions=False)


@pytest.fixture
def campaign(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return small_campaign.write_campaign(tmp_path)


def test_a_dry_run_predicts_and_pours_nothing(campaign: Path) -> None:
    result = decant("dose", str(campaign), "--amount", "25 g", "--dry-run")
    assert result.exit_code == 0, result.output
    found = re.search(r"25 g: ([\d.]+) to ([\d.]+) g expected", result.stdout)
    assert found is not None
    low, high = map(float, found.groups())
    assert 22.0 < low < high < 28.0
    assert "probability of 100 %" in result.stdout
    assert "spill risk: " in result.stdout
    assert not Path("runs").exists()


def test_doses_are_poured_weighed_and_recorded(campaign: Path) -> None:
    result = decant("dose", str(campaign), "--amount", "25 g", "--amount", "40 g", "--in-process")
    assert result.exit_code == 0, result.output
    weighed = re.findall(r"dose (\d), (\d+) g: ([\d.]+) g weighed", result.stdout)
    assert [(number, wanted) for number, wanted, _ in weighed] == [("1", "25"), ("2", "40")]
    for _, wanted, received in weighed:
        assert float(received) == pytest.approx(float(wanted), abs=2.0)
    run = next(Path("runs").iterdir())
    recorded = read_result(run).results["dose"]
    assert isinstance(recorded, Dispensed)
    assert [dose.number for dose in recorded.doses] == [1, 2]
    page = (run / "report.html").read_text(encoding="utf-8")
    assert "2 wanted amounts" in page
    assert "25 g, 40 g" in page
    assert "minimised" not in page.partition("Settings and versions")[0]
    assert "Dose 2: 40 g wanted" in (run / "figures" / "dose-2.svg").read_text(encoding="utf-8")
    assert f"<td>{recorded.doses[1].received_g:.2f}</td>" in re.sub(r"<td[^>]*>", "<td>", page)
    assert read_former_run(run).pours == ()


def test_the_same_seed_pours_the_same_doses(campaign: Path) -> None:
    lines = [
        [line for line in decant(*command).stdout.splitlines() if line.startswith("dose")]
        for command in 2 * [("dose", str(campaign), "--amount", "25 g", "--seed", "7", "--in-process")]
    ]
    assert lines[0] == lines[1] != []


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (("--amount", "25"), "--amount: "),
        (("--amount", "25 mL"), "--amount: "),
        (("--amount", "0.5 g"), "larger than the tolerance"),
        (("--amount", "25 g", "--receiver", "nowhere"), "there are narrow, tumbler"),
        (("--amount", "150 g"), "the pourer holds 100 g, and 150 g are wanted"),
        (("--amount", "25 g", "--laboratory", str(shipped("laboratories/virtual.yaml"))), "simulated benches only"),
    ],
)
def test_bad_input_is_refused_before_anything_is_written(campaign: Path, arguments: tuple[str, ...], text: str) -> None:
    result = decant("dose", str(campaign), *arguments)
    assert result.exit_code == 2
    assert text in result.stderr
    assert not Path("runs").exists()


def test_hardware_is_refused_before_anything_is_written(campaign: Path) -> None:
    text = campaign.read_text(encoding="utf-8").replace("on_unknown: repeat\n", "")
    campaign.write_text(text, encoding="utf-8")
    result = decant("dose", str(campaign), "--amount", "25 g", "--laboratory", str(HARDWARE))
    assert result.exit_code == 2
    assert "ur5e-mettler has an arm, and wanted amounts are poured on simulated benches only" in result.stderr
    assert not Path("runs").exists()


def test_a_receiver_that_is_too_small_is_refused(campaign: Path) -> None:
    narrow = campaign.parent / "narrow.yaml"
    narrow.write_text(narrow.read_text(encoding="utf-8").replace("90]]", "20]]"), encoding="utf-8")
    result = decant("dose", str(campaign), "--amount", "60 g", "--dry-run")
    assert result.exit_code == 2
    assert "narrow holds" in result.stderr


def test_a_pourer_that_is_no_straight_cup_is_refused(campaign: Path) -> None:
    beaker = campaign.parent / "beaker.yaml"
    beaker.write_text(
        beaker.read_text(encoding="utf-8").replace("[0, 0], [30, 0]", "[0, 0], [20, 0]"), encoding="utf-8"
    )
    result = decant("dose", str(campaign), "--amount", "25 g")
    assert result.exit_code == 2
    assert "no straight cup" in result.stderr
