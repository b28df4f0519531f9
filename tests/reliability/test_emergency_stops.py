"""An emergency stop with every body, while the arm of a virtual bench tilts: real processes, sockets, device protocols.

One daemon takes all requests; every pour is a campaign of its own.
`tests/orchestrator/daemon/rigs/test_emergency_stop.py` sends the same requests to a daemon without devices.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from typing import Any

import pytest
from ruamel.yaml import YAML

from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.daemon.api.daemon_client import Client
from orchestrator.daemon.rigs.submissions import Files, pack
from orchestrator.daemon.state.access_tokens import Role, token_of
from tests.end_to_end.test_daemon_killed import Laboratory, opened
from tests.support.small_campaign import write_campaign
from tests.support.stop_requests import CASES, StopCase, stopped_by
from tests.support.waiting import PATIENCE
from tests.support.wired_bench import LABORATORIES

pytestmark = [pytest.mark.slow, pytest.mark.realtime]

PACE = 15
"""Bench seconds per second: a tilt of 5 deg/s takes one and a half seconds."""

CAMPAIGN = """\
name: stops
laboratory: wires.yaml
liquid: {name: water, mass: 100 g}
pourer: beaker.yaml
motion: {hold_time: 8 s, return_velocity: 100 deg/s}
simulator: {parameters: {particles: 300}}
deployment:
  strategy: D2
  receiver: narrow.yaml
  motion: {max_angle: 115 deg, height: 80 mm}
  actions: {angular_velocity: [4 deg/s, 5 deg/s], x_offset: [70 mm, 100 mm]}
  pours: 8
outputs: {recording: false, figures: false}
"""


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Laboratory, tuple[str, Files]]]:
    folder = tmp_path_factory.mktemp("wires")
    yaml = YAML()
    laboratory = yaml.load(LABORATORIES / "virtual.yaml")
    laboratory["simulators"] = 1
    laboratory["operator"]["time"] = "1 s"
    laboratory["bench"]["liquid"]["particles"] = 300
    laboratory["bench"]["time_scale"] = PACE
    yaml.dump(laboratory, folder / "wires.yaml")
    campaign = write_campaign(folder, CAMPAIGN)
    with opened(folder) as found:
        found.start()
        yield found, pack(load_campaign(campaign))
        assert "did not confirm" not in found.said()
        assert found.end() == 0


def until(happened: Any) -> Any:
    end = time.monotonic() + PATIENCE
    while not (found := happened()):
        assert time.monotonic() < end
        time.sleep(0.01)
    return found


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_the_arm_stops_in_mid_tilt_and_the_pour_is_given_up(
    bench: tuple[Laboratory, tuple[str, Files]], case: StopCase
) -> None:
    laboratory, (text, files) = bench
    viewer = token_of(laboratory.state / "tokens", Role.VIEWER) or ""
    with Client(state=laboratory.state) as client:
        key = client.post("/campaigns", {"text": text, "files": files})["id"]

        def checkpoint() -> str:
            (rig,) = [one for one in client.get("/rigs") if one["mode"] == "virtual"]
            return str(rig["checkpoint"])

        until(lambda: checkpoint() == "tilt")
        stopped_by(client.url, viewer, case, lambda: until(lambda: checkpoint() == ""))
        found = until(lambda: state_at_rest(client, key))
        assert found["state"] == "unknown"
        assert [pour["state"] for pour in found["pours_made"]] == ["unknown"]
        client.post("/emergency-stop/clear")
        client.post(f"/campaigns/{key}/stop")


def state_at_rest(client: Client, key: str) -> Any:
    found = client.get(f"/campaigns/{key}")
    return found if found["state"] in ("unknown", "paused", "failed", "finished") and not found["progress"] else None
