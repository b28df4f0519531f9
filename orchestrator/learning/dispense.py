"""Wanted amounts, one after the other: the strategies of `dispense:` and of `decant dose`.

- `ReadSources` makes no request. Its result is the content of the sources when the series began, so that a resumed run
  requests the same doses.
- `Dispense` requests one pour with a `DoseTarget` for each amount; `Dispensed` is its result. It chooses the source,
  has it filled again, and passes the estimates of each dose to the next one. A dose that failed is not repeated, and
  the next one is requested.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, Literal

from pydantic import Field

from actors.dosing.dose_series import NINETY_PERCENT
from actors.interfaces import DoseEnd, DoseKnowledge, DoseSource, DoseTarget
from orchestrator.learning.campaign_plan import DispensePlan, PlannedDose
from orchestrator.learning.requests import Decision, Failed, Outcome, Pour, Poured, Request, Slots
from orchestrator.learning.stage_result import (
    DOSE,
    ResultPart,
    StageResult,
    WeighedMasses,
    entered_by_hand,
    weighed_masses,
)
from orchestrator.learning.strategy import Progress
from orchestrator.learning.trials import SeedStream

FILL_DEVIATION = 0.5e-3
"""Standard deviation of the content of a source that was filled on a scale [kg]."""

WEIGHED_DEVIATION = 0.3e-3
"""Standard deviation of the mass that a dose takes from its source beyond the weighed amount [kg]."""

ENOUGH = 3.0
"""Standard deviations of the content by which a source has to hold more than the amount."""

MISSED_STREAMS = 2
"""Doses in a row whose stream missed the receiver, after which nothing more is poured: the first one may be its cup's,
the second one shows that something was moved for all that follow."""


class KnownSource(ResultPart):
    """Content of a source, and what its doses have shown."""

    mass: float
    """Expected content [kg]."""

    deviation: float
    """Standard deviation of the content [kg]."""

    knowledge: dict[str, Any] | None = None
    """Fields of `actors.interfaces.DoseKnowledge`."""


class SourcesRead(StageResult):
    """Content of the sources when a series began."""

    kind: Literal["sources"] = "sources"

    sources: dict[str, KnownSource]
    """By name; sources of unknown content are absent."""

    simulated: dict[str, dict[str, Any]] = Field(default_factory=dict)
    """What a simulated dose says about sources before their first dose, by name: fields of `DoseKnowledge`."""


class ReadSources:
    """Keeps the content of the sources as a result; it makes no request.

    Args:
        sources: by name.
        simulated: what a simulated dose says about sources, by name.
    """

    def __init__(
        self, sources: Mapping[str, KnownSource], simulated: Mapping[str, DoseKnowledge] | None = None
    ) -> None:
        self._sources, self._simulated = dict(sources), dict(simulated or {})
        self.decisions: list[Decision] = []

    @property
    def finished(self) -> bool:
        """True: nothing is requested."""
        return True

    def ask(self, slots: Slots) -> list[Request]:
        """Return no request."""
        return []

    def tell(self, request: Request, outcome: Outcome) -> None:
        """Raises ValueError: nothing was requested."""
        raise ValueError(f"nothing was asked for: {request}")

    def progress(self) -> Progress:
        """Return no work."""
        return Progress()

    def result(self) -> SourcesRead:
        """The content of the sources."""
        return SourcesRead(
            sources=self._sources, simulated={name: _fields(shown) for name, shown in self._simulated.items()}
        )


class DoseSignals(ResultPart):
    """Signals of a dose; empty where the bench reports none."""

    times: tuple[float, ...] = ()
    """Times of the tilt from the first motion [s]."""

    tilt_deg: tuple[float, ...] = ()
    """Tilt of the pourer [deg]."""

    read_at: tuple[float, ...] = ()
    """Times of the readings [s]."""

    readings_g: tuple[float, ...] = ()
    """Readings of the balance, without the receiver [g]."""


DoseOutcome = Literal["reached", "missed", "refused", "failed", "unknown"]


def dose_outcome(dose: DoseTarget, outcome: Outcome | None) -> DoseOutcome:
    """Whether a dose reached its amount.

    Args:
        dose: that was requested.
        outcome: of its pour; None: it had begun and has none.

    Returns:
        'missed' if the weighed amount differs from the wanted one by more than the tolerance, however the dose ended.
    """
    match outcome:
        case Poured(measured):
            received = 1e-3 * (weighed_masses(measured).delivered_g or 0.0)
            return "reached" if dose.is_met_by(received) else "missed"
        case Failed(kind="invalid_action"):
            return "refused"
        case Failed(kind="pour_failed"):
            return "failed"
    return "unknown"


class Dose(ResultPart):
    """One dose."""

    number: int
    """Number of the dose, from 1."""

    wanted_g: float
    """Wanted amount [g]."""

    received_g: float | None
    """Amount weighed in the receiver [g]; None if it is unknown."""

    deviation_g: float | None = None
    """Standard deviation of this amount [g]: steps and noise of the display, and late drops; None if it is unknown."""

    spilled_g: float | None
    """Mass outside the receiver [g]; None if it is unknown."""

    duration_s: float | None
    """Time from the first motion until it was weighed [s]."""

    end: str
    """How the dose ended, or why it failed."""

    outcome: DoseOutcome | None = None
    """'missed': its amount differs by more than the tolerance; 'refused': nothing was poured; 'unknown': it had begun,
    and its amount is not known. None in runs of earlier versions."""

    tolerance_g: float | None = None
    """Tolerance of the amount [g]; None in runs of earlier versions."""

    by_hand: bool = False
    """Whether a person weighed it and entered the amount."""

    position: str = ""
    """Name of the receiver's place."""

    source: str = ""
    """Name of the source vessel."""

    liquid: str = ""
    """Name of the liquid in a mixture."""

    batch: str = ""
    """Batch of the liquid, if the campaign states it."""

    filled: bool = False
    """Whether the source was filled before the dose."""

    left_g: float | None = None
    """Estimated content of the source after the dose [g]; None if it is unknown."""

    left_deviation_g: float | None = None
    """Standard deviation of this content [g]."""

    missing_g: float = 0.0
    """Estimated to have left the source without arriving in the receiver [g], if the stream missed it."""

    signals: DoseSignals = DoseSignals()
    """Signals over time."""

    @property
    def end_text(self) -> str:
        """The end, as 'stream misses the receiver: about 8 g of it'."""
        return f"{self.end}: about {self.missing_g:.0f} g of it" if self.missing_g else self.end

    @property
    def missed_by_g(self) -> float | None:
        """Difference from the wanted amount beyond the tolerance [g], negative below it; None unless it missed."""
        if self.outcome != "missed" or self.received_g is None or self.tolerance_g is None:
            return None
        difference = self.received_g - self.wanted_g
        return math.copysign(abs(difference) - self.tolerance_g, difference)

    @property
    def outcome_text(self) -> str:
        """'reached', or 'missed by +17.46 g beyond its tolerance of 1 g, entered by hand'; '' if it is not recorded."""
        text = "UNKNOWN" if self.outcome == "unknown" else str(self.outcome or "")
        if self.missed_by_g is not None:
            text += f" by {self.missed_by_g:+.2f} g beyond its tolerance of {self.tolerance_g:g} g"
        return f"{text}, entered by hand" if self.by_hand else text

    @property
    def half_interval_g(self) -> float | None:
        """Half of the interval that contains the true amount with a probability of 90 % [g]."""
        return None if self.deviation_g is None else NINETY_PERCENT * self.deviation_g


