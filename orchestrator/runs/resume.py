"""Resuming an interrupted run: replay of its stages from the journal, and pours whose outcome is unknown.

- `read_history` reads a stage into a `StageHistory`. `replay` repeats the recorded sequence of ask and tell on a new
  strategy, which must make the recorded requests again. Neither runs a request.
- A pour that had begun when the run was interrupted has an unknown outcome, which software must not guess.
  `settle_unknown_pours` asks the operator for each one (lost, weighed, or repeat on a virtual bench) and records it.
  `settle_open_questions` does the same for questions of strategies. `parse_answer` converts an answer to an outcome.
"""

from __future__ import annotations

import inspect
import math
import re
from collections.abc import Awaitable, Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

from actors.balance.readings import KILOGRAMS, typed_weight
from actors.dosing.dose_series import LOST as LOST_BY_DOSE
from actors.dosing.dose_series import NINETY_PERCENT
from actors.interfaces import DoseTarget
from orchestrator.learning.campaign_plan import CampaignPlan
from orchestrator.learning.requests import Failed, Outcome, Pour, Poured, Request, Slots
from orchestrator.learning.run_errors import RunError
from orchestrator.learning.stage_result import DOSE, ENTERED, StageResult
from orchestrator.learning.strategy import Strategy
from orchestrator.records.codec import canonical, encode_request, first_difference
from orchestrator.records.events import (
    Asked,
    DecisionMade,
    Event,
    OperatorAnswered,
    OperatorAsked,
    PourCorrected,
    PourRead,
    PourWithdrawn,
    Requested,
    RequestFinished,
    RequestStarted,
    StageClosed,
    StageOpened,
    Told,
)
from orchestrator.records.journal import Journal, JournalReader
from sim_engine.outcome import PourMeasurement
from sim_engine.scene import Scene
from sim_engine.settings.quantity import number_readings, split_typed, typed_number


@dataclass
class StageHistory:
    """The journal's content for one stage.

    Attributes:
        seed: seed of the stage; None if the stage was never opened.
        steps: asks, tells and corrections in their order.
        requests: by id, in the order in which they were made.
        outcomes: by id, in the order in which the requests finished.
        finished: the finished requests to the laboratory, and corrections, in the same order.
        pour_attempts: how often each pour was begun.
        withdrawn: pours whose last attempt ended without pouring anything.
        readings: last mass in the receiver of each dose, as its balance showed it [kg].
        decisions: number of decisions written.
        result: result of a closed stage.
    """

    seed: int | None = None
    steps: list[Asked | Told | PourCorrected] = field(default_factory=list)
    requests: dict[int, Request] = field(default_factory=dict)
    outcomes: dict[int, Outcome] = field(default_factory=dict)
    finished: list[RequestFinished | PourCorrected] = field(default_factory=list)
    pour_attempts: dict[int, int] = field(default_factory=dict)
    withdrawn: set[int] = field(default_factory=set)
    readings: dict[int, float] = field(default_factory=dict)
    decisions: int = 0
    result: StageResult | None = None

    @property
    def ask_is_due(self) -> bool:
        """Whether the next step is `ask`: the last step was a tell, or there is no step yet."""
        return not self.steps or not isinstance(self.steps[-1], Asked)

    def unknown_pours(self) -> list[int]:
        """Pours that had begun and have no outcome."""
        return [key for key in self.pour_attempts if key not in self.outcomes and key not in self.withdrawn]


def read_history(journal: JournalReader, stage: str) -> StageHistory:
    """Read all entries of a stage.

    Raises:
        RunError: an outcome or a result can't be decoded.
    """
    history = StageHistory()
    for _, event in journal.events(stage=stage):
        match event:
            case StageOpened():
                history.seed = event.seed
            case Asked() | Told():
                history.steps.append(event)
            case PourCorrected():
                history.steps.append(event)
                history.finished.append(event)
            case Requested():
                history.requests[event.id] = event.request
            case RequestStarted(request=Pour()):
                history.pour_attempts[event.id] = event.attempt
                history.withdrawn.discard(event.id)
                history.readings.pop(event.id, None)
            case PourRead():
                history.readings[event.id] = event.mass
            case PourWithdrawn():
                history.withdrawn.add(event.id)
            case RequestFinished():
                history.outcomes[event.id] = event.outcome
                history.finished.append(event)
            case DecisionMade():
                history.decisions += 1
            case StageClosed():
                history.result = event.result
    return history


