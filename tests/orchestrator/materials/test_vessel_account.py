"""`vessel_account`: the account of vessels: one content for doses, orders, pours by hand and weighings, in every
process and restart.
"""

from __future__ import annotations

import contextlib
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from actors.interfaces import LaboratoryError, ProgressCallback
from orchestrator.daemon.rigs.materials import MaterialError, Materials, mass_of
from orchestrator.daemon.state.daemon_store import Store
from orchestrator.learning.campaign_plan import DispensePlan, PlannedDose
from orchestrator.learning.mixtures import Mix
from orchestrator.learning.requests import Failed
from orchestrator.materials.vessel_account import FILE_NAME, MIXTURE, LaboratoryPlaces, Transfer, VesselAccount
from orchestrator.records.events import CampaignOpened, RequestFinished, RequestStarted
from sim_engine.errors import InvalidArgumentError
from sim_engine.liquids import Liquid
from sim_engine.outcome import PourMeasurement
from sim_engine.scene import Scene
from sim_engine.vessel.shapes import cylinder
from tests.support import mixtures
from tests.support.cli_inputs import invoke
from tests.support.station import BEAKER, content, rigs_in
from tests.support.toy_campaign import ToyOptimizer, ToySimulators
from tests.support.toy_daemon import HeldBench, HeldLaboratory, campaign_in, serving

SERIES = """\
name: series
seed: 3
laboratory: {name: numbers, simulators: 2, bench: {liquid: {particles: 400}, time_scale: 0}}
liquid: {name: water, mass: 100 g}
pourer: beaker.yaml
receiver: tumbler.yaml
motion: {pivot: lip, x_offset: 80 mm, height: 100 mm}
dispense: {start: as_left, doses: [{amount: 30 g}]}
outputs: {recording: false, figures: false}
"""


def series(name: str = "beaker") -> DispensePlan:
    pourer = cylinder(name, inner_radius=0.04, inner_height=0.1)
    receiver = cylinder("tumbler", inner_radius=0.03, inner_height=0.09)
    scene = Scene("dispense", pourer, receiver, Liquid(mass=0.3))
    return DispensePlan((scene,), (PlannedDose(0.05, 1e-3, "tumbler"),), 0.0, True, "bench")


def masses(account: VesselAccount) -> dict[str, float | None]:
    return {one.vessel: one.mass for one in account.all()}


def test_a_pour_is_entered_once_in_both_vessels_and_adds_to_their_uncertainty(tmp_path: Path) -> None:
    account = VesselAccount(tmp_path / FILE_NAME)
    account.weigh("beaker-1", 0.2, 3e-4, liquid="water", by="ada")
    for _ in range(2):
        moved = Transfer((0.031, 4e-4), (0.030, 4e-4))
        VesselAccount(tmp_path / FILE_NAME).transfer("order-1", "beaker-1", "vial-7", moved)
    assert masses(account) == {"beaker-1": pytest.approx(0.169), "vial-7": pytest.approx(0.030)}
    source, receiver = account.content("beaker-1"), account.content("vial-7")
    assert source is not None
    assert receiver is not None
    assert (source.deviation, source.pour, receiver.liquid) == (pytest.approx(5e-4), "order-1", "water")


def test_another_liquid_makes_a_mixture_and_an_unknown_pour_is_healed_by_a_weighing(tmp_path: Path) -> None:
    account = VesselAccount(tmp_path / FILE_NAME)
    account.weigh("a", 0.2, 0.0, liquid="water")
    account.weigh("b", 0.1, 0.0, liquid="ethanol")
    account.transfer("1", "a", "b", Transfer((0.02, 0.0), (0.02, 0.0)))
    account.transfer("2", "a", "b", Transfer(None, None))
    account.transfer("3", "a", "b", Transfer((0.01, 0.0), (0.01, 0.0)))  # an unknown content remains unknown
    assert masses(account) == {"a": None, "b": None}
    account.weigh("b", 0.14, 1e-4)
    found = account.content("b")
    assert found is not None
    assert (found.mass, found.liquid) == (0.14, MIXTURE)
    with pytest.raises(InvalidArgumentError, match=r"deviation: -1\.0 kg should be"):
        account.weigh("b", 0.14, -1.0)
    with pytest.raises(InvalidArgumentError, match="name the liquid"):
        account.weigh("c", 0.14, 1e-4)


def test_a_series_takes_the_content_of_its_liquid_only_and_that_of_the_station_if_it_is_there(tmp_path: Path) -> None:
    account = VesselAccount(tmp_path / FILE_NAME)
    account.weigh("bench/beaker", 0.2, 1e-4, liquid="ethanol")
    assert account.known(series()) == {}
    account.weigh("bench/beaker", 0.2, 1e-4, liquid="water")
    account.weigh("4001", 0.1, 1e-4, liquid="water")
    assert account.known(series())["beaker"].mass == 0.2
    assert account.known(replace(series(), vessels={"beaker": "4001"}))["beaker"].mass == 0.1


