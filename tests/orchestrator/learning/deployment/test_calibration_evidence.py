"""`calibration_evidence`: which pours of a calibration say something about a deployment, and with which simulations."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from orchestrator.learning.calibration.calibration_scores import ScoredPair, ScoredPour, Scores
from orchestrator.learning.calibration.campaign_memory import RELIANCE, CampaignMemory, WeighedPair
from orchestrator.learning.campaign_plan import CalibrationEvidence, MeasuredPour
from orchestrator.learning.deployment.calibration_evidence import TRANSFER, calibration_evidence, memory_evidence
from orchestrator.runs.strategy_harness import ACTIONS, SCENE, THETA
from sim_engine.action import DEG
from sim_engine.prediction_band import RESOLUTION_AT, shift_of
from sim_engine.vessel.shapes import cylinder
from tests.support.plans import calibration_plan, deployment_plan

OTHER = replace(SCENE, name="bowl", receiver=cylinder("bowl", inner_radius=0.06, inner_height=0.1))


def evidence(
    *, at: Any = SCENE, scene: Any = OTHER, train: int = 8, test: int = 2, searched: int = 2, speed: float = 60 * DEG
) -> CalibrationEvidence:
    """Evidence of pours with a weighed spillage of 0.10 and a simulated one of 0.13."""
    action = at.action({"angular_velocity": speed, "x_offset": 0.12})
    splits = ["train"] * train + ["test"] * test
    weighed = [ScoredPour(at.name, MeasuredPour(action, 0.10, 0.9, split, at.name)) for split in splits]
    pairs = [
        ScoredPair(theta="theta", split=split, scene=at.name, measured=0.10, simulated=0.13, reason="")
        for split in sorted(splits)  # an evaluation scores unseen pours first
    ]
    scores = Scores(
        simulations=0, undefined={}, discrepancy={}, random_median={}, thetas={"theta": THETA}, pairs=tuple(pairs)
    )
    plan = calibration_plan(scene=at)
    return calibration_evidence(deployment_plan(), scene, THETA, plan, weighed, scores, searched)


def test_training_pours_count_as_if_each_had_been_left_out_of_the_fit() -> None:
    (pours,) = evidence().pours
    retained = 0.1
    assert pours.costs == pytest.approx([0.10 * 0.9 + retained] * 10)
    unseen, fitted = 0.13 * 0.9 + retained, (0.10 + 0.03 / (1.0 - 2 / 8)) * 0.9 + retained
    assert pours.simulated == pytest.approx([unseen] * 2 + [fitted] * 8)
    assert pours.points[0] == pytest.approx(ACTIONS.encode({"angular_velocity": 60 * DEG, "x_offset": 0.12}))


def test_errors_are_larger_in_another_receiver_by_what_the_recorded_pours_show() -> None:
    assert (evidence().pours[0].power, evidence(scene=SCENE).pours[0].power) == (TRANSFER, 1.0)
    file = Path(__file__).parents[4] / "docs" / "data" / "recorded-predictions.json"
    squares: dict[str, list[float]] = {"test": [], "transfer": []}
    for rows in json.loads(file.read_text(encoding="utf-8"))["seeds"].values():
        for row in rows:
            shifts = [shift_of(row[name], RESOLUTION_AT) for name in ("recorded", "predicted")]
            squares[row["split"]].append((shifts[0] - shifts[1]) ** 2)
    root = {split: math.sqrt(sum(values) / len(values)) for split, values in squares.items()}
    assert pytest.approx((root["test"] / root["transfer"]) ** 2, rel=0.01) == TRANSFER


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"train": 2, "test": 1}, "2 training pours of the calibration, to which 2 parameters were fitted"),
        ({"train": 0, "test": 1}, "1 calibration pours into cup: only 1 are close to the deployment's actions"),
        ({"speed": 300 * DEG}, "10 calibration pours into cup: only 0 are close to the deployment's actions"),
        (
            {"at": replace(SCENE, liquid=SCENE.liquid.model_copy(update={"mass": 0.1}))},
            "10 calibration pours into cup: another liquid or amount",
        ),
        (
            {"at": replace(SCENE, pourer=cylinder("jug", inner_radius=0.05, inner_height=0.1))},
            "10 calibration pours into cup: poured from another vessel",
        ),
    ],
)
def test_pours_that_say_nothing_about_the_deployment_are_named_with_the_reason(
    changes: dict[str, Any], reason: str
) -> None:
    found = evidence(**changes)
    assert found.pours == ()
    assert f"not used: {reason}" in found.lines[0]


def test_a_calibration_that_is_used_says_by_how_much_its_simulator_misses() -> None:
    (line,) = evidence(searched=0).lines
    assert "misses 10 calibration pours into cup by 2.7 % of the largest loss" in line


def test_pours_of_earlier_campaigns_count_as_of_another_receiver_and_as_reliably_as_a_memory() -> None:
    at = [SCENE.action({"angular_velocity": speed * DEG, "x_offset": 0.12}) for speed in (60, 70, 300)]
    pairs = [WeighedPair(f"first-1 into {name}", a, 0.9, 0.10, 0.13) for name in ("cup", "mug") for a in at]
    memory = CampaignMemory((), pours=tuple(pairs[:-2]))
    found = memory_evidence(deployment_plan(), SCENE, THETA, memory)
    (pours,) = found.pours
    assert (pours.power, pours.misled, len(pours.points)) == (TRANSFER, pytest.approx(1.0 - RELIANCE), 2)
    assert (pours.costs[0], pours.simulated[0]) == pytest.approx((0.10 * 0.9 + 0.1, 0.13 * 0.9 + 0.1))
    used, far, few = found.lines
    assert "the simulator misses 2 pours of first-1 into cup by 2.7 % of the largest loss" in used
    assert far == "not used: 1 pours of first-1 into cup: far from the deployment's actions"
    assert few.startswith("not used: 1 pours of first-1 into mug: only 1 are close to the deployment's actions")


def test_of_very_many_pours_some_are_used_evenly() -> None:
    found = evidence(train=60, test=30)
    assert len(found.pours[0].costs) == 40
    assert found.lines[1] == "not used: 50 calibration pours into cup: 40 of them are enough"
    assert len(set(found.pours[0].simulated)) == 2  # unseen and training pours
