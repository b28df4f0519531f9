"""Commands as a person types them, in this process and in one of their own; and files that are wrong in one way."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import typer.testing
from typer.testing import CliRunner

from orchestrator.cli.app import app
from tests.support import small_campaign
from tests.support.waiting import PATIENCE

CSV = """\
angular_velocity_deg_s,max_angle_deg,poured_g,spilled_g,retained_g,split
80,95,90,4,10,train
100,100,95,8,5,train
120,110,100,9,0,test
"""

RECORDED = small_campaign.CAMPAIGN.replace("{count: 3, holdout: 1}", "{from: pours.csv}")


def command_tree() -> Any:
    """The program's commands as a tree of click, built once for each process of tests (see `tests/conftest.py`)."""
    return typer.testing._get_command(app)


SIMULATE = "simulate small.yaml --set angular_velocity=100 --set x_offset=70"

ROOT = Path(__file__).parents[2]


def write_inputs(folder: Path) -> None:
    """The good campaign, and everything that is wrong in one way."""
    shutil.copytree(ROOT / "tests/golden/data/bad_input/files/small", folder, dirs_exist_ok=True)
    (folder / "folder").mkdir()


def invoke(command: str) -> Any:
    return CliRunner().invoke(app, shlex.split(command), env={"COLUMNS": "120"})


PROGRAM = """
import sys
from orchestrator.cli.app import main
try:
    main()
finally:
    heavy = {"ray", "taichi", "rerun", "matplotlib", "sklearn"} & set(sys.modules)
    print("loaded:", *sorted(heavy), file=sys.stderr)
"""


def process(command: str, folder: Path, program: str = PROGRAM) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", program, *shlex.split(command)],
        cwd=folder,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )
