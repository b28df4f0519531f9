"""`dose_command`: `decant dose`: predicted amounts, doses in a journal, and refusals before anything moves."""

from __future__ import annotations

import re
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from orchestrator.campaigns.prior_data import read_former_run
from orchestrator.campaigns.shipped import shipped
from orchestrator.cli.app import app
from orchestrator.learning.dispense import Dispensed
from orchestrator.records.run_record import read_result
from tests.support import small_campaign

HARDWARE = shipped("laboratories/ur5e-mettler.yaml")


def decant(*arguments: str) -> Result:
    return CliRunner().invoke(app, list(arguments), catch_exceptions=False)


@pytest.fixture
def campaign(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return small_campaign.write_campaign(tmp_path)


@pytest.mark.slow
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


@pytest.mark.slow
def test_doses_are_poured_weighed_and_recorded(campaign: Path) -> None:
    result = decant("dose", str(campaign), "--amount", "25 g", "--amount", "40 g", "--in-process")
    assert result.exit_code == 0, result.output
    weighed = re.findall(r"dose (\d), (\d+) g: ([\d.]+) g ± [\d.]+ g weighed", result.stdout)
    assert [(number, wanted) for number, wanted, _ in weighed] == [("1", "25"), ("2", "40")]
    for _, wanted, received in weighed:
        assert float(received) == pytest.approx(float(wanted), abs=2.0)
    run = next(Path("runs").iterdir())
    recorded = read_result(run).results["doses"]
    assert isinstance(recorded, Dispensed)
    assert [dose.number for dose in recorded.doses] == [1, 2]
    page = (run / "report.html").read_text(encoding="utf-8")
    assert "2 wanted amounts" in page
    assert "25 g, 40 g" in page
    assert "minimised" not in page.partition("Settings and versions")[0]
    assert "Dose 2: 40 g wanted" in (run / "figures" / "dose-2.svg").read_text(encoding="utf-8")
    assert f"<td>{recorded.doses[1].received_g:.2f}</td>" in re.sub(r"<td[^>]*>", "<td>", page)
    assert [dose.filled for dose in recorded.doses] == [True, False]
    left = recorded.doses[-1].left_g
    assert left == pytest.approx(100.0 - sum(dose.received_g or 0.0 for dose in recorded.doses), abs=4.0)
    assert read_former_run(run).pours == ()

    result = decant("dose", str(campaign), "--amount", "15 g", "--as-left", "--dry-run")
    assert f"source beaker: {left or 0.0:.0f} g, holds enough" in result.stdout


SERIES = small_campaign.series(20, 25, 20, refill_below="40 g")


@pytest.mark.slow
def test_a_campaign_pours_its_series_and_fills_the_source_again(campaign: Path) -> None:
    path = small_campaign.write_campaign(campaign.parent, SERIES)
    result = decant("dose", str(path), "--dry-run")
    assert result.exit_code == 0, result.output
    assert len(re.findall(r"g into A\d: [\d.]+ to [\d.]+ g expected", result.stdout)) == 3
    assert "sources filled 2 times" in result.stdout
    result = decant("run", str(path), "--in-process")
    assert result.exit_code == 0, result.output
    run = next(Path("runs").iterdir())
    recorded = read_result(run).results["doses"]
    assert isinstance(recorded, Dispensed)
    assert [(dose.position, dose.filled) for dose in recorded.doses] == [("A1", True), ("A2", False), ("A3", True)]
    for dose in recorded.doses:
        assert dose.received_g == pytest.approx(dose.wanted_g, abs=2.0)
    page = (run / "report.html").read_text(encoding="utf-8")
    assert "source filled before" in page


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (("refill_below: 40 g", "refill_below: 90 g"), "a full source holds 100 g"),
        (("amount: 25 g", "amount: 0.5 g"), "should be larger than the tolerance"),
        (("position: A2", "place: A2"), "unknown key"),
        (("[{amount: 20 g, position: A1}, {amount: 25 g, position: A2}, {amount: 20 g, position: A3}]", "[]"), "empty"),
    ],
)
def test_an_impossible_series_is_refused(campaign: Path, change: tuple[str, str], text: str) -> None:
    path = small_campaign.write_campaign(campaign.parent, SERIES.replace(*change))
    result = decant("run", str(path))
    assert result.exit_code == 2
    assert text in result.stderr
    assert not Path("runs").exists()


