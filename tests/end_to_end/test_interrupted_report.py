"""Ctrl-C after the last stage, before the report is written: the run is finished, and one command publishes it."""

from __future__ import annotations

import json
import signal
from pathlib import Path

import pytest

from orchestrator.records.journal import Entry, Kind
from orchestrator.records.states import State
from tests.support.command_process import Workplace
from tests.support.small_campaign import CAMPAIGN, write_campaign

SHORT = CAMPAIGN[: CAMPAIGN.index("deployment:")] + "outputs: {directory: runs, recording: false}\n"


@pytest.mark.slow
def test_a_run_interrupted_before_its_report_is_published_by_decant_report(tmp_path: Path) -> None:
    write_campaign(tmp_path, SHORT)
    place = Workplace(tmp_path)

    def drawing(entries: list[Entry]) -> bool:
        # Before its first figure the campaign may still be ending: a signal then pauses what has nothing left to do.
        states = [entry.body["after"] for entry in entries if entry.kind == Kind.CAMPAIGN_STATE]
        run = place.run_directory
        return (
            states[-1:] == [State.FINISHED]
            and any((run() / "figures").glob("*"))
            and not (run() / "summary.json").exists()
        )

    try:
        process, errors = place.interrupt(drawing, signal.SIGINT, "run", "small.yaml", "--in-process")
        run = place.run_directory()
        assert process.returncode == 130, errors
        assert "the run is finished, and nothing is lost" in errors
        command = errors.strip().splitlines()[-1].rpartition("with: decant ")[2].split()
        assert command == ["report", str(run)]
        assert not (run / "summary.json").exists()

        place.succeed(*command)
        summary = json.loads((run / "summary.json").read_text(encoding="utf-8"))
        assert json.loads((run / "theta.json").read_text(encoding="utf-8"))["theta"] == summary["learning"]["theta"]
        assert "finished" in (run / "report.html").read_text(encoding="utf-8")
        assert list((run / "figures").iterdir())
    finally:
        place.close()