def test_where_a_vessel_stands_outlasts_the_program_and_a_place_holds_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DECANT_STATE", str(tmp_path))
    cell = LaboratoryPlaces(VesselAccount.open(), "night")
    cell.content("receiver", 0.0, 0.0, "water")
    cell.put("receiver", "right")
    cell.put("pourer", None, "the arm began to take it from 'left'")
    assert LaboratoryPlaces(VesselAccount.open(), "night").stands() == {"receiver": "right", "pourer": None}
    with pytest.raises(LaboratoryError, match="night/receiver stands at 'right' already"):
        cell.put("pourer", "right")
    LaboratoryPlaces(VesselAccount.open(), "day").put("pourer", "right")  # the places of another laboratory
    assert "right" in invoke("materials list").stdout
    refused = invoke("materials place night/pourer right")
    assert (refused.exit_code, "a place holds one vessel" in refused.stderr) == (2, True)
    assert invoke("materials place night/pourer left").exit_code == 0
    assert cell.stands() == {"receiver": "right", "pourer": "left"}


def test_a_vessel_is_in_the_gripper_while_a_campaign_moves_it_and_unknown_only_afterwards(tmp_path: Path) -> None:
    account = VesselAccount(tmp_path / FILE_NAME)
    cell = LaboratoryPlaces(account, "night")
    cell.content("pourer", 0.1, 0.0, "water")
    cell.put("pourer", "left")
    with contextlib.closing(Store(tmp_path / "store.sqlite")) as store:
        materials = Materials(store)

        def shown(*running: str) -> tuple[str, bool]:
            (source,) = materials.everything(running).sources
            return source.position, source.in_use

        assert shown("night") == ("left", True)
        cell.put("pourer", None, "the arm began to take it from 'left'")
        assert shown("night") == ("in the gripper, from 'left'", True)
        cell.put("pourer", None, "the arm began to carry it to 'pan'")
        assert shown("night") == ("in the gripper, from 'left' to 'pan'", True)
        assert shown() == shown("day") == ("UNKNOWN (the arm began to carry it to 'pan')", False)
        cell.put("pourer", None, "interrupted: the arm began to carry it to 'pan'")
        assert shown("night") == ("UNKNOWN (interrupted: the arm began to carry it to 'pan')", True)


class DosingBench(HeldBench):
    """Pours 30.2 g of a dose and estimates what is left."""

    async def pour(
        self, scene: Scene, action: Any, *, seed: int, progress: ProgressCallback | None = None, dose: Any = None
    ) -> PourMeasurement:
        left = dose.source.mass - 0.0305
        return PourMeasurement(dose.source.mass, 3e-4, left, {"dose": {"received": 0.0302, "left": [left, 4e-4]}})


