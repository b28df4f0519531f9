"""What a laboratory can do without is taken out of a copy of the program, and a campaign still runs.

The core reaches these packages by entry points only; `[tool.importlinter]` rejects an import of theirs.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.small_campaign import write_campaign
from tests.support.waiting import PATIENCE

ROOT = Path(__file__).parents[2]

EXTRAS = (
    "actors/contract_tests",
    "actors/emulators",
    "orchestrator/daemon/integrations",
    "orchestrator/extra_commands",
    "orchestrator/recordings",
    "orchestrator/study",
    "sim_engine/vessel_acquisition",
)

ONLY_THE_COPY = """
import sys
sys.meta_path = [finder for finder in sys.meta_path if "editable" not in getattr(finder, "__module__", "")]
"""
"""Python's start in the copy: an editable installation would find what was taken out."""


@pytest.fixture(scope="module")
def core(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A copy of the program without its optional packages."""
    copy = tmp_path_factory.mktemp("core")
    for package in ("decant", "orchestrator", "actors", "sim_engine", "configs"):
        shutil.copytree(ROOT / package, copy / package, ignore=shutil.ignore_patterns("__pycache__"))
    for extra in EXTRAS:
        shutil.rmtree(copy / extra)
    (copy / "sitecustomize.py").write_text(ONLY_THE_COPY)
    return copy


def decant(core: Path, folder: Path, *arguments: str, seconds: float = PATIENCE) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", "from orchestrator.cli.app import main; main()", *arguments],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(core)},
        capture_output=True,
        text=True,
        timeout=seconds,
    )


def test_a_campaign_runs_without_the_optional_packages(core: Path, tmp_path: Path) -> None:
    campaign = write_campaign(tmp_path)
    result = decant(core, tmp_path, "run", str(campaign), "--in-process")
    assert result.returncode == 0, result.stderr
    assert list(tmp_path.rglob("report.html"))


@pytest.mark.parametrize(
    ("words", "code", "text"),
    [
        ("validate configs/vessels/beaker.yaml", 0, "ok (vessel"),
        ("validate configs/recordings/dose-1.yaml", 2, "no package that reads files of the kind 'recording'"),
        ("validate configs/studies/quick.yaml", 2, "no package that reads files of the kind 'study'"),
        ("schema recording", 2, "no package that reads files of the kind 'recording'"),
        ("schema output", 0, '"runs list"'),
        ("recording replay x.yaml", 2, "No such command"),
    ],
)
def test_commands_and_files_of_missing_packages_are_refused(core: Path, words: str, code: int, text: str) -> None:
    result = decant(core, core, *words.split())
    assert result.returncode == code, result.stderr
    assert text in result.stdout + result.stderr


def test_commands_of_missing_packages_are_not_listed(core: Path, tmp_path: Path) -> None:
    result = decant(core, tmp_path, "--help")
    commands = {line.split()[1] for line in result.stdout.splitlines() if line.startswith("│ ") and line[2] != " "}
    assert {"run", "plan", "robot", "queue"} <= commands
    assert not {"study", "vessel", "recording"} & commands


def test_a_laboratory_with_emulated_devices_is_refused_with_a_remedy(core: Path, tmp_path: Path) -> None:
    result = decant(core, tmp_path, "robot", "check", str(core / "configs/laboratories/virtual.yaml"))
    assert result.returncode != 0
    assert "Traceback" not in result.stderr
    assert "no emulated devices" in result.stdout + result.stderr
    assert "twin.yaml" in result.stdout + result.stderr


@pytest.mark.slow
def test_the_quickstart_runs_without_the_optional_packages(core: Path) -> None:
    laboratory = "configs/laboratories/twin.yaml"
    result = decant(core, core, "run", "configs/campaigns/quickstart.yaml", "--laboratory", laboratory, seconds=900)
    assert result.returncode == 0, result.stderr
