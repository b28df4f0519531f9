"""`study_statistics`: what a study shows, on results that are made up so that the right numbers are known."""

from __future__ import annotations

import csv
import math
import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.collections import PolyCollection

from orchestrator.learning.calibration.calibration_base import Calibrated, CalibratedTheta, TriedOnAll
from orchestrator.learning.calibration.calibration_scores import ScoredPair, Scores
from orchestrator.learning.deployment.deployment_result import Deployed
from orchestrator.learning.deployment.real_pours import DeploymentRow, PredictionCheck
from orchestrator.learning.stage_result import DisplayedMap
from orchestrator.reports.figure_style import new_figure
from orchestrator.study.calibration_figures import Drawn, draw_calibrations, series_style
from orchestrator.study.deployment_figures import draw_deployments, means
from orchestrator.study.study_file import load_study
from orchestrator.study.study_folder import CellResult, code_now, code_summary, run_folder, write_result
from orchestrator.study.study_page import tables, write_report
from orchestrator.study.study_plan import StudyCell, StudyPlan, cells_of
from orchestrator.study.study_statistics import Estimate, at_pour, effect, estimate, gather, running_least
from orchestrator.study.study_strategies import FinalResult
from sim_engine.liquids import SimulationParameters
from tests.support.example_results import strays
from tests.support.study_files import read, written

FIGURES = ("3b", "3c", "4", "5b", "6", "7", "final")


@pytest.fixture(scope="module")
def study(tmp_path_factory: pytest.TempPathFactory) -> StudyPlan:
    return load_study(written(tmp_path_factory.mktemp("study"), read("quick")))


# Test discrepancies of the two repetitions of each strategy: their means are 10, 2 (C4) and so on [%].
DISCREPANCY = {"": (0.10, 0.10), "C1": (0.03, 0.05), "C2": (0.05, 0.05), "C3": (0.02, 0.04), "C4": (0.01, 0.03)}


def made_up(cell: StudyCell) -> CellResult:
    """A cell's result as the worker would have written it."""
    results: dict[str, Any] = {}
    if cell.kind in ("calibration", "uncalibrated"):
        off = DISCREPANCY[cell.strategy][cell.repetition - 1]
        pairs = [(split, 0.3 + sign * off) for split, sign in (("test", 1), ("test", -1), ("train", 1))]
        results["evaluation"] = Scores(
            simulations=4,
            undefined={"theta": 1},
            discrepancy={"theta": {"test": off, "train": off}},
            random_median={},
            thetas={"theta": SimulationParameters()},
            pairs=tuple(
                ScoredPair(theta="theta", split=split, scene="cup", measured=0.3, simulated=simulated, reason="")
                for split, simulated in [*pairs, ("test", None)]
            ),
        )
    if cell.kind == "calibration":
        flat = tuple(tuple(row) for row in np.full((3, 3), 0.1).tolist())
        found = CalibratedTheta(
            theta=SimulationParameters(particles=700 + 10 * cell.repetition, cohesion=0.04),
            searched=("particles", "cohesion"),
            predicted_discrepancy=0.04,
            predicted_deviation=0.01,
            hyperparameters=None,
            map=DisplayedMap(
                over=("particles", "cohesion"),
                held={},
                axes={"particles": (500.0, 1000.0, 1500.0), "cohesion": (0.0, 0.05, 0.1)},
                mean=flat,
                deviation=flat,
            ),
        )
        trials = tuple(
            TriedOnAll(theta={"particles": 600 + 100 * i, "cohesion": 0.02 * i}, discrepancy=d, defined=4, largest=None)
            for i, d in enumerate((0.2, None, 0.1, 0.3))
        )
        results["calibration"] = Calibrated(
            strategy=cell.strategy, simulations=12, lost=0, undefined=0, training_pours=4, trials=trials, found=found
        )
    if cell.kind == "deployment":
        losses = {"D1": [0.08], "D2": [0.5, 0.2, 0.1], "D3": [0.1, 0.3, 0.05]}[cell.strategy.split("-")[0]]
        off = 0.02 if cell.repetition == 1 else 0.0
        rows = [*(("weighed", loss + off) for loss in losses), ("refused", 1.0)]
        results["deployment:narrow"] = poured(cell.strategy, rows)
    if cell.kind == "final":
        loss = {"D1": 0.09, "D2": 0.2, "D3": 0.06}[cell.strategy.split("-")[0]] + 0.02 * (cell.repetition == 1)
        made = (cell.level, cell.strategy, cell.repetition) != ("large", "D2", 2)
        loss, spillage = (loss, loss / 2) if made else (1.0, 1.0)
        results["final"] = FinalResult(action_si=None, loss=loss, spillage=spillage, made=made, reason="")
    return CellResult(
        results=results,
        simulations=10,
        pours=3,
        cpu_s=36.0,
        seconds=72.0,
        expected=((4, 0.2), (5, 0.3), (6, -0.1)),
        code=code_now(),
    )


