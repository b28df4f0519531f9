"""The daemon as a laboratory has it: real processes, killed during a pour, started again, asked, answered, and on."""

from __future__ import annotations

import contextlib
import json
import os
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from orchestrator.daemon.state.access_tokens import Role, token_of
from orchestrator.learning.requests import Poured
from orchestrator.records.codec import decode_outcome
from orchestrator.records.journal import JOURNAL_NAME, JournalReader, Kind
from tests.support.browser import browser
from tests.support.command_process import ROOT, pour_under_way, started_after_they_were_finished
from tests.support.small_campaign import CAMPAIGN, write_campaign
from tests.support.waiting import PATIENCE

pytestmark = pytest.mark.slow

SLOW_POURS = CAMPAIGN.replace("time_scale: 0", "time_scale: 30")


class Laboratory:
    """A state directory, the daemon that has it, and people at other terminals."""

    def __init__(self, folder: Path, *options: str) -> None:
        self.folder, self.state, self.options = folder, folder / "state", options
        self.settings: list[str] = []
        self.in_process = True
        self.environment: dict[str, str] = {}
        self.process: subprocess.Popen[str] | None = None
        self.log = (folder / "log").open("w+", encoding="utf-8")

    def start(self) -> None:
        port = [] if "--port" in self.options or self.settings else ["--port", "0"]
        where = ["--in-process"] if self.in_process else ["--simulators", "1"]
        self.process = self._decant("server", "start", *self.settings, *port, *where, *self.options, stdout=self.log)
        self.until(lambda: (self.state / "url").exists() and self.decant("queue", "list", check=False).returncode == 0)

    def kill(self) -> None:
        assert self.process is not None
        self.process.send_signal(signal.SIGKILL)
        self.process.wait()
        (self.state / "url").unlink(missing_ok=True)

    def end(self) -> int:
        assert self.process is not None
        self.process.send_signal(signal.SIGTERM)
        return self.process.wait(timeout=PATIENCE)

    def _decant(self, *arguments: str, stdout: Any = subprocess.PIPE) -> subprocess.Popen[str]:
        return subprocess.Popen(
            [
                sys.executable,
                "-c",
                "from orchestrator.cli.app import main; main()",
                *arguments,
                "--state",
                str(self.state),
            ],
            cwd=self.folder,
            env={**os.environ, "PYTHONPATH": str(ROOT), **self.environment},
            stdin=subprocess.DEVNULL,
            stdout=stdout,
            stderr=subprocess.STDOUT if stdout is self.log else subprocess.PIPE,
            text=True,
            start_new_session=True,
        )

    def decant(self, *arguments: str, check: bool = True) -> subprocess.CompletedProcess[str]:
        process = self._decant(*arguments)
        output, errors = process.communicate(timeout=PATIENCE)
        if check:
            assert process.returncode == 0, errors
        return subprocess.CompletedProcess(arguments, process.returncode, output, errors)

    def told(self, *arguments: str) -> dict[str, Any]:
        found: dict[str, Any] = json.loads(self.decant(*arguments, "--json").stdout)
        return found

    def until(self, happened: Callable[[], Any]) -> Any:
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            assert self.process is None or self.process.poll() is None, self.said()
            if found := happened():
                return found
            time.sleep(0.1)
        raise AssertionError(f"it never came to that\n{self.said()}")

    def said(self) -> str:
        self.log.seek(0)
        return self.log.read()

    def entries(self) -> list[Any]:
        for path in (self.state / "runs").glob(f"*/{JOURNAL_NAME}"):
            with contextlib.suppress(Exception), JournalReader(path) as journal:
                return list(journal.entries())
        return []


@pytest.fixture
def laboratory(tmp_path: Path) -> Iterator[Laboratory]:
    write_campaign(tmp_path, SLOW_POURS)
    with opened(tmp_path) as found:
        yield found


@contextlib.contextmanager
def opened(folder: Path, *options: str) -> Iterator[Laboratory]:
    """A laboratory whose daemon does not outlive its test."""
    found = Laboratory(folder, *options)
    try:
        yield found
    finally:
        if found.process is not None and found.process.poll() is None:
            found.process.kill()
            found.process.wait()
        found.log.close()


