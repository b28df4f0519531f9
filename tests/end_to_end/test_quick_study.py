"""The quick study, with the real simulator: every part of `decant study` at work."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.study_files import ROOT, read, written
from tests.support.waiting import PATIENCE


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_the_quick_study_runs_and_a_second_call_has_nothing_left_to_do(tmp_path: Path) -> None:
    path = written(tmp_path, read("quick"))
    command = [
        sys.executable,
        "-c",
        "from orchestrator.cli.app import main; main()",
        "study",
        "run",
        str(path),
    ]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    answers = []
    for _ in range(2):
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=PATIENCE)
        assert done.returncode == 0, done.stderr
        answers.append(json.loads(done.stdout.splitlines()[-1]))
    assert answers[0] == answers[1]
    assert answers[0]["finished"] == answers[0]["cells"] == 29 + 12
    page = Path(answers[0]["page"]).read_text(encoding="utf-8")
    assert "Unfinished" not in page
    assert all(f'id="figure-{number}"' in page for number in ("3b", "3c", "4", "5b", "6", "7", "final"))
