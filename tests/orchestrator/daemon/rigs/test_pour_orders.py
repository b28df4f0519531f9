"""`pour_orders`: pours that another program orders: once each, with result, prediction and reasons for a refusal."""

from __future__ import annotations

import asyncio
from pathlib import Path
from typing import Any

import pytest

from actors.interfaces import ProgressCallback
from orchestrator.campaigns.file_loading import load_campaign, load_laboratory
from orchestrator.daemon.state.daemon_settings import Rig
from orchestrator.materials.vessel_account import FILE_NAME, LaboratoryPlaces, VesselAccount
from orchestrator.records.journal import JOURNAL_NAME, JournalReader, Kind
from orchestrator.runs.run_folder import RESOLVED
from sim_engine.outcome import PourMeasurement
from sim_engine.scene import Scene
from tests.support.station import content, order, rigs_in, set_up, until_pour
from tests.support.toy_campaign import ToyOptimizer, ToySimulators
from tests.support.toy_daemon import HeldBench, HeldLaboratory, Served, held, serving


def begun(folder: Path) -> int:
    """Number of pours that have begun in all runs."""
    count = 0
    for path in (folder / "state/runs").glob(f"*/{JOURNAL_NAME}"):
        with JournalReader(path) as journal:
            count += sum(1 for _ in journal.entries(kinds=[Kind.POUR_STARTED]))
    return count


async def test_an_ordered_pour_is_weighed_and_entered_in_the_account(tmp_path: Path) -> None:
    async with serving(tmp_path, rigs=rigs_in(tmp_path)) as served:
        await set_up(served)
        found = await served.post("/pours?wait=600", order())
        assert found["state"] == "weighed"
        result = found["result"]
        low, high = result["received_interval_g"]
        assert low < result["received_g"] < high
        assert result["received_g"] + result["spilled_g"] + result["left_in_source_g"] == pytest.approx(100.0)
        source, receiver = await content(served, "beaker"), await content(served, "vial-1")
        assert source["mass_g"] == pytest.approx(100.0 - result["received_g"] - result["spilled_g"])
        assert receiver["mass_g"] == pytest.approx(result["received_g"])
        assert (receiver["liquid"], receiver["pour"]) == ("water", "order-1")
        assert source["deviation_g"] > 0.1  # of its weighing
        assert [one["id"] for one in await served.get("/pours")] == ["order-1"]
        record = load_campaign(tmp_path / "state/runs" / found["run"] / RESOLVED)  # as 'decant report' reads it
        scene = record.pour
        assert scene is not None
        assert record.deployment is None
        assert (scene.pourer.name, scene.receiver.name, scene.liquid.mass) == ("beaker", "vial-1", 0.1)
        assert scene.fixed["x_offset"] == 0.07
        assert record.laboratory.name == "numbers"


async def test_a_repeated_order_returns_the_pour_and_another_order_with_its_id_is_refused(tmp_path: Path) -> None:
    async with serving(tmp_path, held, rigs=rigs_in(tmp_path)) as served:
        await set_up(served)
        first, second = await asyncio.gather(served.post("/pours", order()), served.post("/pours", order()))
        assert first["campaign"] == second["campaign"]
        laboratory = await served.pouring()
        assert (await served.post("/pours", order()))["state"] == "running"
        told = await served.post("/pours", order(receiver="vial-2"), status=409)
        assert "belongs to another order" in told["detail"]
        laboratory.bench.go.set()
        result = (await until_pour(served, "order-1", "weighed"))["result"]
        assert (await served.post("/pours", order()))["result"] == result
    async with serving(tmp_path, rigs=rigs_in(tmp_path)) as served:
        assert (await served.post("/pours", order()))["result"] == result
        assert len(await served.get("/campaigns")) == 1
    assert begun(tmp_path) == 1


