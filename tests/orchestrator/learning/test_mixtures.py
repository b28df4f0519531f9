"""`mixtures`: cups are filled one after the other, each dose once; what follows from a dose that missed or failed."""

from __future__ import annotations

from dataclasses import replace

import pytest

from actors.interfaces import DoseTarget
from orchestrator.learning.dispense import Dispensed, MixedComponent
from orchestrator.learning.mixtures import Mix, pouring_order
from orchestrator.learning.requests import Answered, Ask, Failed, Outcome, Pour, Slots
from orchestrator.records.codec import decode_request, decode_result, encode_request, encode_result
from tests.support.mixtures import asked, plan, poured, scene


def run(strategy: Mix, errors: dict[int, float | Failed] | None = None) -> list[DoseTarget]:
    """Pour to the end; doses are exact except for these errors [g], by the number of the dose."""
    doses = []
    while not strategy.finished:
        pour, dose = asked(strategy)
        error = (errors or {}).get(pour.number, 0.0)
        outcome: Outcome = error if isinstance(error, Failed) else poured(pour, 1e3 * dose.amount + error)
        strategy.tell(pour, outcome)
        doses.append(dose)
    return doses


def steps(doses: list[DoseTarget]) -> list[tuple[str, str, float]]:
    return [(d.cup, d.source.name if d.source else "", round(1e3 * d.amount, 3)) for d in doses]


def states(result: Dispensed) -> dict[str, str]:
    return {cup.position: cup.state for cup in result.cups}


TWO = ({"water": 40.0, "oil": 10.0}, {"water": 20.0, "oil": 30.0})


def test_all_doses_of_a_cup_follow_each_other_the_smallest_first() -> None:
    strategy = Mix(plan(*TWO), 5)
    assert steps(run(strategy)) == [
        ("rack/A1", "source/oil", 10.0), ("rack/A1", "source/water", 40.0),
        ("rack/A2", "source/water", 20.0), ("rack/A2", "source/oil", 30.0),
    ]  # fmt: skip
    assert states(strategy.result()) == {"rack/A1": "full", "rack/A2": "full"}


def test_a_dose_names_its_cup_its_source_and_what_the_cup_holds() -> None:
    doses = run(Mix(plan(*TWO), 5))
    assert [dose.held for dose in doses] == [None, pytest.approx(0.01), None, pytest.approx(0.02)]
    assert [dose.stays for dose in doses] == [True, False, True, False]
    assert [dose.source.vessel for dose in doses if dose.source] == [dose.source.name for dose in doses if dose.source]


def test_a_source_knows_its_flow_after_another_one_was_used() -> None:
    doses = run(Mix(plan(*TWO), 5))
    known = {(dose.cup, dose.source.name): dose.source.knowledge for dose in doses if dose.source}
    assert known["rack/A1", "source/oil"] is None
    later = known["rack/A2", "source/oil"]
    assert later is not None
    assert later.onset_flow == (0.01, 0.0)


def test_a_missed_dose_scales_what_the_cup_still_lacks() -> None:
    strategy = Mix(plan(*TWO), 5)
    doses = run(strategy, {1: 2.0})  # 12 g of oil instead of 10 g
    assert steps(doses)[1] == ("rack/A1", "source/water", 48.0)
    assert steps(doses)[2:] == [("rack/A2", "source/water", 20.0), ("rack/A2", "source/oil", 30.0)]
    shares = {c.liquid: (c.share, c.wanted_share) for c in strategy.result().components() if c.cup == "rack/A1"}
    assert shares["oil"] == (pytest.approx(0.2), pytest.approx(0.2))
    assert "multiplied by 1.200: water 48 g" in strategy.decisions[1].text


def test_a_dose_within_its_tolerance_changes_nothing() -> None:
    assert steps(run(Mix(plan(*TWO), 5), {1: 0.9}))[1] == ("rack/A1", "source/water", 40.0)


def test_amounts_are_not_corrected_below_the_smallest_one_that_was_checked() -> None:
    strategy = Mix(plan({"water": 5.0, "oil": 6.0}), 5)
    assert steps(run(strategy, {1: -2.5}))[1] == ("rack/A1", "source/oil", 6.0)
    assert "stay as they are: 3 g of oil would be less than any amount of the table" in strategy.decisions[1].text