def test_killed_during_a_pour_it_asks_what_came_of_it_writes_the_answer_down_and_goes_on(
    laboratory: Laboratory,
) -> None:
    laboratory.start()
    key = laboratory.decant("queue", "submit", "small.yaml").stdout.strip()
    laboratory.until(lambda: pour_under_way(laboratory.entries()))
    laboratory.kill()
    before = laboratory.entries()
    assert pour_under_way(before)
    (unknown,) = {e.body["id"] for e in before if e.kind == Kind.POUR_STARTED} - {
        e.body["id"] for e in before if e.kind == Kind.POUR_FINISHED
    }

    laboratory.start()
    (question,) = laboratory.until(lambda: laboratory.told("queue", "list")["questions"])
    assert question["campaign"] == key
    assert question["kind"] == "unknown"
    assert "had begun when the run was interrupted" in question["text"]
    assert question["options"] == ["repeat", "lost", "weighed SPILLED RETAINED [LOADED]"]
    assert "bench" in question["details"]["diagnostics"]
    assert laboratory.told("queue", "list", key)["state"] == "waiting for operator"

    nonsense = laboratory.decant("queue", "answer", str(question["id"]), "spilt", "milk", check=False)
    assert nonsense.returncode == 2
    assert "'spilt milk' is not an answer" in nonsense.stderr
    laboratory.decant("queue", "answer", str(question["id"]), "weighed", "3.2", "0.4")
    laboratory.until(lambda: laboratory.told("queue", "list", key)["state"] == "finished")
    assert laboratory.end() == 0

    entries = laboratory.entries()
    assert started_after_they_were_finished(entries) == []
    assert [e.body["attempt"] for e in entries if e.kind == Kind.POUR_STARTED and e.body["id"] == unknown] == [1]
    (outcome,) = [e.body["outcome"] for e in entries if e.kind == Kind.POUR_FINISHED and e.body["id"] == unknown]
    poured = decode_outcome(outcome)
    assert isinstance(poured, Poured)
    assert (poured.measurement.spilled, poured.measurement.retained) == pytest.approx((3.2e-3, 0.4e-3))
    answers = [e.body["answer"] for e in entries if e.kind == Kind.OPERATOR_ANSWERED]
    assert answers == ["weighed 3.2 0.4"]


def test_killed_during_a_pour_the_page_that_stands_open_asks_is_answered_and_sees_the_campaign_end(
    tmp_path: Path,
) -> None:
    """`decant server start`, `decant queue submit`, kill -9 during a pour, and again: the rest is on the page."""
    write_campaign(tmp_path, SLOW_POURS)
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    with browser() as chromium, opened(tmp_path, "--port", str(port)) as laboratory:
        laboratory.start()
        page = chromium.new_page(viewport={"width": 1024, "height": 768})
        page.set_default_timeout(1e3 * PATIENCE)
        page.goto(f"http://127.0.0.1:{port}/#token={token_of(laboratory.state / 'tokens', Role.OPERATOR)}")
        key = laboratory.decant("queue", "submit", "small.yaml").stdout.strip()
        laboratory.until(lambda: pour_under_way(laboratory.entries()))
        page.locator(".step").wait_for()
        laboratory.kill()
        page.get_by_text("No connection to the daemon").wait_for()
        (unknown,) = {e.body["id"] for e in laboratory.entries() if e.kind == Kind.POUR_STARTED} - {
            e.body["id"] for e in laboratory.entries() if e.kind == Kind.POUR_FINISHED
        }

        laboratory.start()
        card = page.locator(".question")
        card.get_by_role("heading", name="had begun when the run was interrupted").wait_for()
        card.get_by_text("What arm and balance show now").click()
        card.get_by_text("simulated: it has no arm").wait_for()
        assert page.get_by_text("No connection to the daemon").is_hidden()
        card.get_by_label("Spilled").fill("3,2")
        card.get_by_label("Left in the pourer").fill("0.4")
        card.get_by_role("button", name="It was weighed").click()
        card.wait_for(state="detached")
        page.locator("#ended li").get_by_text("complete").wait_for()
        assert laboratory.told("queue", "list", key)["state"] == "finished"
        assert laboratory.end() == 0

        entries = laboratory.entries()
        assert started_after_they_were_finished(entries) == []
        assert [e.body["attempt"] for e in entries if e.kind == Kind.POUR_STARTED and e.body["id"] == unknown] == [1]
        (said,) = [e.body["answer"] for e in entries if e.kind == Kind.OPERATOR_ANSWERED]
        assert said == "weighed 3,2 g; 0.4 g"


def test_told_to_end_it_finishes_the_pour_and_goes_on_by_itself_when_it_is_started_again(
    laboratory: Laboratory,
) -> None:
    laboratory.start()
    key = laboratory.decant("queue", "submit", "small.yaml").stdout.strip()
    laboratory.until(lambda: pour_under_way(laboratory.entries()))
    assert laboratory.end() == 0
    assert not pour_under_way(laboratory.entries())
    laboratory.start()
    laboratory.until(lambda: laboratory.told("queue", "list", key)["state"] == "finished")
    assert laboratory.told("queue", "list")["questions"] == []
    starts = [e.body["id"] for e in laboratory.entries() if e.kind == Kind.POUR_STARTED]
    assert len(starts) == len(set(starts)) == 5
