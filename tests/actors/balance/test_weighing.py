"""`weighing`: a whole pour's weighings on virtual balances over serial lines, with somebody who does what is asked."""

from __future__ import annotations

import asyncio

import pytest

from actors.balance.balance_device import DeviceBalance
from actors.balance.balance_interface import BalanceError, ReferenceLostError
from actors.balance.serial_balance import SerialBalance
from actors.balance.weighing import Weighings
from actors.balance.weighing_plan import Placement
from actors.interfaces import LaboratoryError, OperatorQuestion
from actors.runtime.remote_object import LocalDevice
from tests.actors.balance.conftest import spec_for

LOADED, SPILLED, RETAINED = 0.2003, 0.0046, 0.0121
POURER, RECEIVER, TRAY = 0.0873, 0.1421, 0.4096


class Operator:
    """Puts things on a virtual balance as asked; anything on `surprises` happens before an answer, once each.

    Of a list, the next one happens each time.
    """

    def __init__(self, far, placement: Placement, surprises: dict[str, object] | None = None) -> None:
        self.far, self.placement = far, placement
        self.surprises = dict(surprises or {})
        self.poured = False
        self.base = TRAY if placement in (Placement.TRAY, Placement.EVERYTHING) else 0.0
        self.receiver_on = False
        self.asked: list[OperatorQuestion] = []

    def settle(self, pourer: float = 0.0) -> None:
        spill = SPILLED if self.poured and self.base else 0.0
        receiver = RECEIVER + (LOADED - SPILLED - RETAINED if self.poured else 0.0)
        self.far.put(self.base + spill + pourer + (receiver if self.receiver_on else 0.0))
        self.far.advance(5.0)

    async def __call__(self, question: OperatorQuestion) -> str:
        self.asked.append(question)
        if len(self.asked) > 30:
            raise LaboratoryError("asked for ever")
        for words in [words for words in self.surprises if words in question.text]:
            answer = self.surprises.pop(words)
            if isinstance(answer, list):
                answer, *later = answer
                if later:
                    self.surprises[words] = later
            if callable(answer):
                answer = answer()
            if answer is not None:
                return str(answer)
        text = question.text.lower()
        pourer = 0.0
        if "pourer" in text and "gripper" not in text:
            pourer = POURER + (RETAINED if self.poured else 0.0)
        if "fill the pourer" in text:
            pourer = POURER + LOADED
        if "receiver" in text and self.placement in (Placement.RECEIVER, Placement.EVERYTHING):
            self.receiver_on = "lift" not in text
        if "everything off" in text:
            self.receiver_on = False
        if question.wants == "weight":
            tray = TRAY + (SPILLED if self.poured else 0.0)
            return f"{1e3 * (tray if 'tray' in text else pourer):.1f} g"
        if question.wants == "done":
            self.settle(pourer)
        return "done"


def play(virtual, placement: Placement, surprises=None, *, elsewhere=False, pours=1, meanwhile=lambda: None):
    far = virtual("kcp")
    operator = Operator(far, placement, surprises)
    serial = spec_for(far, "kcp")
    spec = serial.with_values(placement=placement.value, pourer="elsewhere" if elsewhere else "here")

    async def all_of_it():
        driver = SerialBalance(serial, "kern-1")
        device = LocalDevice("balance", lambda: driver)
        behind = None if placement is Placement.MANUAL else DeviceBalance(device, longest_call=30.0)
        known, measured = {}, []
        try:
            for _ in range(pours):
                operator.poured = operator.receiver_on = False
                session = Weighings(spec, behind, operator, known)
                await session.before()
                operator.poured = True
                operator.settle()
                meanwhile()
                await session.after()
                measured.append(session.measurement(nominal=0.2))
                known = session.lasting
        finally:
            driver.close()
            await device.close()
        return measured

    return asyncio.run(all_of_it()), operator


# The placement of the bench of numbers is played in its own tests.
@pytest.mark.parametrize("placement", [p for p in Placement if p is not Placement.TARED])
def test_wherever_the_balance_stands_the_same_pour_is_measured(virtual, placement):
    (measured,), _ = play(virtual, placement)
    assert measured.loaded == pytest.approx(LOADED, abs=1e-9)
    assert measured.spilled == pytest.approx(SPILLED, abs=1e-9)
    assert measured.retained == pytest.approx(RETAINED, abs=1e-9)
    assert 0.0 < measured.notes["uncertainty_g"]["spilled"] < 0.1


def test_a_pourer_weighed_elsewhere_is_typed(virtual):
    (measured,), operator = play(virtual, Placement.TRAY, elsewhere=True)
    assert measured.retained == pytest.approx(RETAINED, abs=1e-9)
    assert [q.wants for q in operator.asked].count("weight") == 3