def test_a_cup_without_room_is_not_corrected() -> None:
    strategy = Mix(plan({"water": 85.0, "oil": 20.0}), 5)
    assert steps(run(strategy, {1: 2.0}))[1] == ("rack/A1", "source/water", 85.0)
    assert "stay as they are: the cup has no room" in strategy.decisions[1].text


def test_a_missed_mixture_is_poured_again_into_a_spare_cup() -> None:
    strategy = Mix(plan(*TWO, on_miss="repeat", spares=("rack/D6",)), 5)
    assert [step[:2] for step in steps(run(strategy, {2: -3.0, 5: 4.0}))] == [
        ("rack/A1", "source/oil"), ("rack/A1", "source/water"),
        ("rack/D6", "source/oil"), ("rack/D6", "source/water"),
        ("rack/A2", "source/water"), ("rack/A2", "source/oil"),
    ]  # fmt: skip
    result = strategy.result()
    assert states(result) == {"rack/A1": "rejected", "rack/D6": "full", "rack/A2": "missed"}
    assert result.cups[1].replaces == "rack/A1"
    assert any("no spare cup is left" in decision.text for decision in strategy.decisions)


@pytest.mark.parametrize("policy", ["repeat", "ask", "correct"])
def test_no_cup_gets_anything_after_two_streams_in_a_row_that_missed(policy: str) -> None:
    strategy = Mix(plan(*TWO, on_miss=policy, spares=("rack/D6",), proposals=("rack/B1",)), 5)
    for _ in range(2):
        if question := strategy._question:
            strategy.ask(Slots(0))
            strategy.tell(question, Answered("accept"))
        pour, _ = asked(strategy)
        answer = poured(pour, 1.0)
        answer.measurement.notes["dose"]["end"] = "stream misses the receiver"
        strategy.tell(pour, answer)
    assert strategy.finished
    assert strategy.ask(Slots(0)) == []
    assert "full" not in states(strategy.result()).values()
    assert "nothing more is poured" in strategy.decisions[-1].text


@pytest.mark.parametrize(("kind", "state"), [("pour_unknown", "unknown"), ("invalid_action", "refused")])
def test_nothing_more_is_poured_into_a_cup_with_a_failed_dose(kind: str, state: str) -> None:
    strategy = Mix(plan(*TWO), 5)
    assert [step[0] for step in steps(run(strategy, {1: Failed(kind, "the cup fell")}))] == ["rack/A1"] + 2 * [
        "rack/A2"
    ]
    assert states(strategy.result()) == {"rack/A1": state, "rack/A2": "full"}


def test_no_dose_is_poured_twice_whatever_misses_or_fails() -> None:
    for number in range(1, 7):
        for error in (5.0, -5.0, Failed("pour_unknown", "")):
            strategy = Mix(plan(*TWO, on_miss="repeat", spares=("rack/D6",)), 5)
            poured_into = [step[:2] for step in steps(run(strategy, {number: error}))]
            assert len(set(poured_into)) == len(poured_into)


def test_the_shares_have_the_errors_of_all_their_doses() -> None:
    strategy = Mix(plan({"water": 40.0, "oil": 10.0}), 5)
    run(strategy)
    oil: MixedComponent = next(c for c in strategy.result().components() if c.liquid == "oil")
    # x = m / M: σ_x = √((0.8 σ)² + (0.2 σ)²) / 50 g with σ = 0.2 g
    assert oil.share_half_interval == pytest.approx(1.645 * 0.2 * (0.8**2 + 0.2**2) ** 0.5 / 50.0)


def test_a_resumed_run_corrects_as_it_did() -> None:
    first, again = Mix(plan(*TWO), 5), Mix(plan(*TWO), 5)
    pour, dose = asked(first)
    first.tell(pour, poured(pour, 1e3 * dose.amount + 2.0))
    replayed, _ = asked(again)
    assert decode_request(encode_request(pour)) == replayed == pour
    again.tell(replayed, poured(replayed, 1e3 * dose.amount + 2.0))
    assert asked(again)[0] == asked(first)[0]
    assert decode_result(encode_result(first.result())) == first.result() == again.result()


def test_a_fixed_order_of_liquids_is_kept() -> None:
    assert pouring_order({"water": 40.0, "oil": 10.0}, ["water", "oil"]) == ["water", "oil"]
    assert pouring_order({"oil": 10.0}, ["water", "oil"]) == ["oil"]