def replay(strategy: Strategy, history: StageHistory, stage: str) -> dict[int, Request]:
    """Bring a new strategy to the state at the end of the journal.

    Returns:
        The requests whose outcome the strategy has not received, by id, in the order in which they were made.

    Raises:
        RunError: the strategy's requests differ from those in the journal.
    """
    undelivered: dict[int, Request] = {}
    for step in history.steps:
        if isinstance(step, Told):
            request = undelivered.pop(step.id, None) or history.requests[step.id]
            strategy.tell(request, history.outcomes[step.id])
            continue
        if isinstance(step, PourCorrected):
            correct(strategy, history.requests[step.id], step.outcome)
            continue
        requests = strategy.ask(Slots(step.simulations, step.pours))
        for key, request in zip(step.ids, requests, strict=False):
            _check_same(history.requests[key], request, key, stage)
            undelivered[key] = history.requests[key] = request
        if len(requests) != len(step.ids):
            raise RunError(
                f"stage {stage}: the journal has {len(step.ids)} request(s) from {step.ids[:1] or 'none'} on, "
                f"the replayed strategy asks for {len(requests)}. {_ADVICE}"
            )
    return undelivered


def correct(strategy: Strategy, request: Request, outcome: Outcome) -> None:
    """Give a strategy the right outcome of a pour, in place of the one that it was told.

    Raises:
        ValueError: it is not a pour whose outcome the strategy can replace.
    """
    replace_outcome = getattr(strategy, "correct", None)
    if replace_outcome is None:
        raise ValueError("the outcomes of this stage can't be replaced before it has ended")
    replace_outcome(request, outcome)


_ADVICE = (
    "The program or its numerical libraries have changed since the run began; go on with the versions written in "
    "versions.json beside the journal, or begin a new run"
)


def _check_same(written: Request, now: Request, key: int, stage: str) -> None:
    # Decoded and encoded again: a later field with a default that changes nothing does not make a request different.
    if isinstance(written, Pour) and isinstance(now, Pour):
        written = replace(written, number=now.number)  # programs before 0.3.0 did not number refused pours
    before, after = encode_request(written), encode_request(now)
    if canonical(before) != canonical(after):
        raise RunError(
            f"stage {stage}: request {key} differs from the journal's at {first_difference(before, after)}. {_ADVICE}"
        )


Facts = Mapping[str, float | str]
"""What is known about the subject of a question; the ends of the names are units, such as 'wanted_g'."""

AskOperator = Callable[[str, Sequence[str], Facts], str | Awaitable[str]]
"""Called with a question, the allowed answers and facts; returns one of the answers. Masses follow the words 'weighed'
and 'received'."""

LOST, REPEAT, WEIGHED = "lost", "repeat", "weighed SPILLED RETAINED [LOADED]"

RECEIVED = "received MASS [± MASS]"
"""Answer to the question about a dose: what the cup has received of it."""

LOAD = "load_g"
"""Fact about an unknown pour: what its source held before [g]."""

ENTERED_DEVIATION = 0.3e-3
"""Standard deviation of an amount that a person enters without one: two weighings of a cup [kg]."""

_TRIES = 3

LOAD_WITHIN, LOAD_WITHIN_MASS = 0.1, 5e-3
"""Maximum difference between a load weighed by the operator and the nominal one: relative, or [kg] if larger."""


class OperatorNeededError(RunError):
    """The operator must answer a question, and no operator is present."""

    exit_code = 3


