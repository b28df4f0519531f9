"""`flowing_liquid`: liquid that follows an emulated arm: a lost answer is made up for; an emulator that has ended
ends the flow.
"""

from __future__ import annotations

import threading
from dataclasses import dataclass

import pytest

from actors.arm.ur_settings import UrArmSettings
from actors.bench import flowing_liquid
from actors.bench.flowing_liquid import FlowingLiquid, FlowOrder
from actors.dosing.virtual_dosing_bench import TrueCup
from actors.interfaces import LaboratoryError
from sim_engine.liquids import Liquid
from tests.support.waiting import PATIENCE


@dataclass(frozen=True)
class Motion:
    times: tuple[float, ...] = ()
    joints: tuple[tuple[float, ...], ...] = ()
    now: float = 0.0


def following(history: object) -> FlowingLiquid:
    order = FlowOrder(TrueCup(0.04, 0.1), Liquid(mass=0.3), constants=1, seed=2, wetness=0.0, base=0.1)
    return FlowingLiquid(order, UrArmSettings.model_construct(), history, lambda mass: None)  # type: ignore[arg-type]


def test_the_flow_ends_when_the_emulator_has_been_silent_for_too_long(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(flowing_liquid, "SILENCE", 0.0)
    calls = 0

    def history(since: float) -> Motion:
        nonlocal calls
        calls += 1
        if calls > 1:
            raise LaboratoryError("the emulator has ended")
        return Motion()

    liquid = following(history)
    liquid._thread.join(PATIENCE)
    assert not liquid._thread.is_alive()
    assert liquid.end().received == 0.0


def test_the_flow_goes_on_after_a_lost_answer() -> None:
    again, calls = threading.Event(), 0

    def history(since: float) -> Motion:
        nonlocal calls
        calls += 1
        if calls == 2:
            raise LaboratoryError("no answer")
        if calls > 3:
            again.set()
        return Motion()

    liquid = following(history)
    assert again.wait(PATIENCE)
    liquid.end()
