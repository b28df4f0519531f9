"""A series of wanted amounts: one dose after the other, none repeated."""

from __future__ import annotations

import pytest

from actors.interfaces import DoseTarget
from orchestrator.journal.codec import decode_request, decode_result, encode_request, encode_result
from orchestrator.requests import Failed, Pour, Poured, Slots
from orchestrator.strategies.dispense import Dispense
from sim_engine.action import Action
from sim_engine.liquids import Liquid
from sim_engine.outcome import PourMeasurement
from sim_engine.scene import Scene
from sim_engine.vessel.shapes import cylinder

SCENE = Scene(
    "tumbler",
    cylinder("beaker", inner_radius=0.04, inner_height=0.1),
    cylinder("tumbler", inner_radius=0.03, inner_height=0.09),
    Liquid(mass=0.3),
)
ACTION = Action(1.0, 0.09, 0.06)


def series(*grams: float) -> Dispense:
    return Dispense(SCENE, ACTION, [DoseTarget(1e-3 * g) for g in grams], seed=5)


def asked(strategy: Dispense) -> Pour:
    (request,) = strategy.ask(Slots(0))
    assert isinstance(request, Pour)
    return request


def poured(grams: float, **notes: object) -> Poured:
    loaded = 0.3
    return Poured(PourMeasurement(loaded, 0.0, loaded - 1e-3 * grams, {"dose": {"received": 1e-3 * grams, **notes}}))


def test_doses_are_asked_one_after_the_other_in_order() -> None:
    strategy = series(50, 25)
    first = asked(strategy)
    assert strategy.ask(Slots(0)) == []
    strategy.tell(first, poured(50.3, end="reached", duration=8.0))
    second = asked(strategy)
    assert [pour.dose and pour.dose.amount for pour in (first, second)] == [0.05, 0.025]
    assert first.seed != second.seed
    strategy.tell(second, poured(24.9, end="reached"))
    assert strategy.finished
    assert [dose.received_g for dose in strategy.result().doses] == pytest.approx([50.3, 24.9])


def test_a_failed_dose_is_kept_and_not_repeated() -> None:
    strategy = series(50, 25)
    strategy.tell(asked(strategy), Failed("pour_failed", "the cup fell"))
    assert asked(strategy).number == 2
    (failed,) = strategy.result().doses
    assert (failed.received_g, failed.end) == (None, "pour_failed: the cup fell")


def test_requests_and_results_survive_the_journal() -> None:
    strategy = series(50)
    request = asked(strategy)
    assert decode_request(encode_request(request)) == request
    strategy.tell(request, poured(50.3, end="reached"))
    assert decode_result(encode_result(strategy.result())) == strategy.result()


def test_a_pour_without_an_amount_is_written_as_before() -> None:
    data = encode_request(Pour("tumbler", ACTION, 1, 3))
    assert "dose" not in data
    assert decode_request(data) == Pour("tumbler", ACTION, 1, 3)