CupState = Literal["waiting", "filling", "full", "missed", "rejected", "refused", "unknown"]


class MixedCup(ResultPart):
    """A cup of mixtures. What it contains follows from its doses."""

    position: str
    """Name of its position."""

    wanted_g: dict[str, float]
    """Amounts of the table by liquid [g]."""

    state: CupState = "waiting"
    """'full': all doses reached their amounts; 'missed': all were poured, and one missed its tolerance; 'rejected': a
    dose missed, and the mixture was poured again; 'refused': a dose was impossible; 'unknown': the amount of a dose is
    not known."""

    replaces: str = ""
    """Position of the rejected cup whose mixture it has."""

    first_dose: int = 1
    """Number of the first dose that it may contain: it was emptied after the earlier ones."""

    def contains(self, dose: Dose) -> bool:
        """Whether a dose was poured into it since it was empty."""
        return dose.position == self.position and dose.number >= self.first_dose


class MixedComponent(ResultPart):
    """A liquid in a cup of mixtures."""

    cup: str
    """Position of the cup."""

    liquid: str
    """Name of the liquid."""

    wanted_g: float
    """Amount of the table [g]."""

    received_g: float | None
    """Weighed amount [g]; None if it was not poured, or is unknown."""

    half_interval_g: float | None
    """Half of the interval that contains the true amount with a probability of 90 % [g]."""

    share: float | None
    """Share of the cup's content by mass; None unless all of the cup is known."""

    wanted_share: float
    """The share that the table states."""

    share_half_interval: float | None
    """Half of its interval with a probability of 90 %."""

    dose: int | None
    """Number of the dose; None if it was not poured."""

    source: str
    """Name of the source."""

    batch: str
    """Batch of the liquid, if the campaign states it."""

    outcome: DoseOutcome | None
    """Outcome of the dose; None if it was not tried."""

    tolerance_g: float | None
    """Tolerance of the dose [g]; None if it was not tried."""

    missed_by_g: float | None
    """Difference from the amount that was wanted of the dose beyond its tolerance [g], negative if too little was
    poured; None unless it missed. After a missed dose this may be a corrected amount instead of the table's."""

    by_hand: bool
    """Whether a person weighed the dose and entered its amount."""

    outcome_text: str
    """The outcome in words; '' if the dose was not tried."""

    state: CupState
    """State of the cup."""


