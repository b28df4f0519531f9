"""`resume`: what a person is asked about a dose whose amount is unknown, and what becomes of the answer."""

from __future__ import annotations

import asyncio
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from actors.dosing.dose_series import LOST as LOST_BY_DOSE
from actors.dosing.dose_series import NINETY_PERCENT
from orchestrator.learning.dispense import Dispensed
from orchestrator.learning.mixtures import Mix
from orchestrator.learning.requests import Outcome, Pour, Poured
from orchestrator.materials.vessel_account import VesselAccount
from orchestrator.records.events import (
    CampaignOpened,
    Event,
    PourRead,
    Requested,
    RequestFinished,
    RequestStarted,
    StageOpened,
)
from orchestrator.records.journal import Header
from orchestrator.records.run_record import RunState
from orchestrator.reports.mixture_report import mixture_rows
from orchestrator.reports.summarise import pour_summaries
from orchestrator.reports.wording import cost, standing
from orchestrator.runs.resume import (
    LOST,
    RECEIVED,
    WEIGHED,
    StageHistory,
    parse_answer,
    settle_unknown_pours,
    unknown_pour_facts,
)
from tests.support import mixtures

SERIES = mixtures.plan({"water": 40.0, "oil": 10.0})
SCENES = {scene.name: scene for scene in SERIES.scenes}


def weighed(pour: Pour, grams: float) -> Poured:
    """The outcome of a dose on a bench, which weighs nothing outside the cup."""
    outcome = mixtures.poured(pour, grams)
    outcome.measurement.notes["dose"]["spilled"] = None
    return outcome


def dosed(*answers: str | float) -> tuple[Mix, list[Event]]:
    """The doses of a cup, each weighed by the bench [g] or entered by a person, and the events of their run."""
    strategy = Mix(SERIES, 5)
    events: list[Event] = [
        CampaignOpened(name="mix", run_directory=Path("run"), stages=("doses",), mode="virtual", simulators=1),
        StageOpened(stage="doses", seed=5),
    ]
    for key, answer in enumerate(answers, start=1):
        pour, _ = mixtures.asked(strategy)
        events += [Requested(stage="doses", id=key, request=pour), RequestStarted(stage="doses", id=key, request=pour)]
        outcome: Outcome = weighed(pour, answer) if isinstance(answer, float) else settled(pour, answer)[0]
        events.append(RequestFinished(stage="doses", id=key, request=pour, outcome=outcome))
        strategy.tell(pour, outcome)
    return strategy, events


def settled(pour: Pour, answer: str, reading: float | None = None) -> tuple[Outcome, str, tuple[str, ...], Any]:
    """The outcome of an unknown dose; the question, its options and its facts."""
    asked: list[Any] = []
    written: list[Event] = []

    def ask(question: str, options: Any, facts: Any) -> str:
        asked.extend((question, tuple(options), facts))
        return answer

    history = StageHistory(requests={1: pour}, pour_attempts={1: 1}, readings={} if reading is None else {1: reading})
    plan: Any = SimpleNamespace(laboratory=SimpleNamespace(mode="hardware"), on_unknown="ask")
    journal: Any = SimpleNamespace(append=lambda *events: written.extend(events))
    asyncio.run(
        settle_unknown_pours(
            journal, history, "doses", plan=plan, scenes=SCENES, ask=ask, on_waiting=lambda question: None
        )
    )
    return next(e.outcome for e in written if isinstance(e, RequestFinished)), *asked


