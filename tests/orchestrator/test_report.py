"""Figures and summary say what the strategies' results say, in the units that people read."""

from __future__ import annotations

import io
import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.collections import PathCollection
from matplotlib.text import Text
from rich.console import Console

from actors.protocols import SimulationResult
from orchestrator.report import figures as figures_module
from orchestrator.report import maps as maps_module
from orchestrator.report.campaign import draw_figures
from orchestrator.report.figures import DiscrepancyGroup, PourSeries, draw_discrepancy, draw_spillage
from orchestrator.report.maps import SurrogatePicture, draw_surrogate
from orchestrator.report.results import (
    calibration_picture,
    deployment_picture,
    discrepancy_groups,
    evaluation_of,
    pour_series,
)
from orchestrator.report.scene import _moments, simulation_png
from orchestrator.report.section import place, section
from orchestrator.report.style import display_value, display_values
from orchestrator.report.summary import print_summary, summarise, summary_table, write_summary
from orchestrator.report.units import loss_unit
from orchestrator.strategies.calibration import ContinuousBayesianCalibration
from orchestrator.strategies.deployment_d3 import Hybrid
from orchestrator.strategies.design import MeasuredPour
from orchestrator.strategies.evaluation import Evaluation, ScoredPour, random_parameters
from sim_engine.action import DEG, Action
from sim_engine.liquid import SimulationParameters
from sim_engine.losses import Loss
from sim_engine.motion import plan_motion
from sim_engine.space import Axis, Space
from sim_engine.vessel.build import build_vessel
from tests.orchestrator import watched


def spilled(action: Action, parameters: SimulationParameters) -> float:
    """Least at 60 deg/s and 110 mm; cohesion spills."""
    miss = ((action.angular_velocity - 60 * DEG) / DEG / 100) ** 2 + ((action.x_offset - 0.11) / 0.05) ** 2
    return min(0.02 + 0.3 * miss + 2.0 * abs(parameters.cohesion - 0.02), 0.9)


@pytest.fixture(scope="module")
def results() -> dict[str, dict[str, Any]]:
    """Results of the real strategies, in a world whose spillage is a formula."""
    plan = watched.campaign(pours=4)
    assert plan.calibration is not None
    assert plan.deployment is not None
    rng = np.random.default_rng(3)
    pours = []
    for number in range(8):
        values = watched.ACTIONS.draw(rng)
        action = Action(height=0.05, **values)
        split = "test" if number >= 6 else "train"
        pours.append(MeasuredPour(action, spilled(action, SimulationParameters()), 0.98, split))
    calibrated = watched.played(ContinuousBayesianCalibration(_with_height(plan.calibration), pours, 1), spilled)
    thetas = {"calibrated": SimulationParameters.model_validate(calibrated["theta"])}
    thetas |= random_parameters(watched.THETA, {}, 3, 2)
    evaluated = watched.played(Evaluation(thetas, [ScoredPour("tumbler", pour) for pour in pours], 3), spilled)
    poured = watched.played(Hybrid(plan.deployment, watched.NARROW, SimulationParameters(), 4), spilled)
    return {"calibration": calibrated, "evaluation": evaluated, "narrow cup": poured}


def _with_height(plan: Any) -> Any:
    return replace(plan, scene=replace(plan.scene, fixed={"height": 0.05}))


def shown(renderable: Any) -> str:
    """What the terminal would show, 160 columns wide."""
    console = Console(file=io.StringIO(), width=160)
    console.print(renderable)
    return console.file.getvalue()  # type: ignore[attr-defined, no-any-return]


def is_picture(path: Path) -> bool:
    """A PNG with something on it."""
    from matplotlib.image import imread

    pixels = imread(path)
    return path.suffix == ".png" and pixels.shape[0] > 300 and len(np.unique(pixels[::7, ::7, :3])) > 20


# -- figures of a campaign ---------------------------------------------------------------------------------------------


def test_run_gets_every_figure_that_its_results_allow(results: dict[str, dict[str, Any]], tmp_path: Path) -> None:
    drawn = draw_figures(tmp_path / "figures", watched.campaign(), results)
    assert set(drawn) == {"discrepancy map", "test discrepancy", "spillage against pours", "loss map narrow"}
    assert all(is_picture(path) for path in drawn.values())


