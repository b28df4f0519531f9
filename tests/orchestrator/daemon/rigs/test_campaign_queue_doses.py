"""`campaign_queue`: a series of wanted amounts as a queued campaign: live state, pours, and report."""

from __future__ import annotations

import asyncio
import re
from pathlib import Path
from typing import Any

import pytest

from actors.dosing.simulated_dose import simulated_dose
from actors.dosing_settings import DosingSettings
from actors.interfaces import DoseProgress, PourProgress, ProgressCallback
from sim_engine.outcome import PourMeasurement
from sim_engine.scene import Scene
from tests.orchestrator.reports.test_mixture_report import PROPOSING
from tests.support.small_campaign import series, write_campaign
from tests.support.toy_campaign import ToyOptimizer, ToySimulators
from tests.support.toy_daemon import HeldBench, HeldLaboratory, serving

SERIES = series(20, 25, outputs="recording: false, figures: false")


class DosingBench(HeldBench):
    """Reports how far a dose has come, waits for the test, and pours it on the virtual dosing bench."""

    async def pour(
        self, scene: Scene, action: Any, *, seed: int, progress: ProgressCallback | None = None, dose: Any = None
    ) -> PourMeasurement:
        assert progress is not None
        estimate = DoseProgress("pour", dose.amount, 0.6 * dose.amount, 0.2e-3, 5.1e-3, 0.5 * dose.amount)
        progress(PourProgress("dose", 0.5, dose=estimate))
        self.begun.set()
        await self.go.wait()
        return await asyncio.to_thread(simulated_dose, scene, dose, seed, DosingSettings())


def held_dose() -> HeldLaboratory:
    laboratory = HeldLaboratory(ToySimulators(), DosingBench(), ToyOptimizer())
    laboratory.bench.go.clear()
    return laboratory


async def test_a_queued_series_shows_its_doses_while_it_runs_and_reports_them(tmp_path: Path) -> None:
    write_campaign(tmp_path, SERIES)
    async with serving(tmp_path, held_dose) as served:
        key = await served.submit()
        laboratory = await served.pouring()
        live = await served.get(f"/campaigns/{key}")
        assert live["progress"]["pour"].startswith("pour 1/2 into narrow")
        assert "20 g wanted" in live["progress"]["pour"]
        assert live["progress"]["dose"] == "12.0 ± 0.4 g of 20 g   5.1 g/s"
        assert [(pour["state"], pour["action"]) for pour in live["pours_made"]] == [("under way", "20 g wanted")]
        laboratory.bench.go.set()
        found = await served.until(key, "finished", "failed")
        assert found["state"] == "finished"
        pours = found["pours_made"]
        assert [pour["action"] for pour in pours] == ["20 g wanted", "25 g wanted"]
        assert {pour["loss"] for pour in pours} == {"received"}, "what is shown as measured is named for what it is"
        received = [float(pour["measured"].removesuffix(" g")) for pour in pours]
        assert received == pytest.approx([20.0, 25.0], abs=2.0)
        answer = await served.http.get(f"/api/v1/campaigns/{key}/report", headers=served.headers())
        assert answer.status_code == 200
        page = re.sub(r"<td[^>]*>", "<td>", answer.text)
        assert "2 wanted amounts" in page
        assert "A1" in page
        cells = [float(text) for text in re.findall(r"<td>([0-9.]+)", page)]
        for amount in received:  # the list of pours shows one decimal, the table two
            assert any(cell == pytest.approx(amount, abs=0.051) for cell in cells)


async def test_a_program_proposes_mixtures_by_answering_a_question(tmp_path: Path) -> None:
    write_campaign(tmp_path, PROPOSING)
    async with serving(tmp_path, held_dose) as served:
        key = await served.submit()
        (await served.pouring()).bench.go.set()
        question = await served.question()
        assert (question["kind"], question["options"]) == ("mixtures", ["[]"])
        assert "at most 2 cups (rack/B1, rack/C1)" in question["text"]
        poured = (await served.get(f"/campaigns/{key}"))["mixtures"]
        assert {row["state"] for row in poured} == {"full"}
        answer = f"/questions/{question['id']}/answer"
        refused = await served.post(answer, {"answer": "water 20 g"}, status=422)
        assert "should be a list in JSON" in refused["detail"]
        await served.post(answer, {"answer": '[{"water": "70 g"}]'})
        again = await served.question()
        assert again["problem"] == "Refused: rack/B1: it is heavier than 50 g, the largest mixture of the table"
        await served.post(f"/questions/{again['id']}/answer", {"answer": '[{"water": "20 g", "ethanol": "20 g"}]'})
        while (last := await served.question())["id"] == again["id"]:
            await asyncio.sleep(0.01)
        await served.post(f"/questions/{last['id']}/answer", {"answer": "[]"})
        found = await served.until(key, "finished", "failed")
        assert found["state"] == "finished"
        assert [row["cup"] for row in found["mixtures"]][-2:] == ["rack/B1", "rack/B1"]