def test_the_empty_pourer_is_weighed_once_for_many_pours(virtual):
    measured, operator = play(virtual, Placement.TRAY, pours=2)
    assert measured[0].loaded == pytest.approx(measured[1].loaded)
    assert sum("empty, dry pourer" in q.text for q in operator.asked) == 1


def test_what_needs_no_hands_is_not_asked_for(virtual):
    _, operator = play(virtual, Placement.TRAY)
    assert [q.text for q in operator.asked] == [
        "Leave the wiped tray on the balance, with nothing on it.",
        "Put the empty, dry pourer on the tray.",
        "Fill the pourer and put it on the tray.",
        "Give the pourer to the gripper. Wipe the tray, and put the receiver on its stand; it must not touch the tray.",
        "Put the pourer on the tray, beside what lies there.",
    ]


def test_what_a_person_can_mend_is_asked_again_with_the_reason(virtual):
    far = virtual("kcp")

    def overload():
        far.put(8.0)
        return "done"

    (measured,), operator = play(virtual, Placement.TRAY, {"Fill the pourer": overload})
    again = [q for q in operator.asked if q.problem]
    assert len(again) == 1
    assert "over range" in again[0].problem
    assert measured.loaded == pytest.approx(LOADED, abs=1e-9)


def test_a_weight_typed_without_its_unit_is_asked_for_again(virtual):
    (measured,), operator = play(virtual, Placement.MANUAL, {"Wipe the tray": "409.6"})
    assert [q.problem for q in operator.asked if q.problem] == [
        "'409.6' has no unit; type '409.6 g' if that is what is meant"
    ]
    assert measured.spilled == pytest.approx(SPILLED, abs=1e-9)


def test_a_weight_with_two_meanings_is_shown_with_both_and_asked_for_again(virtual):
    wiped, after = ["1,234 g", "1.234 g", "1234 g"], ["1,250 g", "1,25 kg"]
    (measured,), operator = play(virtual, Placement.MANUAL, {"Wipe the tray": wiped, "Weigh the tray": after})
    assert [q.problem for q in operator.asked if q.problem] == [
        "'1,234 g' may be 1.234 g or 1234 g; type '1234 mg' or '1234 g'",
        "'1.234 g' may be 1.234 g or 1234 g; type '1234 mg' or '1234 g'",
        "'1,250 g' may be 1.250 g or 1250 g; type '1250 mg' or '1250 g'",
    ]
    assert measured.spilled == pytest.approx(0.016)


def test_a_weight_that_can_hardly_be_right_is_shown_back_and_kept_if_it_is_typed_again(virtual):
    (measured,), operator = play(
        virtual, Placement.MANUAL, {"Weigh the tray": ["41.0 g", "4110 g"], "Weigh the pourer": "390.0 g"}
    )
    problems = [q.problem for q in operator.asked if q.problem]
    assert problems == [
        "'41.0 g' is 41 g. The tray was 409.6 g before the pour, and 200.3 g were loaded: 409.6 to 609.9 g are "
        "possible. Read it again; type the same text to keep it",
        problems[1],
        "'390.0 g' is 390 g. The pourer was 87.3 g when it was empty, and 200.3 g were loaded: 87.3 to 287.6 g are "
        "possible. Read it again; type the same text to keep it",
    ]
    assert "'4110 g' is 4110 g" in problems[1]
    assert measured.spilled == pytest.approx(SPILLED, abs=1e-9)
    with pytest.raises(BalanceError, match="the tray got lighter"):
        play(virtual, Placement.MANUAL, {"Weigh the tray": ["41.0 g", "41.0 g"]})


@pytest.mark.parametrize("stayed_on", [True, False])
def test_a_plug_pulled_during_the_pour_costs_a_question_and_no_weight(virtual, stayed_on):
    far = virtual("kcp")

    def pulled():
        far.unplug()
        far.plug()

    surprises = {"stay switched on": "yes" if stayed_on else "no"}
    if stayed_on:
        (measured,), operator = play(virtual, Placement.TRAY, surprises, meanwhile=pulled)
        assert measured.spilled == pytest.approx(SPILLED, abs=1e-9)
        assert any("since the last tare" in q.problem for q in operator.asked)
    else:
        with pytest.raises(ReferenceLostError, match="If it was off"):
            play(virtual, Placement.TRAY, surprises, meanwhile=pulled)


def test_a_load_far_from_the_one_asked_for_is_refused(virtual):
    with pytest.raises(BalanceError, match=r"loaded 100\.3 .* but 200 ± 5 g was asked for"):
        play(virtual, Placement.MANUAL, {"Fill the pourer": "187.6 g", "Weigh the pourer with": "90 g"})