async def test_a_campaign_of_the_daemon_pours_out_of_a_vessel_of_the_station(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DECANT_STATE", str(tmp_path / "state"))
    campaign_in(tmp_path).write_text(SERIES, encoding="utf-8")

    def make() -> HeldLaboratory:
        return HeldLaboratory(ToySimulators(), DosingBench(), ToyOptimizer())

    async with serving(tmp_path, make, rigs=rigs_in(tmp_path)) as served:
        await served.post("/materials/liquids", {"id": "water"})
        await served.post("/materials/vessels", {"id": "beaker", "shape": BEAKER})
        weighed = {"mass": "90 g", "liquid": "water", "deviation": "0.1 g"}
        await served.post("/materials/vessels/beaker/weighed", weighed)
        await served.until(await served.submit(rig="left"), "finished")
        found = await content(served, "beaker")
        assert found["mass_g"] == pytest.approx(59.5)
        assert found["pour"].startswith("series-")
        for _ in range(2):  # a person pours; a repeated entry counts once
            body = {"id": "m-1", "source": "beaker", "receiver": "jar/cup", "mass": "9.5 g", "note": "by eye"}
            await served.post("/materials/pours", body)
        found = await served.get("/materials")
        assert found["vessels"][0]["content"]["mass_g"] == pytest.approx(50.0)
        assert [(one["id"], one["content"]["mass_g"]) for one in found["sources"]] == [("jar/cup", pytest.approx(9.5))]
        kinds = [one["kind"] for one in await served.get("/materials/account", vessel="beaker")]
        assert kinds == ["weighed", "weighed", "begun", "poured", "poured"]
        await served.post("/materials/vessels/jar/cup/weighed", {"mass": "9 g"})
        found = (await served.get("/materials"))["sources"][0]
        assert (found["content"]["mass_g"], found["position"]) == (pytest.approx(9.0), "")
        await served.post("/materials/vessels/jar/cup/place", {"position": "shelf"})
        assert (await served.get("/materials"))["sources"][0]["position"] == "shelf"


async def test_a_lone_surrogate_in_a_liquid_is_refused(tmp_path: Path) -> None:
    """The refusal quotes it, and UTF-8 has no code for it."""
    async with serving(tmp_path, rigs=rigs_in(tmp_path)) as served:
        client, headers = served.http, {**served.headers(), "Content-Type": "application/json"}
        for properties in (r'{"\ud969x": null}', r'{"name": "\ud969"}', r'{"density": "1 \ud969"}'):
            body = f'{{"id": "water", "properties": {properties}}}'
            answer = await client.post("/api/v1/materials/liquids", content=body, headers=headers)
            assert answer.status_code == 422, answer.text
            assert answer.json()["detail"]


def test_a_person_weighs_a_source_on_the_command_line_and_sees_what_is_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DECANT_STATE", str(tmp_path))
    monkeypatch.delenv("DECANT_URL", raising=False)
    assert "name the liquid" in invoke("materials weigh bench/beaker '200 g'").stderr
    assert invoke("materials weigh bench/beaker '200 g' --liquid water --note Monday").exit_code == 0
    assert invoke("materials poured m-1 --from bench/beaker --into bench/jar --weighed '30.5 g'").exit_code == 0
    listed = invoke("materials list").stdout
    assert "169.5 ± 0.1 g" in listed
    assert "bench/jar                water        30.5" in listed
    lines = invoke("materials list bench/beaker").stdout.splitlines()
    assert [line.split()[3] for line in lines] == ["weighed", "poured"]
    assert "Monday" in lines[0]
    assert VesselAccount.open().known(series())["beaker"].mass == pytest.approx(0.1695)
    refused = invoke("materials weigh beaker '200 g'")  # a vessel of the station: its daemon checks the entry
    assert refused.exit_code == 2
    assert "write LABORATORY/VESSEL" in refused.stderr


@pytest.mark.parametrize("mass", ["100000 kg", "1,234 g", "12.345 g", "-1 g", "5 mL", "5"])
def test_a_content_that_can_not_be_meant_is_not_entered(mass: str, tmp_path: Path) -> None:
    expected = {
        "100000 kg": "'100000 kg' is too much: at most 20 kg is possible. Is the unit right?",
        "1,234 g": "'1,234 g' may be 1.234 g or 1234 g; type '1234 mg' or '1234 g'",
        "12.345 g": "'12.345 g' may be 12.345 g or 12345 g; type '12345 mg' or '12345 g'",
        "-1 g": "should be 0 g or more",
        "5 mL": "is a volume; should be a mass",
        "5": "has no unit",
    }
    result = invoke(f'materials weigh --state {tmp_path} --liquid water -- virtual/beaker "{mass}"')
    assert result.exit_code == 2
    assert expected[mass] in result.stderr
    assert VesselAccount(tmp_path / FILE_NAME).content("virtual/beaker") is None


def test_a_content_is_read_as_it_was_typed_and_the_reading_is_shown(tmp_path: Path) -> None:
    for typed, grams in (("412,3 g", 412.3), ("1.234,5 g", 1234.5), ("0,198 kg", 198.0), ("312.345 g", 312.345)):
        result = invoke(f'materials weigh --state {tmp_path} virtual/beaker "{typed}" --liquid water')
        assert result.stdout == f"virtual/beaker: {grams:.6g} g\n"
        entry = VesselAccount(tmp_path / FILE_NAME).content("virtual/beaker")
        assert entry is not None
        assert entry.mass == pytest.approx(1e-3 * grams)


def test_a_pour_by_hand_is_checked_against_its_source_and_a_repetition_is_told(tmp_path: Path) -> None:
    def poured(key: str, mass: str) -> Any:
        return invoke(f'materials poured --state {tmp_path} {key} --from lab/jug --into lab/cup --weighed "{mass}"')

    VesselAccount(tmp_path / FILE_NAME).weigh("lab/jug", 0.2, 1e-3, liquid="water")
    result = poured("1", "1230 g")
    assert result.exit_code == 2
    assert "lab/jug: holds 200 g by its account, and 1230 g were poured from it" in result.stderr
    assert poured("1", "123,0 g").stdout == "1: 123 g from lab/jug into lab/cup\n"
    assert "is entered already, and nothing was changed" in poured("1", "12,3 g").stderr
    assert masses(VesselAccount(tmp_path / FILE_NAME)) == pytest.approx({"lab/cup": 0.123, "lab/jug": 0.077})


def test_a_source_that_can_not_hold_what_was_entered_is_not_used(tmp_path: Path) -> None:
    account = VesselAccount(tmp_path / FILE_NAME)
    account.weigh("bench/beaker", 0.49, 1e-3, liquid="water")
    assert account.known(series())["beaker"].mass == pytest.approx(0.49)
    account.weigh("bench/beaker", 1.0, 1e-3, liquid="water")
    with pytest.raises(InvalidArgumentError, match="holds 1000 g of water by its account, and there is room for 50"):
        account.known(series())
    with pytest.raises(InvalidArgumentError, match="mass: 412 kg is more than 20 kg; is it in grams"):
        account.weigh("bench/beaker", 412.0, 1e-3, liquid="water")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("1,234 g", "mass: '1,234 g' has two meanings; write '1.234 g' or '1234 g'"),
        ("12,5 g", "mass: '12,5 g' has a decimal comma; write '12.5 g'"),
        ("100000 kg", "mass: 100000 kg is more than 20 kg; is it in grams?"),
    ],
)
def test_a_mass_of_a_request_has_one_meaning(text: str, said: str, tmp_path: Path) -> None:
    with pytest.raises(MaterialError) as refusal:
        Materials(Store(tmp_path / "queue.sqlite")).weigh("lab/jug", mass_of(text, "mass"), 1e-4, "water", "ada")
    assert str(refusal.value) == said


