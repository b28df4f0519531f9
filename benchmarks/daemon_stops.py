"""How soon the daemon's four ways to stop take effect, with an idle machine and with a saturated one; how warm it is.

A daemon of its own, on a bench of numbers at twice real time. Each time a campaign is stopped while its arm tilts:
'pause' and 'stop' are measured until the daemon has taken note (they wait for the pour by intention), 'abort' and the
emergency stop until the arm has confirmed that it stands. Saturated: a busy process for each core beside all
that, and 200 readers of all events. Run from the project's root:

    python -m benchmarks.daemon_stops [--times N] > stops.json
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from orchestrator.config.load import load_campaign
from orchestrator.daemon.client import Client
from orchestrator.daemon.packing import pack

READERS = 200
PATIENCE = 120.0

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
outputs: {rrd: false, figures: false}
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


@contextlib.contextmanager
def daemon(folder: Path) -> Iterator[Client]:
    """A daemon with its state there."""
    with (folder / "log").open("w") as log:
        command = [sys.executable, "-c", "from orchestrator.cli import main; main()", "serve"]
        options = ["--state", str(folder / "state"), "--port", "0", "--simulators", "1"]
        process = subprocess.Popen([*command, *options], stdout=log, stderr=log, start_new_session=True)
        try:
            await_((folder / "state/url").exists)
            with Client(state=folder / "state") as client:
                await_(lambda: client.get("/status")["ready"])
                yield client
        finally:
            process.terminate()
            try:
                process.wait(60.0)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def await_(happened: Any) -> Any:
    """Until it is true."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        with contextlib.suppress(Exception):
            if found := happened():
                return found
        time.sleep(0.03)
    raise TimeoutError("it never came to that")


@contextlib.contextmanager
def saturated(client: Client, folder: Path) -> Iterator[None]:
    """Every core has more to do than it can, and many watch."""
    token = next(line.split()[2] for line in (folder / "state/tokens").read_text().splitlines() if "viewer" in line)
    busy = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(os.cpu_count() or 1)]
    busy.append(subprocess.Popen([sys.executable, "-c", READER, client.url, token, str(READERS)]))
    try:
        await_(lambda: _readers(client) >= READERS)
        yield
    finally:
        for one in busy:
            one.kill()
            one.wait()


def _readers(client: Client) -> float:
    text = client._http.get("/api/v1/metrics").text
    return next(float(line.split()[1]) for line in text.splitlines() if line.startswith("decant_readers "))


def once(client: Client, text: str, grade: str) -> float:
    """Stop a campaign whose arm tilts; how long that takes [s]."""
    key = client.post("/campaigns", {"text": text})["id"]
    await_(
        lambda: client.get("/rigs")[0]["campaign"] == key and client.get("/rigs")[0]["checkpoint"] in ("tilt", "hold")
    )
    begin = time.perf_counter()
    client.post("/emergency-stop" if grade == "emergency stop" else f"/campaigns/{key}/{grade}")
    seconds = time.perf_counter() - begin
    if grade == "emergency stop":
        client.post("/emergency-stop/clear")
    else:
        with contextlib.suppress(Exception):
            client.post(f"/campaigns/{key}/abort")
            client.post(f"/campaigns/{key}/abort")
    await_(lambda: client.get("/rigs")[0]["campaign"] is None)
    client.post(f"/campaigns/{key}/stop")
    return seconds


def warm(client: Client, text: str) -> float:
    """From the submission of a plan to the beginning of its first simulation [s]."""
    begin = time.time()
    last = client.get("/status")["last_event"]
    key = client.post("/campaigns", {"text": text, "verb": "plan"})["id"]
    for told in client.events(last):
        simulates = told.type == "RequestStarted" and told.data["request"]["type"] == "Simulate"
        if simulates and told.data["campaign"] == key:
            client.post(f"/campaigns/{key}/stop")
            await_(lambda: client.get(f"/campaigns/{key}")["state"] in ("stopped", "finished"))
            return float(told.data["time"]) - begin
        if told.type == "CampaignRests" and told.data["campaign"] == key:
            raise AssertionError(f"it came to nothing: {told.data['reason']}")
    raise AssertionError("unreachable")


def main() -> None:
    """Measure, and print JSON."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--times", type=int, default=6)
    times = parser.parse_args().times
    found: dict[str, Any] = {"cores": os.cpu_count(), "times": times, "load before": os.getloadavg()[0]}
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "stops.yaml").write_text(CAMPAIGN, encoding="utf-8")
        text, _ = pack(load_campaign(folder / "stops.yaml"))
        with daemon(folder) as client:
            found["first simulation of a plan"] = [round(warm(client, text), 3) for _ in range(3)]
            print("first simulation", found["first simulation of a plan"], file=sys.stderr, flush=True)
            for load in ("idle", "saturated"):
                with saturated(client, folder) if load == "saturated" else contextlib.nullcontext():
                    for grade in ("emergency stop", "abort", "stop", "pause"):
                        taken = [once(client, text, grade) for _ in range(times)]
                        found[f"{grade}, {load}"] = {
                            "median": round(1e3 * statistics.median(taken), 1),
                            "worst": round(1e3 * max(taken), 1),
                        }
                        print(load, grade, found[f"{grade}, {load}"], file=sys.stderr, flush=True)
    print(json.dumps(found, indent=1))


if __name__ == "__main__":
    main()
