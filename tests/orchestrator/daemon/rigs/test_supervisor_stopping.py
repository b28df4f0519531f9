"""`supervisor`: four ways to stop, from the gentlest to the one that nobody waits for; and what each leaves behind."""

from __future__ import annotations

import asyncio
import shutil
from pathlib import Path
from typing import Any

import pytest

from orchestrator.daemon.state.access_tokens import Role
from orchestrator.records.journal import JOURNAL_NAME, JournalReader, Kind
from tests.support.toy_daemon import HeldLaboratory, held, serving


def entries(folder: Path, found: dict[str, Any]) -> list[Any]:
    with JournalReader(folder / "state/runs" / found["run"] / JOURNAL_NAME) as journal:
        return list(journal.entries())


async def test_pausing_finishes_the_pour_and_resuming_goes_on_with_the_next_one(tmp_path: Path) -> None:
    async with serving(tmp_path, held) as served:
        key = await served.submit()
        laboratory = await served.pouring()
        told = await served.post(f"/campaigns/{key}/pause")
        assert told["desired_state"] == "pause"
        await served.until(key, "pausing", "paused")
        laboratory.bench.go.set()
        found = await served.until(key, "paused")
        assert laboratory.bench.aborted == []
        assert [pour["state"] for pour in found["pours_made"]] == ["weighed"]
        await served.post(f"/campaigns/{key}/resume")
        while len(served.laboratories) < 2:
            await asyncio.sleep(0.01)
        served.laboratories[-1].bench.go.set()
        found = await served.until(key, "finished")
        made = [e.body["id"] for e in entries(tmp_path, found) if e.kind == Kind.POUR_STARTED]
        assert len(made) == len(set(made)) == 3


async def test_a_stopped_campaign_publishes_what_it_has_and_does_not_go_on(tmp_path: Path) -> None:
    async with serving(tmp_path, held) as served:
        key = await served.submit()
        laboratory = await served.pouring()
        await served.post(f"/campaigns/{key}/stop")
        laboratory.bench.go.set()
        found = await served.until(key, "stopped")
        assert found["ended"] is not None
        assert found["summary"]["pours"] == 1
        assert (await served.get(f"/campaigns/{key}"))["state"] == "stopped"
        assert len(served.laboratories) == 1
        again = await served.post(f"/campaigns/{key}/stop", status=409)
        assert again["detail"] == f"{key} is stopped already"


async def test_aborting_stops_the_arm_and_leaves_the_pour_to_the_person_who_brings_it_upright(tmp_path: Path) -> None:
    async with serving(tmp_path, held) as served:
        key = await served.submit()
        laboratory = await served.pouring()
        await served.post(f"/campaigns/{key}/abort")
        assert laboratory.arm_stops == 1
        assert laboratory.bench.aborted == []  # its operator is asked about the tilted pourer
        await served.post(f"/campaigns/{key}/abort")
        found = await served.until(key, "unknown")
        assert len(laboratory.bench.aborted) == 1
        assert found["pours_made"][0]["state"] == "unknown"
        assert await served.get("/questions") == []

        await served.post(f"/campaigns/{key}/resume")
        question = await served.question()
        assert question["kind"] == "unknown"
        assert (await served.get(f"/campaigns/{key}"))["pours_made"][0]["state"] == "unknown"
        assert question["details"]["load_g"] == pytest.approx(100.0)
        for answer in ("weighed 500 0", "weighed 500 0 600"):  # more than the load of 100 g
            refused = await served.post(f"/questions/{question['id']}/answer", {"answer": answer}, status=422)
            assert "load of 100 g" in refused["detail"]
        assert len(await served.get("/questions")) == 1
        await served.post(f"/questions/{question['id']}/answer", {"answer": "lost"})
        served.laboratories[-1].bench.go.set()
        while len(served.laboratories) < 2:
            await asyncio.sleep(0.01)
        served.laboratories[-1].bench.go.set()
        found = await served.until(key, "finished")
        assert [pour["state"] for pour in found["pours_made"]] == ["failed", "weighed", "weighed"]


