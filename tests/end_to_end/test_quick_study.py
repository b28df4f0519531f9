"""The quick study, with the real simulator: every part of `decant study` at work."""

from __future__ import annotations

import os
import re
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
    said = []
    for _ in range(2):
        done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False, timeout=PATIENCE)
        assert done.returncode == 0, done.stderr
        said.append(done.stderr)
    left = subprocess.run([*command, "--dry-run"], env=environment, capture_output=True, text=True, check=True)
    assert f"{29 + 12} cells, 0 left" in left.stdout
    (page,) = {re.search(r"figures, tables and a page: (.*)", text)[1] for text in said}  # type: ignore[index]
    text = Path(page).read_text(encoding="utf-8")
    assert "Unfinished" not in text
    assert all(f'id="figure-{number}"' in text for number in ("3b", "3c", "4", "5b", "6", "7", "final"))
