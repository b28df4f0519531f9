"""Mixtures: doses of several liquids into one cup after the other.

`Mix` is the strategy of `mixtures:`; its doses are those of `Dispense`. `pouring_order` has the rule of the order.

A dose misses if it differs from its amount by more than its tolerance. With `on_miss: accept`, the amounts that the cup
still lacks are multiplied by received / wanted of its doses so far, so that their ratio holds: as long as the cup and a
full source have room for it. With `on_miss: repeat`, the cup is rejected, and its mixture is poured into the next spare
cup. A cup with a dose of unknown amount gets no further liquid.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

from actors.interfaces import DoseKnowledge, DoseTarget
from orchestrator.learning.campaign_plan import DispensePlan, PlannedDose
from orchestrator.learning.dispense import Dispense, Dispensed, Dose, KnownSource, MixedCup
from orchestrator.learning.requests import Decision, Failed, Outcome, Poured
from sim_engine.vessel.vessel import build_vessel

STEP = 1e-5
"""Corrected amounts are multiples of it [kg]."""


def pouring_order(amounts: Mapping[str, float], fixed: Sequence[str] | None = None) -> list[str]:
    """The liquids of one cup in the order of pouring.

    All doses of a cup follow each other, because gripper and balance hold one vessel each. Within a cup the smallest
    amount is first: it has the largest relative error, and the larger ones after it can be corrected.

    Args:
        amounts: wanted [kg], by liquid, in the order of the table.
        fixed: order that a person has fixed; None: the smallest amount first.
    """
    if fixed is None:
        return sorted(amounts, key=lambda liquid: amounts[liquid])
    return sorted(amounts, key=fixed.index)


class Mix(Dispense):
    """Pour mixtures, one cup after the other.

    Args:
        plan: with mixtures.
        seed, known, calibrated: see `Dispense`.
    """

    def __init__(
        self,
        plan: DispensePlan,
        seed: int,
        known: Mapping[str, KnownSource] | None = None,
        calibrated: Mapping[str, DoseKnowledge] | None = None,
    ) -> None:
        super().__init__(plan, seed, known, calibrated)
        assert plan.mixtures is not None
        self._mixtures = plan.mixtures
        self._spares = list(plan.mixtures.spares)
        self._cups = [_cup(position, doses) for position, doses in plan.mixtures.cups.items()]
        self._planned = {position: dict(doses) for position, doses in plan.mixtures.cups.items()}
        self._remaining = {position: list(doses.values()) for position, doses in plan.mixtures.cups.items()}

    def _next(self) -> PlannedDose | None:
        return next((self._remaining[cup.position][0] for cup in self._cups if self._open(cup)), None)

    def _open(self, cup: MixedCup) -> bool:
        return cup.state in ("waiting", "filling")

    def _in_cup(self, target: DoseTarget) -> DoseTarget:
        cup, source = target.position, target.source
        assert source is not None
        poured = [1e-3 * (dose.received_g or 0.0) for dose in self._doses if dose.position == cup]
        return replace(
            target,
            source=replace(source, vessel=source.name),
            cup=cup,
            stays=len(self._remaining[cup]) > 1,
            held=sum(poured) if poured else None,
        )

    @property
    def _count(self) -> int:
        return len(self._doses) + sum(len(self._remaining[cup.position]) for cup in self._cups if self._open(cup))

    def _settle(self, dose: Dose, outcome: Outcome) -> None:
        index = next(i for i, cup in enumerate(self._cups) if cup.position == dose.position)
        cup, remaining = self._cups[index], self._remaining[dose.position]
        planned = remaining.pop(0)
        state = cup.state
        match outcome:
            case Poured() if dose.received_g is not None:
                state = "filling" if remaining else "full"
                missed = abs(1e-3 * dose.received_g - planned.amount) > planned.limit
                if missed and self._mixtures.on_miss == "accept":
                    self._correct(cup)
                elif missed and self._spares:
                    state = "rejected"
                    self._pour_again(index, dose)
                elif missed:
                    self._say(f"{_missed(dose)}; no spare cup is left, the mixture stays as it is", urgent=True)
            case Failed(kind="invalid_action"):
                state = "refused"
                self._say(f"{cup.position}: a dose is impossible, the cup stays as it is: {dose.end}", urgent=True)
            case _:
                state = "unknown"
                self._say(f"{cup.position}: its content is UNKNOWN, nothing more is poured into it", urgent=True)
        self._cups[index] = cup.model_copy(update={"state": state})

    def _correct(self, cup: MixedCup) -> None:
        """Multiply the amounts that a cup still lacks so that their ratio to its content holds, if there is room."""
        poured = [dose for dose in self._doses if dose.position == cup.position]
        remaining = self._remaining[cup.position]
        received = sum(dose.received_g or 0.0 for dose in poured)
        factor = received / sum(cup.wanted_g[dose.liquid] for dose in poured)
        if not remaining:
            self._say(f"{_missed(poured[-1])}; it was the last of its cup, and is accepted")
            return
        table = self._planned[cup.position]
        corrected = [
            replace(dose, amount=round(factor * table[dose.liquid or ""].amount / STEP) * STEP) for dose in remaining
        ]
        if (reason := self._no_room(poured, corrected)) is not None:
            self._say(f"{_missed(poured[-1])}; the other amounts of {cup.position} stay as they are: {reason}")
            return
        self._remaining[cup.position] = corrected
        amounts = ", ".join(f"{dose.liquid} {1e3 * dose.amount:g} g" for dose in corrected)
        self._say(
            f"{_missed(poured[-1])}; the other amounts of {cup.position} are multiplied by {factor:.3f}: {amounts}"
        )

    def _no_room(self, poured: Sequence[Dose], corrected: Sequence[PlannedDose]) -> str | None:
        """Why corrected amounts can't be poured; None if they can."""
        densities = {scene.liquid.name: scene.liquid.density for scene in self._plan.scenes}
        full = {scene.liquid.name: scene.liquid.mass for scene in self._plan.scenes}
        volume = sum(1e-3 * (dose.received_g or 0.0) / densities[dose.liquid] for dose in poured)
        for dose in corrected:
            liquid = dose.liquid or ""
            if dose.amount <= dose.limit:
                return f"{1e3 * dose.amount:.3g} g of {liquid} would be within its tolerance"
            if dose.amount + dose.limit + self._plan.refill_below >= full[liquid]:
                return f"a full source holds too little {liquid}"
            volume += (dose.amount + dose.limit) / densities[liquid]
        return None if volume <= build_vessel(self._plan.scenes[0].receiver).capacity else "the cup has no room"

    def _pour_again(self, index: int, dose: Dose) -> None:
        """Pour the mixture of a rejected cup into the next spare one."""
        rejected, spare = self._cups[index], self._spares.pop(0)
        doses = {liquid: replace(d, position=spare) for liquid, d in self._planned[rejected.position].items()}
        self._planned[spare], self._remaining[spare] = doses, list(doses.values())
        self._cups.insert(index + 1, _cup(spare, doses, replaces=rejected.position))
        self._say(f"{_missed(dose)}; {rejected.position} is rejected, its mixture is poured into {spare}", urgent=True)

    def _say(self, text: str, *, urgent: bool = False) -> None:
        self.decisions.append(Decision(text, urgent=urgent))

    def result(self) -> Dispensed:
        """The doses so far, and the cups. That of a dose under way is being filled."""
        cups = tuple(self._cups)
        if self._pouring is not None and self._pouring.dose is not None:
            position, filling = self._pouring.dose.position, {"state": "filling"}
            cups = tuple(cup.model_copy(update=filling) if cup.position == position else cup for cup in cups)
        return super().result().model_copy(update={"cups": cups})


def dose_strategy(
    plan: DispensePlan,
    seed: int,
    known: Mapping[str, KnownSource] | None = None,
    calibrated: Mapping[str, DoseKnowledge] | None = None,
) -> Dispense:
    """The strategy of a series of doses; see `Dispense`."""
    kind = Dispense if plan.mixtures is None else Mix
    return kind(plan, seed, known, calibrated)


def _cup(position: str, doses: Mapping[str, PlannedDose], replaces: str = "") -> MixedCup:
    wanted = {liquid: 1e3 * dose.amount for liquid, dose in doses.items()}
    return MixedCup(position=position, wanted_g=wanted, replaces=replaces)


def _missed(dose: Dose) -> str:
    return (
        f"dose {dose.number}, {dose.wanted_g:g} g of {dose.liquid} into {dose.position}, missed its tolerance: "
        f"{dose.received_g or 0.0:.1f} g"
    )
