"""`dispense`: a series of wanted amounts: one dose after the other, none repeated, out of sources that are tracked
and filled.
"""

from __future__ import annotations

import math
from pathlib import Path

import pytest

from actors.dosing.dose_estimator import ONSET
from actors.interfaces import DoseSource
from orchestrator.cli.dose_command import dose_text
from orchestrator.learning.calibration.calibration_base import Calibrated
from orchestrator.learning.campaign_plan import DispensePlan, PlannedDose
from orchestrator.learning.dispense import Dispense, KnownSource, SourcesRead
from orchestrator.learning.requests import Failed, Pour, Poured, Slots
from orchestrator.materials.vessel_account import VesselAccount
from orchestrator.records.codec import decode_request, decode_result, encode_request, encode_result
from orchestrator.records.events import CampaignOpened, RequestFinished, RequestStarted
from orchestrator.reports.wording import _dose_table
from orchestrator.runs.stages import CALIBRATION, DOSES, SOURCES, dispense_stages
from sim_engine.action import Action
from sim_engine.liquids import Liquid, SimulationParameters
from sim_engine.outcome import PourMeasurement
from sim_engine.scene import Scene
from sim_engine.vessel.shapes import cylinder
from tests.support import plans

ACTION = Action(1.0, 0.09, 0.06)
TUMBLER = cylinder("tumbler", inner_radius=0.03, inner_height=0.09)
MISSES = "stream misses the receiver"
KNOWLEDGE = {"onset_flow": [0.01, 0.0], "covariance": [1e-4, 0.0, 0.0, 0.04], "lag": None, "aim": 3e-4, "doses": 1}


def scene(source: str) -> Scene:
    pourer = cylinder(source, inner_radius=0.04, inner_height=0.1)
    return Scene(f"dispense-{source}-tumbler", pourer, TUMBLER, Liquid(mass=0.3), fixed=ACTION.values())


def plan(*grams: float, sources: tuple[str, ...] = ("beaker",), refill_below: float = 0.0) -> DispensePlan:
    doses = tuple(PlannedDose(1e-3 * g, 1e-3, "tumbler", f"A{i}") for i, g in enumerate(grams, start=1))
    return DispensePlan(tuple(map(scene, sources)), doses, refill_below, True, "bench")


def asked(strategy: Dispense) -> Pour:
    (request,) = strategy.ask(Slots(0))
    assert isinstance(request, Pour)
    return request


def source_of(pour: Pour) -> DoseSource:
    assert pour.dose is not None
    assert pour.dose.source is not None
    return pour.dose.source


def poured(pour: Pour, grams: float, **notes: object) -> Poured:
    held = source_of(pour).mass
    about = {"received": 1e-3 * grams, "left": [held - 1e-3 * grams, 1e-3], "knowledge": KNOWLEDGE, **notes}
    return Poured(PourMeasurement(held, 0.0, held - 1e-3 * grams, {"dose": about}))


def test_doses_are_asked_one_after_the_other_in_order() -> None:
    strategy = Dispense(plan(50, 25), seed=5)
    first = asked(strategy)
    assert strategy.ask(Slots(0)) == []
    strategy.tell(first, poured(first, 50.3, end="reached", duration=8.0))
    second = asked(strategy)
    assert [pour.dose and pour.dose.amount for pour in (first, second)] == [0.05, 0.025]
    assert [pour.dose and pour.dose.position for pour in (first, second)] == ["A1", "A2"]
    assert first.seed != second.seed
    strategy.tell(second, poured(second, 24.9, end="reached"))
    assert strategy.finished
    assert [dose.received_g for dose in strategy.result().doses] == pytest.approx([50.3, 24.9])


def test_a_spilled_mass_that_nobody_weighed_is_unknown_and_not_zero() -> None:
    strategy = Dispense(plan(50, 25), seed=5)
    for spilled in ({"spilled": None}, {}):  # with an arm; on a simulated bench
        pour = asked(strategy)
        strategy.tell(pour, poured(pour, 1e3 * (pour.dose.amount if pour.dose else 0.0), **spilled))
    assert [dose.spilled_g for dose in strategy.result().doses] == [None, 0.0]


def test_a_stream_that_misses_is_stated_with_its_missing_mass_wherever_the_dose_is_told() -> None:
    strategy = Dispense(plan(50), seed=5)
    pour = asked(strategy)
    end = MISSES
    strategy.tell(pour, poured(pour, 2.1, end=end, missing=None, missing_mass=7.8e-3, deviation=1e-4, spilled=None))
    (dose,) = strategy.result().doses
    assert (dose.missing_g, dose.end_text) == (pytest.approx(7.8), f"{end}: about 8 g of it")
    assert dose.end_text in dose_text(dose)
    (row,) = _dose_table("doses", strategy.result()).rows
    assert dose.end_text in row.cells[-1]


