"""The commands for recorded pours, and a core without their package."""

from __future__ import annotations

import subprocess
import sys

import pytest

from orchestrator.campaigns.shipped import shipped

WITHOUT_RECORDINGS = """
import sys
from importlib.abc import MetaPathFinder

class LeftOut(MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.startswith("orchestrator.recordings"):
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, LeftOut())
from orchestrator.cli.app import main
main()
"""


@pytest.mark.parametrize(
    ("words", "code", "text"),
    [
        (["validate", str(shipped("vessels/beaker.yaml"))], 0, "ok (vessel"),
        (["validate", str(shipped("recordings/dose-1.yaml"))], 2, "no package orchestrator.recordings"),
        (["schema", "recording"], 2, "no schema 'recording'"),
        (["schema", "output"], 0, '"runs list"'),
        (["recording", "replay", "x.yaml"], 2, "No such command"),
    ],
)
def test_the_core_runs_without_the_package_of_recordings(words: list[str], code: int, text: str) -> None:
    program = [sys.executable, "-c", WITHOUT_RECORDINGS, *words]
    ended = subprocess.run(program, capture_output=True, text=True, timeout=60)
    assert ended.returncode == code, ended.stderr
    assert text in ended.stdout + ended.stderr
