"""A whole campaign that takes seconds: three pours, calibration and two pours by D3, few particles, no waits."""

from __future__ import annotations

from pathlib import Path

BEAKER = """\
name: beaker
profile: {unit: mm, inner: [[0, 0], [30, 0], [30, 70]], wall: 4 mm, floor: 4 mm}
"""

TUMBLER = """\
name: tumbler
profile: {unit: mm, inner: [[0, 0], [26, 0], [26, 70]], wall: 4 mm, floor: 4 mm}
"""

NARROW = """\
name: narrow
profile: {unit: mm, inner: [[0, 0], [20, 0], [20, 90]], wall: 4 mm, floor: 4 mm}
"""

CAMPAIGN = """\
name: small
seed: 3
laboratory:
  name: small
  simulators: 2
  bench:
    liquid: {particles: 400, cohesion: 0.05 N/m}
    pose_error: {x: 1 mm}
    pose_noise: {x: 0.5 mm}
    time_scale: 0
liquid: {name: water, mass: 100 g}
pourer: beaker.yaml
motion: {hold_time: 0.3 s, return_velocity: 180 deg/s}
simulator:
  parameters: {particles: 300, cohesion: [0 N/m, 0.1 N/m]}
calibration:
  receiver: tumbler.yaml
  motion: {x_offset: 66 mm, height: 60 mm}
  actions: {angular_velocity: [60 deg/s, 180 deg/s], max_angle: [80 deg, 115 deg]}
  pours: {count: 3, holdout: 1}
  simulations: 6
  initial_samples: 3
deployment:
  strategy: D3
  receiver: narrow.yaml
  motion: {max_angle: 115 deg, height: 60 mm}
  actions: {angular_velocity: [60 deg/s, 180 deg/s], x_offset: [60 mm, 100 mm]}
  prior_simulations: 4
  pours: 2
  simulations_per_pour: 2
on_unknown: repeat
outputs: {directory: runs}
"""

GOOD_ACTION = ("--set", "angular_velocity=100", "--set", "x_offset=70")
"""Pours into the narrow cup of the campaign without touching it."""


def series(*amounts: float, refill_below: str = "0 g", outputs: str = "directory: runs") -> str:
    """Write the text of a campaign that pours amounts [g] into A1, A2, …"""
    doses = ", ".join(f"{{amount: {amount} g, position: A{place}}}" for place, amount in enumerate(amounts, 1))
    return f"""\
name: series
seed: 3
laboratory: {{name: small, bench: {{liquid: {{particles: 400}}, time_scale: 0}}}}
liquid: {{name: water, mass: 100 g}}
pourer: beaker.yaml
receiver: narrow.yaml
motion: {{x_offset: 70 mm, height: 60 mm}}
dispense:
  refill_below: {refill_below}
  doses: [{doses}]
on_unknown: repeat
outputs: {{{outputs}}}
"""


def write_campaign(folder: Path, text: str = CAMPAIGN) -> Path:
    """Write the campaign and its vessels; returns the campaign's file."""
    for name, vessel in (("beaker", BEAKER), ("tumbler", TUMBLER), ("narrow", NARROW)):
        (folder / f"{name}.yaml").write_text(vessel, encoding="utf-8")
    path = folder / "small.yaml"
    path.write_text(text, encoding="utf-8")
    return path
