"""A 'hardware' laboratory for tests: its controller and balance are virtual ones, reached by address and port."""

from __future__ import annotations

import socket
from pathlib import Path

from actors.emulators.ur_controller.controller_process import VirtualController
from orchestrator.campaigns.file_loading import load_laboratory
from orchestrator.daemon.state.daemon_settings import Rig
from tests.support.waiting import wait_for

HOME = (-14.0, -91.0, -115.0, -154.0, -104.0, 0.0)
"""[deg]"""

LABORATORY = """\
name: {name}
mode: hardware
simulators: 1
arm:
  model: ur10
  address: {address}
  tool: {{z: 170 mm}}
  payload: 1.6 kg
  payload_centre: {{z: 110 mm}}
  grip: {{y: -60 mm, rx: -1.5707963 rad}}
  home: {{base: -14 deg, shoulder: -91 deg, elbow: -115 deg, wrist1: -154 deg, wrist2: -104 deg, wrist3: 0 deg}}
  limits:
    box: {{low: {{x: 250 mm, y: -600 mm, z: 0 mm}}, high: {{x: 1000 mm, y: 400 mm, z: 900 mm}}}}
    joint_speed: 120 deg/s
    tool_speed: 800 mm/s
    tilt: 135 deg
    tilt_speed: 130 deg/s
cell:
  receiver: {{x: 750 mm, y: 0 mm, z: 60 mm}}
  direction: 90 deg
  table: 0 mm
{balance}
"""

MANUAL = "balance: {placement: manual}"


def write_laboratory(path: Path, address: str, balance: str = MANUAL, name: str = "rig") -> Path:
    path.write_text(LABORATORY.format(name=name, address=address, balance=balance), encoding="utf-8")
    return path


def install(controller: VirtualController, tool: float = 0.17, payload: float = 1.6) -> None:
    """What somebody would have set on the teach pendant."""
    program = f"def setup():\n set_tcp(p[0,0,{tool},0,0,0])\n set_payload({payload}, [0,0,0.11])\nend\n"
    with socket.create_connection((controller.address, 30003), timeout=5.0) as connection:
        connection.sendall(program.encode())
        wait_for(lambda: controller.fault("state")["payload"] == payload, "payload on the controller")


CAMPAIGN = """\
name: rigged
seed: 3
laboratory: rig.yaml
liquid: {name: water, mass: 100 g}
pourer: beaker.yaml
motion: {hold_time: 0.3 s, return_velocity: 90 deg/s, max_angle: 110 deg, height: 60 mm}
simulator: {parameters: {particles: 300}}
deployment:
  strategy: D2
  receiver: narrow.yaml
  actions: {angular_velocity: [20 deg/s, 60 deg/s], x_offset: [70 mm, 100 mm]}
  pours: 3
outputs: {directory: runs, recording: false}
"""


def write_rig(folder: Path, address: str) -> Path:
    """A campaign of pours on hardware, with its laboratory and vessels; returns the campaign's file."""
    from tests.support import small_campaign

    path = small_campaign.write_campaign(folder)
    write_laboratory(folder / "rig.yaml", address)
    path = folder / "rigged.yaml"
    path.write_text(CAMPAIGN, encoding="utf-8")
    return path


def hardware_rig(folder: Path, address: str, model: str = "ur10") -> Rig:
    """A rig whose arm is reached by address, as hardware is."""
    path = write_laboratory(folder / "rig.yaml", address)
    path.write_text(path.read_text().replace("model: ur10", f"model: {model}"))
    return Rig("rig", path, load_laboratory(path))
