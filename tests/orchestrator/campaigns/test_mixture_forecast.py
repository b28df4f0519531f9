"""`mixture_forecast`: what `validate` answers about mixtures before anything moves."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from orchestrator.campaigns.campaign_checks import check_campaign
from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.campaigns.mixture_forecast import MixtureForecast

CAMPAIGN = """\
name: mix
laboratory: {name: bench, mode: virtual, bench: {liquid: {particles: 400}, operator_time: 60 s}}
pourer: {name: beaker, profile: {unit: mm, inner: [[0, 0], [40, 0], [40, 100]], wall: 4 mm, floor: 4 mm}}
receiver: {name: cup, profile: {unit: mm, inner: [[0, 0], [32, 0], [32, 100]], wall: 3 mm, floor: 3 mm}}
motion: {x_offset: 90 mm, height: 100 mm}
mixtures:
  refill_below: 80 g
  liquids:
    - {name: water, liquid: {name: water, mass: 300 g}}
    - {name: ethanol, liquid: {name: ethanol, mass: 250 g}}
  wanted:
    A1: {water: 100 g, ethanol: 20 g}
    A2: {water: 100 g, ethanol: 20 g}
    A3: {water: 100 g, ethanol: 30 g}
outputs: {directory: runs}
"""


def checked(folder: Path, old: str = "", new: str = "") -> tuple[list[str], str]:
    path = folder / "mix.yaml"
    path.write_text(CAMPAIGN.replace(old, new) if old else CAMPAIGN, encoding="utf-8")
    lines: list[str] = []
    problems = check_campaign(load_campaign(path), tell=lines.append)
    return lines, "\n".join(f"{p.line}:{p.column}: {p.where}: {p.message}" for p in problems)


def test_order_sources_errors_and_duration_are_stated(tmp_path: Path) -> None:
    lines, problems = checked(tmp_path)
    assert problems == ""
    text = "\n".join(lines)
    assert "3 cups, 6 doses, 5 changes of source; first cup: ethanol 20 g, then water 100 g" in text
    assert "water: 300 g in 3 doses; source/water filled twice, 300 g each time; 100 g: " in text
    low, high = map(float, re.findall(r"; 20 g: ([\d.]+) to ([\d.]+) g expected", text)[0])
    assert 17.0 < low < 20.0 < high < 23.0
    share = re.search(r"within ± ([\d.]+) percentage points \(90 %\); the least certain is (\w+) in rack/A", text)
    assert share is not None
    # the error of 20 g of 120 g is about half of its interval: 100 · 2 g / 120 g
    assert 0.2 < float(share[1]) < 3.0
    minutes = re.search(r"duration: (\d+) min", text)
    assert minutes is not None
    assert 6 <= int(minutes[1]) <= 9  # six times 60 s of handling, and 5 to 30 s a dose


def test_an_amount_that_source_and_balance_can_not_support_is_refused_with_one_that_they_can(tmp_path: Path) -> None:
    _, problems = checked(tmp_path, "20 g", "1.05 g")
    match = re.search(
        r"12:33: mixtures.wanted.A1.ethanol: ethanol into rack/A1, rack/A2: .* support ([\d.]+) g", problems
    )
    assert match is not None, problems
    assert float(match[1]) > 1.05
    assert "rack/A3" not in problems


def test_a_cup_that_would_be_open_for_too_long_is_refused(tmp_path: Path) -> None:
    _, problems = checked(tmp_path, "  refill_below", "  max_open: 1 min\n  refill_below")
    assert re.search(r"mixtures.max_open: a cup is open for up to [12]\.\d min; pour fewer liquids", problems)


def test_what_is_expected_does_not_depend_on_the_seed(tmp_path: Path) -> None:
    assert checked(tmp_path, "name: mix", "name: mix\nseed: 1") == checked(tmp_path, "name: mix", "name: mix\nseed: 2")


def test_later_doses_and_a_second_check_cost_no_further_predictions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "mix.yaml"
    rows = "".join(f"    B{i}: {{water: {20 + i} g, ethanol: {20 + i / 2} g}}\n" for i in range(1, 20))
    path.write_text(CAMPAIGN.replace("outputs", rows + "outputs"), encoding="utf-8")
    from orchestrator.campaigns import mixture_forecast

    monkeypatch.setenv("DECANT_CACHE_DIR", str(tmp_path / "cache"))
    monkeypatch.setattr(mixture_forecast, "PREDICTED", 2)
    calls = []
    original = mixture_forecast.predict_dose
    monkeypatch.setattr(mixture_forecast, "predict_dose", lambda *a: calls.append(a) or original(*a))
    said: list[str] = []
    first = MixtureForecast(load_campaign(path), said.append)
    assert said[0] == "predicting the doses of the mixtures, 1 of 4: 20 g of ethanol"
    assert len(said) == len(set(said)) == 4
    assert len(calls) == 4
    assert MixtureForecast(load_campaign(path)).lines() == first.lines()  # also in another process
    assert len(calls) == 4
    path.write_text(
        path.read_text(encoding="utf-8").replace("mixtures:", "mixtures:\n  tolerance: 2 g", 1), encoding="utf-8"
    )
    MixtureForecast(load_campaign(path))
    assert len(calls) == 8


RACK = Path(__file__).parents[3] / "configs" / "laboratories" / "rack.yaml"


def test_vessels_places_and_amounts_that_are_impossible_are_refused_at_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The cup has no empty mass, both sources are too heavy when full, and the balance does not support one amount."""
    monkeypatch.setattr("orchestrator.campaigns.mixture_forecast.PREDICTED", 2)
    text = CAMPAIGN.replace(
        "{name: bench, mode: virtual, bench: {liquid: {particles: 400}, operator_time: 60 s}}", str(RACK)
    )
    text = text.replace("floor: 4 mm}}", "floor: 4 mm}, grip: {mass: 1400 g}}").replace(
        "ethanol: 20 g}\n    A2", "ethanol: 1.01 g}\n    A2"
    )
    path = tmp_path / "mix.yaml"
    path.write_text(text, encoding="utf-8")
    problems = [f"{p.line}: {p.where}: {p.message}" for p in check_campaign(load_campaign(path))]
    assert [problem.partition(";")[0] for problem in problems] == [
        "3: pourer: 'source/water' is too heavy when full: 1700 g without the gripper, and arm.payload is 1600 g",
        "3: pourer: 'source/ethanol' is too heavy when full: 1650 g without the gripper, and arm.payload is 1600 g",
        "4: receiver: 'cup' is carried between places: its vessel file needs its empty mass, 'grip: {mass: 312 g}'",
        problems[3].partition(";")[0],
    ]
    assert re.match(r"12: mixtures.wanted.A1.ethanol: ethanol into rack/A1: .* support ([\d.]+) g", problems[3])


