"""`run_figures`: figures say what the strategies' results say, in the units that people read."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.collections import PathCollection
from matplotlib.text import Text

from orchestrator.learning.dispense import Dose, DoseSignals
from orchestrator.reports import figure_style as style
from orchestrator.reports import run_figures as figures_module
from orchestrator.reports.console_view import summary_table
from orchestrator.reports.figure_style import display_value, display_values, log_ticks
from orchestrator.reports.loss_units import loss_unit
from orchestrator.reports.run_figures import (
    DiscrepancyGroup,
    LossSeries,
    calibration_picture,
    deployment_picture,
    discrepancy_groups,
    draw_discrepancy,
    draw_dose,
    draw_figures,
    draw_losses,
    loss_series,
)
from orchestrator.reports.stage_views import evaluation_of
from orchestrator.reports.summarise import summarise
from orchestrator.reports.surrogate_figures import SurrogatePicture, draw_posterior, draw_surrogate, draw_trials
from sim_engine.action import DEG, Action
from sim_engine.outcome import Loss
from sim_engine.search_space import Axis, Space
from tests.support import example_run
from tests.support.example_results import changed, is_picture, shown, strays


@pytest.mark.slow
def test_run_gets_every_figure_that_its_results_allow(results: dict[str, Any], tmp_path: Path) -> None:
    drawn = draw_figures(tmp_path / "figures", example_run.campaign(), results)
    assert set(drawn) == {
        "discrepancy map",
        "test discrepancy",
        "posterior",
        "loss against pours",
        "loss map narrow",
        "uncertainty of the loss narrow",
    }
    assert all(is_picture(path) for path in drawn.values())


@pytest.mark.slow
def test_unfinished_run_gets_the_figures_it_can(results: dict[str, Any], tmp_path: Path) -> None:
    assert draw_figures(tmp_path, example_run.campaign(), {}) == {}
    only_pours = draw_figures(tmp_path, example_run.campaign(), {"narrow cup": results["narrow cup"]})
    assert set(only_pours) == {"loss against pours", "loss map narrow", "uncertainty of the loss narrow"}


@pytest.mark.slow
def test_a_figure_that_fails_does_not_take_the_others_with_it(
    results: dict[str, Any], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "loss-against-pours.png").mkdir()
    drawn = draw_figures(tmp_path, example_run.campaign(), results)
    assert "loss against pours" not in drawn
    assert len(drawn) == 5
    assert "figure 'loss against pours' was not drawn" in caplog.text


def test_discrepancy_map_shows_every_useful_trial_and_theta_in_percent(results: dict[str, Any]) -> None:
    result = results["calibration"]
    picture = calibration_picture(example_run.campaign(), result)
    assert picture is not None
    assert picture.best == result.found.theta.model_dump()
    assert list(picture.costs) == [100 * t.discrepancy for t in result.trials if t.discrepancy is not None]
    assert picture.mean is not None
    assert np.allclose(picture.mean, 100 * np.array(result.found.map.mean))


def in_three_axes(results: dict[str, Any]) -> tuple[Any, Any]:
    """A plan that searches friction too, and what its calibration gave: a map over particles and cohesion."""
    plan = example_run.campaign()
    assert plan.calibration is not None
    box = Space((*example_run.THETA.axes, Axis("friction", 0.0, 0.5)))
    result: Any = results["calibration"]
    trials = [changed(trial, theta={**trial.theta, "friction": 0.1}) for trial in result.trials]
    axes = {"particles": result.found.map.axes["particles"], "friction": np.linspace(0.0, 0.5, 30).tolist()}
    cut = changed(result.found.map, over=("particles", "friction"), held={"cohesion": 0.04}, axes=axes)
    theta = changed(result.found.theta, friction=0.2, cohesion=0.04)
    plan = replace(plan, calibration=replace(plan.calibration, parameters=box))
    return plan, changed(result, trials=trials, found=changed(result.found, map=cut, theta=theta, posterior=None))


def test_map_of_three_parameters_says_where_the_third_was_held_and_marks_theta(results: dict[str, Any]) -> None:
    plan, result = in_three_axes(results)
    picture = calibration_picture(plan, result)
    assert picture is not None
    figure = draw_surrogate(picture)
    said = {text.get_text() for text in figure.findobj(Text)}
    assert "number of particles" in said
    assert "wall friction" in said
    assert any(text.startswith("others at θ*: cohesion 0.04 N/m") for text in said)
    scatters = [c for c in figure.axes[0].collections if isinstance(c, PathCollection)]
    star = next(c for c in scatters if len(c.get_offsets()) == 1 and c.get_sizes()[0] > 300)
    assert star.get_offsets()[0].tolist() == pytest.approx([result.found.theta.particles, 0.2])
    dots = next(c for c in scatters if len(c.get_offsets()) == len(picture.points))
    assert dots.get_offsets()[0].tolist() == pytest.approx([picture.points[0]["particles"], 0.1])


def test_the_notes_of_a_single_map_are_not_on_its_legend(results: dict[str, Any]) -> None:
    picture = calibration_picture(*in_three_axes(results))
    assert picture is not None
    figure = draw_surrogate(replace(picture, deviation=None))
    figure.draw_without_rendering()
    notes = [text for text in figure.findobj(Text) if text.get_text().startswith("others at θ*")]
    (legend,) = figure.legends
    for note in notes:
        assert not any(note.get_window_extent().overlaps(one.get_window_extent()) for one in legend.get_texts())
    assert notes
    assert strays(figure) == []


@pytest.mark.slow
def test_three_parameters_get_their_trials_against_each_of_them_as_well(
    results: dict[str, Any], tmp_path: Path
) -> None:
    plan, result = in_three_axes(results)
    drawn = draw_figures(tmp_path, plan, {"calibration": result})
    assert {name: path.name for name, path in drawn.items()} == {
        "discrepancy map": "discrepancy-map.png",
        "discrepancy trials": "discrepancy-trials.png",
    }
    assert all(is_picture(path) for path in drawn.values())


def test_expected_losses_below_zero_are_shown_as_zero_and_stored_as_they_are(
    results: dict[str, Any],
) -> None:
    plan, learnt = example_run.campaign(), results["narrow cup"]
    deployed = changed(
        learnt,
        recommended=changed(learnt.recommended, predicted_loss=-0.013, predicted_deviation=0.014),
        pours=[
            changed(p, predicted=-0.005, predicted_deviation=0.008, predicted_scatter=0.006, predicted_interval=None)
            for p in learnt.pours
        ],
        map=changed(learnt.map, mean=(np.array(learnt.map.mean) - 0.5).tolist()),
    )
    summary = summarise(plan, {"narrow cup": deployed})
    recommended = summary.outcome.receivers["narrow cup"].recommended
    assert recommended is not None
    assert recommended.predicted_loss == -0.013
    assert "0.00 ± 1.40 %" in shown(summary_table(summary))
    assert "-" not in loss_unit(Loss()).text(-0.013, 0.014)
    (told,) = set(loss_series(plan, {"narrow cup": deployed}, loss_unit(Loss()))[0].predicted)
    assert told == pytest.approx((0.0, 0.0, 0.78), abs=0.01)
    picture = deployment_picture(plan, deployed)
    assert picture is not None
    assert picture.mean is not None
    assert picture.mean.min() == 0.0


def test_receivers_are_called_by_their_own_name_unless_two_share_it(results: dict[str, Any], tmp_path: Path) -> None:
    plan = example_run.campaign()
    assert plan.deployment is not None
    deployed = {"narrow cup": results["narrow cup"]}
    assert draw_figures(tmp_path, plan, deployed)["loss map narrow"].name == "loss-map-narrow.png"
    assert loss_series(plan, deployed, loss_unit(Loss()))[0].receiver == "narrow (D3)"
    text = shown(summary_table(summarise(plan, deployed)))
    assert "narrow " in text
    assert "narrow cup" not in text
    low = replace(example_run.NARROW, name="low", fixed={"height": 0.02})
    twins = replace(plan, deployment=replace(plan.deployment, scenes=(example_run.NARROW, low)))
    assert loss_series(twins, deployed, loss_unit(Loss()))[0].receiver == "narrow cup (D3)"


def test_loss_map_numbers_its_pours_as_the_log_does(results: dict[str, Any]) -> None:
    picture = deployment_picture(example_run.campaign(), results["narrow cup"])
    assert picture is not None
    assert picture.numbers == [1, 2, 3, 4]
    assert picture.best == results["narrow cup"].recommended.action_si


def test_bars_of_the_test_discrepancy_are_the_evaluations_scores(results: dict[str, Any]) -> None:
    scored = changed(results["evaluation"], mean_predictor={"test": 0.2}, regression={"test": 0.1})
    evaluation = evaluation_of({"evaluation": scored})
    assert evaluation is not None
    train, test = discrepancy_groups(evaluation)
    assert (train.pours, test.pours) == (6, 2)
    assert test.calibrated == scored.discrepancy["calibrated"]["test"]
    assert float(np.median(test.random)) == pytest.approx(scored.random_median["test"])
    assert (train.mean_predictor, test.mean_predictor, test.regression) == (None, 0.2, 0.1)


def test_maps_can_be_drawn_for_any_number_of_axes(tmp_path: Path) -> None:
    for dimension in (1, 3):
        space = Space(tuple(Axis(name, 0.0, 1.0) for name in ("cohesion", "friction", "xsph_rate")[:dimension]))
        points = [space.decode([u] * dimension) for u in (0.1, 0.5, 0.9)]
        picture = SurrogatePicture("θ", "|Δ| [%]", space, points, [3.0, 1.0, 2.0], points[1])
        assert is_picture(style.save(draw_surrogate(picture), tmp_path / f"{dimension}.png"))


def test_flat_surrogate_is_drawn_too(tmp_path: Path) -> None:
    flat = np.full((5, 5), 2.0)
    picture = SurrogatePicture("θ", "|Δ| [%]", example_run.THETA, [], [], mean=flat, deviation=flat)
    assert is_picture(style.save(draw_surrogate(picture), tmp_path / "flat.png"))


def test_nothing_to_draw_is_said_not_drawn(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="neither a surrogate nor a single observation"):
        draw_surrogate(SurrogatePicture("θ", "|Δ| [%]", example_run.THETA, [], []))
    with pytest.raises(ValueError, match="no pours"):
        draw_losses([], cost="loss [%]", title="")
    with pytest.raises(ValueError, match="no set of pours"):
        draw_discrepancy([], title="")
    assert not list(tmp_path.iterdir())


def test_best_so_far_never_rises_and_skips_failed_pours() -> None:
    series = LossSeries("cup", [None, 5.0, 7.0, None, 2.0], [None] * 5)
    assert series.best_so_far() == [None, 5.0, 5.0, 5.0, 2.0]


def test_clueless_first_prediction_does_not_squeeze_the_measured_pours(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tops: list[float] = []
    original = figures_module._pour_panel

    def watching(axes: Any, series: LossSeries) -> float:
        tops.append(original(axes, series))
        return tops[-1]

    monkeypatch.setattr(figures_module, "_pour_panel", watching)
    series = LossSeries("cup", [10.0, 5.0, 2.0], [(50.0, 0.0, 850.0), (6.0, 4.0, 8.0), (2.0, 0.0, 4.0)])
    assert is_picture(style.save(draw_losses([series], cost="loss [%]", title=""), tmp_path / "spillage.png"))
    assert tops == [20.0]


def test_receivers_and_predictors_that_are_missing_leave_room_not_errors(tmp_path: Path) -> None:
    failed = LossSeries("cup", [None, None], [None, None])
    assert is_picture(style.save(draw_losses([failed], cost="loss [%]", title="all failed"), tmp_path / "failed.png"))
    alone = DiscrepancyGroup("another receiver", 1, 0.05)
    assert is_picture(style.save(draw_discrepancy([alone], title="θ* alone"), tmp_path / "alone.png"))


def test_a_single_pour_is_drawn_with_its_whole_prediction() -> None:
    one = LossSeries("cup", [0.25], [(2.1, 0.0, 6.7)])
    two = LossSeries("cup", [0.25, 0.2], [(2.1, 0.0, 6.7), (0.5, 0.1, 0.9)])
    shown = [draw_losses([series], cost="loss [%]", title="").axes[0].get_ylim()[1] for series in (one, two)]
    assert shown[0] > 6.7
    assert shown[1] < 1.0  # several measured values remain apart


def test_a_dose_is_drawn_until_its_receiver_is_taken_off_the_balance() -> None:
    """Of a rack: the arm carries the filled cup of 90 g away while the balance is still read."""
    signals = DoseSignals(
        times=(0.0, 1.5, 11.0),
        tilt_deg=(0.0, 47.0, 0.0),
        read_at=(0.0, 0.1, 8.0, 14.0, 14.7, 14.8, 14.9),
        readings_g=(0.0, -9.0, 59.6, 59.6, 4.0, -89.0, 0.0),
    )
    dose = Dose(
        number=2, wanted_g=60.0, received_g=59.6, spilled_g=None, duration_s=14.1, end="reached", signals=signals
    )
    drawn = draw_dose(dose)
    (points,) = (line for line in drawn.axes[0].lines if line.get_label() == "reading")
    assert points.get_ydata() == pytest.approx([0.0, -9.0, 59.6, 59.6])


def test_quantities_are_shown_in_the_units_that_people_type() -> None:
    assert display_value("angular_velocity", 41.2 * DEG) == "41.2 deg/s"
    assert display_value("x_offset", 0.104) == "104 mm"
    assert display_value("cohesion", 0.032) == "0.032 N/m"
    assert display_value("particles", 1840.0) == "1 840"
    assert display_value("hold_time", None) == "until_flow_ends"
    assert display_value("cohesion", None) == "—"
    assert Action(1.0, 0.1, 0.1).display("x_offset", "hold_time") == "x_offset 100 mm  hold_time until_flow_ends"
    assert display_values({"x_offset": 0.104, "friction": 0.1}) == "x offset 104 mm, friction 0.1"


def test_losses_are_shown_in_their_own_unit() -> None:
    assert loss_unit(Loss()).text(0.0123, 0.005) == "1.23 ± 0.50 %"
    assert loss_unit(Loss(name="grams")).text(2.46) == "2.46 g"
    assert loss_unit(Loss(name="particles")).text(17.0) == "17 particles"
    assert "0.5 × retained" in loss_unit(Loss(retained_weight=0.5)).label


def at_the_edges(**changes: Any) -> SurrogatePicture:
    """Observations and the best in the corners of the box."""
    corners = [{"particles": n, "cohesion": c} for n in (500.0, 4000.0) for c in (0.0, 0.1)]
    picture = SurrogatePicture("corners", "loss [%]", example_run.THETA, corners, [1.0, 2.0, 3.0, 4.0], best=corners[3])
    return replace(picture, **changes)


@pytest.mark.parametrize("mapped", [True, False])
def test_what_lies_on_an_edge_of_the_box_is_drawn_whole(mapped: bool) -> None:
    grid = np.linspace(0.0, 1.0, 100).reshape(10, 10)
    numbered = at_the_edges(mean=grid, deviation=grid, numbers=[1, 2, 3, 4], best_name="best action")
    figure = (draw_surrogate if mapped else draw_trials)(numbered)
    assert strays(figure) == []


def test_a_best_action_at_an_end_of_the_box_is_said_to_be_there() -> None:
    grid = np.zeros((5, 5))
    inside = {"particles": 1000.0, "cohesion": 0.05}
    drawn = [
        draw_surrogate(at_the_edges(mean=grid, deviation=grid, best_name="best action")),
        draw_surrogate(at_the_edges(mean=grid, deviation=grid, best=inside)),
    ]
    said = [" ".join(text.get_text() for text in figure.findobj(Text)) for figure in drawn]
    assert "best action has particles at its upper end (4 000) and cohesion at its upper end (0.1 N/m)" in said[0]
    assert "end" not in said[1]


def test_a_note_below_a_single_map_is_as_wide_as_the_figure() -> None:
    grid = np.zeros((5, 5))
    figure = draw_surrogate(at_the_edges(mean=grid, numbers=[1, 2, 3, 4], best_name="recommended action of this bench"))
    assert strays(figure) == []


def test_a_surrogate_that_expects_the_impossible_does_not_stretch_the_colours() -> None:
    grid = np.full((5, 5), 20.0)
    grid[0, 0] = 500.0
    figure = draw_surrogate(at_the_edges(mean=grid, deviation=grid, largest=100.0))
    bars = [axes for axes in figure.axes if axes.get_label() == "<colorbar>"]
    assert [bar.get_ylim()[1] for bar in bars] == pytest.approx([100.0, 100.0])


def test_simulations_stand_beside_the_pours_of_a_loss_map(results: dict[str, Any]) -> None:
    deployed = results["narrow cup"]
    picture = deployment_picture(example_run.campaign(), deployed)
    assert picture is not None
    assert len(picture.simulated) == deployed.simulations - deployed.simulations_lost
    figure = draw_surrogate(picture)
    crosses = [c for c in figure.axes[0].collections if c.get_label() == "simulation"]
    assert [len(c.get_offsets()) for c in crosses] == [len(picture.simulated)]
    assert strays(figure) == []


def test_predictors_that_have_nothing_to_say_get_no_bar_and_no_word() -> None:
    groups = [
        DiscrepancyGroup("training pours", 7, 0.06),
        DiscrepancyGroup("test pours", 3, 0.01, None, [0.02, 0.03], 0.04),
    ]
    figure = draw_discrepancy(groups, title="bars")
    said = [text.get_text() for text in figure.findobj(Text)]
    assert not [text for text in said if "n/a" in text]
    places = [(bar.get_x(), bar.get_x() + bar.get_width()) for bar in figure.axes[0].patches]
    assert len(places) == 4
    assert all(end <= begin for (_, end), (begin, _) in itertools.pairwise(sorted(places)))
    assert strays(figure) == []


def test_ticks_of_a_logarithmic_axis_are_numbers_that_people_read() -> None:
    assert log_ticks(500.0, 1500.0) == [500.0, 700.0, 1000.0, 1500.0]
    assert log_ticks(500.0, 4000.0) == [500.0, 1000.0, 2000.0]
    assert len(log_ticks(250.0, 500.0)) >= 3


def test_the_posterior_has_axes_with_plain_numbers_and_nothing_is_cut(results: dict[str, Any]) -> None:
    result = results["calibration"]
    theta = {**result.found.theta.model_dump(), "particles": 4000.0, "cohesion": 0.0}
    figure = draw_posterior(result.found.posterior, example_run.THETA, theta)
    figure.draw_without_rendering()
    said = [text.get_text() for text in figure.findobj(Text)]
    assert not [text for text in said if "10^" in text]
    assert said.count("draws") == 2
    assert strays(figure) == []
    cloud = figure.axes[2]
    (star,) = [line for line in cloud.lines if line.get_marker() == "*"]
    (place,) = cloud.transData.transform(np.column_stack(star.get_data()))
    assert cloud.bbox.padded(-5).contains(*place)
