"""The verdict of a run: what it reached of what was wanted, counted from its journal.

`verdict_of` is the only place that judges a run. Exit codes, `summary.json`, report, tables, catalogue, HTTP API,
notifications and metrics show its `Verdict`. It reads the plan from the journal's header, so that neither the files of
the campaign nor the packages of its plug-ins are needed.

A run is complete if it finished, if every stage has the result that it was run for, and if every wanted cup or dose
was poured within its tolerance. Failed pours of a calibration or a deployment do not prevent that.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Literal

from orchestrator.learning.dispense import dose_outcome
from orchestrator.learning.requests import Failed, Pour
from orchestrator.learning.requests import Outcome as RequestOutcome
from orchestrator.learning.stage_result import ResultPart, entered_by_hand, weighed_masses
from orchestrator.records.codec import from_json
from orchestrator.records.run_record import RunPour, RunState
from orchestrator.records.states import State

VerdictWord = Literal["complete", "incomplete", "nothing"]

Outcome = Literal["made", "missed", "refused", "failed", "unknown", "untried"]

_WORDS: dict[Outcome, str] = {
    "missed": "missed",
    "refused": "refused",
    "failed": "failed",
    "unknown": "UNKNOWN",
    "untried": "not poured",
}


class OutcomeCounts(ResultPart):
    """Numbers of wanted pours, doses or cups by outcome."""

    made: int = 0
    """Weighed pours; doses and cups within their tolerances."""

    missed: int = 0
    """Poured, beyond the tolerance."""

    refused: int = 0
    """Refused before anything was poured; cups may have some of their liquids."""

    failed: int = 0
    """Begun and failed."""

    unknown: int = 0
    """Begun, with an amount that is not known."""

    untried: int = 0
    """Not poured, or not to the end."""

    by_hand: int = 0
    """Of the ones that were made or missed: weighed by a person, who entered the masses."""

    @property
    def wanted(self) -> int:
        """Their total number."""
        return self.made + self.missed + self.refused + self.failed + self.unknown + self.untried

    def line(self, noun: str) -> str:
        """'8 of 12 cups reached; 3 refused, 1 UNKNOWN'."""
        others = ", ".join(f"{count} {word}" for name, word in _WORDS.items() if (count := getattr(self, name)))
        hand = f"{self.by_hand} weighed by hand" if self.by_hand else ""
        return f"{self.made} of {self.wanted} {noun}" + "".join(f"; {text}" for text in (others, hand) if text)


class UnmetGoal(ResultPart):
    """A reason why something was not reached."""

    outcome: Outcome
    """Outcome of the cups, doses or pours; 'failed' for a stage without the result that it was run for."""

    reason: str
    of: tuple[str, ...]
    """The cups, doses, pours or stages that it concerns, each once."""

    @property
    def line(self) -> str:
        """'refused: rack/A1, rack/A2: the gripper would touch rack/B1'."""
        return f"{_WORDS[self.outcome]}: {', '.join(self.of)}: {self.reason}"


class Verdict(ResultPart):
    """What a run reached."""

    word: VerdictWord
    """'complete': all that was wanted; 'incomplete': a part of it; 'nothing': nothing was poured or found."""

    text: str
    """The same in a line, with the counts."""

    pours: OutcomeCounts = OutcomeCounts()
    """Pours of calibration, deployment and confirmation, and single pours."""

    doses: OutcomeCounts = OutcomeCounts()
    """Doses of wanted amounts, those of mixtures included."""

    cups: OutcomeCounts = OutcomeCounts()
    """Wanted mixtures; a cup that was rejected and poured again counts once."""

    unmet: tuple[UnmetGoal, ...] = ()
    """Reasons why something was not reached, each once."""


def verdict_of(record: RunState) -> Verdict:
    """Judge a run.

    Args:
        record: counted from its journal. A pour that has begun and has no outcome is UNKNOWN, so that the verdict of
            a run in progress is provisional.
    """
    plain = [pour for pour in record.pours if pour.request.dose is None]
    dosed = [pour for pour in record.pours if pour.request.dose is not None]
    finished = record.state is State.FINISHED
    # a run of one task of a campaign, such as its calibration, has the whole plan in its header
    plan = {} if finished and not dosed else record.header.fingerprint.get("dispense") or {}
    pours = _counted([_outcome(pour) for pour in plain], plain)
    mixtures = plan.get("mixtures")
    if mixtures is None:
        cups, untried = OutcomeCounts(), max(len(plan.get("doses", ())) - len(dosed), 0)
    else:
        cups, untried = _cups(mixtures, dosed)
    doses = _counted([_outcome(pour) for pour in dosed], dosed, untried)
    stages = list(_unmet_stages(record))
    wanted = cups if cups.wanted else doses
    word: VerdictWord = "incomplete"
    if finished and not stages and wanted.made == wanted.wanted:
        word = "complete"
    elif not (pours.made or doses.made or doses.missed or _any_result(record)):
        word = "nothing"
    counts = [(cups, "cups reached"), (doses, "doses reached"), (pours, "pours weighed")]
    parts = [count.line(noun) for count, noun in counts if count.wanted]
    parts += [f"{', '.join(goal.of)}: {goal.reason}" for goal in stages]
    if not finished:
        parts.append(f"the run is {record.state}")
    text = f"{word}: {'. '.join(parts)}" if parts else word
    unmet = list(_unmet_pours(record.pours))
    told = {goal.reason for goal in unmet}
    unmet += [goal for goal in stages if goal.reason not in told]
    return Verdict(word=word, text=text, pours=pours, doses=doses, cups=cups, unmet=tuple(unmet))


def outcome_of(request: Pour, outcome: RequestOutcome | None) -> Outcome:
    """Outcome of a pour or a dose that has begun; None: it has none yet, and is UNKNOWN if it never gets one."""
    if request.dose is not None:
        reached = dose_outcome(request.dose, outcome)
        return "made" if reached == "reached" else reached
    match outcome:
        case None | Failed(kind="pour_unknown"):
            return "unknown"
        case Failed(kind="invalid_action"):
            return "refused"
        case Failed():
            return "failed"
    return "made"


def _outcome(pour: RunPour) -> Outcome:
    return "untried" if pour.state == "asked" else outcome_of(pour.request, pour.outcome)


def _counted(outcomes: Sequence[Outcome], pours: Sequence[RunPour], untried: int = 0) -> OutcomeCounts:
    by_hand = sum(pour.measured is not None and entered_by_hand(pour.measured) for pour in pours)
    counts = Counter[str](outcomes)
    counts["untried"] += untried
    return OutcomeCounts(**counts, by_hand=by_hand)


def _cups(mixtures: Mapping[str, Any], dosed: Sequence[RunPour]) -> tuple[OutcomeCounts, int]:
    """Outcomes of the cups of mixtures, and the number of their doses that were not tried.

    A spare cup has the mixture of the cup that was poured before it, and replaces that. A cup that was emptied begins
    again.
    """
    sizes: dict[str, int] = {position: len(row) for position, row in mixtures["cups"].items()}
    poured: dict[str, list[RunPour]] = {position: [] for position in sizes}
    last = ""
    for pour in dosed:
        target = pour.request.dose
        assert target is not None
        cup = target.position
        if cup in mixtures.get("spares", ()) and cup not in poured and last in sizes:
            sizes[cup] = sizes.pop(last)
            del poured[last]
        if target.emptied:
            poured[cup] = []
        poured.setdefault(cup, []).append(pour)
        last = cup
    outcomes, untried = list[Outcome](), 0
    for cup, pours in poured.items():
        # a proposed mixture is not in the plan: its last dose does not stay on the balance
        size = sizes.get(cup) or len(pours) + bool(pours[-1].request.dose and pours[-1].request.dose.stays)
        outcomes.append(_cup_outcome([_outcome(pour) for pour in pours], size))
        untried += size - len(pours)
    return _counted(outcomes, ()), untried


def _cup_outcome(doses: Sequence[Outcome], size: int) -> Outcome:
    if "unknown" in doses or "failed" in doses:
        return "unknown"
    if "refused" in doses:
        return "refused"
    if len(doses) < size or "untried" in doses:
        return "untried"
    return "missed" if "missed" in doses else "made"


def _unmet_pours(pours: Sequence[RunPour]) -> Iterator[UnmetGoal]:
    reasons: dict[tuple[Outcome, str], list[str]] = {}
    for pour in pours:
        outcome = _outcome(pour)
        if outcome not in ("made", "untried"):
            reasons.setdefault((outcome, _reason(pour)), []).append(_name(pour))
    for (outcome, reason), names in reasons.items():
        yield UnmetGoal(outcome=outcome, reason=reason, of=tuple(dict.fromkeys(names)))


def _name(pour: RunPour) -> str:
    dose = pour.request.dose
    if dose is None:
        return f"pour {pour.request.number} of {pour.stage}"
    return dose.position or f"dose {pour.request.number}"


def _reason(pour: RunPour) -> str:
    if pour.reason:
        return pour.reason
    dose = pour.request.dose
    if pour.measured is None or dose is None:
        return "it had begun, and its outcome is not known"
    received = weighed_masses(pour.measured).delivered_g or 0.0
    source = f" from {dose.source.name}" if dose.source is not None else ""
    end = pour.measured.notes.get("dose", {}).get("end", "")
    cause = "" if end in ("", "reached", "missed", "short") else f"{end}: "
    beyond = abs(received - 1e3 * dose.amount) - 1e3 * dose.limit
    return (
        f"{cause}{received:.2f} g received of {1e3 * dose.amount:g} g{source}, {beyond:.2f} g beyond the tolerance of "
        f"{1e3 * dose.limit:g} g"
    )


def _unmet_stages(record: RunState) -> Iterator[UnmetGoal]:
    """Closed stages without the result that they were run for. Results are read without the packages of their kinds."""
    for name, event in record.closed.items():
        result = from_json(event.encoded)
        reason = None
        match result.get("kind"):
            case "deployment" if result.get("gave_up"):
                reason = result["gave_up"]
            case "deployment" if result.get("pours") and all(p["status"] != "weighed" for p in result["pours"]):
                reason = "no pour was weighed"
            case "deployment" if result.get("recommended") is None:
                reason = "no action is recommended"
            case "calibration" if result.get("found") is None:
                reason = "no θ* was found"
            case "confirmation" if result.get("pours") and all(pour.get("failed") for pour in result["pours"]):
                reason = "no pour confirms the recommended action"
            case "pour" if result.get("weighed") is None:
                reason = (result.get("failed") or "").partition(": ")[2] or "nothing was poured"
        if reason is not None:
            yield UnmetGoal(outcome="failed", reason=reason, of=(name,))


def _any_result(record: RunState) -> bool:
    """Whether a stage has found something without a pour: θ*, or an action."""
    results = (from_json(event.encoded) for event in record.closed.values())
    return any(result.get("found") or (result.get("recommended") and not result.get("pours")) for result in results)