def test_vessels_of_plain_doses_that_can_not_be_carried_are_refused_at_their_own_lines(tmp_path: Path) -> None:
    text = CAMPAIGN.partition("mixtures:")[0].replace("floor: 4 mm}}", "floor: 4 mm}, grip: {mass: 1400 g}}")
    text = re.sub("laboratory: .*", f"laboratory: {RACK.with_name('night.yaml')}", text)
    text += "liquid: {name: water, mass: 350 g}\ndispense: {doses: [{amount: 50 g}], tolerance: 1 g}\non_unknown: ask\n"
    path = tmp_path / "doses.yaml"
    path.write_text(f"{text}outputs: {{directory: runs}}\n", encoding="utf-8")
    problems = [f"{p.line}: {p.where}: {p.message}" for p in check_campaign(load_campaign(path))]
    assert [problem[:40] for problem in problems] == [
        "3: pourer: 'beaker' is too heavy when fu",
        "4: receiver: 'cup' is carried between pl",
    ]


def test_a_source_whose_stream_misses_the_cups_is_refused_with_distances_that_hit(tmp_path: Path) -> None:
    _, problems = checked(tmp_path, "x_offset: 90 mm", "x_offset: 160 mm")
    assert (
        "5:20: motion.x_offset: doses from 'source/water' into 'cup': from this x_offset no stream can hit" in problems
    )
    low, high = map(int, re.findall(r"comes down in it from an x_offset of (\d+) … (\d+) mm", problems)[0])
    assert low < 90 < high < 160


def test_a_source_that_is_not_needed_is_stated(tmp_path: Path) -> None:
    lines, problems = checked(
        tmp_path, "{name: water, mass: 300 g}}", "{name: water, mass: 400 g}, stands: [source/a, source/b]}"
    )
    assert problems == ""
    assert "water: 300 g in 3 doses; source/a filled once, source/b not needed, 400 g each time" in "\n".join(lines)