async def settle_unknown_pours(
    journal: Journal,
    history: StageHistory,
    stage: str,
    *,
    plan: CampaignPlan,
    scenes: Mapping[str, Scene],
    ask: AskOperator | None,
    on_waiting: Callable[[str], None],
) -> None:
    """Ask for the outcome of each pour that had started and has none, and write it to the journal.

    A pour that will be repeated (virtual bench only) stays without outcome and runs again with its seed.

    Args:
        ask: None if no operator is present.
        on_waiting: called with the question before it is shown.

    Raises:
        OperatorNeededError: no operator is present, or no valid answer was given.
        RunError: the plan repeats pours, but the bench is not virtual.
    """
    virtual = plan.laboratory.mode == "virtual"
    for key in history.unknown_pours():
        pour = history.requests[key]
        assert isinstance(pour, Pour)
        scene = scenes[pour.scene]
        subject = _subject(pour, scene, stage)
        if plan.on_unknown == "repeat":
            if not virtual:
                raise RunError(
                    f"{subject} has begun and has no outcome; 'on_unknown: repeat' is for the virtual bench only, "
                    "because on a real one the liquid may be in the receiver already. Set on_unknown: ask"
                )
            text = f"{subject} had begun and has no outcome; it is repeated with the same seed on the virtual bench"
            journal.log("info", text, stage=stage, kept=True)
            continue
        options = (*((REPEAT,) if virtual else ()), LOST, WEIGHED if pour.dose is None else RECEIVED)
        facts = unknown_pour_facts(pour, scene, history.readings.get(key))
        question = f"{subject} had begun when the run was interrupted; {_to_weigh(facts)}"
        answer, outcome = await _ask(ask, question, options, facts, on_waiting)
        if isinstance(outcome, Poured) and pour.dose is not None:
            outcome = _entered_dose(outcome, pour.dose)
        events: list[Event] = [
            OperatorAsked(stage=stage, id=key, question=question, options=options),
            OperatorAnswered(stage=stage, id=key, answer=answer),
        ]
        if outcome is not None:
            events.append(RequestFinished(stage=stage, id=key, request=pour, outcome=outcome, replayed=True))
        journal.append(*events)


def parse_answer(answer: str, options: Sequence[str], loaded: float) -> Outcome | None:
    """Convert an operator's answer to an outcome.

    Args:
        answer: 'repeat', 'lost', or 'weighed' with the masses spilled, retained and optionally loaded: in g, or with
            units. Spaces or semicolons separate them. Of a dose 'received' with the mass in the cup, and after '±' half
            of its interval with a probability of 90 %.
        options: allowed answers.
        loaded: nominal load of the pourer [kg].

    Returns:
        The outcome; None if the pour will be repeated.

    Raises:
        ValueError: the answer is invalid; the text gives the reason.
    """
    text = answer.strip().lower()
    if text == REPEAT and REPEAT in options:
        return None
    if text == LOST:
        return Failed("pour_unknown", "declared lost by the operator")
    word, _, masses = text.partition(" ")
    if word == "received" and RECEIVED in options:
        return _received(answer, masses, loaded)
    if word != "weighed":
        raise ValueError(f"'{answer}' is not an answer; answer with one of: {'; '.join(options)} (masses in grams)")
    try:
        weighed = weighed_pour(*_typed_masses(masses, loaded), nominal=loaded)
    except ValueError as error:
        raise ValueError(f"'{answer}': {error}") from None
    return replace(weighed, measurement=replace(weighed.measurement, notes=dict(_BY_OPERATOR)))


_BY_OPERATOR = {ENTERED: "weighed by the operator after a restart"}


def _received(answer: str, masses: str, loaded: float) -> Poured:
    """The outcome of a dose whose cup a person has weighed."""
    amount, stated, half = re.sub(r"\+/?[-−]", "±", masses).partition("±")
    try:
        mass, half_interval = (_typed_mass(text) if text else None for text in (amount.strip(), half.strip()))
        if mass is None or (stated and half_interval is None):
            raise ValueError("a mass is needed, what the cup has received, e.g. received 4.6 g")
        if not 0.0 <= mass <= 1.02 * loaded:
            raise ValueError(f"{1e3 * mass:g} g cannot come from a source that held {1e3 * loaded:g} g")
    except ValueError as error:
        raise ValueError(f"'{answer}': {error}") from None
    deviation = ENTERED_DEVIATION if half_interval is None else half_interval / NINETY_PERCENT
    about = {"received": mass, "deviation": deviation, "spilled": None}
    return Poured(PourMeasurement(loaded, 0.0, max(loaded - mass, 0.0), _BY_OPERATOR | {DOSE: about}))