def test_the_question_names_cup_liquid_amount_and_last_reading_and_what_to_weigh() -> None:
    strategy = Mix(SERIES, 5)
    first, _ = mixtures.asked(strategy)
    strategy.tell(first, mixtures.poured(first, 10.2))
    pour, _ = mixtures.asked(strategy)
    _, question, options, facts = settled(pour, "lost", reading=22.2e-3)
    assert question.startswith(
        "dose 2 of stage doses, 40 g of water from 'source/water' into 'rack/A1', had begun when"
    )
    assert "Weigh 'rack/A1': its content, without the empty cup and without the 10.2 g that it held before" in question
    assert options == (LOST, RECEIVED)
    assert facts == {
        "liquid": "water",
        "from": "source/water",
        "into": "rack/A1",
        "wanted_g": 40.0,
        "last_reading_g": 22.2,
        "held_before_g": 10.2,
        "load_g": 300.0,  # of this source, not of another liquid's
    }


def test_a_report_of_a_run_with_an_unknown_dose_says_which_cup_is_to_be_weighed() -> None:
    pour, _ = mixtures.asked(Mix(SERIES, 5))
    record = RunState(Header("mix", {}))
    for event in (
        StageOpened(stage="doses", seed=5),
        Requested(stage="doses", id=1, request=pour),
        RequestStarted(stage="doses", id=1, request=pour),
    ):
        record.take(event)
    said = " ".join(standing(record, "mix-1"))
    assert "Dose 1 of doses had begun, and its outcome is not known." in said
    assert "Weigh the content of 'rack/A1', and give the answer on resuming." in said


def test_the_last_reading_is_in_the_journal() -> None:
    event = PourRead(stage="doses", id=3, phase="pour", mass=4.2e-3)
    assert event.body() == {"id": 3, "phase": "pour", "mass": 4.2e-3}


def test_the_question_about_a_pour_names_vessels_and_liquid() -> None:
    scene = SERIES.scenes[1]
    facts = unknown_pour_facts(Pour(scene.name, mixtures.ACTION, 1, 7), scene, None)
    assert facts == {"liquid": "oil", "from": "source/oil", "into": "cup", "load_g": 300.0}


@pytest.mark.parametrize(
    ("answer", "grams", "half"),
    [
        ("received 4.6 g", 4.6, 0.3 * NINETY_PERCENT),
        ("received 4,6", 4.6, 0.3 * NINETY_PERCENT),
        ("Received 4.6 ± 0.2 g", 4.6, 0.2),
        ("received 4.6 g +/- 0.2 g", 4.6, 0.2),
        ("received 0 g", 0.0, 0.3 * NINETY_PERCENT),
    ],
)
def test_what_the_cup_has_received_is_read_with_its_interval(answer: str, grams: float, half: float) -> None:
    outcome = parse_answer(answer, (LOST, RECEIVED), 0.28)
    assert isinstance(outcome, Poured)
    about = outcome.measurement.notes["dose"]
    assert 1e3 * about["received"] == pytest.approx(grams)
    assert 1e3 * about["deviation"] * NINETY_PERCENT == pytest.approx(half)


@pytest.mark.parametrize(
    ("answer", "complaint"),
    [
        ("received", "a mass is needed"),
        ("received -1 g", "-1 g cannot come from a source that held"),
        ("received 4.6 ml", "not a unit of mass"),
        ("received 4.6 ±", "a mass is needed"),
        ("received 290 g", "cannot come from a source that held 280 g"),
        ("received a bit", "not a weight"),
        ("4.6 g", "is not an answer"),
    ],
)
def test_an_amount_that_makes_no_sense_is_explained(answer: str, complaint: str) -> None:
    with pytest.raises(ValueError, match=complaint):
        parse_answer(answer, (LOST, RECEIVED), 0.28)
    with pytest.raises(ValueError, match="is not an answer"):
        parse_answer("received 4.6 g", (LOST, WEIGHED), 0.28)  # of a pour