@pytest.mark.parametrize(
    ("ends", "poured_doses"),
    [("mmrr", 2), ("rmmr", 3), ("mrmr", 4), ("rrmm", 4)],
    ids=["at once", "moved later", "not in a row", "at the end"],
)
def test_nothing_is_poured_after_two_streams_in_a_row_that_missed(ends: str, poured_doses: int) -> None:
    strategy = Dispense(plan(50, 50, 50, 50, refill_below=0.0), seed=5)
    while not strategy.finished:
        pour = asked(strategy)
        missed = ends[pour.number - 1] == "m"
        strategy.tell(pour, poured(pour, 2.0 if missed else 50.0, end=MISSES if missed else "reached"))
    assert len(strategy.result().doses) == poured_doses
    stopped = [decision for decision in strategy.decisions if "nothing more is poured" in decision.text]
    assert [decision.urgent for decision in stopped] == ([True] if ends[:poured_doses].endswith("mm") else [])


def test_a_dose_knows_what_the_earlier_ones_have_shown_and_left() -> None:
    strategy = Dispense(plan(50, 25), seed=5)
    first = asked(strategy)
    assert (source_of(first).fill, source_of(first).knowledge) == (True, None)
    strategy.tell(first, poured(first, 50.3))
    second = source_of(asked(strategy))
    assert (second.fill, second.mass, second.deviation) == (False, pytest.approx(0.2497), 1e-3)
    assert second.knowledge is not None
    assert second.knowledge.onset_flow == (0.01, 0.0)
    assert second.constants == source_of(first).constants


def test_a_source_is_filled_before_it_would_hold_less_than_the_threshold() -> None:
    strategy = Dispense(plan(100, 100, 100, refill_below=0.08), seed=5)
    fills = []
    for _ in range(3):
        pour = asked(strategy)
        fills.append((source_of(pour).fill, source_of(pour).mass))
        strategy.tell(pour, poured(pour, 100.0))
    assert fills == [(True, 0.3), (False, pytest.approx(0.2)), (True, 0.3)]


def test_several_sources_are_used_before_one_is_filled_again() -> None:
    known = {"beaker": KnownSource(mass=0.12, deviation=1e-3), "jug": KnownSource(mass=0.25, deviation=1e-3)}
    strategy = Dispense(plan(100, 100, 100, 100, sources=("beaker", "jug")), seed=5, known=known)
    used = []
    while not strategy.finished:
        pour = asked(strategy)
        used.append((source_of(pour).name, source_of(pour).fill, pour.scene))
        strategy.tell(pour, poured(pour, 100.0))
    assert [name for name, _, _ in used] == ["beaker", "jug", "jug", "jug"]
    assert [fill for _, fill, _ in used] == [False, False, False, True]
    assert used[1][2] == "dispense-jug-tumbler"


def test_a_failed_dose_is_kept_and_not_repeated_and_its_source_is_filled() -> None:
    strategy = Dispense(plan(50, 25), seed=5)
    strategy.tell(asked(strategy), Failed("pour_failed", "the cup fell"))
    second = asked(strategy)
    assert second.number == 2
    assert source_of(second).fill  # what it holds is not known
    (failed,) = strategy.result().doses
    assert (failed.received_g, failed.end, failed.left_g) == (None, "pour_failed: the cup fell", None)


def test_requests_and_results_survive_the_journal() -> None:
    strategy = Dispense(plan(50, 25), seed=5)
    request = asked(strategy)
    strategy.tell(request, poured(request, 50.3, end="reached"))
    for one in (request, asked(strategy)):
        assert decode_request(encode_request(one)) == one
    assert decode_result(encode_result(strategy.result())) == strategy.result()


def test_a_pour_without_an_amount_is_written_as_before() -> None:
    data = encode_request(Pour("tumbler", ACTION, 1, 3))
    assert "dose" not in data
    assert decode_request(data) == Pour("tumbler", ACTION, 1, 3)


# ---- the calibration before the doses

GRIPS = tuple({"tilt_zero": math.radians(degrees)} for degrees in (1.8, 2.0, 2.2))


