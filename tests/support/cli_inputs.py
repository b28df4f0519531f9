"""Commands as a person types them, in this process and in one of their own; and files that are wrong in one way."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import trimesh
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
    small_campaign.write_campaign(folder)

    def write(name: str, text: str | bytes) -> None:
        (folder / name).write_bytes(text.encode() if isinstance(text, str) else text)

    def spoil(name: str, old: str, new: str, text: str = small_campaign.CAMPAIGN) -> None:
        assert old in text
        write(name, text.replace(old, new, 1))

    (folder / "folder").mkdir()
    write("binary.yaml", bytes(range(256)))
    write("null.yaml", b"name: x\nseed: \x00\n")
    write("empty.yaml", "")
    spoil("misspelt.yaml", "pours: 2", "pour: 2")
    spoil("unitless.yaml", "100 g", "100")
    spoil("wrong-unit.yaml", "x_offset: 66 mm", "x_offset: 66 deg")
    spoil("duplicate.yaml", "seed: 3", "seed: 3\nseed: 4")
    spoil("tab.yaml", "  strategy: D3", "\tstrategy: D3")
    spoil("no-cup.yaml", "tumbler.yaml", "tumbrel.yaml")
    spoil("heavy.yaml", "mass: 100 g", "mass: 120 g")
    spoil("close.yaml", "[60 mm, 100 mm]", "[10 mm, 12 mm]")
    spoil("unwritable.yaml", "directory: runs", "directory: beaker.yaml/runs")
    spoil("passwd.yaml", "directory: runs", "directory: /etc/passwd")
    start, end = small_campaign.CAMPAIGN.index("calibration:"), small_campaign.CAMPAIGN.index("deployment:")
    uncalibrated = small_campaign.CAMPAIGN[:start] + small_campaign.CAMPAIGN[end:]
    spoil("plan-only.yaml", "[0 N/m, 0.1 N/m]", "0.05 N/m", uncalibrated)
    write("calibrate-only.yaml", small_campaign.CAMPAIGN[:end])

    solid = trimesh.creation.box((60, 60, 80))
    solid.export(folder / "solid.stl")
    open_ = solid.copy()
    open_.update_faces([face != 3 for face in range(len(open_.faces))])
    open_.export(folder / "open.stl")
    write("junk.stl", bytes(200))
    meshes = {"solid": "unit: mm", "open": "unit: mm", "junk": "unit: mm", "metres": "unit: m", "unitless": ""}
    for name, unit in meshes.items():
        mesh = name if name in ("open", "junk") else "solid"
        write(f"{name}-cup.yaml", f"name: {name}\nmesh: {mesh}.stl\n{unit}\n")
        spoil(f"{name}-mesh.yaml", "narrow.yaml", f"{name}-cup.yaml")

    write("pours.csv", CSV)
    tables = {
        "number": CSV.replace("95,8", "9x5,8"),
        "column": re.sub(r"spilled_g,|(?<=\d,)[489](?=,\d)", "", CSV).replace(",,", ","),
        "mass": CSV.replace("90,4,10", "90,4,90"),
        "nothing": "",
    }
    for name, table in tables.items():
        write(f"{name}.csv", table)
        spoil(f"{name}-csv.yaml", "pours.csv", f"{name}.csv", RECORDED)

    header, *lines = CSV.splitlines()
    offsets = ("x_offset_mm", 66, 20, 66)
    close = [f"{line},{offset}" for line, offset in zip([header, *lines], offsets, strict=True)]
    write("close.csv", "\n".join(close) + "\n")
    write("odd-theta.json", '{"theta": {"cohesion": 0.05}, "remaining_discrepancy": {"shift": -1}}')
    write("misspelt-theta.yaml", "theta: {cohesoin: 0.05}\n")
    write("wild-theta.json", '{"theta": {"cohesion": 50}}')
    write("list-theta.json", "[1, 2]")


def invoke(command: str) -> Any:
    return CliRunner().invoke(app, shlex.split(command), env={"COLUMNS": "120"})


def refused(command: str, folder: Path) -> str:
    """What a command says that refuses its input and leaves everything as it was."""
    before = sorted(folder.rglob("*"))
    result = invoke(command)
    assert isinstance(result.exception, SystemExit), result.exception
    assert result.exit_code == 2, result.stderr
    assert result.stdout == ""
    assert "Traceback" not in result.stderr
    assert sorted(folder.rglob("*")) == before
    return str(result.stderr)


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