def poured(strategy: str, rows: Sequence[tuple[Any, float]]) -> Deployed:
    """A deployment of which only its pours matter."""
    pours = [
        DeploymentRow(
            number=number,
            status=status,
            reason="",
            action={},
            action_si={},
            predicted=None,
            predicted_deviation=None,
            predicted_scatter=None,
            loss=loss,
        )
        for number, (status, loss) in enumerate(rows, start=1)
    ]
    return Deployed(
        strategy=strategy,
        scene="narrow",
        loss="normalised",
        simulations=0,
        simulations_lost=0,
        simulations_refused=0,
        pours=tuple(pours),
        simulated=(),
        former_pours=0,
        refused_pours=1,
        failed_pours=0,
        model_check=PredictionCheck(z_scores=(), alarm=False),
    )


def rows(folder: Path, name: str) -> list[dict[str, str]]:
    with (folder / "report" / f"{name}.csv").open(encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_a_study_of_which_nothing_is_there_yet_has_a_page(study: StudyPlan, tmp_path: Path) -> None:
    page = write_report(study, tmp_path).read_text(encoding="utf-8")
    assert "Unfinished: 0 of 41 cells" in page
    assert "<img" not in page


@pytest.mark.slow
def test_every_figure_is_drawn_with_its_numbers_and_the_page_needs_nothing_else(
    study: StudyPlan, tmp_path: Path
) -> None:
    for cell in cells_of(study):
        run_folder(tmp_path, cell.id).mkdir(parents=True)
        write_result(tmp_path, cell.id, made_up(cell))
    page = write_report(study, tmp_path).read_text(encoding="utf-8")
    for number in FIGURES:
        assert f'id="figure-{number}"' in page
        for suffix in ("png", "svg", "csv"):
            assert (tmp_path / "report" / f"figure-{number}.{suffix}").stat().st_size > 100, f"{number}.{suffix}"
    assert "Unfinished" not in page
    assert not re.search(r'(src|href)="(?!data:)', page), "the page refers to something beside it"
    assert "A repetition resamples the pours" in page
    assert "Student&#39;s t over repetitions" in page
    assert "do not separate" in page or " is better than " in page
    assert "below 5 no difference is tested" in page
    assert "test pours recur between repetitions" in page
    assert "Code: 1 different for" in page

    boxes = {row["strategy"]: row for row in rows(tmp_path, "figure-3b")}
    assert list(boxes) == ["uncalibrated", "C1", "C2", "C3", "C4"]
    assert float(boxes["C4"]["mean_percent"]) == pytest.approx(2.0)
    assert (float(boxes["C4"]["low"]), float(boxes["C4"]["high"])) == pytest.approx((0.0, 2.0 + 12.7062), abs=1e-4)
    assert int(boxes["C4"]["pours"]) == 4, "two defined test pours in each of two repetitions"
    curves = [row for row in rows(tmp_path, "figure-3c") if row["strategy"] == "C3"]
    assert [int(row["simulations"]) for row in curves] == [4, 8, 12, 16]
    assert [float(row["best_percent"]) for row in curves] == pytest.approx([20, 20, 10, 10])
    baseline = next(row for row in rows(tmp_path, "figure-3c") if row["strategy"] == "uncalibrated")
    assert (int(baseline["simulations"]), float(baseline["best_percent"])) == (0, pytest.approx(10.0))
    hybrid = [r for r in rows(tmp_path, "figure-6") if (r["level"], r["strategy"]) == ("large", "D3")]
    assert [float(row["least_%"]) for row in hybrid] == pytest.approx([11, 11, 6])
    planned = [r for r in rows(tmp_path, "figure-6") if (r["level"], r["strategy"]) == ("large", "D1-2")]
    assert [float(row["least_%"]) for row in planned] == pytest.approx([9, 9, 9])
    mean = next(r for r in rows(tmp_path, "figure-5b") if (r["level"], r["strategy"]) == ("small", "D2"))
    assert float(mean["mean_%"]) == pytest.approx(100 * (0.8 / 3 + 0.01)), "a refused pour is none"
    price = [r for r in rows(tmp_path, "figure-7") if r["strategy"] == "D3" and r["seconds_per_pour"] == "90.0"]
    first = next(r for r in price if r["seconds_per_simulation"] == "25.0")
    assert float(first["total_seconds"]) == 4 * 25 + 90


def test_no_two_arms_of_a_figure_look_alike() -> None:
    strategies = ["D1-uncalibrated", "D1-5", "D1-15", "D1-10", "D2", "D2-paper", "D3", "D3-paper"]
    looks = [series_style(strategy, strategies) for strategy in strategies]
    assert len({one.colour for one in looks}) == len(strategies)
    planned = [series_style(strategy, strategies) for strategy in ("D1-5", "D1-10", "D1-15")]
    assert len({one.marker for one in planned}) == len({one.line for one in planned}) == 3, (
        "in print without colours too"
    )
    brightness = [sum(bytes.fromhex(one.colour[1:])) for one in planned]
    assert brightness == sorted(brightness, reverse=True), (
        "darker with more iterations, whatever the order of the strategies"
    )
    for name in ("C4", "D2", "D3"):
        ours, theirs = (
            series_style(name, [name, f"{name}-paper"]),
            series_style(f"{name}-paper", [name, f"{name}-paper"]),
        )
        assert ours.colour != theirs.colour
        assert (theirs.line, theirs.filled, theirs.marker) == ("--", False, ours.marker)
    assert len({series_style(strategy, ["D1-5", "D2", "D3"]).marker for strategy in ("D1-5", "D2", "D3")}) == 3


def test_small_losses_can_be_told_apart_and_none_is_drawn_at_the_floor(study: StudyPlan) -> None:
    found = gather(study, {cell.id: made_up(cell) for cell in cells_of(study)})
    for key in [key for key in found.losses if key.level == "small"]:
        del found.losses[key]
    for key in found.losses:
        if key.strategy == "D3":
            found.losses[key] = [[0.004, 0.0, 0.0], [0.004, 0.0, 0.0]]
    figure = next(one for one in draw_deployments(study, found) if one.number == "6")
    for axes in figure.figure.axes:
        assert axes.get_yscale() == "log"
        (hybrid,) = [line for line in axes.get_lines() if line.get_label() == "D3"]
        assert list(hybrid.get_ydata()) == pytest.approx([0.4, 0.01, 0.01])
    assert "less than 0.01 %" in figure.caption
    assert [row[5] for row in figure.rows if row[2] == "D3"][1] == 0.0, "the numbers are what was measured"


def all_drawn(study: StudyPlan) -> list[Drawn]:
    found = gather(study, {cell.id: made_up(cell) for cell in cells_of(study)})
    return [*draw_calibrations(study, found), *draw_deployments(study, found)]


@pytest.mark.slow
def test_nothing_leaves_a_figure_no_mark_is_cut_and_no_band_fills_a_panel(study: StudyPlan) -> None:
    for one in all_drawn(study):
        assert strays(one.figure) == [], one.number
        assert not [c for c in one.figure.findobj(PolyCollection) if c.get_alpha() is not None], one.number


@pytest.mark.slow
def test_a_panel_says_what_its_bench_is_like(study: StudyPlan) -> None:
    for number in ("5b", ""):
        one = next(one for one in all_drawn(study) if one.number == number)
        titles = [" ".join(axes.get_title(loc="left").split()) for axes in one.figure.axes]
        assert titles[0] == "small mismatch cohesion 0.03, xsph rate 3, friction 0, receiver -2 mm"
        assert titles[1] == "large mismatch cohesion 0.08, xsph rate 12, friction 0.2, receiver -12 mm"
        assert "not how hard it is to pour there" in one.caption


def test_an_interval_that_goes_on_below_the_axis_ends_in_an_arrow(study: StudyPlan) -> None:
    _, axes = new_figure(size=(3, 3))
    kept = means(axes, ["a", "b"], ["D3"], lambda i, _: Estimate(5.0, (1.0, -2.0)[i], 9.0, 3), 0.01)
    assert [row[2] for row in kept] == [[3, 5.0, 1.0, 9.0], [3, 5.0, -2.0, 9.0]], "the numbers are what was measured"
    arrows = [line for line in axes.lines if line.get_marker() == "v"]
    assert [[*line.get_xdata(), *line.get_ydata()] for line in arrows] == [pytest.approx([1.0, 0.01])]
    assert axes.get_yscale() == "log"


def test_an_arm_that_its_first_panel_lacks_is_in_the_legend(study: StudyPlan) -> None:
    found = gather(study, {cell.id: made_up(cell) for cell in cells_of(study)})
    lacking = next(key for key in found.losses if key.strategy == "D3")
    found.losses[lacking] = []
    for one in draw_deployments(study, found):
        if one.number != "7":  # of one level only
            assert "D3" in [text.get_text() for text in one.figure.legends[0].get_texts()], one.number


def test_recommended_actions_are_compared_by_their_own_pours(study: StudyPlan) -> None:
    found = gather(study, {cell.id: made_up(cell) for cell in cells_of(study)})
    known = {table.name: table for table in tables(study, found)}
    final = {tuple(map(str, row[:3])): row for row in known["table-final"].rows}
    assert len(final) == 2 * 1 * 3
    _, _, _, count, loss, spilled, lost = final["small", "narrow", "D3"]
    assert isinstance(loss, Estimate)
    assert isinstance(spilled, Estimate)
    assert (count, loss.mean, spilled.mean, lost) == (2, pytest.approx(7.0), pytest.approx(3.5), "0 of 2")
    _, _, _, _, worst, spilled, lost = final["large", "narrow", "D2"]
    assert isinstance(worst, Estimate)
    assert isinstance(spilled, Estimate)
    assert (worst.mean, spilled.mean, lost) == (pytest.approx(61.0), pytest.approx(55.5), "1 of 2"), "a failure counts"
    rows = [row for row in known["table-effects"].rows if str(row[1]).endswith("of the final action")]
    small = {str(row[0]): row for row in rows if row[2] == "small"}
    assert list(small) == ["D3 − D2", "D3 − D1-2"]
    for compared, difference in (("D3 − D2", -14.0), ("D3 − D1-2", -3.0)):
        one = small[compared][5]
        assert isinstance(one, Estimate)
        assert (one.mean, one.high) == pytest.approx((difference, difference)), "repetitions share their chance"
        assert small[compared][6] == "2 of 2"


def test_a_strategy_of_a_package_is_compared_with_d3_and_with_d2(study: StudyPlan) -> None:
    planned, *others = study.deployments
    with_plugin = replace(study, deployments=(replace(planned, label="Mine"), *others))
    found = gather(study, {cell.id: made_up(cell) for cell in cells_of(study)})
    for of in (found.losses, found.numbers, found.finals):
        for key in [key for key in of if key.strategy == planned.label]:
            of[replace(key, strategy="Mine")] = of.pop(key)
    (effects,) = (table for table in tables(with_plugin, found) if table.name == "table-effects")
    compared = {(str(row[0]), str(row[1]).endswith("final action")) for row in effects.rows}
    assert {(f"Mine − {rival}", final) for rival in ("D3", "D2") for final in (False, True)} <= compared


def test_the_paper_s_budgets_and_findings_are_beside_ours_with_their_source(study: StudyPlan, tmp_path: Path) -> None:
    for cell in cells_of(study):
        run_folder(tmp_path, cell.id).mkdir(parents=True)
        write_result(tmp_path, cell.id, made_up(cell))
    page = write_report(study, tmp_path).read_text(encoding="utf-8")
    beside = {row["of"]: row for row in rows(tmp_path, "table-paper")}
    assert (beside["C4"]["in the paper"], beside["C4"]["here"]) == ("108 simulations", "6 simulations")
    assert beside["D1-2"]["in the paper"] == "5, 10 or 15 iterations, one pour"
    assert (beside["D3"]["repetitions in the paper"], beside["D3"]["repetitions here"]) == ("3", "2")
    assert "Counterpart of figure 6 of Lopez-Guevara et al., CoRL 2017: D2 spilled least into cup 1" in page


def test_the_page_tells_by_how_many_codes_the_cells_were_made(study: StudyPlan) -> None:
    def made_with(code: dict[str, str]) -> CellResult:
        return CellResult(results={}, simulations=0, pours=0, cpu_s=0.0, seconds=0.0, expected=(), code=code)

    old, new = made_with({**code_now(), "solver": "another"}), made_with(code_now())
    text = code_summary({"a": old, "b": new, "c": new})
    assert text.startswith("Code: 2 different for 3 cells: 2 of decant ")
    assert f"solver {code_now()['solver']}" in text
    assert text.endswith("solver another.")


def test_effects_are_differences_within_repetitions() -> None:
    ours, theirs = {1: 0.1, 2: 0.2, 3: 0.3, 5: math.nan}, {1: 0.3, 2: 0.3, 3: 0.5, 4: 9.0, 5: 1.0}
    one = effect(ours, theirs)
    assert one.difference.mean == pytest.approx(-0.5 / 3)
    assert (one.difference.count, one.better, one.probability) == (3, 3, None)
    assert one.difference.high < 0.0, "repetitions differ much more than strategies do within one"
    shifted = {n: 10.0 * n for n in range(8)}
    sure = effect(shifted, {n: value + 1.0 for n, value in shifted.items()})
    assert sure.probability == pytest.approx(2 / 2**8)
    even = effect(shifted, {n: value + (1.0 if n % 2 else -1.0) for n, value in shifted.items()})
    assert even.probability == 1.0


@pytest.mark.slow
def test_half_a_study_shows_what_is_there(study: StudyPlan, tmp_path: Path) -> None:
    for cell in cells_of(study):
        if cell.repetition == 1 and cell.strategy in ("C4", "D2"):
            run_folder(tmp_path, cell.id).mkdir(parents=True)
            write_result(tmp_path, cell.id, made_up(cell))
    page = write_report(study, tmp_path).read_text(encoding="utf-8")
    assert "Unfinished: 6 of 41 cells" in page
    assert all(f'id="figure-{number}"' in page for number in FIGURES)
    only = rows(tmp_path, "figure-3b")[0]
    assert only["low"] == "nan", "one repetition has no interval"


def test_interval_of_known_numbers() -> None:
    rng = np.random.default_rng(1)
    values = rng.normal(5.0, 2.0, 400)
    found = estimate(values.tolist())
    half = 1.96 * values.std() / math.sqrt(400)
    assert found.mean == pytest.approx(values.mean())
    assert found.low == pytest.approx(values.mean() - half, abs=0.03)
    assert found.high == pytest.approx(values.mean() + half, abs=0.03)
    assert estimate([0.2, math.nan, 0.4]).count == 2
    assert math.isnan(estimate([]).mean)
    assert estimate([3.0, 3.0, 3.0]).low == 3.0


@pytest.mark.parametrize("count", [5, 10])
def test_of_a_hundred_intervals_of_few_repetitions_ninety_five_hold_the_true_mean(count: int) -> None:
    studies = np.random.default_rng(3).normal(0.3, 0.05, (3000, count)).tolist()
    found = [estimate(repetitions) for repetitions in studies]
    covered = sum(one.low <= 0.3 <= one.high for one in found) / len(found)
    # standard deviation of the share: 0.004; the percentile bootstrap has .83 and .91
    assert 0.93 < covered < 0.97


def test_interval_of_a_share_ends_where_shares_do_and_keeps_its_mean() -> None:
    few = [0.0, 0.0, 0.3]
    assert estimate(few).low < 0.0, "of numbers that can be anything"
    assert estimate(few, (0.0, 1.0)).low == 0.0
    assert estimate(few, (0.0, 1.0)).high == estimate(few).high
    more = estimate([1.004, 1.001, 1.001], (0.0, 1.0))  # a balance's noise
    assert more.low < more.high == more.mean
    off = effect({1: 1.0, 2: 0.1}, {1: 0.0, 2: 0.0}, (0.0, 1.0)).difference
    assert off.high == 1.0 > off.mean > 0.0 > off.low == -1.0


def test_pours_without_a_loss_and_curves_of_different_lengths() -> None:
    assert running_least([math.nan, 0.3, 0.4, 0.1])[1:] == [0.3, 0.3, 0.1]
    assert at_pour([[0.3], [0.4, 0.2]], 2) == [0.3, 0.2]


def test_only_the_compared_level_enters_the_comparison(study: StudyPlan) -> None:
    results = {cell.id: made_up(cell) for cell in cells_of(study)}
    assert len(gather(study, results).calibrated["C4"].test) == 2
