"""Measure how soon the daemon's four stop commands take effect and a plan starts, on an idle and a saturated machine.

The benchmark starts a daemon with a simulated bench at twice real time, and one with a bench over serial and network
protocols. Each campaign is stopped while its arm tilts. 'pause' and 'stop' are measured until the daemon has accepted
them (by design they wait for the pour). 'abort' and the emergency stop are measured until the arm confirms standstill.

Loads: 'idle' has nothing else; 'readers' has 200 readers of all events; 'saturated' has the readers and one busy
process per core. Run from the project's root:

    python benchmarks/daemon_stops.py --times 10    # into docs/data/daemon.json and docs/evidence/reliability.md
"""

from __future__ import annotations

import argparse
import contextlib
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from daemon_page import keep
from daemon_process import await_, end_in_order, serving
from machine import started
from ruamel.yaml import YAML

from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.daemon.api.daemon_client import Client
from orchestrator.daemon.rigs.submissions import Files, pack

ROOT = Path(__file__).parents[1]
READERS = 200
MOVING = ("tilt", "hold")
LOADS = {
    "idle": {"readers": 0, "busy": 0},
    "readers": {"readers": READERS, "busy": 0},
    "saturated": {"readers": READERS, "busy": os.cpu_count() or 1},
}
GRADES = ("pause", "stop", "abort", "emergency stop")

CAMPAIGN = """\
name: stops
laboratory:
  name: numbers
  bench: {liquid: {particles: 300}, time_scale: 2, operator_time: 0.2 s}
liquid: {name: water, mass: 100 g}
pourer: {name: beaker, profile: {unit: mm, inner: [[0, 0], [30, 0], [30, 70]], wall: 4 mm, floor: 4 mm}}
motion: {hold_time: 8 s, return_velocity: 180 deg/s}
simulator: {parameters: {particles: 300}}
deployment:
  strategy: D2
  receiver: {name: narrow, profile: {unit: mm, inner: [[0, 0], [20, 0], [20, 90]], wall: 4 mm, floor: 4 mm}}
  motion: {max_angle: 115 deg, height: 60 mm}
  actions: {angular_velocity: [60 deg/s, 180 deg/s], x_offset: [60 mm, 100 mm]}
  pours: 8
outputs: {recording: false, figures: false}
"""

READER = """
import asyncio, sys, httpx
async def read(client, url):
    async with client.stream("GET", url + "/api/v1/events", params={"after": 0}) as answer:
        async for _ in answer.aiter_bytes():
            pass
async def main(url, token, count):
    limits = httpx.Limits(max_connections=None)
    headers = {"Authorization": "Bearer " + token}
    async with httpx.AsyncClient(limits=limits, timeout=None, headers=headers, trust_env=False) as client:
        await asyncio.gather(*(read(client, url) for _ in range(count)), return_exceptions=True)
asyncio.run(main(sys.argv[1], sys.argv[2], int(sys.argv[3])))
"""


def campaigns(folder: Path) -> dict[str, tuple[str, Files]]:
    """Return the campaigns to stop: on a simulated bench, and over device protocols in real time."""
    yaml = YAML()
    table = yaml.load(CAMPAIGN)
    yaml.dump(table, folder / "numbers.yaml")
    laboratory = yaml.load(ROOT / "configs/laboratories/virtual.yaml")
    laboratory["simulators"] = 1
    laboratory["operator"]["time"] = "1 s"
    laboratory["bench"]["liquid"]["particles"] = 300
    laboratory["bench"]["time_scale"] = 1
    table["laboratory"] = laboratory
    table["motion"]["return_velocity"] = "100 deg/s"
    table["deployment"]["motion"]["height"] = "80 mm"
    table["deployment"]["actions"] = {"angular_velocity": ["15 deg/s", "30 deg/s"], "x_offset": ["70 mm", "100 mm"]}
    yaml.dump(table, folder / "wires.yaml")
    return {name: pack(load_campaign(folder / f"{name}.yaml")) for name in ("numbers", "wires")}


