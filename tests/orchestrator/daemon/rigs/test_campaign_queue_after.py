"""A campaign that waits for another one's end, and the counters of what happened at the rigs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from orchestrator.daemon.state.access_tokens import Role
from tests.orchestrator.daemon.rigs.test_campaign_queue_doses import held_dose
from tests.orchestrator.reports.test_mixture_report import MIXTURES
from tests.support.small_campaign import write_campaign
from tests.support.toy_daemon import CAMPAIGN, HeldLaboratory, Served, held, serving
from tests.support.waiting import wait_async

SINGLE = (
    CAMPAIGN[: CAMPAIGN.index("motion:")]
    + """\
receiver: narrow.yaml
motion: {angular_velocity: 90 deg/s, x_offset: 80 mm, max_angle: 115 deg, height: 60 mm, hold_time: 0.3 s}
pour: true
outputs: {recording: false, figures: false}
"""
)
"""One pour, which is complete when it is weighed."""


async def test_a_campaign_starts_when_the_one_before_it_is_complete(tmp_path: Path) -> None:
    write_campaign(tmp_path, SINGLE)
    async with serving(tmp_path, held) as served:
        first = await served.submit(id="first")
        laboratory = await served.pouring()
        second = await served.submit(id="second", after={"campaign": "first"}, priority=9)
        third = await served.submit(after={"campaign": second, "verdict": "any"})
        found = await served.get(f"/campaigns/{second}")
        assert found["after"] == {"campaign": first, "verdict": "complete"}
        assert found["waits_for"] == f"the end of {first}, which is running"
        assert (await served.get(f"/campaigns/{first}"))["followers"] == [second]
        laboratory.bench.go.set()
        await served.until(first, "finished")
        async for _ in served.daemon.feed.read(0, beat=0.05):
            if len(served.laboratories) == 2:
                served.laboratories[1].bench.go.set()
            if len(served.laboratories) == 3:
                served.laboratories[2].bench.go.set()
                break
        ended = await served.until(third, "finished")
        before = await served.get(f"/campaigns/{second}")
        assert before["verdict"]["word"] == ended["verdict"]["word"] == "complete"
        assert before["ended"] <= ended["begun"]
        assert (await served.get(f"/campaigns/{first}"))["followers"] == []


async def test_a_campaign_after_one_that_reached_too_little_waits_for_an_operator(tmp_path: Path) -> None:
    async with serving(tmp_path) as served:
        await served.post("/queue/pause")
        first = await served.submit()
        second = await served.submit(after={"campaign": first})
        await served.post(f"/campaigns/{first}/stop")
        await served.post("/queue/resume")
        found = await served.get(f"/campaigns/{second}")
        assert found["waits_for"].startswith(f"an operator: {first} is withdrawn, and has to be complete")
        told = await served.post(f"/campaigns/{second}/move", {"after": {"campaign": second}}, status=409)
        assert told["detail"] == f"after: {second} waits for {second} itself"
        await served.post(f"/campaigns/{second}/move", {"after": ""})
        await served.until(second, "finished")


async def test_a_campaign_after_an_unknown_one_is_refused(tmp_path: Path) -> None:
    async with serving(tmp_path) as served:
        body: dict[str, Any] = {"text": "name: x\n", "after": {"campaign": "nobody"}}
        assert "there is no campaign 'nobody'" in (await served.post("/campaigns", body, status=409))["detail"]
        body["after"]["verdict"] = "good"
        await served.post("/campaigns", body, status=422)


async def metrics(served: Served) -> dict[str, float]:
    answer = await served.http.get("/api/v1/metrics", headers=served.headers(Role.VIEWER))
    lines = [line.rsplit(" ", 1) for line in answer.text.splitlines() if not line.startswith("#")]
    return {name: float(value) for name, value in lines}


async def test_pours_ends_and_http_errors_are_counted(tmp_path: Path) -> None:
    write_campaign(tmp_path, SINGLE)
    async with serving(tmp_path) as served:
        before = await metrics(served)
        made, ended = (
            'decant_pours_total{outcome="made",rig="virtual"}',
            'decant_campaigns_ended_total{outcome="complete",rig="virtual"}',
        )
        assert before[made] == before[ended] == 0.0
        await served.until(await served.submit(), "finished")
        await served.post("/campaigns", {"text": 1}, status=422)
        after = await metrics(served)
        assert after[made] == 1.0
        assert after[ended] == 1.0
        assert after['decant_http_responses_total{status="422"}'] == 1.0
        for name in ('doses_total{outcome="missed",rig="virtual"}', 'faults_total{outcome="fault",rig="virtual"}'):
            assert after[f"decant_{name}"] == 0.0


async def test_a_pour_that_an_emergency_stop_ends_is_counted_as_unknown(tmp_path: Path) -> None:
    laboratories: list[HeldLaboratory] = []

    def make() -> HeldLaboratory:
        laboratories.append(held())
        return laboratories[-1]

    async with serving(tmp_path, make) as served:
        key = await served.submit()
        await served.pouring()
        await served.post("/emergency-stop")
        await served.until(key, "unknown")
        after = await metrics(served)
        assert after['decant_pours_total{outcome="unknown",rig="virtual"}'] == 1.0
        assert after['decant_campaigns_ended_total{outcome="unknown",rig="virtual"}'] == 1.0


async def test_a_dose_that_remains_unknown_after_its_question_is_counted_once(tmp_path: Path) -> None:
    write_campaign(tmp_path, MIXTURES)
    async with serving(tmp_path, held_dose) as served:
        key = await served.submit()
        await served.pouring()
        for _ in range(2):
            await served.post(f"/campaigns/{key}/abort")
        await served.until(key, "unknown")
        counted = 'decant_doses_total{outcome="unknown",rig="virtual"}'
        assert (await metrics(served))[counted] == 1.0
        await served.post(f"/campaigns/{key}/resume")
        question = await served.question()
        await served.post(f"/questions/{question['id']}/answer", {"answer": "lost"})
        await wait_async(lambda: len(served.laboratories) == 2, "the laboratory of the resumed run")
        (await served.pouring()).bench.go.set()
        await served.until(key, "finished")
        after = await metrics(served)
        assert after[counted] == 1.0
        assert after['decant_pours_total{outcome="unknown",rig="virtual"}'] == 0.0
