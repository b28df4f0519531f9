"""`verdict`: what a run reached, judged from its events alone."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from actors.interfaces import DoseTarget
from orchestrator.campaigns.fingerprint import deciding
from orchestrator.learning.calibration.calibration_base import Calibrated
from orchestrator.learning.campaign_plan import DispensePlan
from orchestrator.learning.deployment.deployment_result import Deployed, Recommended
from orchestrator.learning.deployment.real_pours import PredictionCheck
from orchestrator.learning.mixtures import Mix
from orchestrator.learning.requests import Answered, Ask, Failed, Outcome, Pour, Poured, Slots
from orchestrator.learning.single_action import SingleResult
from orchestrator.learning.stage_result import ENTERED, StageResult
from orchestrator.records.events import (
    CampaignStateChanged,
    Event,
    Requested,
    RequestFinished,
    RequestStarted,
    StageClosed,
)
from orchestrator.records.journal_file import Header
from orchestrator.records.run_record import RunState
from orchestrator.records.states import State
from orchestrator.records.verdict import OutcomeCounts, verdict_of
from sim_engine.outcome import PourMeasurement
from tests.support.mixtures import ACTION, plan, poured

LOST = Failed("pour_unknown", "the program died")
REFUSED = Failed("invalid_action", "the gripper would touch rack/B1")


def record(
    pours: list[tuple[Pour, Outcome | None]],
    *,
    series: DispensePlan | None = None,
    state: State = State.FINISHED,
    results: dict[str, StageResult] | None = None,
) -> RunState:
    """The state of a run with these pours; one without an outcome has begun."""
    run = RunState(Header("x", {"dispense": deciding(series)} if series is not None else {}))
    events: list[Event] = []
    for key, (pour, outcome) in enumerate(pours, start=1):
        stage = "doses" if pour.dose is not None else "pours"
        events += [Requested(stage=stage, id=key, request=pour), RequestStarted(stage=stage, id=key, request=pour)]
        if outcome is not None:
            events.append(RequestFinished(stage=stage, id=key, request=pour, outcome=outcome))
    events += [StageClosed(stage=name, result=result) for name, result in (results or {}).items()]
    events.append(CampaignStateChanged(before=State.RUNNING, after=state, pid=1))
    for event in events:
        run.take(event)
    return run


def pour(number: int, dose: DoseTarget | None = None) -> Pour:
    return Pour("scene", ACTION, number, 1, dose=dose)


def weighed(grams: float, **notes: object) -> Poured:
    return Poured(PourMeasurement(0.2, 0.0, 0.2 - 1e-3 * grams, dict(notes)))


def dose(number: int, grams: float, position: str = "") -> Pour:
    return pour(number, DoseTarget(1e-3 * grams, 1e-3, position))


def test_a_night_whose_cups_were_all_refused_reached_nothing() -> None:
    series = plan({"water": 20.0}, {"water": 20.0})
    refused = [(dose(i, 20.0, f"rack/A{i}"), REFUSED) for i in (1, 2)]
    verdict = verdict_of(record(refused, series=series))
    assert verdict.word == "nothing"
    assert verdict.cups == OutcomeCounts(refused=2)
    assert [goal.line for goal in verdict.unmet] == ["refused: rack/A1, rack/A2: the gripper would touch rack/B1"]
    assert verdict.text == "nothing: 0 of 2 cups reached; 2 refused. 0 of 2 doses reached; 2 refused"


def test_a_cup_with_five_times_its_amount_has_missed() -> None:
    series = plan({"water": 4.74})
    verdict = verdict_of(record([(dose(1, 4.74, "rack/A1"), weighed(22.2))], series=series))
    assert (verdict.word, verdict.cups, verdict.doses) == (
        "incomplete", OutcomeCounts(missed=1), OutcomeCounts(missed=1),
    )  # fmt: skip
    (goal,) = verdict.unmet
    assert goal.reason == "22.20 g received of 4.74 g, 16.46 g beyond the tolerance of 1 g"


def test_a_series_that_missed_its_receiver_says_so_and_what_was_not_tried() -> None:
    outcome = weighed(2.0, dose={"end": "stream misses the receiver"})
    series = plan({"water": 20.0}, {"water": 20.0}, {"water": 20.0})
    missed = [(dose(i, 20.0, f"rack/A{i}"), outcome) for i in (1, 2)]
    verdict = verdict_of(record(missed, series=series))
    assert verdict.text.startswith("incomplete: 0 of 3 cups reached; 2 missed, 1 not poured")
    (goal,) = verdict.unmet
    assert goal.reason.startswith("stream misses the receiver: 2.00 g received of 20 g, 17.00 g beyond")


@pytest.mark.parametrize(
    ("outcome", "word", "counts"),
    [
        (weighed(20.5), "complete", OutcomeCounts(made=1)),
        (weighed(20.5, **{ENTERED: "by hand"}), "complete", OutcomeCounts(made=1, by_hand=1)),
        (weighed(22.0), "incomplete", OutcomeCounts(missed=1)),
        (REFUSED, "nothing", OutcomeCounts(refused=1)),
        (LOST, "nothing", OutcomeCounts(unknown=1)),
        (None, "nothing", OutcomeCounts(unknown=1)),
        (Failed("pour_failed", "the arm stopped"), "nothing", OutcomeCounts(failed=1)),
    ],
)
def test_a_dose_counts_by_its_outcome(outcome: Outcome | None, word: str, counts: OutcomeCounts) -> None:
    verdict = verdict_of(record([(dose(1, 20.0), outcome)]))
    assert (verdict.word, verdict.doses) == (word, counts)


def test_a_paused_series_counts_the_doses_that_were_not_poured() -> None:
    series = plan({"water": 20.0}, {"water": 20.0, "oil": 10.0})
    first = [(dose(1, 20.0, "rack/A1"), weighed(20.0))]
    verdict = verdict_of(record(first, series=series, state=State.PAUSED))
    assert (verdict.cups, verdict.doses) == (OutcomeCounts(made=1, untried=1), OutcomeCounts(made=1, untried=2))
    assert verdict.text.endswith("the run is paused")
    assert verdict.word == "incomplete"


def deployed(*, gave_up: str | None = None, found: bool = True) -> Deployed:
    best = Recommended(action={}, action_si={}, predicted_loss=0.0, predicted_deviation=0.0, predicted_scatter=None)
    return Deployed(
        strategy="D3", scene="s", loss="normalised", simulations=0, simulations_lost=0, simulations_refused=0,
        pours=(), simulated=(), former_pours=0, refused_pours=0, failed_pours=0,
        model_check=PredictionCheck(z_scores=(), alarm=False), gave_up=gave_up, recommended=best if found else None,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("result", "word", "text"),
    [
        (deployed(), "complete", ""),
        (deployed(gave_up="20 pours were refused"), "incomplete", "deployment:narrow: 20 pours were refused"),
        (deployed(found=False), "incomplete", "deployment:narrow: no action is recommended"),
        (SingleResult(failed="pour_failed: it fell"), "incomplete", "deployment:narrow: it fell"),
    ],
)
def test_a_stage_has_to_have_the_result_that_it_was_run_for(result: StageResult, word: str, text: str) -> None:
    pours: list[tuple[Pour, Outcome | None]] = [(pour(1), weighed(150.0)), (pour(2), Failed("pour_failed", "it slid"))]
    verdict = verdict_of(record(pours, results={"deployment:narrow": result}))
    assert verdict.word == word
    assert verdict.pours == OutcomeCounts(made=1, failed=1)
    assert text in verdict.text


def test_a_calibration_without_theta_reached_nothing() -> None:
    found = Calibrated(strategy="C4", simulations=3, lost=3, undefined=0, training_pours=0, trials=())
    verdict = verdict_of(record([], results={"calibration": found}))
    assert (verdict.word, verdict.text) == ("nothing", "nothing: calibration: no θ* was found")


_STATES = {
    "full": "made", "missed": "missed", "refused": "refused", "unknown": "unknown", "waiting": "untried",
    "filling": "untried",
}  # fmt: skip


@given(
    errors=st.lists(st.sampled_from([0.0, 0.0, 0.0, 3.0, -3.0, "refused", "lost", "failed"]), min_size=9, max_size=9),
    policy=st.sampled_from(["accept", "repeat", "ask"]),
    spares=st.booleans(),
    stop=st.integers(0, 12),
)
def test_cups_are_judged_from_the_journal_as_the_strategy_sees_them(
    errors: list[float | str], policy: str, *, spares: bool, stop: int
) -> None:
    rows = ({"water": 40.0, "oil": 10.0}, {"water": 20.0, "oil": 30.0}, {"water": 25.0})
    series = plan(*rows, on_miss=policy, spares=("rack/D6",) if spares else ())
    strategy, made = Mix(series, 5), list[tuple[Pour, Outcome | None]]()
    failures = {"refused": REFUSED, "lost": LOST, "failed": Failed("pour_failed", "it slid")}
    while not strategy.finished and len(made) < stop:
        (request,) = strategy.ask(Slots(0))
        if isinstance(request, Ask):
            strategy.tell(request, Answered(request.options[len(made) % len(request.options)]))
            continue
        assert isinstance(request, Pour)
        assert request.dose is not None
        error = errors[len(made) % len(errors)]
        outcome = failures[error] if isinstance(error, str) else poured(request, 1e3 * request.dose.amount + error)
        strategy.tell(request, outcome)
        made.append((request, outcome))
    result = strategy.result()
    verdict = verdict_of(record(made, series=series, state=State.FINISHED if strategy.finished else State.PAUSED))
    expected = [_STATES[cup.state] for cup in result.cups if cup.state != "rejected"]
    # After a decision to pour a mixture again, the journal shows it with the next dose only.
    if strategy.finished:
        assert verdict.cups == OutcomeCounts(**{word: expected.count(word) for word in set(expected)})
        assert (verdict.word == "complete") == (set(expected) == {"made"})
    assert verdict.cups.wanted == len(rows)
    assert verdict.doses.made == sum(row.outcome == "reached" for row in result.doses)