def _typed_mass(text: str) -> float:
    digits, unit = split_typed(text)
    return typed_weight(text if unit or not digits else f"{text} g").mass


def _entered_dose(outcome: Poured, dose: DoseTarget) -> Poured:
    """The outcome of a dose that a person has entered, with what its source holds now."""
    measured, source = outcome.measurement, dose.source
    about = dict(measured.notes.get(DOSE) or {"received": measured.delivered, "spilled": measured.spilled})
    about |= {"wanted": dose.amount, "end": "entered by hand"}
    if source is not None:
        lost = LOST_BY_DOSE[0] if about["spilled"] is None else about["spilled"]
        spread = math.hypot(source.deviation, about.get("deviation", 0.0), LOST_BY_DOSE[1])
        about["left"] = [max(source.mass - about["received"] - lost, 0.0), spread]
    return Poured(replace(measured, notes={**measured.notes, DOSE: about}))


_MASS = re.compile(r"([-+−–]?[.,]?[0-9]+(?:[.,'’][0-9]+)*\.?(?:e-?[0-9]+)?)\s*([a-zµ]+)?\s*(?:;|,?(?=\s|$))\s*")


def _typed_masses(text: str, loaded: float) -> tuple[float, ...]:
    """Spilled and retained mass, and the load if it is there [kg], as an operator types them.

    A comma between digits is a decimal sign where units or semicolons separate the masses. Otherwise it may as well
    separate two masses, and the text is refused.

    Raises:
        ValueError: the text is something else, or has two meanings.
    """
    masses = _MASS.findall(text)
    units = {unit for _, unit in masses} - {""}
    if _MASS.sub("", text).strip() or not units <= set(KILOGRAMS):
        raise ValueError("after 'weighed' there must be numbers in grams, e.g. weighed 3.2 0.4")
    if not units and ";" not in text:
        separate = [(number, "") for listed, _ in masses for number in listed.split(",")]
        doubtful = [number for number, _ in masses if "," in number and "." not in number]
        if doubtful:
            readings = "".join(f"{reading}, or " for reading in number_readings(doubtful[0]))
            raise ValueError(
                f"'{doubtful[0]}' may be {readings}the masses {' and '.join(doubtful[0].split(','))}, since a comma "
                "may be a decimal sign; type decimal points, e.g. weighed 3.2 0.4, or a semicolon: weighed 3,2; 0,4"
            )
        masses = separate
    if len(masses) not in (2, 3):
        raise ValueError("two masses are needed, spilled and retained, e.g. weighed 3.2 0.4 (grams)")
    if units - {"g"} and not all(unit for _, unit in masses):
        raise ValueError("write the unit of each mass, e.g. weighed 3.2 g 0.4 g")
    kilograms = []
    for number, unit in masses:
        factor = KILOGRAMS[unit or "g"]
        possible = (loaded + _load_slack(loaded)) / factor if len(number_readings(number)) > 1 else math.inf
        kilograms.append(float(typed_number(number, unit or "g", largest=possible)) * factor)
    return tuple(kilograms)


def _load_slack(nominal: float) -> float:
    return max(LOAD_WITHIN * nominal, LOAD_WITHIN_MASS) + 1e-9


def weighed_pour(spilled: float, retained: float, loaded: float | None = None, *, nominal: float) -> Poured:
    """The outcome of a pour that a person or another program has weighed.

    Args:
        spilled, retained: masses next to the receiver, and left in the pourer [kg].
        loaded: mass in the pourer before [kg]; None for the nominal load.
        nominal: load that the pour was to have [kg].

    Raises:
        ValueError: the masses don't fit each other or the load.
    """
    slack = _load_slack(nominal)
    if loaded is not None and not abs(loaded - nominal) <= slack:
        raise ValueError(
            f"the pour was to have a load of {nominal * 1e3:g} g, and {loaded * 1e3:g} g is more than "
            f"{slack * 1e3:g} g away from that"
        )
    loaded = nominal if loaded is None else loaded
    if not (min(spilled, retained) >= 0.0 and loaded > 0.0 and spilled + retained <= 1.02 * loaded):
        raise ValueError(
            f"{spilled * 1e3:g} g spilled and {retained * 1e3:g} g retained don't fit a load of {loaded * 1e3:g} g"
        )
    return Poured(PourMeasurement(loaded, spilled, retained))


