"""`foreground_run`: what people are told when they stop a run: that nothing is lost only where nothing is."""

from __future__ import annotations

import asyncio
import errno
from dataclasses import replace
from pathlib import Path

import pytest

from actors.interfaces import LaboratoryError
from orchestrator.cli.console import RefusalError
from orchestrator.cli.foreground_run import file_trouble, given_up_pours, interruption, run_at_terminal
from orchestrator.learning.run_errors import RunError
from orchestrator.runs.request_executor import PourNotMadeError
from orchestrator.runs.run_service import RunRequest, RunResources, RunService
from tests.support.scripted_strategy import Script, one_stage, pour, states
from tests.support.toy_campaign import ToyBench, ToyLaboratory, run_toy, toy_plan
from tests.support.waiting import wait_async


def interrupted(directory: Path, times: int) -> None:
    """A toy run whose pour is under way when Ctrl-C comes."""

    async def play() -> None:
        laboratory = ToyLaboratory(bench=ToyBench(lambda: 0.3 if times == 1 else 60.0))
        task = asyncio.create_task(run_toy(directory, laboratory, stages=one_stage(Script(pour()))))
        await wait_async(lambda: laboratory.bench.received, "pour")
        for _ in range(times):
            task.cancel()
            await asyncio.sleep(0.05)  # two interrupts, and not one
        with pytest.raises(asyncio.CancelledError):
            await task

    asyncio.run(play())


def test_after_ctrl_c_once_nothing_is_lost(tmp_path: Path) -> None:
    interrupted(tmp_path / "run", 1)
    assert states(tmp_path / "run")[-1] == "paused"
    said = interruption(tmp_path / "run", toy_plan(tmp_path), "decant run toy.yaml --resume")
    assert said == "; nothing is lost. Continue with: decant run toy.yaml --resume"


def test_after_ctrl_c_twice_it_is_said_what_may_be_lost_and_what_to_do(tmp_path: Path) -> None:
    interrupted(tmp_path / "run", 2)
    assert states(tmp_path / "run")[-1] == "unknown"
    plan = toy_plan(tmp_path)
    assert given_up_pours(tmp_path / "run") == ["pour 1 of stage only"]
    real = replace(plan, laboratory=plan.laboratory.with_values(mode="hardware"))
    for each, advice in (
        (real, "lost unless you weigh it now.*Resuming asks for its outcome: 'weighed SPILLED RETAINED'"),
        (plan, "Resuming asks for its outcome: on a virtual bench 'repeat'"),
        (replace(plan, on_unknown="repeat"), "Resuming pours it again with the same chance"),
    ):
        said = interruption(tmp_path / "run", each, "decant run toy.yaml --resume")
        assert "nothing is lost" not in said
        assert said.startswith(" while pour 1 of stage only was under way: it was abandoned")
        assert said.endswith("Continue with: decant run toy.yaml --resume")
        with pytest.raises(ValueError, match=advice):
            raise ValueError(said)


def test_a_run_without_a_journal_has_no_pour(tmp_path: Path) -> None:
    (tmp_path / "journal.sqlite").touch()
    assert given_up_pours(tmp_path) == given_up_pours(tmp_path / "nowhere") == []


def test_a_full_disk_is_told_with_path_and_room(tmp_path: Path) -> None:
    full = OSError(errno.ENOSPC, "No space left on device")  # as a write raises it: without a name
    said = file_trouble(full, tmp_path)
    assert said.startswith(f"{tmp_path}: No space left on device; ")
    assert "MB are free there. A run needs 40 MB to begin" in said
    other = OSError(errno.EACCES, "Permission denied", "some.file")
    assert file_trouble(other, tmp_path) == "some.file: Permission denied"


@pytest.mark.parametrize(
    ("error", "code"),
    [
        (LaboratoryError("the balance is silent"), 1),
        (RunError("no simulation is valid"), 1),
        (PourNotMadeError("pour 3 may have been made"), 3),
    ],
)
def test_the_exit_code_tells_a_failure_from_a_question(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, error: Exception, code: int
) -> None:
    def fail(*args: object) -> None:
        raise error

    monkeypatch.setattr(RunService, "start", fail)
    request = RunRequest(toy_plan(tmp_path), (), tmp_path / "run")
    with pytest.raises(RefusalError, match=str(error)) as refused:
        run_at_terminal(request, RunResources(), again=lambda folder: "decant run toy.yaml --resume")
    assert refused.value.exit_code == code