def first_sources(
    calibrated: Calibrated, poured_from: str = "beaker", known: dict[str, KnownSource] | None = None
) -> dict[str, DoseSource]:
    """Sources of the first two doses, out of two vessels, after a calibration that poured from one of them."""
    series = plan(100, 250, sources=("beaker", "jug"))
    calibration = plans.calibration_plan(scene=scene(poured_from))
    doses = next(stage for stage in dispense_stages(series, lambda series: {}, calibration) if stage.name == DOSES)
    results = {CALIBRATION: calibrated, SOURCES: SourcesRead(sources=known or {})}
    strategy = doses.build(results, 5)
    assert isinstance(strategy, Dispense)
    found = {}
    while not strategy.finished:
        pour = asked(strategy)
        found[source_of(pour).name] = source_of(pour)
        strategy.tell(pour, poured(pour, 1e3 * (pour.dose.amount if pour.dose else 0.0)))
    return found


def test_a_first_dose_begins_with_the_grip_that_the_calibration_found() -> None:
    """A cup that is held 2° more tilted pours 2° earlier; its grip is known to 0.2° instead of 0.7°."""
    theta = SimulationParameters.from_values(GRIPS[1])
    sources = first_sources(plans.calibrated(theta, GRIPS, ("tilt_zero",)))
    knowledge = sources["beaker"].knowledge
    assert knowledge is not None
    assert sources["beaker"].unused
    assert knowledge.onset_flow[0] == pytest.approx(ONSET[0] - math.radians(2.0), abs=1e-4)
    assert math.degrees(math.sqrt(knowledge.covariance[0])) == pytest.approx(math.sqrt(1.2**2 - 0.7**2), abs=0.02)
    assert sources["jug"].knowledge is None  # the calibration says nothing of another vessel's grip


def test_only_a_posterior_of_the_grip_counts_and_what_doses_have_shown_counts_more() -> None:
    theta = SimulationParameters.from_values(GRIPS[1])
    with_posterior = plans.calibrated(theta, GRIPS, ("tilt_zero",))
    for found in (plans.calibrated(theta, (), ("tilt_zero",)), plans.calibrated(theta, [{"cohesion": 0.03}])):
        assert first_sources(found)["beaker"].knowledge is None
    known = {"beaker": KnownSource(mass=0.3, deviation=1e-3, knowledge=KNOWLEDGE)}
    knowledge = first_sources(with_posterior, known=known)["beaker"].knowledge
    assert knowledge is not None
    assert (knowledge.onset_flow, knowledge.doses) == ((0.01, 0.0), 1)


# ---- the account of the sources


def test_the_account_follows_a_run_once_and_another_process_reads_it(tmp_path: Path) -> None:
    series, path = plan(50, 25), tmp_path / "vessels.sqlite"
    strategy = Dispense(series, seed=5)
    opened = CampaignOpened(name="c", run_directory=tmp_path, stages=("doses",), mode="virtual", simulators=1)
    follow = VesselAccount(path).follow(series)
    follow(opened)
    first = asked(strategy)
    follow(RequestStarted(stage="doses", id=1, request=first))
    name = series.tracked("beaker")
    begun = VesselAccount(path).content(name)
    assert begun is not None
    assert begun.kind == "begun"
    assert begun.mass is not None
    assert begun.mass + 2 * begun.deviation > 0.3 > 0.25 > begun.mass - 2 * begun.deviation  # all or nothing of it
    outcome = poured(first, 50.0)
    finished = RequestFinished(stage="doses", id=1, request=first, outcome=outcome)
    for _ in range(2):  # a resumed run tells of it again
        follow(finished)
    assert [entry.kind for entry in VesselAccount(path).history(name)] == ["poured", "begun", "filled"]
    known = VesselAccount(path).known(series)["beaker"]
    assert known.mass == pytest.approx(0.25)
    again = source_of(asked(Dispense(series, seed=6, known={"beaker": known})))
    assert (again.fill, again.mass) == (False, pytest.approx(0.25))
    assert again.knowledge is not None
    assert again.knowledge.lag is None  # the balance may be another one


def test_a_weighing_replaces_the_estimate_and_an_unknown_dose_ends_it(tmp_path: Path) -> None:
    series = plan(50)
    account, name = VesselAccount(tmp_path / "vessels.sqlite"), series.tracked("beaker")
    account.fill(name, 0.3, 1e-3, liquid="water")
    account.weigh(name, 0.27, 1e-4)
    found = account.content(name)
    assert found is not None
    assert (found.mass, found.deviation) == (0.27, 1e-4)
    pour = asked(Dispense(series, seed=5, known=account.known(series)))
    account.finish(name, pour, Failed("pour_unknown", "nobody saw it"), "water", key="run 1")
    unknown = account.content(name)
    assert unknown is not None
    assert unknown.mass is None
    assert account.known(series) == {}
    assert [entry.kind for entry in account.all()] == ["unknown"]
