"""Mixtures: doses of several liquids into one cup after the other.

`Mix` is the strategy of `mixtures:`; its doses are those of `Dispense`. `pouring_order` has the rule of the order.

A dose misses if it differs from its amount by more than its tolerance. Then `on_miss` decides:

- accept: the amounts that the cup still lacks are multiplied by received / wanted of its doses so far, so that their
  ratio holds, as long as the cup and a full source have room for it.
- repeat: the mixture is poured again, into the next spare cup; without spare cups, into the same one, emptied before.
- ask: the operator chooses one of these, or that the amounts stay as they are.

A cup with a dose of unknown amount gets no further liquid.

With `cups: {proposals: …}`, further mixtures are asked for when all cups are poured, until these cups are used: an
optimiser closes the loop within one run.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace

from actors.interfaces import DoseKnowledge, DoseTarget
from orchestrator.learning.campaign_plan import DispensePlan, PlannedDose
from orchestrator.learning.dispense import Dispense, Dispensed, Dose, KnownSource, MixedCup
from orchestrator.learning.requests import Answered, Ask, Decision, Outcome, Pour, Request, Slots
from sim_engine.settings.quantity import parse_quantity
from sim_engine.vessel.vessel import build_vessel

REPEATS = 2
"""How often the mixture of a cup is poured again into itself."""

STEP = 1e-5
"""Corrected amounts are multiples of it [kg]."""

HEAVIER = 1e-4
"""Mass by which a proposed mixture may exceed the largest one of the table, whose cup was checked [kg]."""

NO_MORE = "[]"
"""The answer that ends the proposals."""


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


def parse_proposals(answer: str) -> list[dict[str, float]]:
    """Mixtures as an answer in JSON proposes them: masses by liquid [kg].

    Raises:
        ValueError: it has another form; the text says which.
    """
    form = 'a list in JSON, such as [{"water": "30 g", "oil": "8 g"}]'
    try:
        rows = json.loads(answer)
    except ValueError:
        raise ValueError(f"the mixtures should be {form}") from None
    if not isinstance(rows, list) or not all(isinstance(row, dict) and row for row in rows):
        raise ValueError(f"the mixtures should be {form}")
    return [{liquid: parse_quantity(text, "kg", "30 g") for liquid, text in row.items()} for row in rows]


class Mix(Dispense):
    """Pour mixtures, one cup after the other.

    Args:
        plan: with mixtures.
        seed, known, expected: see `Dispense`.
    """

    def __init__(
        self,
        plan: DispensePlan,
        seed: int,
        known: Mapping[str, KnownSource] | None = None,
        expected: Mapping[str, DoseKnowledge] | None = None,
    ) -> None:
        super().__init__(plan, seed, known, expected)
        assert plan.mixtures is not None
        self._mixtures = plan.mixtures
        self._spares = list(plan.mixtures.spares)
        self._cups = [_cup(position, doses) for position, doses in plan.mixtures.cups.items()]
        self._planned = {position: dict(doses) for position, doses in plan.mixtures.cups.items()}
        self._remaining = {position: list(doses.values()) for position, doses in plan.mixtures.cups.items()}
        self._emptied = Counter[str]()
        self._miss: tuple[int, Dose, Ask] | None = None
        self._asked = False
        self._free, self._refused = list(plan.mixtures.proposals or ()), ""

    def _next(self) -> PlannedDose | None:
        if self._stopped:
            return None
        return next((self._remaining[cup.position][0] for cup in self._cups if self._open(cup)), None)

    def _open(self, cup: MixedCup) -> bool:
        return cup.state in ("waiting", "filling")

    def _in_cup(self, target: DoseTarget) -> DoseTarget:
        cup, source = target.position, target.source
        assert source is not None
        poured = [
            1e-3 * (d.received_g or 0.0) for mixed in self._cups for d in self._poured(mixed) if d.position == cup
        ]
        return replace(
            target,
            source=replace(source, vessel=source.name),
            cup=cup,
            stays=len(self._remaining[cup]) > 1,
            emptied=self._emptied[cup] > 0 and not poured,
            held=sum(poured) if poured else None,
        )

    @property
    def finished(self) -> bool:
        """Whether all doses are completed, and no question is open."""
        return self._question is None and super().finished

    @property
    def _question(self) -> Ask | None:
        """What has to be decided before the next dose; None: nothing."""
        if self._miss is not None:
            return self._miss[2]
        if self._stopped or not self._free or self._pouring is not None or self._next() is not None:
            return None
        text = f"Which mixtures are poured next, into at most {len(self._free)} cups ({', '.join(self._free)})? "
        text += (
            f'Answer in JSON, such as [{{"water": "30 g", "oil": "8 g"}}]; {NO_MORE} ends the series.{self._refused}'
        )
        return Ask(text, (NO_MORE,), len(self._free))

    def ask(self, slots: Slots) -> list[Request]:
        """Return the next dose, if none is running and there is nothing to decide."""
        if (question := self._question) is None:
            return super().ask(slots)
        pending, self._asked = self._asked, True
        return [] if pending else [question]

    def tell(self, request: Request, outcome: Outcome) -> None:
        """Record the outcome of a dose, or an answer.

        Raises:
            ValueError: the request was not made, or has another kind of outcome.
        """
        if not isinstance(request, Ask):
            super().tell(request, outcome)
            return
        if request != self._question or not isinstance(outcome, Answered):
            raise ValueError(f"this was not asked, or not answered: {request.question}")
        self._asked = False
        if self._miss is None:
            self.propose(outcome.answer)
            return
        (index, dose, _), self._miss = self._miss, None
        self._decide(index, dose, outcome.answer)

    def propose(self, answer: str) -> None:
        """Add the mixtures of an answer. If one of them is impossible, none is added, and the question is repeated."""
        cups: dict[str, dict[str, PlannedDose]] = {}
        try:
            rows = parse_proposals(answer)
            if len(rows) > len(self._free):
                raise ValueError(f"{len(rows)} mixtures, and {len(self._free)} cups are empty")
            for position, row in zip(self._free, rows, strict=False):
                cups[position] = self._proposed(position, row)
        except ValueError as error:
            self._refused = f"\nRefused: {error}"
            self._say(f"the proposed mixtures are refused: {error}", urgent=True)
            return
        self._free, self._refused = self._free[len(rows) :] if rows else [], ""
        self._say(f"proposed: {', '.join(cups)}" if rows else "no further mixtures are proposed")
        self._planned |= cups
        self._remaining |= {position: list(doses.values()) for position, doses in cups.items()}
        self._cups += [_cup(position, doses) for position, doses in cups.items()]

    def _proposed(self, position: str, row: Mapping[str, float]) -> dict[str, PlannedDose]:
        """The doses of a proposed mixture. Raises ValueError: it can't be poured."""
        known = {dose.liquid: dose for dose in self._plan.doses}
        if unknown := [liquid for liquid in row if liquid not in known]:
            raise ValueError(f"{position}: the table has no {', '.join(unknown)}")
        doses = {
            liquid: replace(known[liquid], amount=row[liquid], position=position)
            for liquid in pouring_order(row, self._mixtures.order)
        }
        reason = self._no_room([], list(doses.values()))
        largest = max(sum(dose.amount for dose in cup.values()) for cup in self._mixtures.cups.values())
        if reason is None and sum(dose.amount for dose in doses.values()) > largest + HEAVIER:
            reason = f"it is heavier than {1e3 * largest:.4g} g, the largest mixture of the table"
        if reason is not None:
            raise ValueError(f"{position}: {reason}")
        return doses

    def take(self, pour: Pour, outcome: Outcome | None) -> None:
        """See `Dispense.take`. What was decided after a miss follows from the next dose."""
        assert pour.dose is not None
        if self._doses:
            index = next(i for i, cup in enumerate(self._cups) if cup.position == self._doses[-1].position)
            emptied = pour.dose.emptied and self._cups[index].first_dose <= self._doses[-1].number
            if emptied or pour.dose.position in self._spares:
                self._pour_again(index)
        self._miss = None
        super().take(pour, outcome)

    @property
    def _count(self) -> int:
        return len(self._doses) + sum(len(self._remaining[cup.position]) for cup in self._cups if self._open(cup))

    def _settle(self, dose: Dose) -> None:
        index = next(i for i, cup in enumerate(self._cups) if cup.position == dose.position)
        cup, remaining = self._cups[index], self._remaining[dose.position]
        del remaining[0]
        state = cup.state
        match dose.outcome:
            case "reached" | "missed" if remaining:
                state = "filling"
            case "reached" | "missed":
                state = "missed" if any(poured.outcome == "missed" for poured in self._poured(cup)) else "full"
            case "refused":
                state = "refused"
                self._say(f"{cup.position}: a dose is impossible, the cup stays as it is: {dose.end}", urgent=True)
            case _:
                state = "unknown"
                self._say(f"{cup.position}: its content is UNKNOWN, nothing more is poured into it", urgent=True)
        self._cups[index] = cup.model_copy(update={"state": state})
        if dose.outcome == "missed" and not self._stopped:
            policy = self._mixtures.on_miss
            self._decide(index, dose, "correct" if policy == "accept" else policy)

    def _poured(self, cup: MixedCup) -> list[Dose]:
        return [dose for dose in self._doses if cup.contains(dose)]

    def _decide(self, index: int, dose: Dose, answer: str) -> None:
        """Follow from a missed dose what the campaign or the operator has decided."""
        cup, text = self._cups[index], _missed(dose)
        corrected, correction = self._correction(cup)
        repetition = self._repetition(cup)
        if answer == "ask":
            options = ["accept", *(["correct"] if corrected else []), *(["repeat"] if repetition else [])]
            question = (
                f"{text[0].upper()}{text[1:]}; {self._limit(dose):.3g} g are tolerated. accept: it stays as it is. "
                f"{'correct: ' if corrected else 'No correction is possible: '}{correction}."
                + (f" repeat: {repetition}." if repetition else "")
            )
            self._miss = index, dose, Ask(question, tuple(options))
        elif answer == "repeat" and repetition:
            self._say(f"{text}; {repetition}", urgent=True)
            self._pour_again(index)
        elif answer == "repeat":
            reason = "no spare cup is left" if self._mixtures.spares else f"it was poured again {REPEATS} times"
            self._say(f"{text}; {reason}, the mixture stays as it is", urgent=True)
        elif answer == "correct":
            self._remaining[cup.position] = corrected or self._remaining[cup.position]
            self._say(f"{text}; {correction}")
        else:
            self._say(f"{text}; it is accepted")

    def _limit(self, dose: Dose) -> float:
        """Tolerance of a dose [g]."""
        return 1e3 * self._planned[dose.position][dose.liquid].limit

    def _correction(self, cup: MixedCup) -> tuple[list[PlannedDose], str]:
        """The amounts that a cup still lacks, multiplied so that their ratio to its content holds, and their text; none
        and the reason if they can't be poured."""
        poured, remaining = self._poured(cup), self._remaining[cup.position]
        if not remaining:
            return [], "it was the last dose of its cup"
        factor = sum(dose.received_g or 0.0 for dose in poured) / sum(cup.wanted_g[dose.liquid] for dose in poured)
        table = self._planned[cup.position]
        corrected = [
            replace(dose, amount=round(factor * table[dose.liquid or ""].amount / STEP) * STEP) for dose in remaining
        ]
        if (reason := self._no_room(poured, corrected)) is not None:
            return [], f"the other amounts of {cup.position} stay as they are: {reason}"
        amounts = ", ".join(f"{dose.liquid} {1e3 * dose.amount:g} g" for dose in corrected)
        return corrected, f"the other amounts of {cup.position} are multiplied by {factor:.3f}: {amounts}"

    def _no_room(self, poured: Sequence[Dose], corrected: Sequence[PlannedDose]) -> str | None:
        """Why corrected amounts can't be poured; None if they can."""
        densities = {scene.liquid.name: scene.liquid.density for scene in self._plan.scenes}
        full = {scene.liquid.name: scene.liquid.mass for scene in self._plan.scenes}
        volume = sum(1e-3 * (dose.received_g or 0.0) / densities[dose.liquid] for dose in poured)
        # it was not checked that source and balance support less than this
        smallest = min(dose.amount for row in self._planned.values() for dose in row.values())
        for dose in corrected:
            liquid = dose.liquid or ""
            if dose.amount <= dose.limit:
                return f"{1e3 * dose.amount:.3g} g of {liquid} would be within its tolerance"
            if dose.amount < smallest - 0.5 * STEP:
                return f"{1e3 * dose.amount:.3g} g of {liquid} would be less than any amount of the table"
            if dose.amount + dose.limit + self._plan.refill_below >= full[liquid]:
                return f"a full source holds too little {liquid}"
            volume += (dose.amount + dose.limit) / densities[liquid]
        return None if volume <= build_vessel(self._plan.scenes[0].receiver).capacity else "the cup has no room"

    def _repetition(self, cup: MixedCup) -> str:
        """How the mixture of a cup would be poured again; '' if it can't be."""
        if self._spares:
            return f"{cup.position} is rejected, its mixture is poured into {self._spares[0]}"
        if self._mixtures.spares or self._emptied[cup.position] >= REPEATS:
            return ""
        return f"{cup.position} is emptied, and its mixture is poured again"

    def _pour_again(self, index: int) -> None:
        """Pour the mixture of a cup again: into the next spare one, or into itself."""
        cup = self._cups[index]
        if not self._spares:
            self._emptied[cup.position] += 1
            self._remaining[cup.position] = list(self._planned[cup.position].values())
            self._cups[index] = cup.model_copy(update={"state": "filling", "first_dose": len(self._doses) + 1})
            return
        spare = self._spares.pop(0)
        doses = {liquid: replace(d, position=spare) for liquid, d in self._planned[cup.position].items()}
        self._planned[spare], self._remaining[spare] = doses, list(doses.values())
        self._cups[index] = cup.model_copy(update={"state": "rejected"})
        self._cups.insert(index + 1, _cup(spare, doses, replaces=cup.position))

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
    expected: Mapping[str, DoseKnowledge] | None = None,
) -> Dispense:
    """The strategy of a series of doses; see `Dispense`."""
    kind = Dispense if plan.mixtures is None else Mix
    return kind(plan, seed, known, expected)


def _cup(position: str, doses: Mapping[str, PlannedDose], replaces: str = "") -> MixedCup:
    wanted = {liquid: 1e3 * dose.amount for liquid, dose in doses.items()}
    return MixedCup(position=position, wanted_g=wanted, replaces=replaces)


def _missed(dose: Dose) -> str:
    return (
        f"dose {dose.number}, {dose.wanted_g:g} g of {dose.liquid} into {dose.position}, missed its tolerance: "
        f"{dose.received_g or 0.0:.1f} g"
    )