def test_a_dose_that_a_person_entered_has_the_interval_of_the_entry_and_leaves_its_source_known() -> None:
    strategy, _ = dosed(10.2, "received 38 ± 2 g")
    measured, entered = strategy.result().doses
    assert (measured.received_g, entered.received_g) == pytest.approx((10.2, 38.0))
    assert entered.half_interval_g == pytest.approx(2.0)
    assert measured.half_interval_g == pytest.approx(0.2 * NINETY_PERCENT)
    assert entered.by_hand
    assert entered.left_g == pytest.approx(300.0 - 38.0 - 1e3 * LOST_BY_DOSE[0])
    assert entered.left_deviation_g is not None
    assert entered.left_deviation_g > 2.0 / NINETY_PERCENT
    shares = [component.share_half_interval for component in strategy.result().components()]
    assert all(share is not None and share > 0.2 * 2.0 / 48.2 * 0.9 for share in shares)


def test_a_share_has_no_interval_if_one_of_its_doses_has_none() -> None:
    strategy, _ = dosed(10.2, 40.0)
    result = strategy.result()
    doses = (result.doses[0].model_copy(update={"deviation_g": None}), result.doses[1])
    assert {c.share_half_interval for c in result.model_copy(update={"doses": doses}).components()} == {None}


@pytest.mark.parametrize("carried", [False, True])
@pytest.mark.parametrize("vessels", ["without ids", "with ids", "of an order"])
def test_after_the_answer_the_account_knows_the_cup(carried: bool, vessels: str, tmp_path: Path) -> None:
    account, (_, events) = VesselAccount(tmp_path / "vessels.sqlite"), dosed(10.2, "received 38 ± 2 g")
    ids, ordered = {"rack/A1": "cup-1", "source/water": "can", "source/oil": "jug"}, vessels == "of an order"
    for place, vessel in ids.items() if vessels != "without ids" else ():
        account.assign(vessel, ("bench", place), by="ada")
    follow = account.follow(replace(SERIES, laboratory="", vessels=ids) if ordered else SERIES, carried=carried)
    if carried:  # the bench enters its own doses, and that the second one has begun
        for liquid, mass in (("oil", 10.2e-3), ("water", None)):
            account.add_component("bench/rack/A1", liquid, mass, 2e-4, f"bench/source/{liquid}")
        account.lose("bench/rack/A1")
    for event in [*events, *events]:  # a resumed run replays them
        follow(event)
    content = account.content("bench/rack/A1")
    assert content is not None
    assert content.mass == pytest.approx(48.2e-3)
    assert content.deviation == pytest.approx(2e-3 / NINETY_PERCENT, rel=0.02)
    source = account.content("bench/source/water")
    assert source is not None
    assert source.mass == pytest.approx(0.3 - 0.038 - LOST_BY_DOSE[0])


def test_the_sums_of_report_tables_page_and_account_are_the_masses_of_the_journal(tmp_path: Path) -> None:
    strategy, events = dosed(10.2, "received 38 ± 2 g")
    record, account = RunState(Header("mix", {})), VesselAccount(tmp_path / "vessels.sqlite")
    follow = account.follow(SERIES)
    for event in events:
        record.take(event)
        follow(event)
    journal = sum(
        1e3 * event.outcome.measurement.notes["dose"]["received"]
        for event in events
        if isinstance(event, RequestFinished) and isinstance(event.outcome, Poured)
    )
    assert journal == pytest.approx(48.2)
    # one dose was weighed by the bench, whose tray counts what it may have spilled; nobody has weighed the other's
    assert cost(record, {})["liquid"] == "48 g delivered; spilled by 1 dose: not weighed, 1 g by estimate"
    assert sum(pour.delivered_g or 0.0 for pour in pour_summaries(None, record)) == pytest.approx(journal)
    result = strategy.result()
    assert isinstance(result, Dispensed)
    assert sum(component.received_g or 0.0 for component in result.components()) == pytest.approx(journal)
    rows = mixture_rows(result, record)
    assert sum(float(str(row["received_g"])) for row in rows) == pytest.approx(journal)
    content = account.content("bench/rack/A1")
    assert content is not None
    assert 1e3 * (content.mass or 0.0) == pytest.approx(journal)