@contextlib.contextmanager
def beside(client: Client, token: str, *, readers: int, busy: int) -> Iterator[None]:
    """Run a load during the block: readers of all events, and processes that occupy a core each."""
    others = [started([sys.executable, "-c", "while True: pass"]) for _ in range(busy)]
    if readers:
        others.append(
            started([sys.executable, "-c", READER, client.url, token, str(readers)], stderr=subprocess.DEVNULL)
        )
    try:
        await_(lambda: _readers(client) >= readers)
        yield
    finally:
        for one in others:
            one.kill()
            one.wait()


def _readers(client: Client) -> float:
    text = client.fetch("/metrics").decode()
    return next(float(line.split()[1]) for line in text.splitlines() if line.startswith("decant_readers "))


def once(client: Client, sent: tuple[str, Files], grade: str) -> float:
    """Stop a campaign while its arm tilts; return the time until the stop took effect [s]."""
    key = client.post("/campaigns", {"text": sent[0], "files": sent[1]})["id"]
    await_(lambda: _at_bench(client) == key and client.get("/rigs")[0]["checkpoint"] in MOVING)
    begin = time.perf_counter()
    client.post("/emergency-stop" if grade == "emergency stop" else f"/campaigns/{key}/{grade}")
    seconds = time.perf_counter() - begin
    if grade == "emergency stop":
        client.post("/emergency-stop/clear")
    else:
        for _ in range(2):
            with contextlib.suppress(Exception):  # the campaign has already stopped
                client.post(f"/campaigns/{key}/abort")
    await_(lambda: _at_bench(client) is None)
    client.post(f"/campaigns/{key}/stop")
    return seconds


def _at_bench(client: Client) -> Any:
    return client.get("/rigs")[0]["campaign"]


def warm(client: Client, sent: tuple[str, Files]) -> float:
    """Return the time from the submission of a plan to the start of its first simulation [s]."""
    begin = time.time()
    last = client.get("/status")["last_event"]
    key = client.post("/campaigns", {"text": sent[0], "files": sent[1], "task": "plan"})["id"]
    for told in client.events(last, key):
        if told.type == "RequestStarted" and told.data["request"]["type"] == "Simulate":
            client.post(f"/campaigns/{key}/stop")
            await_(lambda: client.get(f"/campaigns/{key}")["state"] in ("stopped", "finished"))
            return float(told.data["time"]) - begin
        if told.type == "CampaignRests":
            raise AssertionError(f"it came to nothing: {told.data['reason']}")
    raise AssertionError("unreachable")


def measured(folder: Path, times: int) -> dict[str, Any]:
    """Run all measurements [ms]; include the machine's load average before them."""
    found: dict[str, Any] = {
        "cores": os.cpu_count(),
        "times": times,
        "load before": round(os.getloadavg()[0], 2),
        "stops": [],
    }
    sent = campaigns(folder)
    with serving(folder, "--simulators", "1") as client:
        token = next(line.split()[2] for line in (folder / "state/tokens").read_text().splitlines() if "viewer" in line)
        found["first simulation of a plan"] = [round(1e3 * warm(client, sent["numbers"])) for _ in range(3)]
        print("first simulation [ms]", found["first simulation of a plan"], file=sys.stderr, flush=True)
        for load, others in LOADS.items():
            with beside(client, token, **others):
                for bench, text in sent.items():
                    for grade in GRADES if bench == "numbers" else GRADES[2:]:
                        taken = [1e3 * once(client, text, grade) for _ in range(times)]
                        row: dict[str, Any] = {"bench": bench, "grade": grade, "load": load}
                        row |= {"median": round(statistics.median(taken), 1), "worst": round(max(taken), 1)}
                        found["stops"].append(row)
                        print(*row.values(), file=sys.stderr, flush=True)
    return found


def main() -> None:
    """Measure, and write the figures and their table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--times", type=int, default=10)
    arguments = parser.parse_args()
    end_in_order()
    with tempfile.TemporaryDirectory() as name:
        keep("stops", measured(Path(name), arguments.times))


if __name__ == "__main__":
    main()
