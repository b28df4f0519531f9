"""`remote_operator`: what people are asked over the API: written down, answered once, by whoever is there first."""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from pathlib import Path

import pytest

from actors.interfaces import OperatorQuestion
from orchestrator.cli import queue_commands
from orchestrator.daemon.state.access_tokens import Role
from tests.support.cli_inputs import invoke
from tests.support.toy_daemon import HeldLaboratory, serving

REFILL = OperatorQuestion("Refill the beaker to 100 g.", "done", about="refill", details={"load": 100.0})
WEIGH = OperatorQuestion(
    "Weigh the receiver.", "weight", problem="the balance is silent", about="receiver", hands=False
)


def asking(question: OperatorQuestion) -> Callable[[], HeldLaboratory]:
    def make() -> HeldLaboratory:
        laboratory = HeldLaboratory()
        laboratory.bench.question, laboratory.bench.checkpoint = question, "operator"
        return laboratory

    return make


@pytest.fixture
def with_person(tmp_path: Path) -> Path:
    """A campaign on a bench beside which somebody stands."""
    from tests.support.toy_daemon import CAMPAIGN, write_campaign

    text = CAMPAIGN.replace("pours: 3", "pours: 2").replace(
        "  bench: {liquid: {particles: 400}, time_scale: 0}\n",
        "  bench: {liquid: {particles: 400}, time_scale: 1000}\n  arm: {kind: simulated}\n"
        "  balance: {kind: simulated}\n  operator: {answers: person}\n",
    )
    write_campaign(tmp_path, text)
    return tmp_path


async def test_a_step_at_the_bench_is_asked_and_the_first_answer_counts(with_person: Path) -> None:
    async with serving(with_person, asking(REFILL)) as served:
        key = await served.submit()
        question = await served.question()
        assert {name: question[name] for name in ("campaign", "kind", "text", "wants", "hands", "details")} == {
            "campaign": key,
            "kind": "bench",
            "text": REFILL.text,
            "wants": "done",
            "hands": True,
            "details": {"load": 100.0},
        }
        where = f"/questions/{question['id']}/answer"
        wrong = await served.post(where, {"answer": "yes"}, status=422)
        assert wrong["detail"] == "'yes' is not an answer; answer with 'done' when it is done, or 'give up'"
        await served.post(where, {"answer": "done"}, role=Role.VIEWER, status=403)
        told = await served.post(where, {"answer": " Done "})
        assert (told["answer"], told["by"], told["open"]) == ("done", "operator", False)
        late = await served.post(where, {"answer": "done"}, status=404)
        assert late["detail"] == f"question {question['id']} is not open"
        second = await served.question()
        assert second["id"] > question["id"]
        await served.post(f"/questions/{second['id']}/answer", {"answer": "done"})
        found = await served.until(key, "finished")
        assert served.laboratories[0].bench.answers == ["done", "done"]
        assert [entry["what"] for entry in found["audit"]].count("answer") == 2


async def test_a_weight_is_typed_with_its_unit(with_person: Path) -> None:
    async with serving(with_person, asking(WEIGH)) as served:
        await served.submit()
        question = await served.question()
        assert question["problem"] == "the balance is silent"
        where = f"/questions/{question['id']}/answer"
        assert "unit" in (await served.post(where, {"answer": "203.4"}, status=422))["detail"]
        assert (await served.post(where, {"answer": "203.4 g"}))["answer"] == "203.4 g"
        served.laboratories[0].bench.question = None


async def test_a_decision_is_answered_with_one_of_its_options(with_person: Path) -> None:
    missed = OperatorQuestion("It missed.", "option", about="decision", hands=False, options=("accept", "repeat"))
    async with serving(with_person, asking(missed)) as served:
        await served.submit()
        question = await served.question()
        assert (question["wants"], question["options"]) == ("option", ["accept", "repeat"])
        where = f"/questions/{question['id']}/answer"
        wrong = await served.post(where, {"answer": "yes"}, status=422)
        assert wrong["detail"] == "'yes' is not an answer; answer with one of: accept; repeat"
        assert (await served.post(where, {"answer": "Repeat"}))["answer"] == "repeat"
        served.laboratories[0].bench.question = None


async def test_a_question_that_nobody_needs_any_more_is_closed(with_person: Path) -> None:
    async with serving(with_person, asking(REFILL)) as served:
        key = await served.submit()
        question = await served.question()
        await served.post(f"/campaigns/{key}/abort")
        await served.until(key, "unknown", "paused")
        assert await served.get("/questions") == []
        (found,) = await served.get("/questions", answered=True)
        assert (found["id"], found["closed"], found["answer"]) == (question["id"], "withdrawn", None)


def test_a_question_whose_facts_are_still_read_is_announced(monkeypatch: pytest.MonkeyPatch) -> None:
    class Reading:
        def get(self, path: str, **query: object) -> list[dict[str, str]]:
            return [] if path == "/questions" else [{"id": "small-1a2b3c", "state": "waiting for operator"}]

    monkeypatch.setattr(queue_commands, "connected_client", lambda url, state: contextlib.nullcontext(Reading()))
    told = invoke("queue answer").stderr
    assert "the question of small-1a2b3c is being prepared" in told
    assert "Try again in a moment" in told