async def test_where_nothing_moves_aborting_gives_the_pour_up_at_once(tmp_path: Path) -> None:
    def waiting() -> HeldLaboratory:
        laboratory = held()
        laboratory.bench.checkpoint = "weigh"
        return laboratory

    async with serving(tmp_path, waiting) as served:
        key = await served.submit()
        laboratory = await served.pouring()
        await served.post(f"/campaigns/{key}/abort")
        await served.until(key, "unknown")
        assert laboratory.arm_stops == 0
        assert len(laboratory.bench.aborted) == 1


async def test_an_emergency_stop_is_latched_until_somebody_clears_it(tmp_path: Path) -> None:
    async with serving(tmp_path, held) as served:
        key, waiting = await served.submit(), await served.submit()
        laboratory = await served.pouring()
        status = await served.post("/emergency-stop?reason=glass", role=Role.VIEWER)
        assert laboratory.arm_stops == 1
        assert status["emergency"]["reason"] == "glass"
        found = await served.until(key, "unknown")
        assert found["desired_state"] == "abort"
        for path, body in (
            (f"/campaigns/{key}/resume", None),
            ("/campaigns", {"text": "name: x"}),
        ):
            told = await served.post(path, body, status=409)
            assert "latched" in told["detail"]
        await served.post("/emergency-stop/clear", role=Role.OPERATOR, status=403)
        assert (await served.get(f"/campaigns/{waiting}"))["state"] == "queued"
    async with serving(tmp_path, held) as served:  # also by another process
        assert (await served.get("/status"))["emergency"]["by"] == "viewer"
        assert (await served.get(f"/campaigns/{waiting}"))["state"] == "queued"
        await served.post("/emergency-stop/clear", role=Role.ADMIN)
        (await served.pouring()).bench.go.set()
        await served.until(waiting, "finished")
        assert (await served.get(f"/campaigns/{key}"))["state"] == "unknown"


async def test_one_emergency_stop_is_for_all_rigs(tmp_path: Path) -> None:
    from orchestrator.campaigns.file_loading import load_laboratory
    from orchestrator.daemon.state.daemon_settings import Rig

    laboratory = tmp_path / "numbers.yaml"
    laboratory.write_text("{name: numbers, bench: {liquid: {particles: 400}, time_scale: 0}}\n")
    rigs = tuple(Rig(name, laboratory, load_laboratory(laboratory)) for name in ("left", "right"))
    async with serving(tmp_path, held, rigs=rigs) as served:
        keys = [await served.submit(rig=rig.name) for rig in rigs]
        for key in keys:
            await served.until(key, "running")
        for one in served.laboratories:
            await one.bench.begun.wait()
        await served.post("/emergency-stop")
        assert [one.arm_stops for one in served.laboratories] == [1, 1]
        for key in keys:
            await served.until(key, "unknown")


@pytest.mark.parametrize("lost", ["journal", "content", "folder"])
async def test_a_campaign_whose_journal_is_lost_while_it_is_paused_fails_and_pours_nothing(
    tmp_path: Path, lost: str
) -> None:
    async with serving(tmp_path, held) as served:
        key = await served.submit()
        laboratory = await served.pouring()
        await served.post(f"/campaigns/{key}/pause")
        await served.until(key, "pausing", "paused")
        laboratory.bench.go.set()
        found = await served.until(key, "paused")
        run_folder = tmp_path / "state/runs" / found["run"]
        if lost == "folder":
            shutil.rmtree(run_folder)
        elif lost == "journal":
            (run_folder / JOURNAL_NAME).unlink()
        else:
            (run_folder / JOURNAL_NAME).write_bytes(b"")
        await served.post(f"/campaigns/{key}/resume")
        found = await served.until(key, "failed")
        assert "Nothing was poured now" in found["reason"]
        if lost != "folder":
            assert "pours that may have been made: pour 1 of stage deployment:narrow (weighed: " in found["reason"]
        assert [len(one.bench.poured) for one in served.laboratories] == [1]