async def test_a_source_that_cannot_serve_an_order_refuses_it_before_anything_moves(tmp_path: Path) -> None:
    async with serving(tmp_path, rigs=rigs_in(tmp_path)) as served:
        await set_up(served)
        await served.post("/queue/pause")
        for changes, status, said in (
            ({"amount": "120 g"}, 409, "beaker: holds 100 ± 0.3 g, and 120 g are wanted"),
            ({"source": "vial-2", "amount": "5 g"}, 409, "vial-2: is empty"),
            ({"source": "vial-1", "amount": "5 g"}, 409, "source and receiver at once"),
            ({"receiver": "vial-9", "amount": "5 g"}, 422, "there is no vessel 'vial-9'"),
            ({"amount": "5 kg"}, 409, "are wanted"),
            ({"amount": "5 s"}, 422, "amount: '5 s' is a time"),
            ({"amount": "1 g"}, 422, "larger than the tolerance"),
            ({"action": {}}, 422, "give an 'amount'"),
            ({"action": {"angular_velocity": "100 deg/s", "x_offset": "0 mm"}}, 422, "touch"),
            ({"action": {"angular_velocity": "9 deg/s", "return_velocity": "none"}}, 422, "only replays recorded"),
        ):
            told = await served.post("/pours", order(**changes), status=status)
            assert said in told["detail"], (changes, told)
        await served.post("/pours", order(amount="60 g"))
        told = await served.post("/pours", order("order-2", amount="60 g", receiver="vial-2"), status=409)
        assert "60 g of it are promised" in told["detail"]
        await served.post("/pours/order-1/cancel")
        await served.post("/pours", order("order-2", amount="60 g", receiver="vial-2"))
    assert begun(tmp_path) == 0


@pytest.mark.slow
async def test_a_dry_run_states_amount_spread_duration_and_limits_and_leaves_nothing_behind(tmp_path: Path) -> None:
    async with serving(tmp_path, rigs=rigs_in(tmp_path)) as served:
        await set_up(served)
        found = await served.post("/pours", order(amount="30 g", dry_run=True))
        low, high = found["predicted"]["interval_g"]
        assert 25.0 < low < high < 31.0
        assert found["predicted"]["duration_s"] > 0.0
        assert found["limits"]["available_g"] == pytest.approx(99.7)
        assert found["state"] == "dry run"
        again = await served.post("/pours", order(amount="30 g", dry_run=True))
        assert again["predicted"] == found["predicted"]
        assert await served.get("/pours") == []
        assert not list((tmp_path / "state/campaigns").iterdir())
    assert begun(tmp_path) == 0


async def test_a_cancelled_pour_is_not_poured_and_a_paused_one_goes_on(tmp_path: Path) -> None:
    async with serving(tmp_path, rigs=rigs_in(tmp_path)) as served:
        await set_up(served)
        await served.post("/queue/pause")
        await served.post("/pours", order())
        assert (await served.post("/pours/order-1/cancel"))["state"] == "cancelled"
        assert (await served.post("/pours/order-1/cancel"))["state"] == "cancelled"
        await served.post("/pours", order("order-2"))
        assert (await served.post("/pours/order-2/pause"))["state"] == "paused"
        await served.post("/queue/resume")
        assert (await served.post("/pours", order()))["state"] == "cancelled"
        await served.post("/pours/order-2/resume")
        await until_pour(served, "order-2", "weighed")
    assert begun(tmp_path) == 1


async def test_a_pour_without_outcome_is_unknown_and_blocks_its_vessels_until_an_operator_reports_it(
    tmp_path: Path,
) -> None:
    async with serving(tmp_path, held, rigs=rigs_in(tmp_path)) as served:
        await set_up(served)
        key = (await served.post("/pours", order()))["campaign"]
        await served.pouring()
        await served.post("/emergency-stop")
        assert (await until_pour(served, "order-1", "unknown"))["result"] is None
        await served.post("/emergency-stop/clear", role=_admin())
        assert (await served.post("/pours", order()))["state"] == "unknown"
        told = await served.post("/pours", order("order-2"), status=409)
        assert "order-1 has begun and has no outcome" in told["detail"]
        await served.until(key, "unknown")
        await served.post(f"/campaigns/{key}/resume")
        question = await served.question()
        await served.post(f"/questions/{question['id']}/answer", {"answer": "lost"})
        found = await until_pour(served, "order-1", "failed")
        assert found["result"]["received_g"] is None
        assert (await content(served, "beaker"))["mass_g"] is None
        told = await served.post("/pours", order("order-2"), status=409)
        assert "weigh the vessel" in told["detail"]
        for vessel, mass in (("beaker", "70 g"), ("vial-1", "20 g")):
            await served.post(f"/materials/vessels/{vessel}/weighed", {"mass": mass, "liquid": "L-1"})
        assert await _pours(served, order("order-2"))
    assert begun(tmp_path) == 2


async def test_pours_of_one_source_take_what_the_pours_before_them_have_left(tmp_path: Path) -> None:
    async with serving(tmp_path, rigs=rigs_in(tmp_path)) as served:
        await set_up(served)
        await served.post("/queue/pause")
        for number in (1, 2, 3):
            await served.post("/pours", order(f"order-{number}", receiver=f"vial-{1 + number % 2}"))
        await served.post("/queue/resume")
        # the toy bench pours everything but 1 g: the second pour finds 1 g, and the third one none
        first = await until_pour(served, "order-1", "weighed")
        second = await until_pour(served, "order-2", "weighed", "failed")
        assert first["result"]["left_in_source_g"] == pytest.approx(1.0)
        assert second["result"] is None or second["result"]["received_g"] < 1.0


