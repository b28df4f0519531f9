"""What goes with what: every pair of features works in a run, or is refused before it, as the documentation lists."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

from orchestrator.daemon.state.daemon_store import AT_REST
from sim_engine.engine_package import engine_name
from tests.end_to_end.combinations import CELLS, PAGE, ROOT, RUNS, Run, page, pairs, shown, verdict, write_campaign
from tests.end_to_end.test_daemon_killed import opened
from tests.support.waiting import PATIENCE

COMMAND = "from orchestrator.cli.app import main; main()"
LIBRARY = "import decant, sys; decant.run(decant.load_campaign('pair.yaml'), in_process=sys.argv[1] == 'True')"


def program(folder: Path, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT), "DECANT_STATE": str(folder / "state"), **environment},
        capture_output=True,
        text=True,
        timeout=2 * PATIENCE,
        check=False,
    )


def by_the_daemon(run: Run, folder: Path, environment: dict[str, str]) -> Path:
    with opened(folder) as laboratory:
        laboratory.in_process = "Ray" not in run.ways
        laboratory.environment = environment
        laboratory.start()
        key = laboratory.decant("queue", "submit", "pair.yaml").stdout.strip()
        end = time.monotonic() + 2 * PATIENCE
        while (campaign := laboratory.told("queue", "list", key))["state"] != "finished":
            listed = laboratory.told("queue", "list")
            assert not listed["questions"], listed["questions"]
            assert campaign["state"] not in set(AT_REST) - {"queued"}, campaign["reason"]
            assert time.monotonic() < end, laboratory.said()
            time.sleep(0.3)
        assert laboratory.end() == 0, laboratory.said()
    return folder / "state" / "runs" / campaign["run"]


def result_of(run: Run, folder: Path) -> tuple[Path, dict[str, Any]]:
    """Make a run. Returns its folder, and the published summary."""
    write_campaign(folder, run.features)
    environment = {"DECANT_ENGINE": "quadrants"} if "Quadrants" in run.ways else {}
    in_process = "in process" in run.ways
    if "daemon" in run.ways:
        directory = by_the_daemon(run, folder, environment)
    else:
        arguments = [LIBRARY, str(in_process)]
        if "command line" in run.ways:
            arguments = [COMMAND, "run", "pair.yaml", "--quiet", *(["--in-process"] if in_process else [])]
        process = program(folder, *arguments, **environment)
        assert process.returncode == 0, process.stderr
        assert "Traceback" not in process.stderr
        (directory,) = (folder / "runs").iterdir()
    return directory, json.loads((directory / "summary.json").read_text(encoding="utf-8"))


def assert_complete(run: Run, folder: Path) -> None:
    directory, summary = result_of(run, folder)
    pours = summary["outcome"]["pours_made"]
    assert summary["state"] == "finished"
    assert [pour["state"] for pour in pours] == ["weighed"] * run.pours()
    versions = json.loads((directory / "versions.json").read_text(encoding="utf-8"))
    assert versions["engine"].startswith("quadrants" if "Quadrants" in run.ways else engine_name())
    if "recordings" in run.features:
        assert len(list((directory / "recordings").glob("*.yaml"))) == len(pours)


def test_every_pair_works_or_is_refused_as_the_page_says() -> None:
    assert page() == PAGE.read_text(encoding="utf-8"), "python -m tests.end_to_end.combinations --write"


def test_every_pair_that_works_is_in_a_run() -> None:
    assert [pair for pair in pairs() if verdict(*pair) == "works" and not shown(pair)] == []


def test_every_refusal_names_a_key_and_says_what_to_do() -> None:
    for pair in pairs():
        if (text := verdict(*pair)) not in CELLS:
            assert any(word in text for word in ("remove it", "Name a", "can't be combined")), f"{pair}: {text}"
            assert text.startswith("`"), f"{pair}: {text}"


def test_a_campaign_with_a_calibration_d3_a_dose_a_risk_limit_and_a_prior_runs(tmp_path: Path) -> None:
    assert_complete(RUNS[0], tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("run", RUNS, ids=lambda run: run.name)
def test_a_short_run_shows_that_they_go_together(run: Run, tmp_path: Path) -> None:
    assert_complete(run, tmp_path)


@pytest.mark.parametrize("feature", ["calibration", "doses"])
def test_without_an_answer_from_the_cluster_nothing_starts(feature: str, tmp_path: Path) -> None:
    write_campaign(tmp_path, (feature, "cluster"))
    process = program(tmp_path, COMMAND, "run", "pair.yaml")
    assert process.returncode == 2
    assert "Ray cluster at 127.0.0.1:1: nothing answers there" in process.stderr
    assert not (tmp_path / "runs").exists()
