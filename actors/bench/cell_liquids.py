"""Liquid of a cell with places: what is in the vessels, in the spill tray and in the reservoir of the refill device.

`CellLiquids` enters it in the account of vessels, and asks the operator before the tray may overflow or the reservoir
runs short. The vessels are carried by `actors.bench.vessel_carrying`.
"""

from __future__ import annotations

import math

from actors.balance.weighing_plan import SURE, Weighing
from actors.bench.vessel_carrying import MotionConsent, VesselCarrier
from actors.interfaces import OperatorQuestion
from actors.places import PlaceRecord
from sim_engine.liquids import Liquid

TRAY, RESERVOIR = "tray", "reservoir"
"""Their names in the account of vessels."""


class CellLiquids:
    """Contents that the account of vessels has.

    Args:
        record: the account.
        carrier: asks the operator.
        tray: volume of the spill tray around the balance [m³]; None if it is not watched.
    """

    def __init__(self, record: PlaceRecord, carrier: VesselCarrier, tray: float | None) -> None:
        self._record, self._carrier, self._tray = record, carrier, tray
        self._in_tray = (0.0, 0.0)

    def enter(self, vessel: str, mass: float | None, deviation: float, liquid: str) -> None:
        """Enter a content [kg]; None: it is unknown until it is weighed."""
        self._record.content(vessel, mass, deviation, liquid)

    def unknown(self, vessels: tuple[str, ...], liquid: str) -> None:
        """A pour begins: these contents and that of the tray are unknown until they are weighed."""
        for name in (*vessels, *([] if self._tray is None else [TRAY])):
            self.enter(name, None, 0.0, liquid)

    # ---- the spill tray

    async def room_for_spills(self, liquid: Liquid, most: float, consent: MotionConsent) -> None:
        """Have the spill tray emptied if the liquid of one more pour could overflow it.

        Args:
            liquid: of the pour.
            most: the largest mass that it may spill [kg].
            consent: of the pour.
        """
        if self._tray is None:
            return
        held = self._record.held(TRAY)
        if held is None or held[0] + SURE * held[1] + most > self._tray * liquid.density:
            holds = "An unknown mass" if held is None else f"About {1e3 * held[0]:.0f} g"
            question = OperatorQuestion(
                f"{holds} is in the spill tray, and one more pour may spill up to {1e3 * most:.0f} g. Empty it.",
                "done",
                about="tray_full",
                details={} if held is None else {"held_g": 1e3 * held[0]},
            )
            await self._carrier.ask(question, consent)
            held = (0.0, 0.0)
            self.enter(TRAY, *held, liquid.name)
        self._in_tray = held

    def spilled(self, mass: float, deviation: float) -> None:
        """Add what was spilled [kg]; a loss within its uncertainty counts as well, a gain does not."""
        self._in_tray = (self._in_tray[0] + max(mass, 0.0), math.hypot(self._in_tray[1], deviation))

    def enter_tray(self, liquid: str) -> None:
        """Enter what is in the tray after a pour."""
        if self._tray is not None:
            self.enter(TRAY, *self._in_tray, liquid)

    # ---- the reservoir

    async def reserve(self, missing: float, consent: MotionConsent) -> tuple[float, float] | None:
        """What the reservoir of the refill device holds [kg]; None if the account has no content of it.

        While it may hold less than is `missing` [kg], a person is asked to fill it and to enter what it holds.
        """
        problem = ""
        while (held := self._record.held(RESERVOIR)) is not None and held[0] - SURE * held[1] < missing:
            question = OperatorQuestion(
                f"The reservoir of the refill device holds {1e3 * held[0]:.0f} g by the account of vessels, and "
                f"{1e3 * missing:.0f} g are needed. Fill it, and enter what it holds with 'decant materials weigh "
                f"LABORATORY/{RESERVOIR}', where LABORATORY is the name of this one.",
                "done",
                problem,
                about="reservoir",
                details={"held_g": 1e3 * held[0], "missing_g": 1e3 * missing},
            )
            await self._carrier.ask(question, consent)
            problem = "the account has not enough for it yet"
        return held

    def taken(self, reserve: tuple[float, float] | None, before: Weighing, after: Weighing, liquid: str) -> None:
        """Enter what the refill device has moved from the reservoir into a vessel.

        Args:
            reserve: what it held [kg].
            before, after: weighings of the vessel.
            liquid: name of the liquid.
        """
        if reserve is not None:
            spread = math.hypot(reserve[1], before.uncertainty, after.uncertainty)
            self.enter(RESERVOIR, reserve[0] - (after.mass - before.mass), spread, liquid)