async def _pours(served: Served, body: dict[str, object]) -> bool:
    key = str((await served.post("/pours", body))["id"])
    if served.laboratories:
        while len(served.laboratories) < 2:
            await asyncio.sleep(0.01)
        for laboratory in served.laboratories:
            laboratory.bench.go.set()
    async with asyncio.timeout(60):
        while (found := await served.get(f"/pours/{key}"))["state"] not in ("weighed", "failed"):
            for laboratory in served.laboratories:
                laboratory.bench.go.set()
            await asyncio.sleep(0.02)
    return bool(found["state"] == "weighed")


def _admin() -> object:
    from orchestrator.daemon.state.access_tokens import Role

    return Role.ADMIN


RACK = Path(__file__).parents[4] / "configs" / "laboratories" / "rack.yaml"
SOURCE = {"profile": {"unit": "mm", "inner": [[0, 0], [40, 0], [40, 100]], "wall": "4 mm", "floor": "4 mm"}}
CUP = {"profile": {"unit": "mm", "inner": [[0, 0], [28, 0], [28, 80]], "wall": "3 mm", "floor": "3 mm"}}


async def rack_set_up(served: Served) -> None:
    for path, body in (
        ("/materials/liquids", {"id": "water", "properties": {"name": "water"}}),
        *(("/materials/positions", {"id": p, "rig": "left"}) for p in ("source/water", "rack/A1", "rack/B2", "shelf")),
        (
            "/materials/vessels",
            {"id": "can", "position": "source/water", "shape": {**SOURCE, "grip": {"mass": "312 g"}}},
        ),
        ("/materials/vessels", {"id": "cup-1", "position": "rack/A1", "shape": {**CUP, "grip": {"mass": "90 g"}}}),
        ("/materials/vessels", {"id": "cup-2", "position": "shelf", "shape": {**CUP, "grip": {"mass": "90 g"}}}),
        ("/materials/vessels/can/weighed", {"mass": "300 g", "liquid": "water"}),
    ):
        await served.post(path, body)


class CarryingBench(HeldBench):
    """Enters a dose of 30.1 g in the account as `DoseHandling` does."""

    async def pour(
        self, scene: Scene, action: Any, *, seed: int, progress: ProgressCallback | None = None, dose: Any = None
    ) -> PourMeasurement:
        places, liquid, source = LaboratoryPlaces(VesselAccount.open(), "rack"), scene.liquid.name, dose.source
        places.add_component(dose.cup, liquid, None, 0.0, source.vessel)
        places.content(dose.cup, None, 0.0, liquid)
        await super().pour(scene, action, seed=seed, progress=progress, dose=dose)
        places.add_component(dose.cup, liquid, 0.0301, 1e-4, source.vessel)
        places.content(dose.cup, 0.0301, 1e-4, liquid)
        left = source.mass - 0.0301
        places.content(source.vessel, left, 4e-4, liquid)
        return PourMeasurement(source.mass, 0.0, left, {"dose": {"received": 0.0301, "left": [left, 4e-4]}})


def carrying() -> HeldLaboratory:
    """A laboratory whose arm carries the cups, and whose first pour does not end by itself."""
    laboratory = HeldLaboratory(ToySimulators(), CarryingBench(), ToyOptimizer())
    laboratory.bench.go.clear()
    return laboratory