class Dispensed(StageResult):
    """Results of a series of doses."""

    kind: Literal["doses"] = "doses"

    scene: str
    """Name of the first scene."""

    doses: tuple[Dose, ...]
    """Completed doses, in the order made."""

    cups: tuple[MixedCup, ...] = ()
    """Cups of mixtures, in the order of filling."""

    def components(self) -> list[MixedComponent]:
        """Wanted and reached amounts of all cups, in the order of pouring."""
        return [component for cup in self.cups for component in self._of_cup(cup)]

    def _of_cup(self, cup: MixedCup) -> list[MixedComponent]:
        doses = {dose.liquid: dose for dose in self.doses if cup.contains(dose)}
        order = {liquid: dose.number for liquid, dose in doses.items()}
        masses = {liquid: dose.received_g for liquid, dose in doses.items()}
        complete = cup.state in ("full", "missed") and all(mass is not None for mass in masses.values())
        total = sum(mass or 0.0 for mass in masses.values())
        errors = {liquid: dose.deviation_g for liquid, dose in doses.items() if dose.deviation_g is not None}
        components = []
        for liquid, wanted in sorted(
            cup.wanted_g.items(), key=lambda item: (order.get(item[0], len(self.doses)), item)
        ):
            dose = doses.get(liquid)
            share = (masses[liquid] or 0.0) / total if complete and total > 0.0 else None
            components.append(
                MixedComponent(
                    cup=cup.position,
                    liquid=liquid,
                    wanted_g=wanted,
                    received_g=masses.get(liquid),
                    half_interval_g=None if dose is None else dose.half_interval_g,
                    share=share,
                    wanted_share=wanted / sum(cup.wanted_g.values()),
                    share_half_interval=None
                    if share is None or len(errors) < len(doses)
                    else NINETY_PERCENT * share_deviation(liquid, share, errors, total),
                    dose=None if dose is None else dose.number,
                    source="" if dose is None else dose.source,
                    batch="" if dose is None else dose.batch,
                    outcome=None if dose is None else dose.outcome,
                    tolerance_g=None if dose is None else dose.tolerance_g,
                    missed_by_g=None if dose is None else dose.missed_by_g,
                    by_hand=dose is not None and dose.by_hand,
                    outcome_text="" if dose is None else dose.outcome_text,
                    state=cup.state,
                )
            )
        return components


def share_deviation(liquid: str, share: float, deviations: Mapping[str, float], total: float) -> float:
    """Standard deviation of a liquid's share of a mixture, whose amounts have independent errors.

    Args:
        liquid: name of the liquid.
        share: its share of the mass.
        deviations: standard deviations of all amounts, by liquid, in the unit of `total`.
        total: mass of the mixture.
    """
    # x = m / M, so dx = ((1 − x) dm − x Σ dm_others) / M
    others = math.fsum(deviation**2 for name, deviation in deviations.items() if name != liquid)
    return math.sqrt(((1.0 - share) * deviations.get(liquid, 0.0)) ** 2 + share**2 * others) / total


