"""`run_engine`: what happens to a laboratory in mid-campaign: told, written down, and the end of a run that has
lost its bench.
"""

from __future__ import annotations

from typing import Any

import pytest

from actors.interfaces import BenchLostError, LaboratoryError, Notice
from orchestrator.records.events import LogLine
from orchestrator.records.journal import JOURNAL_NAME, JournalReader, Kind
from orchestrator.runs.request_executor import RequestExecutorError
from tests.support.scripted_strategy import Script, one_stage, pour, run, simulate, states
from tests.support.toy_campaign import ToyBench, ToyLaboratory, ToySimulators

LOST = BenchLostError("arm: its machine bench-pc (10.0.0.3) was lost during 'execute'")


def kinds(directory, *wanted: Kind) -> list[str]:
    with JournalReader(directory / JOURNAL_NAME) as journal:
        return [entry.kind for entry in journal.entries(kinds=list(wanted))]


def test_a_bench_lost_during_a_pour_leaves_the_pour_unknown_and_pours_nothing_more(tmp_path):
    bench = ToyBench(fails=lambda seed: LOST)
    script = Script(pour(1), pour(2))
    with pytest.raises(
        RequestExecutorError, match=r"bench-pc .* what was poured is unknown: see to the bench, then resume"
    ):
        run(tmp_path, ToyLaboratory(bench=bench), stages=one_stage(script))
    assert kinds(tmp_path, Kind.POUR_STARTED, Kind.POUR_FINISHED) == [Kind.POUR_STARTED]
    assert states(tmp_path)[-1] == "unknown"
    assert script.told == [], "nothing is made up in its place"


class BenchGone(ToyLaboratory):
    """The machine has died while nothing was being poured."""

    @property
    def bench(self) -> Any:
        if self.simulators.tasks:
            raise BenchLostError("the bench's machine is lost; no pour can be made until it is back")
        return self._bench

    @bench.setter
    def bench(self, value: Any) -> None:
        self._bench = value


def test_a_bench_lost_between_pours_leaves_no_pour_unknown(tmp_path):
    laboratory = BenchGone()
    with pytest.raises(LaboratoryError, match="no pour can be made until it is back"):
        run(tmp_path, laboratory, stages=one_stage(Script(simulate(1), pour(1))))
    assert kinds(tmp_path, Kind.POUR_STARTED) == []
    assert states(tmp_path)[-1] == "failed"


class Talking(ToyLaboratory):
    """Tells something as soon as somebody listens."""

    def listen(self, hear: Any) -> None:
        hear(Notice("warning", "machine b (10.0.0.4) is lost"))
        hear(Notice("warning", "the arm was stopped", asked=True))


def test_what_happens_to_a_laboratory_is_in_the_journal(tmp_path):
    seen: list[Any] = []
    run(tmp_path, Talking(), stages=one_stage(Script(simulate(1))), subscribers=[seen.append])
    with JournalReader(tmp_path / JOURNAL_NAME) as journal:
        notes = [entry.body["text"] for entry in journal.entries(kinds=[Kind.NOTE])]
    assert notes == ["machine b (10.0.0.4) is lost", "the arm was stopped"]
    lines = [(event.text, event.asked) for event in seen if isinstance(event, LogLine)]
    assert lines == [(notes[0], False), (notes[1], True)], "a terminal leaves out what its operator is asked"


@pytest.mark.parametrize(("simulators", "pointed_out"), [(2, False), (16, True)])
def test_simulators_that_a_campaign_will_leave_idle_are_pointed_out(tmp_path, simulators, pointed_out):
    seen: list[Any] = []
    laboratory = ToyLaboratory(simulators=ToySimulators(size=simulators))
    run(tmp_path, laboratory, stages=one_stage(Script(simulate(1))), subscribers=[seen.append])
    lines = [event.text for event in seen if isinstance(event, LogLine)]
    assert any("14 will have nothing to do" in line for line in lines) == pointed_out
