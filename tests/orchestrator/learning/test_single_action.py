"""`single_action`: what is recommended is poured again, by pours that took no part in choosing it."""

from __future__ import annotations

import pytest

from orchestrator.learning.deployment.costing import Costing
from orchestrator.learning.deployment.deployment_result import Recommended
from orchestrator.learning.requests import Failed, Outcome, Pour, Poured, Slots
from orchestrator.learning.single_action import Confirmation
from orchestrator.learning.strategy import Progress
from sim_engine.liquids import Liquid
from sim_engine.outcome import Loss, PourMeasurement
from tests.support.toy_campaign import SCENE, SPACE, THETA

COSTING = Costing(Loss(), SCENE, THETA)
RECOMMENDED = Recommended(
    action={},
    action_si=SPACE.decode([0.25, 0.5]),
    predicted_loss=0.02,
    predicted_deviation=0.01,
    predicted_scatter=0.005,
)


def poured(spilled: float) -> Poured:
    return Poured(PourMeasurement(loaded=0.2, spilled=spilled, retained=0.001))


def played(strategy: Confirmation, *outcomes: Outcome) -> list[Pour]:
    pours = []
    for outcome in outcomes:
        (pour,) = strategy.ask(Slots(2, 1))
        assert isinstance(pour, Pour)
        assert strategy.ask(Slots(2, 1)) == [], "one at a time"
        strategy.tell(pour, outcome)
        pours.append(pour)
    return pours


def test_every_pour_is_of_the_recommended_action_with_a_chance_of_its_own() -> None:
    strategy = Confirmation(COSTING, RECOMMENDED, 3, seed=7)
    pours = played(strategy, poured(0.002), poured(0.004), poured(0.006))
    assert {pour.action for pour in pours} == {SCENE.action(dict(RECOMMENDED.action_si))}
    assert len({pour.seed for pour in pours}) == 3
    assert [pour.number for pour in pours] == [1, 2, 3]
    assert all(pour.predicted is not None and pour.predicted.mean == 0.02 for pour in pours)
    assert strategy.finished
    assert strategy.ask(Slots(2, 1)) == []
    result = strategy.result()
    assert result.loss is not None
    assert result.delivered_g is not None
    assert result.loss.mean == pytest.approx((0.004 + 0.001) / 0.2)  # the mean spill and what stayed in the pourer
    assert result.loss.deviation == pytest.approx(0.002 / 0.2)
    assert result.delivered_g.mean == pytest.approx(200.0 - 1.0 - 4.0)
    assert result.delivered_ml == pytest.approx(195.0 / Liquid(mass=0.2).density * 1e3)


def test_a_pour_that_went_wrong_is_kept_as_that_and_the_next_one_is_made() -> None:
    strategy = Confirmation(COSTING, RECOMMENDED, 2, seed=7)
    played(strategy, Failed("pour_unknown", "declared lost by the operator"), poured(0.002))
    assert strategy.progress() == Progress(pours=2, of_pours=2)
    result = strategy.result()
    assert [pour.failed for pour in result.pours] == ["pour_unknown: declared lost by the operator", ""]
    assert result.loss is not None
    assert (result.loss.count, result.loss.mean) == (1, pytest.approx(0.003 / 0.2))


def test_an_action_that_is_refused_is_not_asked_for_again() -> None:
    strategy = Confirmation(COSTING, RECOMMENDED, 5, seed=7)
    played(strategy, Failed("invalid_action", "cups touch"))
    assert strategy.finished
    assert strategy.result().loss is None
    assert strategy.progress() == Progress(pours=1, of_pours=1)


def test_nothing_is_poured_where_nothing_was_recommended() -> None:
    strategy = Confirmation(COSTING, None, 5, seed=7)
    assert strategy.finished
    assert strategy.ask(Slots(2, 1)) == []
    assert strategy.result().pours == ()