def test_a_balance_that_is_too_slow_for_the_tolerance_is_refused_before_anything_moves(campaign: Path) -> None:
    text = shipped("laboratories/virtual-dosing.yaml").read_text(encoding="utf-8")
    slow = campaign.parent / "slow.yaml"
    slow.write_text(text.replace("interval: 0.1 s", "interval: 2 s"), encoding="utf-8")
    result = decant("dose", str(campaign), "--amount", "25 g", "--laboratory", str(slow))
    assert result.exit_code == 2
    assert "a new reading each 2 s" in result.stderr
    assert "ask for a tolerance of 1.5 g" in result.stderr
    assert not Path("runs").exists()
    series = small_campaign.write_campaign(campaign.parent, SERIES)
    series.write_text(
        re.sub("laboratory: .*", f"laboratory: {slow}", series.read_text(encoding="utf-8")), encoding="utf-8"
    )
    checked = decant("validate", str(series))
    assert checked.exit_code == 2
    assert (checked.output.count("is too slow"), "dispense.doses[0]" in checked.output) == (1, True)


@pytest.mark.parametrize(
    ("bench", "inner", "text"),
    [
        ("doses: formula, liquid: {particles: 400}", "[35, 0], [35, 60], [12, 70]", "no straight cup"),
        ("doses: particles, liquid: {particles: 400}", "[45, 0], [45, 40], [5, 41], [5, 45]", "keeps 60.57 g of 80 g"),
        ("doses: particles, liquid: {particles: 400, lip_adhesion: 1}", "", "runs down the outside of the pourer"),
        ("doses: particles, liquid: {particles: 200}", "", "a dose of 8 g is 20.0 particles of the bench's liquid"),
    ],
)
def test_doses_that_the_bench_cannot_pour_are_refused_before_anything_starts(
    campaign: Path, bench: str, inner: str, text: str
) -> None:
    amounts = small_campaign.series(8 if "particles: 200" in bench else 12, 20).replace("mass: 100 g", "mass: 80 g")
    laboratory = f"laboratory: {{name: small, bench: {{{bench}, time_scale: 0}}}}"
    path = small_campaign.write_campaign(campaign.parent, re.sub("laboratory: .*", laboratory, amounts))
    if inner:
        shape = f"name: flask\nprofile: {{unit: mm, inner: [[0, 0], {inner}], wall: 4 mm, floor: 4 mm}}\n"
        (campaign.parent / "beaker.yaml").write_text(shape, encoding="utf-8")
    checked = decant("validate", str(path))
    assert (checked.exit_code, text in checked.output) == (2, True), checked.output
    assert decant("run", str(path)).exit_code == 2
    assert not Path("runs").exists()


@pytest.mark.parametrize(
    ("change", "text"),
    [
        (("mass: 100 g", "mass: 195 g"), "holds 197.5 g to the brim: fill it with 189.6 g at most"),
        (("x_offset: 70 mm", "x_offset: 40 mm"), "it can't be poured from at this placement: cups touch"),
        (("x_offset: 70 mm", "x_offset: 150 mm"), "from this x_offset no stream can hit 'narrow'"),
        (("height: 60 mm", "height: -60 mm"), "the liquid leaves the lip below the rim of 'narrow'"),
        (("liquid: {particles: 400}", "liquid: {particles: 200}, doses: particles"), "to 300 or more"),
    ],
)
def test_doses_that_cannot_be_poured_are_one_error_before_anything_starts(
    campaign: Path, change: tuple[str, str], text: str
) -> None:
    path = small_campaign.write_campaign(campaign.parent, small_campaign.series(12, 20).replace(*change))
    refused = decant("run", str(path))
    assert refused.exit_code == 2, refused.output
    assert refused.stderr.count(text) == 1, refused.stderr
    assert not Path("runs").exists()


def test_an_amount_is_needed(campaign: Path) -> None:
    result = decant("dose", str(campaign))
    assert result.exit_code == 2
    assert "--amount: name the wanted amount" in result.stderr


@pytest.mark.slow
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
        (("--amount", "150 g"), "a full source holds 100 g"),
        (("--amount", "25 g", "--laboratory", str(shipped("laboratories/virtual.yaml"))), "balance under the receiver"),
    ],
)
def test_bad_input_is_refused_before_anything_is_written(campaign: Path, arguments: tuple[str, ...], text: str) -> None:
    result = decant("dose", str(campaign), *arguments)
    assert result.exit_code == 2
    assert text in result.stderr
    assert not Path("runs").exists()


def test_a_single_dose_of_a_cell_with_several_sources_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    rack, mixtures = str(shipped("laboratories/rack.yaml")), str(shipped("campaigns/mixtures.yaml"))
    result = decant("dose", mixtures, "--amount", "20 g", "--laboratory", rack)
    assert result.exit_code == 2
    assert "'decant run' pours them" in result.stderr
    assert not Path("runs").exists()


def test_a_balance_in_another_place_is_refused_before_anything_is_written(campaign: Path) -> None:
    text = campaign.read_text(encoding="utf-8").replace("on_unknown: repeat\n", "")
    campaign.write_text(text, encoding="utf-8")
    result = decant("dose", str(campaign), "--amount", "25 g", "--laboratory", str(HARDWARE))
    assert result.exit_code == 2
    assert "wanted amounts need a connected balance under the receiver" in result.stderr
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