async def test_an_order_names_the_positions_of_a_rack_whose_cup_the_arm_carries(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DECANT_STATE", str(tmp_path / "state"))
    rigs = (Rig("left", RACK, load_laboratory(RACK)),)
    async with serving(tmp_path, carrying, rigs=rigs) as served:
        await rack_set_up(served)
        wanted = order(source="source/water", receiver="rack/A1", amount="30 g")
        tried = await served.post("/pours", wanted | {"predict": True, "dry_run": True})
        assert tried["predicted"]["interval_g"][0] < 30.0 < tried["predicted"]["interval_g"][1]
        assert (tried["source"], tried["receiver"]) == ("can", "cup-1")
        placed = await served.post("/pours", wanted)
        laboratory = await served.pouring()
        assert [(v.place, v.liquid, v.filled) for v in laboratory.spec.vessels] == [
            ("source/water", "water", False), ("rack/A1", "", True),
        ]  # fmt: skip
        dose = laboratory.bench.dose
        assert (dose.cup, dose.source.vessel, dose.source.mass) == ("rack/A1", "source/water", 0.3)
        assert (await content(served, "cup-1"))["mass_g"] is None
        laboratory.bench.go.set()
        done = await until_pour(served, "order-1", "weighed")
        assert placed["campaign"] == done["campaign"]
        for vessel, grams in (("cup-1", done["result"]["received_g"]), ("can", 300.0 - 30.1)):  # each counts once
            assert (await content(served, vessel))["mass_g"] == pytest.approx(grams), vessel
        terminal = LaboratoryPlaces(VesselAccount.open(), "rack")
        assert terminal.composition("rack/A1")["water"][0] == 0.0301
        again = await served.post("/pours", order("order-2", **{**wanted, "id": "order-2"}), status=409)
        assert "cup-1: has 30.1 g of water already, and no liquid is dosed into a cup twice" in again["detail"]


async def test_what_an_operator_enters_for_an_order_in_a_rack_is_in_its_vessels_and_is_not_dosed_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DECANT_STATE", str(tmp_path / "state"))
    rigs = (Rig("left", RACK, load_laboratory(RACK)),)
    wanted = order(source="can", receiver="cup-1", amount="30 g")
    async with serving(tmp_path, carrying, rigs=rigs) as served:
        await rack_set_up(served)
        key = (await served.post("/pours", wanted))["campaign"]
        await served.pouring()
        await served.post("/emergency-stop")
        await until_pour(served, "order-1", "unknown")
        assert (await content(served, "cup-1"))["mass_g"] is None
        await served.post("/emergency-stop/clear", role=_admin())
        await served.until(key, "unknown")
        await served.post(f"/campaigns/{key}/resume")
        question = await served.question()
        await served.post(f"/questions/{question['id']}/answer", {"answer": "received 29 ± 1 g"})
        done = await until_pour(served, "order-1", "weighed")
        assert done["result"]["received_g"] == pytest.approx(29.0)
        cup, can = await content(served, "cup-1"), await content(served, "can")
        assert cup["mass_g"] == pytest.approx(29.0)
        assert can["mass_g"] == pytest.approx(300.0 - 29.0, abs=1.5)  # and what such a dose loses
        told = await served.post("/pours", wanted | {"id": "order-2"}, status=409)
        assert "cup-1: has 29.0 g of water already" in told["detail"]
    assert begun(tmp_path) == 1


async def test_a_cup_in_a_rack_that_is_unknown_or_has_the_liquid_is_refused(tmp_path: Path) -> None:
    rigs = (Rig("left", RACK, load_laboratory(RACK)),)
    async with serving(tmp_path, held, rigs=rigs) as served:
        await rack_set_up(served)
        account = VesselAccount(tmp_path / "state" / FILE_NAME)

        async def refused(status: int = 409, **changes: str) -> str:
            body = order(source="can", receiver="rack/A1", amount="30 g") | changes
            return str((await served.post("/pours", body, status=status))["detail"])

        assert "there is no vessel 'rack/B2'" in await refused(422, receiver="rack/B2")
        assert "cup-2: stands at 'shelf', and the arm of laboratory 'rack' pours" in await refused(
            422, receiver="cup-2"
        )
        account.add_component("rack/rack/A1", "water", 0.02, 1e-4)  # as a run at the terminal does
        account.weigh("rack/rack/A1", 0.02, 1e-4, liquid="water")
        assert "cup-1: has 20.0 g of water already" in await refused()
        account.add_component("rack/rack/A1", "water", None, 0.0)
        assert "cup-1: has an UNKNOWN mass of water already" in await refused()
        account.lose("rack/rack/A1")
        assert "cup-1: holds UNKNOWN; weigh the vessel" in await refused()
        account.weigh("rack/rack/A1", 0.0, 0.0, by="a person")
        account.assign("cup-1", ("another", "rack/A1"), by="ada")  # the rig had another laboratory
        assert "cup-1: does not stand at 'rack/A1' of laboratory 'rack'; place it there again" in await refused()
        await served.post("/materials/vessels/cup-1/place", {"position": "rack/A1"})
        await served.post("/queue/pause")
        await served.post("/pours", order(source="can", receiver="rack/A1", amount="30 g"))
        account.lose("rack/rack/A1")  # while it waits
        await served.post("/queue/resume")
        stopped = await until_pour(served, "order-1", "failed", "paused")
        assert "UNKNOWN" in stopped["reason"]
        assert "Nothing was poured" in stopped["reason"]
    assert begun(tmp_path) == 0