def test_unfinished_run_gets_the_figures_it_can(results: dict[str, dict[str, Any]], tmp_path: Path) -> None:
    assert draw_figures(tmp_path, watched.campaign(), {}) == {}
    only_pours = draw_figures(tmp_path, watched.campaign(), {"narrow cup": results["narrow cup"]})
    assert set(only_pours) == {"spillage against pours", "loss map narrow"}


def test_a_figure_that_fails_does_not_take_the_others_with_it(
    results: dict[str, dict[str, Any]], tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    (tmp_path / "spillage.png").mkdir()
    drawn = draw_figures(tmp_path, watched.campaign(), results)
    assert "spillage against pours" not in drawn
    assert len(drawn) == 3
    assert "figure 'spillage against pours' was not drawn" in caplog.text


def test_discrepancy_map_shows_every_useful_trial_and_theta_in_percent(results: dict[str, dict[str, Any]]) -> None:
    result = results["calibration"]
    picture = calibration_picture(watched.campaign(), result)
    assert picture is not None
    assert picture.best == result["theta"]
    assert list(picture.costs) == [100 * t["discrepancy"] for t in result["trials"] if t["discrepancy"] is not None]
    assert picture.mean is not None
    assert np.allclose(picture.mean, 100 * np.array(result["map"]["mean"]))


def in_three_axes(results: dict[str, dict[str, Any]]) -> tuple[Any, dict[str, Any]]:
    """A plan that searches friction too, and what its calibration gave: a map over particles and cohesion."""
    plan = watched.campaign()
    assert plan.calibration is not None
    box = Space((*watched.THETA.axes, Axis("friction", 0.0, 0.5)))
    result = results["calibration"]
    trials = [{**t, "theta": {**t["theta"], "friction": 0.1}} for t in result["trials"]]
    cut = {**result["map"], "over": ["particles", "friction"], "held": {"cohesion": 0.04}}
    cut["axes"] = {"particles": cut["axes"]["particles"], "friction": list(np.linspace(0.0, 0.5, 30))}
    theta = {**result["theta"], "friction": 0.2, "cohesion": 0.04}
    plan = replace(plan, calibration=replace(plan.calibration, parameters=box))
    return plan, {**result, "trials": trials, "map": cut, "theta": theta}


def test_map_of_three_parameters_says_where_the_third_was_held_and_marks_theta(
    results: dict[str, dict[str, Any]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan, result = in_three_axes(results)
    drawn: list[Any] = []
    monkeypatch.setattr(maps_module.style, "save", lambda figure, path: drawn.append(figure) or path)
    picture = calibration_picture(plan, result)
    assert picture is not None
    draw_surrogate(tmp_path / "map.png", picture)
    said = {text.get_text() for text in drawn[0].findobj(Text)}
    assert "number of particles" in said
    assert "wall friction" in said
    assert any(text.startswith("others at θ*: cohesion 0.04 N/m") for text in said)
    scatters = [c for c in drawn[0].axes[0].collections if isinstance(c, PathCollection)]
    star = next(c for c in scatters if len(c.get_offsets()) == 1 and c.get_sizes()[0] > 300)
    assert star.get_offsets()[0].tolist() == pytest.approx([result["theta"]["particles"], 0.2])
    dots = next(c for c in scatters if len(c.get_offsets()) == len(picture.points))
    assert dots.get_offsets()[0].tolist() == pytest.approx([picture.points[0]["particles"], 0.1])


def test_three_parameters_get_their_trials_against_each_of_them_as_well(
    results: dict[str, dict[str, Any]], tmp_path: Path
) -> None:
    plan, result = in_three_axes(results)
    drawn = draw_figures(tmp_path, plan, {"calibration": result})
    assert {name: path.name for name, path in drawn.items()} == {
        "discrepancy map": "discrepancy-map.png",
        "discrepancy trials": "discrepancy-trials.png",
    }
    assert all(is_picture(path) for path in drawn.values())


def test_expected_losses_below_zero_are_shown_as_zero_and_stored_as_they_are(
    results: dict[str, dict[str, Any]],
) -> None:
    plan, deployed = watched.campaign(), dict(results["narrow cup"])
    deployed |= {"predicted_loss": -0.013, "predicted_deviation": 0.014}
    deployed["pours"] = [{**p, "predicted": -0.02, "predicted_deviation": 0.01} for p in deployed["pours"]]
    deployed["map"] = {**deployed["map"], "mean": (np.array(deployed["map"]["mean"]) - 0.5).tolist()}
    summary = summarise(plan, {"narrow cup": deployed})
    assert summary["receivers"]["narrow cup"]["predicted_loss"] == -0.013
    assert "0.00 ± 1.40 %" in shown(summary_table(plan, summary))
    assert "-" not in loss_unit(Loss()).text(-0.013, 0.014)
    assert pour_series(plan, {"narrow cup": deployed}, loss_unit(Loss()))[0].predicted == [(0.0, 1.0)] * 4
    picture = deployment_picture(plan, deployed)
    assert picture is not None
    assert picture.mean is not None
    assert picture.mean.min() == 0.0


def test_receivers_are_called_by_their_own_name_unless_two_share_it(
    results: dict[str, dict[str, Any]], tmp_path: Path
) -> None:
    plan = watched.campaign()
    assert plan.deployment is not None
    deployed = {"narrow cup": results["narrow cup"]}
    assert draw_figures(tmp_path, plan, deployed)["loss map narrow"].name == "loss-map-narrow.png"
    assert pour_series(plan, deployed, loss_unit(Loss()))[0].receiver == "narrow (D3)"
    text = shown(summary_table(plan, summarise(plan, deployed)))
    assert "narrow " in text
    assert "narrow cup" not in text
    low = replace(watched.NARROW, name="low", fixed={"height": 0.02})
    twins = replace(plan, deployment=replace(plan.deployment, scenes=(watched.NARROW, low)))
    assert pour_series(twins, deployed, loss_unit(Loss()))[0].receiver == "narrow cup (D3)"


def test_loss_map_numbers_its_pours_as_the_log_does(results: dict[str, dict[str, Any]]) -> None:
    picture = deployment_picture(watched.campaign(), results["narrow cup"])
    assert picture is not None
    assert picture.numbers == [1, 2, 3, 4]
    assert picture.best == results["narrow cup"]["action_si"]


def test_bars_of_the_test_discrepancy_are_the_evaluations_scores(results: dict[str, dict[str, Any]]) -> None:
    evaluation = evaluation_of(results)
    assert evaluation is not None
    train, test = discrepancy_groups(evaluation, {"test": {"mean_predictor": 0.2, "regression": 0.1}})
    assert (train.pours, test.pours) == (6, 2)
    assert test.calibrated == results["evaluation"]["discrepancy"]["calibrated"]["test"]
    assert float(np.median(test.random)) == pytest.approx(results["evaluation"]["random_median"]["test"])
    assert (train.mean_predictor, test.mean_predictor, test.regression) == (None, 0.2, 0.1)


def test_maps_can_be_drawn_for_any_number_of_axes(tmp_path: Path) -> None:
    for dimension in (1, 3):
        space = Space(tuple(Axis(name, 0.0, 1.0) for name in ("cohesion", "friction", "viscosity")[:dimension]))
        points = [space.decode([u] * dimension) for u in (0.1, 0.5, 0.9)]
        picture = SurrogatePicture("θ", "|Δ| [%]", space, points, [3.0, 1.0, 2.0], points[1])
        assert is_picture(draw_surrogate(tmp_path / f"{dimension}.png", picture))


def test_flat_surrogate_is_drawn_too(tmp_path: Path) -> None:
    flat = np.full((5, 5), 2.0)
    picture = SurrogatePicture("θ", "|Δ| [%]", watched.THETA, [], [], mean=flat, deviation=flat)
    assert is_picture(draw_surrogate(tmp_path / "flat.png", picture))


def test_nothing_to_draw_is_said_not_drawn(tmp_path: Path) -> None:
    with pytest.raises(ValueError, match="neither a surrogate nor a single observation"):
        draw_surrogate(tmp_path / "a.png", SurrogatePicture("θ", "|Δ| [%]", watched.THETA, [], []))
    with pytest.raises(ValueError, match="no pours"):
        draw_spillage(tmp_path / "b.png", [], cost="loss [%]", title="")
    with pytest.raises(ValueError, match="no set of pours"):
        draw_discrepancy(tmp_path / "c.png", [], title="")
    assert not list(tmp_path.iterdir())


def test_best_so_far_never_rises_and_skips_failed_pours() -> None:
    series = PourSeries("cup", [None, 5.0, 7.0, None, 2.0], [None] * 5)
    assert series.best_so_far() == [None, 5.0, 5.0, 5.0, 2.0]


def test_clueless_first_prediction_does_not_squeeze_the_measured_pours(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    tops: list[float] = []
    original = figures_module._pour_panel

    def watching(axes: Any, series: PourSeries) -> float:
        tops.append(original(axes, series))
        return tops[-1]

    monkeypatch.setattr(figures_module, "_pour_panel", watching)
    series = PourSeries("cup", [10.0, 5.0, 2.0], [(50.0, 400.0), (6.0, 1.0), (2.0, 1.0)])
    assert is_picture(draw_spillage(tmp_path / "spillage.png", [series], cost="loss [%]", title=""))
    assert tops == [20.0]


def test_receivers_and_predictors_that_are_missing_leave_room_not_errors(tmp_path: Path) -> None:
    failed = PourSeries("cup", [None, None], [None, None])
    assert is_picture(draw_spillage(tmp_path / "failed.png", [failed], cost="loss [%]", title="all failed"))
    alone = DiscrepancyGroup("another receiver", 1, 0.05)
    assert is_picture(draw_discrepancy(tmp_path / "alone.png", [alone], title="θ* alone"))


# -- units -------------------------------------------------------------------------------------------------------------


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
    assert loss_unit(Loss("grams")).text(2.46) == "2.46 g"
    assert loss_unit(Loss("particles")).text(17.0) == "17 particles"
    assert "0.5 × retained" in loss_unit(Loss(retained_weight=0.5)).label


# -- summary -----------------------------------------------------------------------------------------------------------


def test_summary_tells_theta_discrepancies_losses_actions_and_files(
    results: dict[str, dict[str, Any]], tmp_path: Path
) -> None:
    plan = watched.campaign()
    baselines = {"test": {"mean_predictor": 0.1234, "regression": None}}
    figures = {"spillage against pours": tmp_path / "spillage.png"}
    summary = summarise(
        plan,
        results,
        figures=figures,
        recording=tmp_path / "campaign.rrd",
        baselines=baselines,
        totals={"simulations": 60},
    )
    deployed = results["narrow cup"]
    losses = [pour["loss"] for pour in deployed["pours"]]
    receiver = summary["receivers"]["narrow cup"]
    assert summary["theta"] == results["calibration"]["theta"]
    assert summary["simulations"] == 60
    assert summary["discrepancy"]["test"]["calibrated"] == results["evaluation"]["discrepancy"]["calibrated"]["test"]
    assert summary["discrepancy"]["test"]["random_theta"] == results["evaluation"]["random_median"]["test"]
    assert (receiver["first_loss"], receiver["best_loss"]) == (losses[0], min(losses))
    assert receiver["best_pour"] == 1 + losses.index(min(losses))
    assert receiver["best_action"] == deployed["action"]

    text = shown(summary_table(plan, summary))
    assert display_value("particles", summary["theta"]["particles"]) in text
    assert "12.34" in text
    assert f"{100 * min(losses):.2f} % (pour {receiver['best_pour']})" in text
    assert display_values(deployed["action_si"]) in text
    assert "campaign.rrd" in text


def test_summary_file_reads_back_as_what_was_summarised(results: dict[str, dict[str, Any]], tmp_path: Path) -> None:
    summary = summarise(watched.campaign(), results)
    path = write_summary(tmp_path / "run", summary)
    assert path.name == "summary.json"
    assert json.loads(path.read_text(encoding="utf-8")) == summary
    assert [p.name for p in path.parent.iterdir()] == ["summary.json"]


def test_summary_warns_of_an_untrustworthy_simulator_failed_pours_and_dropped_events(
    results: dict[str, dict[str, Any]],
) -> None:
    poured = {**results["narrow cup"], "failed_pours": 2, "trust": {"z_scores": [9.0, 9.0, 9.0], "alarm": True}}
    plan = watched.campaign()
    text = shown(summary_table(plan, summarise(plan, {"narrow cup": poured}, dropped_events=12)))
    assert "the simulator may not fit this vessel" in text
    assert "2 pour(s) failed" in text
    assert "lacks 12 events" in text


def test_planning_alone_shows_no_columns_about_pours_and_no_empty_table(results: dict[str, dict[str, Any]]) -> None:
    plan = watched.campaign()
    planned = {**results["narrow cup"], "strategy": "D1", "pours": []}
    nothing = {split: {"mean_predictor": None, "regression": None} for split in ("train", "test", "transfer")}
    text = shown(summary_table(plan, summarise(plan, {"narrow cup": planned}, baselines=nothing)))
    assert "best expected" in text
    assert display_values(planned["action_si"]) in text
    for absent in ("pours", "first", "best measured", "mean |measured", "—"):
        assert absent not in text
    fruitless = {**planned, "predicted_loss": None, "action_si": None}
    text = shown(summary_table(plan, summarise(plan, {"narrow cup": fruitless})))
    assert "best expected" not in text
    assert "narrow: nothing was learnt" in text


def test_table_in_a_log_file_breaks_neither_paths_nor_rows(
    results: dict[str, dict[str, Any]], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "60")
    plan = watched.campaign()
    recording = Path("/laboratory") / "a-folder-with-a-rather-long-name" / ("x" * 120) / "campaign.rrd"
    summary = summarise(plan, {"narrow cup": results["narrow cup"]}, recording=recording)
    print_summary(plan, summary)
    lines = capsys.readouterr().err.splitlines()
    assert any(line.endswith(str(recording)) for line in lines)
    action = display_values(results["narrow cup"]["action_si"])
    assert any("narrow" in line and "D3" in line and action in line for line in lines)


def test_run_that_was_stopped_at_once_has_a_summary_too() -> None:
    plan = watched.campaign()
    summary = summarise(plan, {})
    assert (summary["theta"], summary["receivers"]) == (None, {})
    assert "narrow-cup" in shown(summary_table(plan, summary))


# -- one simulated pour ------------------------------------------------------------------------------------------------


def test_simulated_pour_is_drawn_with_its_vessels_and_particles(tmp_path: Path) -> None:
    task, result = watched.simulation()
    assert is_picture(simulation_png(tmp_path / "pour.png", task, result))


def test_pour_that_keeps_everything_in_the_pourer_is_drawn(tmp_path: Path) -> None:
    task, result = watched.simulation()
    frames = result.frames
    assert frames is not None
    for states in frames.states:
        states[:] = 0
    assert is_picture(simulation_png(tmp_path / "nothing.png", task, result))


def test_snapshots_show_the_flow_from_its_beginning_to_its_end() -> None:
    times = np.linspace(0.0, 10.0, 101)
    left = np.clip((times - 6.0) / 2.0, 0.0, 0.9)  # flows from 6 s to 7.8 s
    shares = np.column_stack([1.0 - left, 0 * left, left, 0 * left, 0 * left])
    assert times[_moments(times, shares, 4)] == pytest.approx([6.3, 6.9, 7.5, 10.0])
    shares[:, 0] = 1.0  # nothing leaves: evenly spread
    assert times[_moments(times, shares, 4)] == pytest.approx([0.0, 3.3, 6.7, 10.0])
    assert len(_moments(times[:1], shares[:1], 4)) == 4


def test_simulation_without_frames_is_refused_with_advice(tmp_path: Path) -> None:
    task, result = watched.simulation()
    with pytest.raises(ValueError, match="record rate above 0"):
        simulation_png(tmp_path / "pour.png", task, SimulationResult(result.outcome))


def test_section_of_a_cup_is_its_wall_cut_open() -> None:
    vessel = build_vessel(watched.BEAKER)
    loops = section(vessel.solid_vertices, vessel.solid_faces)
    assert len(loops) == 1
    x, z = loops[0].T
    area = 0.5 * abs(float(np.dot(x, np.roll(z, -1)) - np.dot(z, np.roll(x, -1))))
    # two walls of 4 mm × 90 mm and a floor of 4 mm × (70 + 2·4) mm
    assert area == pytest.approx(2 * 0.004 * 0.09 + 0.004 * 0.078, rel=0.01)


def test_section_of_an_open_mesh_is_refused() -> None:
    vessel = build_vessel(watched.BEAKER)
    with pytest.raises(ValueError, match="loose end"):
        section(vessel.solid_vertices, vessel.solid_faces[: len(vessel.solid_faces) // 2])


def test_drawn_vessel_turns_the_way_the_motion_turns_it() -> None:
    pourer, receiver = build_vessel(watched.BEAKER), build_vessel(watched.NARROW.receiver)
    motion = plan_motion(watched.NARROW, watched.ACTION, pourer, receiver)
    poses = motion.sample(np.linspace(0.0, motion.duration, 9))
    lip = pourer.lip_point(0.0)
    for pose in poses:
        x, z = place(np.array([[lip[0], lip[2]]]), pose)[0]
        assert (x, z) == pytest.approx((motion.pivot_world[0], motion.pivot_world[2]), abs=1e-9)
    rim = place(np.array([[0.0, 0.1]]), np.array([0, 0, 0, math.cos(0.25), 0, math.sin(0.25), 0]))[0]
    assert rim[0] > 0.0  # a positive tilt tips the opening towards the receiver