class Dispense:
    """Pour amounts, one after the other.

    Args:
        plan: sources, amounts and their order.
        seed: seed of a virtual bench's random numbers.
        known: content of the sources; one that is absent is filled before its first dose.
        expected: what a calibration or a simulated dose has shown of sources, by name; it counts until the first dose
            of each.
    """

    def __init__(
        self,
        plan: DispensePlan,
        seed: int,
        known: Mapping[str, KnownSource] | None = None,
        expected: Mapping[str, DoseKnowledge] | None = None,
    ) -> None:
        self._plan, self._expected = plan, dict(expected or {})
        self._seeds = SeedStream(seed, "dispense")
        self._constants = self._seeds.next()
        self._sources: dict[str, KnownSource] = dict(known or {})
        self._pouring: Pour | None = None
        self._doses: list[Dose] = []
        self.decisions: list[Decision] = []

    @property
    def finished(self) -> bool:
        """Whether all doses are completed."""
        return self._pouring is None and self._next() is None

    @property
    def _stopped(self) -> bool:
        """Whether the last doses missed the receiver, so that the next one would pour onto the table."""
        last = self._doses[-MISSED_STREAMS:]
        return len(last) == MISSED_STREAMS and all(dose.end == DoseEnd.STREAM_MISSED for dose in last)

    def _next(self) -> PlannedDose | None:
        """The dose after the completed ones; None if there is none."""
        if self._stopped:
            return None
        return self._plan.doses[len(self._doses)] if len(self._doses) < len(self._plan.doses) else None

    def _in_cup(self, target: DoseTarget) -> DoseTarget:
        """The target with its cup, if it has one."""
        return target

    @property
    def _count(self) -> int:
        """Number of doses, completed and to be poured."""
        return len(self._plan.doses)

    def ask(self, slots: Slots) -> list[Request]:
        """Return the next dose, if none is running."""
        planned = self._next()
        if planned is None or self._pouring is not None or slots.pours < 1:
            return []
        number = len(self._doses) + 1
        source = self.next_source(planned)
        scene = self._plan.scene(source.name, planned.receiver)
        target = self._in_cup(DoseTarget(planned.amount, planned.limit, planned.position, source))
        self._pouring = Pour(scene.name, scene.action({}), number, self._seeds.next(), purpose=DOSE, dose=target)
        into = f" into {planned.position}" if planned.position else ""
        filled = ", filled before" if source.fill else f", which holds {1e3 * source.mass:.0f} g"
        text = f"dose {number}/{self._count}: {1e3 * planned.amount:g} g{into} from {source.name}{filled}"
        if source.knowledge is not None and source.unused:
            mean, deviation = source.knowledge.onset_flow[0], math.sqrt(source.knowledge.covariance[0])
            text += f"; expected onset: {math.degrees(mean):+.1f}° ± {math.degrees(deviation):.1f}°"
        self.decisions.append(Decision(text))
        return [self._pouring]

    def next_source(self, planned: PlannedDose) -> DoseSource:
        """The source of a dose: the first one that holds enough; if there is none, the fullest is filled."""
        names = self._plan.sources_of(planned)
        for name in names:
            content = self._sources.get(name)
            if content is not None and self._holds(content, planned):
                return self._source(name, content, fill=False)
        unknown = [name for name in names if name not in self._sources]
        name = unknown[0] if unknown else max(names, key=lambda one: self._sources[one].mass)
        scene = self._plan.scene(name, planned.receiver)
        before = self._sources.get(name)
        filled = KnownSource(
            mass=scene.liquid.mass,
            deviation=FILL_DEVIATION,
            knowledge=None if before is None else before.knowledge,
        )
        source = self._source(name, filled, fill=True)
        return source if before is None else replace(source, before=before.mass)

    def assume(self, name: str, content: KnownSource) -> None:
        """Set the content of a source, for a forecast of the doses after it."""
        self._sources[name] = content

    def _holds(self, content: KnownSource, planned: PlannedDose) -> bool:
        sure = content.mass - ENOUGH * content.deviation
        return sure > planned.amount + planned.limit and content.mass - planned.amount >= self._plan.refill_below

    def _source(self, name: str, content: KnownSource, *, fill: bool) -> DoseSource:
        knowledge = self._expected.get(name) if content.knowledge is None else knowledge_of(content.knowledge)
        return DoseSource(name, content.mass, content.deviation, fill, self._constants, knowledge)

    def take(self, pour: Pour, outcome: Outcome | None) -> None:
        """Record a dose without a request, for the result of a run that has not finished; None: it is under way."""
        self._pouring = pour
        if outcome is not None:
            self.tell(pour, outcome)

    def tell(self, request: Request, outcome: Outcome) -> None:
        """Record the outcome of a dose.

        Raises:
            ValueError: the dose was not requested, or has another kind of outcome.
        """
        pour = self._pouring
        if pour is None or request != pour:
            raise ValueError(f"this dose was not asked for: {request}")
        assert pour.dose is not None
        assert pour.dose.source is not None
        self._pouring = None
        left = left_after(pour.dose, outcome)
        if left is None:
            self._sources.pop(pour.dose.source.name, None)
        else:
            self._sources[pour.dose.source.name] = left
        about: dict[str, Any] = {}
        masses = WeighedMasses()
        match outcome:
            case Poured(measured):
                about, masses = measured.notes.get(DOSE, {}), weighed_masses(measured)
                end = str(about.get("end", ""))
            case Failed(kind, reason):
                end = f"{kind}: {reason}"
            case _:
                raise ValueError(f"a dose can't be answered by {type(outcome).__name__}")
        liquid = "" if self._plan.mixtures is None else self._plan.liquid(pour.dose.source.name)
        dose = Dose(
            number=pour.number,
            wanted_g=1e3 * pour.dose.amount,
            received_g=masses.delivered_g,
            deviation_g=None if "deviation" not in about else 1e3 * about["deviation"],
            spilled_g=masses.spilled_g,
            duration_s=about.get("duration"),
            end=end,
            outcome=dose_outcome(pour.dose, outcome),
            tolerance_g=1e3 * pour.dose.limit,
            by_hand=isinstance(outcome, Poured) and entered_by_hand(outcome.measurement),
            position=pour.dose.position,
            source=pour.dose.source.name,
            liquid=liquid,
            batch="" if self._plan.mixtures is None else self._plan.mixtures.batches.get(liquid, ""),
            filled=pour.dose.source.fill,
            left_g=None if left is None else 1e3 * left.mass,
            left_deviation_g=None if left is None else 1e3 * left.deviation,
            missing_g=1e3 * about.get("missing_mass", 0.0),
            signals=DoseSignals(**{name: about.get(name, ()) for name in DoseSignals.model_fields}),
        )
        self._doses.append(dose)
        self._settle(dose)
        if self._stopped:
            text = (
                f"nothing more is poured: the streams of {MISSED_STREAMS} doses in a row missed the receiver. See "
                "where receiver and source stand before you start another run"
            )
            self.decisions.append(Decision(text, urgent=True))

    def _settle(self, dose: Dose) -> None:
        """Decide what follows from a completed dose."""

    def progress(self) -> Progress:
        """Doses made, and their total number."""
        return Progress(pours=len(self._doses), of_pours=self._count)

    def result(self) -> Dispensed:
        """The doses so far."""
        return Dispensed(scene=self._plan.scenes[0].name, doses=tuple(self._doses))