def test_a_sources_rest_decides_which_of_several_is_used() -> None:
    two = plan({"water": 40.0}, {"water": 270.0})
    second = scene("water")
    second = replace(second, pourer=second.pourer.model_copy(update={"name": "source/water-2"}), name="second")
    strategy = Mix(replace(two, scenes=(*two.scenes, second)), 5)
    assert [name for _, name, _ in steps(run(strategy))] == ["source/water", "source/water-2"]


def test_a_missed_mixture_without_spare_cups_is_poured_again_into_the_emptied_cup() -> None:
    strategy = Mix(plan(*TWO, on_miss="repeat"), 5)
    doses = run(strategy, {2: -3.0})
    assert steps(doses) == [
        ("rack/A1", "source/oil", 10.0), ("rack/A1", "source/water", 40.0),
        ("rack/A1", "source/oil", 10.0), ("rack/A1", "source/water", 40.0),
        ("rack/A2", "source/water", 20.0), ("rack/A2", "source/oil", 30.0),
    ]  # fmt: skip
    assert [dose.emptied for dose in doses] == [False, False, True, False, False, False]
    assert [dose.held for dose in doses][:4] == [None, pytest.approx(0.01), None, pytest.approx(0.01)]
    result = strategy.result()
    assert states(result) == {"rack/A1": "full", "rack/A2": "full"}
    assert [c.dose for c in result.components() if c.cup == "rack/A1"] == [3, 4]  # what it contains now
    assert "rack/A1 is emptied, and its mixture is poured again" in strategy.decisions[2].text


def test_a_mixture_that_keeps_missing_is_poured_three_times_at_most() -> None:
    strategy = Mix(plan({"water": 40.0}, on_miss="repeat"), 5)
    assert len(run(strategy, dict.fromkeys(range(1, 9), 3.0))) == 3
    assert strategy.decisions[-1].text.endswith("it was poured again 2 times, the mixture stays as it is")
    assert states(strategy.result()) == {"rack/A1": "missed"}


def question(strategy: Mix) -> Ask:
    (request,) = strategy.ask(Slots(0))
    assert isinstance(request, Ask)
    assert strategy.ask(Slots(0)) == []  # nothing is poured while it is open
    assert not strategy.finished
    return request


def first_dose(strategy: Mix, error: float) -> Ask:
    pour, dose = asked(strategy)
    strategy.tell(pour, poured(pour, 1e3 * dose.amount + error))
    return question(strategy)


@pytest.mark.parametrize(
    ("answer", "rest"),
    [
        ("accept", [("rack/A1", "source/water", 40.0)]),
        ("correct", [("rack/A1", "source/water", 48.0)]),
        ("repeat", [("rack/A1", "source/oil", 10.0), ("rack/A1", "source/water", 40.0)]),
    ],
)
def test_the_operator_decides_about_a_missed_dose(answer: str, rest: list[tuple[str, str, float]]) -> None:
    strategy = Mix(plan(*TWO, on_miss="ask"), 5)
    request = first_dose(strategy, 2.0)
    assert request.options == ("accept", "correct", "repeat")
    assert "10 g of oil into rack/A1, missed its tolerance: 12.0 g; 1 g are tolerated." in request.question
    assert "correct: the other amounts of rack/A1 are multiplied by 1.200: water 48 g." in request.question
    assert "repeat: rack/A1 is emptied, and its mixture is poured again." in request.question
    strategy.tell(request, Answered(answer))
    assert steps(run(strategy))[: len(rest)] == rest


def test_the_operator_is_not_offered_what_is_impossible() -> None:
    full = Mix(plan({"water": 85.0, "oil": 20.0}, on_miss="ask"), 5)
    request = first_dose(full, 2.0)
    assert request.options == ("accept", "repeat")
    assert (
        "No correction is possible: the other amounts of rack/A1 stay as they are: the cup has no room."
        in request.question
    )
    last = first_dose(Mix(plan({"water": 40.0}, on_miss="ask", spares=("rack/D6",)), 5), 2.0)
    assert last.options == ("accept", "repeat")
    assert "rack/A1 is rejected, its mixture is poured into rack/D6" in last.question


def test_an_answer_to_another_question_is_refused() -> None:
    strategy = Mix(plan(*TWO, on_miss="ask"), 5)
    request = first_dose(strategy, 2.0)
    with pytest.raises(ValueError, match="was not asked"):
        strategy.tell(replace(request, question="another"), Answered("accept"))


