"""`run_summary`: the summary of a run: its table for people, its file for programs."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import jsonschema
import pytest

from orchestrator.learning.calibration.campaign_memory import MemoryFound, MemoryGroup
from orchestrator.learning.deployment.model_monitoring import Belief, Believed
from orchestrator.learning.deployment.real_pours import PredictionCheck
from orchestrator.learning.single_action import ActionPrediction
from orchestrator.records.codec import decode_result
from orchestrator.records.run_record import Occupancy
from orchestrator.reports.console_view import print_summary, summary_table
from orchestrator.reports.figure_style import display_value, display_values
from orchestrator.reports.run_summary import (
    NotSimulated,
    PoolUse,
    RunFiles,
    RunSummary,
    Totals,
    summary_schema,
    write_summary,
)
from orchestrator.reports.summarise import summarise
from orchestrator.reports.wording import pool_line
from sim_engine.prediction_band import SampleStatistics
from tests.support import example_run
from tests.support.example_results import changed, shown

BUSY = PoolUse(
    pool_busy=0.974,
    arm_longest_wait_s=0.061,
    arm_mean_wait_s=0.03,
    text=pool_line(0.974, 0.061),
)


def test_summary_tells_theta_discrepancies_losses_actions_and_files(results: dict[str, Any], tmp_path: Path) -> None:
    plan = example_run.campaign()
    results = {**results, "evaluation": changed(results["evaluation"], mean_predictor={"test": 0.1234})}
    figures = {"loss against pours": tmp_path / "spillage.png"}
    summary = summarise(
        plan,
        results,
        files=RunFiles(figures=figures, recording=tmp_path / "campaign.rrd"),
        totals=Totals(simulations=60),
    )
    deployed = results["narrow cup"]
    losses = [pour.loss for pour in deployed.pours]
    receiver = summary.outcome.receivers["narrow cup"]
    assert summary.learning.theta == results["calibration"].found.theta
    assert summary.simulations == 60
    assert summary.learning.discrepancy["test"]["calibrated"] == results["evaluation"].discrepancy["calibrated"]["test"]
    assert summary.learning.discrepancy["test"]["random_theta"] == results["evaluation"].random_median["test"]
    assert (receiver.first.loss, receiver.best.loss) == (losses[0], min(losses))
    assert receiver.best.number == 1 + losses.index(min(losses))
    assert receiver.recommended == deployed.recommended

    text = shown(summary_table(summary))
    assert display_value("particles", summary.learning.theta.particles) in text
    assert "12.34" in text
    assert f"{100 * min(losses):.2f} % (pour {receiver.best.number})" in text
    assert display_values(deployed.recommended.action_si) in text
    assert "campaign.rrd" in text

    ranges = {"angular_velocity": (1.0, 2.0), "x_offset": (0.1, 0.1)}
    wide = changed(deployed, recommended=changed(deployed.recommended, equal_ranges=ranges))
    text = shown(summary_table(summarise(plan, {**results, "narrow cup": wide})))
    said = "Equally good to 0.2 % of the load, one changed at a time: angular velocity 57.3 … 115 deg/s."
    assert said in " ".join(text.split())


def test_a_memory_that_the_pours_contradict_is_an_open_question_of_the_run(results: dict[str, Any]) -> None:
    group = MemoryGroup(
        group="placement",
        parameters={"receiver_x": (0.014, 0.003)},
        runs=("first-1",),
        probability=0.03,
        contradicted=True,
    )
    memory = MemoryFound(groups=(group,), alone={}, left_out=(), text="prior from the run first-1")
    results = {**results, "calibration": changed(results["calibration"], memory=memory)}
    (first, *_) = summarise(example_run.campaign(), results).outcome.open_questions
    assert first == "The pours contradict what first-1 found about the placement: was the receiver or the arm moved?"


def test_summary_file_has_what_was_summarised_and_the_results_read_back(
    results: dict[str, Any], tmp_path: Path
) -> None:
    summary = summarise(example_run.campaign(), results)
    path = write_summary(tmp_path / "run", summary)
    assert path.name == "summary.json"
    written = json.loads(path.read_text(encoding="utf-8"))
    assert RunSummary.model_validate({**written, "results": results}) == summary
    assert {name: decode_result(one) for name, one in written["results"].items()} == results
    assert [p.name for p in path.parent.iterdir()] == ["summary.json"]


def test_summary_file_is_what_its_schema_says(results: dict[str, Any], tmp_path: Path) -> None:
    plan = example_run.campaign()
    warning = NotSimulated(
        receiver="cup", kind="wetting", share=0.1, text="", action_si={"x_offset": 0.1}, hit=1, tried=5
    )
    busy = Totals(occupancy={"narrow cup": BUSY})
    summary = summarise(plan, results, totals=busy, not_covered={"cup": (warning,)})
    written = json.loads(write_summary(tmp_path, summary).read_text())
    validator = jsonschema.Draft202012Validator(summary_schema())
    validator.validate(written)
    kinds = {one["kind"] for one in written["results"].values()}
    assert kinds == {"calibration", "evaluation", "deployment"}
    written["results"]["calibration"]["kind"] = "guess"
    assert not validator.is_valid(written)


def test_summary_warns_of_an_untrustworthy_simulator_failed_pours_and_dropped_events(
    results: dict[str, Any],
) -> None:
    trust = PredictionCheck(z_scores=(9.0, 9.0, 9.0), alarm=True)
    pours = [*results["narrow cup"].pours]
    for index, why in ((1, "pour_failed: the gripper slipped"), (2, "pour_unknown: declared lost by the operator")):
        pours[index] = changed(pours[index], status="failed", reason=why)
    poured = changed(results["narrow cup"], failed_pours=2, model_check=trust, pours=tuple(pours))
    plan = example_run.campaign()
    text = shown(summary_table(summarise(plan, {"narrow cup": poured}, files=RunFiles(dropped_events=12))))
    assert "the simulator may not fit this vessel" in text
    assert (
        "2 pours failed: pour 2: pour_failed: the gripper slipped; pour 3: pour_unknown: declared lost by the operator"
    ) in " ".join(text.split())
    assert "lacks 12 events" in text


@pytest.mark.parametrize(("ignorance", "known"), [(0.01, True), (0.5, False)])
def test_what_pours_say_of_the_simulator_is_known_where_it_is_borne_out_and_open_where_it_is_in_doubt(
    results: dict[str, Any], ignorance: float, known: bool
) -> None:
    trust = Believed(
        after=(Belief(pour=1, ignorance=ignorance, gain=None),),
        displaced={},
        factor=1.0,
        alarm=False,
        text="the simulator is as it is",
    )
    plan = example_run.campaign()
    poured = changed(results["narrow cup"], model_check=trust)
    (said,) = summarise(plan, {"narrow cup": poured}).outcome.advice
    assert ("The simulator is as it is." in said.sentences) == known
    assert ("The simulator is as it is." in said.open) != known


def test_what_was_delivered_stands_in_table_and_file_in_grams_and_millilitres(results: dict[str, Any]) -> None:
    plan = example_run.campaign()
    assert plan.deployment is not None
    liquid = plan.deployment.scenes[0].liquid
    deployed = results["narrow cup"]
    best = deployed.best
    for pour in deployed.weighed:
        assert pour.delivered_g == pytest.approx(1e3 * liquid.mass - pour.spilled_g - pour.retained_g, abs=1e-9)
        assert pour.delivered_ml == pytest.approx(pour.delivered_g / liquid.density * 1e3)
    foreseen = ActionPrediction(
        scene="narrow cup",
        simulations=2,
        simulations_lost=0,
        thetas=0,
        touching=0,
        over_seeds={"received": SampleStatistics(0.9, 0.01, 2), "spilled": SampleStatistics(0.1, 0.01, 2)},
    )
    summary = summarise(plan, {"narrow cup": deployed, "prediction:narrow cup": foreseen})
    receiver = summary.outcome.receivers["narrow cup"]
    assert receiver.best == best
    assert receiver.predicted_delivered_g == pytest.approx(900.0 * liquid.mass)
    assert receiver.predicted_delivered_ml == pytest.approx(900.0 * liquid.mass / liquid.density * 1e3)
    text = shown(summary_table(summary))
    assert f"{best.delivered_g:.1f} g, {best.delivered_ml:.1f} mL" in text
    assert f"delivered {900.0 * liquid.mass:.1f} g" in " ".join(text.split())


def test_planning_alone_shows_no_columns_about_pours_and_no_empty_table(results: dict[str, Any]) -> None:
    plan = example_run.campaign()
    planned = changed(results["narrow cup"], strategy="D1", pours=())
    text = shown(summary_table(summarise(plan, {"narrow cup": planned})))
    assert "expected of the best action" in " ".join(text.split())
    assert display_values(planned.recommended.action_si) in text
    for absent in ("first ", "best measured", "mean |measured", "—"):
        assert absent not in text
    fruitless = changed(planned, recommended=None)
    text = shown(summary_table(summarise(plan, {"narrow cup": fruitless})))
    assert "expected of" not in text
    assert "No action is recommended: there is no result" in text


def test_table_in_a_log_file_breaks_neither_paths_nor_rows(
    results: dict[str, Any], capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "60")
    plan = example_run.campaign()
    recording = Path("/laboratory") / "a-folder-with-a-rather-long-name" / ("x" * 120) / "campaign.rrd"
    summary = summarise(plan, {"narrow cup": results["narrow cup"]}, files=RunFiles(recording=recording))
    print_summary(summary)
    lines = capsys.readouterr().err.splitlines()
    assert any(line.endswith(str(recording)) for line in lines)
    action = display_values(results["narrow cup"].recommended.action_si)
    assert any(line.endswith(f"into narrow: {action}") for line in lines)


def test_summary_tells_how_busy_the_pool_was_and_whether_the_arm_waited(results: dict[str, Any]) -> None:
    plan = example_run.campaign()
    summary = summarise(plan, results, totals=Totals(occupancy={"deployment:narrow": BUSY}))
    assert summary.occupancy["deployment:narrow"] == BUSY
    text = " ".join(shown(summary_table(summary)).split())
    assert "narrow: pool 97 % busy" in text
    assert "the arm waited 0.061 s at most" in text


def test_run_that_was_stopped_at_once_has_a_summary_too() -> None:
    plan = example_run.campaign()
    summary = summarise(plan, {})
    assert (summary.learning.theta, summary.outcome.receivers) == (None, {})
    assert "narrow-cup" in shown(summary_table(summary))


def test_the_pool_counts_as_busy_by_slots_until_the_last_pour() -> None:
    pool = Occupancy(slots=2)
    pool.simulation_started(0.0)
    pool.simulation_started(0.0)
    pool.simulation_finished(10.0)  # one of two slots is free for 10 s
    pool.pour_started(10.0)
    pool.simulation_finished(20.0)
    pool.simulation_started(50.0)
    pool.simulation_started(50.0)
    pool.pour_finished(60.0)
    pool.pour_started(60.5)
    pool.pour_finished(70.5)
    pool.simulation_finished(90.0)
    pool.finish()  # simulations after the last pour are not counted
    assert pool.waits == [0.5]
    assert pool.busy == pytest.approx(20.0 + 10.0 + 41.0)
    assert pool.total == pytest.approx(2 * 70.5)


def test_a_pause_is_no_wait_of_the_arm() -> None:
    pool = Occupancy(slots=1)
    pool.pour_started(0.0)
    pool.pour_finished(90.0)
    pool.interrupted()
    pool.pour_started(4000.0)
    pool.pour_finished(4090.0)
    pool.finish()
    assert pool.waits == []
    assert pool.total == pytest.approx(180.0)