# ---- mixtures


def composition(account: VesselAccount, cup: str) -> dict[str, float | None]:
    return {part.liquid: part.mass for part in account.composition(cup) if part.liquid}


def test_a_cup_of_a_mixture_has_what_was_weighed_into_it_and_is_unknown_during_a_dose(tmp_path: Path) -> None:
    account, series = VesselAccount(tmp_path / "account.sqlite"), mixtures.plan({"water": 40.0, "oil": 10.0})
    subscriber, strategy, cup = account.follow(series), Mix(series, 5), "bench/rack/A1"
    subscriber(CampaignOpened(name="mix", run_directory=tmp_path, stages=("doses",), mode="virtual", simulators=1))
    for grams, held in ((10.2, 10.2), (39.9, 50.1)):
        pour, _ = mixtures.asked(strategy)
        for _ in range(2):  # events of a resumed run come again
            subscriber(RequestStarted(stage="doses", id=pour.number, request=pour))
        during = account.content(cup)
        assert during is not None
        assert (during.kind, during.mass) == ("begun", None)
        outcome = mixtures.poured(pour, grams)
        strategy.tell(pour, outcome)
        for _ in range(2):
            subscriber(RequestFinished(stage="doses", id=pour.number, request=pour, outcome=outcome))
        after = account.content(cup)
        assert after is not None
        assert 1e3 * (after.mass or 0.0) == pytest.approx(held)
    assert composition(account, cup) == {"oil": pytest.approx(0.0102), "water": pytest.approx(0.0399)}
    assert (after.liquid, 1e3 * after.deviation) == ("mixture", pytest.approx(0.2 * 2**0.5))
    account.weigh(cup, 0.0, 0.0, by="a person", note="emptied")
    assert composition(account, cup) == {}


def test_a_liquid_that_a_person_has_entered_in_a_cup_is_in_it_for_the_bench_too(tmp_path: Path) -> None:
    """Otherwise it was dosed again into that cup."""
    account = VesselAccount(tmp_path / "account.sqlite")
    places = LaboratoryPlaces(account, "bench")
    account.fill("bench/rack/A1", 0.012, 1e-4, liquid="water", by="ada")
    assert places.composition("rack/A1") == {"water": (0.012, 1e-4)}
    account.weigh("bench/rack/A1", 0.0, 0.0, by="ada")
    assert places.composition("rack/A1") == {}
    places.content("source/water", 0.3, 1e-3, "water")
    assert places.composition("source/water") == {}


def test_a_cup_with_a_dose_of_unknown_amount_is_unknown(tmp_path: Path) -> None:
    account, series = VesselAccount(tmp_path / "account.sqlite"), mixtures.plan({"water": 40.0, "oil": 10.0})
    subscriber, (pour, _) = account.follow(series), mixtures.asked(Mix(series, 5))
    subscriber(CampaignOpened(name="mix", run_directory=tmp_path, stages=("doses",), mode="virtual", simulators=1))
    subscriber(RequestStarted(stage="doses", id=pour.number, request=pour))
    failed = Failed("pour_unknown", "it fell")
    subscriber(RequestFinished(stage="doses", id=pour.number, request=pour, outcome=failed))
    content = account.content("bench/rack/A1")
    assert content is not None
    assert (content.kind, content.mass) == ("unknown", None)
    assert composition(account, "bench/rack/A1") == {"oil": None}