def weighed_by_hand(pour: Pour, measured: PourMeasurement) -> str:
    """Message with the answer to type on resume, for a pour that was weighed but can't be written to the journal."""
    loaded, spilled, retained = (f"{1e3 * mass:.1f}" for mass in (measured.loaded, measured.spilled, measured.retained))
    return (
        f"Pour {pour.number} was made and weighed, and is not written down: {loaded} g loaded, {spilled} g spilled, "
        f"{retained} g retained. Resuming asks for its outcome; answer: weighed {spilled} {retained} {loaded}"
    )


async def _ask(
    ask: AskOperator | None, question: str, options: Sequence[str], facts: Facts, on_waiting: Callable[[str], None]
) -> tuple[str, Outcome | None]:
    how = f"Resume with one of these answers: {'; '.join(options)} (masses in grams), for example --answer lost"
    if ask is None:
        raise OperatorNeededError(f"{question} Nobody is here to be asked. {how}")
    on_waiting(question)
    text = question
    for _ in range(_TRIES):
        reply = ask(text, options, facts)
        answer = await reply if inspect.isawaitable(reply) else reply
        try:
            return answer, parse_answer(answer, options, 1e-3 * float(facts[LOAD]))
        except ValueError as error:
            text = f"{question}\n{error}"
    raise OperatorNeededError(f"{text}. {how}")


def unknown_pour_facts(pour: Pour, scene: Scene, reading: float | None) -> dict[str, float | str]:
    """What is known about a pour whose outcome is unknown, for the person who weighs it.

    Args:
        pour: that had begun.
        scene: of the pour.
        reading: the last one of the balance in a dose, without the receiver [kg].
    """
    dose, source, cup = pour.dose, scene.pourer.name, scene.receiver.name
    facts: dict[str, float | str] = {"liquid": scene.liquid.name, "from": source, "into": cup}
    load = scene.liquid.mass
    if dose is not None:
        if dose.source is not None:
            source, load = dose.source.vessel, dose.source.mass
        facts |= {"from": source, "into": dose.cup or dose.position or cup, "wanted_g": _grams(dose.amount)}
        if reading is not None:
            facts["last_reading_g"] = _grams(reading)
        if dose.held is not None:
            facts["held_before_g"] = _grams(dose.held)
    return facts | {LOAD: _grams(load)}


def shown_fact(name: str) -> str:
    """The name of a fact for people: 'wanted [g]'."""
    return f"{name.removesuffix('_g').replace('_', ' ')} [g]" if name.endswith("_g") else name


def _grams(mass: float) -> float:
    return round(1e3 * mass, 3)


def _subject(pour: Pour, scene: Scene, stage: str) -> str:
    facts = unknown_pour_facts(pour, scene, None)
    ways = f"{facts['liquid']} from '{facts['from']}' into '{facts['into']}'"
    if pour.dose is not None:
        return f"dose {pour.number} of stage {stage}, {facts['wanted_g']:g} g of {ways},"
    return f"pour {pour.number} of stage {stage} ({pour.action.display(*_searched(scene, pour))}), {ways},"


def _to_weigh(facts: Facts) -> str:
    """What a person has to weigh, and is asked for."""
    if "wanted_g" not in facts:
        return (
            "what was its outcome? Weigh the liquid that was spilled next to the receiver, and the liquid that is left "
            f"in '{facts['from']}'"
        )
    before = facts.get("held_before_g", 0.0)
    less = f" and without the {before:g} g that it held before" if before else ""
    return f"what has the cup received? Weigh '{facts['into']}': its content, without the empty cup{less}"


def _searched(scene: Scene, pour: Pour) -> tuple[str, ...]:
    return tuple(name for name in pour.action.values() if name not in scene.fixed) or ("angular_velocity", "x_offset")