@pytest.mark.parametrize("answer", ["accept", "correct", "repeat"])
@pytest.mark.parametrize("spares", [(), ("rack/D6",)], ids=["emptied", "spare"])
@pytest.mark.parametrize("policy", ["ask", "repeat"])
def test_what_was_poured_so_far_gives_the_cups_without_the_answers(
    policy: str, answer: str, spares: tuple[str, ...]
) -> None:
    series = plan(*TWO, on_miss=policy, spares=spares)
    strategy, so_far = Mix(series, 5), Mix(series, 5)
    while not strategy.finished:
        (request,) = strategy.ask(Slots(0))
        if isinstance(request, Ask):
            strategy.tell(request, Answered(answer if answer in request.options else "accept"))
            continue
        assert isinstance(request, Pour)
        assert request.dose is not None
        so_far.take(request, None)
        assert {cup.position for cup in so_far.result().cups if cup.state == "filling"} == {request.dose.cup}
        outcome = poured(request, 1e3 * request.dose.amount + 3.0 * (request.number == 1))
        strategy.tell(request, outcome)
        so_far.take(request, outcome)
    assert so_far.result() == strategy.result()


def poured_until_asked(strategy: Mix) -> Ask:
    """Pour all that is known; the question after it."""
    while True:
        (request,) = strategy.ask(Slots(0))
        if isinstance(request, Ask):
            assert strategy.ask(Slots(0)) == []  # it is asked once
            return request
        assert isinstance(request, Pour)
        assert request.dose is not None
        strategy.tell(request, poured(request, 1e3 * request.dose.amount))


def test_proposed_mixtures_are_poured_into_the_empty_cups() -> None:
    strategy = Mix(plan(*TWO, proposals=("rack/B1", "rack/B2", "rack/B3")), 5)
    question = poured_until_asked(strategy)
    assert question.proposals == 3
    assert "at most 3 cups (rack/B1, rack/B2, rack/B3)" in question.question
    assert not strategy.finished
    assert decode_request(encode_request(question)) == question
    strategy.tell(question, Answered('[{"water": "20 g", "oil": "12 g"}, {"oil": "0.03 kg"}]'))
    again = poured_until_asked(strategy)
    result = strategy.result()
    assert [(c.cup, c.liquid, c.wanted_g, c.state) for c in result.components()][4:] == [
        ("rack/B1", "oil", 12.0, "full"), ("rack/B1", "water", 20.0, "full"), ("rack/B2", "oil", 30.0, "full"),
    ]  # fmt: skip
    assert "at most 1 cups (rack/B3)" in again.question
    strategy.tell(again, Answered("[]"))
    assert strategy.finished
    assert len(strategy.result().cups) == 4


@pytest.mark.parametrize(
    ("answer", "reason"),
    [
        ("lost", "should be a list in JSON"),
        ('[{"water": "20"}]', "g"),
        ('[{"milk": "20 g"}]', "rack/B1: the table has no milk"),
        ('[{"water": "0.5 g"}]', "rack/B1: 0.5 g of water would be within its tolerance"),
        ('[{"water": "40 g", "oil": "11 g"}]', "rack/B1: it is heavier than 50 g, the largest mixture of the table"),
        ('[{"oil": "15 g"}, {"oil": "15 g"}, {"oil": "15 g"}]', "3 mixtures, and 2 cups are empty"),
        ('[{"oil": "5 g"}]', "rack/B1: 5 g of oil would be less than any amount of the table"),
        ('[{"oil": "15 g"}, {"oil": "0.1 g"}]', "rack/B2: 0.1 g of oil would be within its tolerance"),
    ],
)
def test_impossible_proposals_are_refused_together_and_asked_for_again(answer: str, reason: str) -> None:
    strategy = Mix(plan(*TWO, proposals=("rack/B1", "rack/B2")), 5)
    strategy.tell(poured_until_asked(strategy), Answered(answer))
    assert len(strategy.result().cups) == 2
    (question,) = strategy.ask(Slots(0))
    assert isinstance(question, Ask)
    assert reason in question.question.partition("\nRefused: ")[2]
    strategy.tell(question, Answered('[{"oil": "10 g"}]'))
    assert "Refused" not in poured_until_asked(strategy).question
