"""Batches of pours and campaigns, held and postponed work, and reservations of a rig."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.daemon.access_tokens import Role
from orchestrator.daemon.submissions import pack
from tests.support.station import order, rigs_in, set_up, until_pour
from tests.support.toy_daemon import run, serving


@pytest.mark.slow
def test_a_batch_is_taken_as_a_whole_or_not_at_all_and_reports_each_item(tmp_path: Path) -> None:
    async def work() -> None:
        async with serving(tmp_path, rigs=rigs_in(tmp_path)) as served:
            await set_up(served)
            await served.post("/queue/pause")
            first = order("a", amount="40 g", receiver="vial-1")
            second = order("b", amount="80 g", receiver="vial-2")
            told = await served.post(
                "/batches", {"id": "plate", "items": [{"pour": first}, {"pour": second}]}, status=409
            )
            assert told["detail"].startswith("b: beaker: holds 100")
            assert await served.get("/campaigns") == []
            assert not list((tmp_path / "state/campaigns").iterdir())
            text, files = pack(load_campaign(served.campaign))
            bad = {"campaign": {"text": text, "files": files, "rig": "lefft"}}
            told = await served.post("/batches", {"id": "plate", "items": [{"pour": first}, bad]}, status=422)
            assert told["detail"].startswith("items.1: there is no rig 'lefft'")
            assert await served.get("/pours") == []

            good = {"campaign": {"text": text, "files": files, "rig": "left"}}
            body = {"id": "plate", "name": "ten vials", "items": [{"pour": first}, good], "hold": True}
            found = await served.post("/batches", body)
            assert found == await served.post("/batches", body)
            assert found["states"] == {"queued": 2}
            await served.post("/queue/resume")
            assert (await served.get("/batches/plate"))["states"] == {"queued": 2}
            await served.post("/batches/plate/release")
            await until_pour(served, "a", "weighed")
            await served.until(found["items"][1]["campaign"], "finished")
            items = (await served.get("/batches/plate"))["items"]
            assert [one["state"] for one in items] == ["weighed", "finished"]
            assert items[0]["result"]["received_g"] > 0.0
            assert (await served.get("/batches"))[0]["id"] == "plate"
            told = await served.post("/batches", body | {"hold": False}, status=409)
            assert "another batch" in told["detail"]

    run(work())


@pytest.mark.slow
def test_held_postponed_and_cancelled_items_do_not_start(tmp_path: Path) -> None:
    async def work() -> None:
        async with serving(tmp_path, rigs=rigs_in(tmp_path)) as served:
            await set_up(served)
            later = time.time() + 3600.0
            held = (await served.post("/pours", order("held", hold=True)))["campaign"]
            late = (await served.post("/pours", order("late", not_before=later)))["campaign"]
            await served.post("/pours", order("gone", hold=True))
            await served.post("/pours/gone/cancel")
            campaign = await served.submit(rig="left")
            await served.until(campaign, "finished")
            assert [(await served.get(f"/pours/{key}"))["state"] for key in ("held", "late", "gone")] == [
                *("queued", "queued", "cancelled"),
            ]
            await served.post(f"/campaigns/{late}/change", {"not_before": time.time() + 0.3})
            await until_pour(served, "late", "weighed")
            await served.post("/materials/vessels/beaker/weighed", {"mass": "100 g"})
            await served.post("/materials/vessels/vial-1/weighed", {"mass": "0 g"})
            await served.post(f"/campaigns/{held}/change", {"hold": False})
            await until_pour(served, "held", "weighed")
            told = await served.post(f"/campaigns/{held}/change", {"hold": True}, status=409)
            assert "only a queued campaign" in told["detail"]

    run(work())


@pytest.mark.slow
def test_a_reserved_rig_starts_nothing_of_others(tmp_path: Path) -> None:
    async def work() -> None:
        async with serving(tmp_path, rigs=rigs_in(tmp_path)) as served:
            await set_up(served)
            now = time.time()
            body = {"rig": "left", "begins": now - 1.0, "ends": now + 3600.0}
            mine = await served.post("/reservations", body, role=Role.ADMIN)
            told = await served.post("/reservations", body, status=409)
            assert "is reserved by admin" in told["detail"]
            await served.post("/pours", order("theirs"))
            answer = await served.post("/pours", order("mine", receiver="vial-2"), role=Role.ADMIN)
            await served.until(answer["campaign"], "finished")
            assert (await served.get("/pours/theirs"))["state"] == "queued"
            await served.post("/materials/vessels/beaker/weighed", {"mass": "100 g"})
            assert await served.post(f"/reservations/{mine['id']}/cancel") == []
            await until_pour(served, "theirs", "weighed")

    run(work())
