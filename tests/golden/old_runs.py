"""Run folders as this version writes them, for `test_old_runs.py`: `python -m tests.golden.old_runs`.

They are made again only while that version is the newest one. Later versions have to read them as they are.
"""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from pathlib import Path

from tests.golden.golden import ROOT

KEPT = ROOT / "tests" / "data" / "old_runs"

HERE = Path("/tmp/decant-old-runs")
"""Where they are made: the same path each time, because it is written into the runs."""

FILES = ("journal.sqlite", "resolved.json", "versions.json", "summary.json", "theta.json")
"""What is kept of a run's folder. Pages and figures are made again from these."""

BEAKER = """\
name: beaker
profile: {unit: mm, inner: [[0, 0], [30, 0], [30, 70]], wall: 4 mm, floor: 4 mm}
"""
TUMBLER = BEAKER.replace("beaker", "tumbler").replace("30", "26")
NARROW = BEAKER.replace("beaker", "narrow").replace("30", "20").replace("70", "90")

BENCH = """\
laboratory:
  name: bench
  simulators: 2
  bench:
    liquid: {particles: 400, cohesion: 0.05 N/m}
    pose_error: {x: 1 mm}
    pose_noise: {x: 0.5 mm}
    time_scale: 0
liquid: {name: water, mass: 100 g}
pourer: beaker.yaml
motion: {hold_time: 0.3 s, return_velocity: 180 deg/s}
on_unknown: ask
outputs: {directory: runs, recording: false, figures: false}
"""

CALIBRATION = """\
simulator:
  parameters: {particles: 300, cohesion: [0 N/m, 0.1 N/m]}
calibration:
  receiver: tumbler.yaml
  motion: {x_offset: 66 mm, height: 60 mm}
  actions: {angular_velocity: [60 deg/s, 180 deg/s], max_angle: [80 deg, 115 deg]}
  pours: POURS
  simulations: 8
  initial_samples: 4
"""

DEPLOYMENT = """\
deployment:
  strategy: STRATEGY
  receiver: narrow.yaml
  motion: {max_angle: 115 deg, height: 60 mm}
  actions: {angular_velocity: [60 deg/s, 180 deg/s], x_offset: [60 mm, 100 mm]}
  pours: 3
"""

TABLE = """\
angular_velocity_deg_s,max_angle_deg,poured_g,spilled_g,retained_g,split
80,95,90,4,10,train
100,100,95,8,5,train
140,105,97,9,3,train
120,110,100,9,0,test
"""

LEARNT = f"""\
name: learnt
seed: 3
{BENCH}{CALIBRATION.replace("POURS", "{count: 4, holdout: 1}")}\
{DEPLOYMENT.replace("STRATEGY", "D3")}  prior_simulations: 6
  simulations_per_pour: 2
"""

WEIGHED = f"""\
name: weighed
seed: 5
{BENCH}{CALIBRATION.replace("POURS", "{from: pours.csv}")}"""

UNKNOWN = f"""\
name: unknown
seed: 7
{BENCH}simulator:
  parameters: {{particles: 300}}
{DEPLOYMENT.replace("STRATEGY", "D2")}"""

CAMPAIGNS = {"learnt": (LEARNT, "run"), "weighed": (WEIGHED, "calibrate"), "unknown": (UNKNOWN, "run")}
"""By the name of the run: its campaign, and the command that runs it."""

PROGRAM = """
import os, signal, sys
from orchestrator.cli.app import main
from orchestrator.journal.journal import Journal

pours, written = int(sys.argv.pop(1)), 0
write = Journal.append_all

def dying(self, drafts):
    global written
    drafts = list(drafts)
    write(self, drafts)
    written += sum(draft.kind == "pour.started" for draft in drafts)
    if pours and written == pours:
        os.kill(os.getpid(), signal.SIGKILL)

Journal.append_all = dying
main()
"""
"""The command. It dies at a pour's start if its first argument is above 0."""


def make() -> None:
    """Make all runs anew, and keep what belongs to them."""
    HERE.mkdir()  # nobody else's
    try:
        for name, text in (("beaker", BEAKER), ("tumbler", TUMBLER), ("narrow", NARROW)):
            (HERE / f"{name}.yaml").write_text(text, encoding="utf-8")
        (HERE / "pours.csv").write_text(TABLE, encoding="utf-8")
        for name, (text, command) in CAMPAIGNS.items():
            (HERE / f"{name}.yaml").write_text(text, encoding="utf-8")
            dies = "2" if name == "unknown" else "0"
            arguments = [sys.executable, "-c", PROGRAM, dies, command, f"{name}.yaml", "--in-process", "--quiet"]
            done = subprocess.run(
                arguments,
                cwd=HERE,
                env={**os.environ, "PYTHONPATH": str(ROOT), "DECANT_STATE": str(HERE / "state"), "TZ": "UTC"},
                check=False,
            )
            assert done.returncode == (-9 if name == "unknown" else 0), done
            (folder,) = (HERE / "runs").glob(f"{name}-*")
            _keep(folder, KEPT / name)
    finally:
        shutil.rmtree(HERE)


def _keep(folder: Path, kept: Path) -> None:
    shutil.rmtree(kept, ignore_errors=True)
    kept.mkdir(parents=True)
    for found in sorted(folder.iterdir()):
        if found.name in (*FILES, "journal.sqlite-wal") and found.stat().st_size:
            shutil.copy(found, kept)


if __name__ == "__main__":
    make()