def left_after(dose: DoseTarget, outcome: Outcome) -> KnownSource | None:
    """Content of a dose's source after it, and what the dose has shown; None if the content is unknown.

    Args:
        dose: with its source.
        outcome: of its pour.
    """
    source = dose.source
    if source is None:
        return None
    before = None if source.knowledge is None or source.unused else _fields(source.knowledge)
    match outcome:
        case Poured(measured):
            about = measured.notes.get(DOSE, {})
            if "left" in about:
                mass, deviation = map(float, about["left"])
                return KnownSource(mass=max(mass, 0.0), deviation=deviation, knowledge=about.get("knowledge", before))
            mass = max(source.mass - measured.delivered - measured.spilled, 0.0)  # an operator weighed it
            return KnownSource(mass=mass, deviation=math.hypot(source.deviation, WEIGHED_DEVIATION), knowledge=before)
        case Failed(kind="invalid_action"):  # nothing was poured
            return KnownSource(mass=source.mass, deviation=source.deviation, knowledge=before)
    return None


def _fields(knowledge: DoseKnowledge) -> dict[str, Any]:
    return {name: getattr(knowledge, name) for name in DoseKnowledge.__dataclass_fields__}


def knowledge_of(fields: Mapping[str, Any]) -> DoseKnowledge:
    """Knowledge about a source, from its fields."""
    lag = fields["lag"]
    return DoseKnowledge(
        tuple(fields["onset_flow"]),
        tuple(fields["covariance"]),
        None if lag is None else tuple(lag),
        float(fields["aim"]),
        int(fields["doses"]),
        tuple(fields.get("display", ())),
    )
