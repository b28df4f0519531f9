"""Campaigns and what they refer to, all good: tests spoil them."""

from __future__ import annotations

import json
from pathlib import Path
from textwrap import dedent

import pytest

from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.campaigns.file_references import References
from orchestrator.campaigns.run_snapshot import as_file
from orchestrator.campaigns.yaml.section_validation import validate
from orchestrator.campaigns.yaml.yaml_errors import ConfigError
from orchestrator.campaigns.yaml.yaml_source import Document, Place, Report
from sim_engine.settings.model import Settings

CAMPAIGN = """\
name: test
laboratory: lab.yaml
liquid: {name: water, mass: 200 g}
pourer: beaker.yaml
receiver: cup.yaml
motion: {max_angle: 110 deg, x_offset: 84 mm, height: 90 mm}
simulator:
  parameters:
    cohesion: [0 N/m, 0.1 N/m]
calibration:
  actions: {angular_velocity: [15 deg/s, 120 deg/s]}
  pours: {count: 8, holdout: 2}
  simulations: 20
"""

RECORDED = CAMPAIGN.replace("{count: 8, holdout: 2}", "{from: pours.csv}").replace(
    "[15 deg/s, 120 deg/s]}", "[15 deg/s, 120 deg/s], max_angle: [70 deg, 125 deg]}"
).replace("max_angle: 110 deg, ", "")  # fmt: skip

DEPLOYED = (
    CAMPAIGN
    + """\
deployment:
  strategy: D3
  actions: {angular_velocity: [15 deg/s, 120 deg/s]}
  pours: 15
"""
)

VESSEL = """\
name: beaker
profile:
  unit: mm
  inner: [[0, 0], [40, 0], [40, 100]]
  wall: 4 mm
  floor: 4 mm
"""

LABORATORY = """\
name: lab
bench:
  liquid: {particles: 4000}
"""

CSV = """\
angular_velocity_deg_s,max_angle_deg,poured_g,spilled_g,retained_g,split
20,95,180,4,20,train
60,110,190,30,10,train
80,120,200,50,0,test
"""


def write(folder: Path, name: str, text: str) -> Path:
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def write_good(folder: Path) -> Path:
    """What the campaigns here refer to."""
    write(folder, "lab.yaml", LABORATORY)
    write(folder, "beaker.yaml", VESSEL)
    write(folder, "cup.yaml", VESSEL.replace("beaker", "cup").replace("40", "32"))
    write(folder, "pours.csv", CSV)
    return folder


def report(path: Path) -> str:
    with pytest.raises(ConfigError) as caught:
        load_campaign(path)
    return str(caught.value)


def written_out(model: type[Settings], text: str) -> str:
    """A section of a text as a run's record has it."""
    report = Report()
    place = Place(Document.parse(dedent(text), Path("written.yaml").resolve()))
    section = validate(model, place, report)
    report.raise_if_any()
    assert section is not None
    return json.dumps(as_file(section, place, References(report), defaults=False))
