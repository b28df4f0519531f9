"""Measure the jitter of the virtual controller's clock while busy simulators share its cores.

    python benchmarks/control_period.py [--seconds 30] [--runs 3] [--cores 2] [--simulators 2] [--json]

A UR10e in real time at 500 Hz moves back and forth while a client reads it at 500 Hz. Simulators pour continuously on
the same cores, each in its own session and with the niceness of a campaign's simulators. The controller reports its
latest wake-up itself, which excludes the client's delays. Both priority settings alternate, so that other load on the
machine affects both. `stolen_ms` is the time the hypervisor took from all cores meanwhile; no priority prevents it.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
from machine import describe, say, show

from actors.arm.ur import rtde
from actors.emulators.ur_controller import VirtualController
from actors.simulators.ray_worker import NICENESS

ADDRESS = "127.9.8.6"
PERIOD = 0.002
"""Control period of a UR10e [s]."""

PROGRAM = b"""def shuttle():
  while True:
    movej([0.5, -1.57, 1.57, -1.57, -1.57, 0], a=1.4, v=1.0)
    movej([-0.5, -1.57, 1.57, -1.57, -1.57, 0], a=1.4, v=1.0)
  end
end
"""

SIMULATE = """
import os, sys
os.nice(int(sys.argv[1]))
from standard_pour import standard_task
from sim_engine.simulator import PourSimulator
simulator = PourSimulator()
while True:
    simulator.simulate(standard_task(2000, 0))
    print("poured", flush=True)
"""


@contextlib.contextmanager
def simulators(count: int, niceness: int) -> Iterator[None]:
    """Run this number of simulators during the block; each has finished its first pour."""
    started = [
        subprocess.Popen(
            [sys.executable, "-c", SIMULATE, str(niceness)],
            cwd=Path(__file__).parent,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
            env={**os.environ, "PYTHONPATH": f"{Path(__file__).parent}:{Path(__file__).parents[1]}"},
        )
        for _ in range(count)
    ]
    try:
        for process in started:
            assert process.stdout is not None
            if not process.stdout.readline():
                raise SystemExit("a simulator ended before its first pour")
        yield
    finally:
        for process in started:
            process.send_signal(signal.SIGKILL)
            process.communicate()


def measure(seconds: float, *, prioritised: bool) -> dict[str, Any]:
    """Start, move, read and end one controller."""
    with VirtualController.start(ADDRESS, "ur10e", prioritised=prioritised) as controller:
        with socket.create_connection((ADDRESS, 30003)) as port:
            port.sendall(PROGRAM)
        with socket.create_connection((ADDRESS, 30004)) as client:
            client.sendall(rtde.package(rtde.REQUEST_PROTOCOL_VERSION, struct.pack(">H", 2)))
            client.sendall(rtde.package(rtde.SETUP_OUTPUTS, struct.pack(">d", 500.0) + b"timestamp,actual_q,actual_qd"))
            client.sendall(rtde.package(rtde.START, b""))
            before, end = psutil.cpu_times().steal, time.monotonic() + seconds
            while time.monotonic() < end:
                client.recv(65536)
        timing = controller.fault("state", patience=30.0)["timing"]
        stolen = psutil.cpu_times().steal - before
    return {
        "priority": timing["priority"],
        "longest_gap_ms": round(1e3 * (timing["worst"] + PERIOD), 1),
        "late_percent": round(100.0 * timing["late"] * PERIOD / timing["wall"], 3),
        "dropped_ms": round(1e3 * timing["dropped"], 1),
        "cpu_percent": round(100.0 * timing["cpu"], 1),
        "stolen_ms": round(1e3 * stolen),
    }


def main() -> None:
    """Measure, and print a table or JSON."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seconds", type=float, default=30.0, help="duration of one run [s]")
    parser.add_argument("--runs", type=int, default=3, help="runs per setting")
    parser.add_argument("--cores", type=int, default=2, help="cores that all processes share")
    parser.add_argument("--simulators", type=int, default=2)
    parser.add_argument("--niceness", type=int, default=NICENESS, help="niceness of the simulators")
    parser.add_argument("--json", action="store_true")
    chosen = parser.parse_args()
    allowed = sorted(os.sched_getaffinity(0))
    if not 1 <= chosen.cores <= len(allowed):
        parser.error(f"--cores {chosen.cores}: 1 to {len(allowed)} can be used here")
    psutil.Process().cpu_affinity(allowed[: chosen.cores])
    rows = []
    with simulators(chosen.simulators, chosen.niceness):
        for run in range(chosen.runs):
            for prioritised in (False, True):
                rows.append({"run": run + 1, **measure(chosen.seconds, prioritised=prioritised)})
                say(str(rows[-1]))
    if chosen.json:
        show({"machine": describe(), "settings": vars(chosen), "rows": rows}, True)
        return
    for priority in dict.fromkeys(row["priority"] for row in rows):
        gaps = [row["longest_gap_ms"] for row in rows if row["priority"] == priority]
        print(f"{priority}: longest gap {max(gaps):.1f} ms (of each run: {', '.join(map(str, gaps))})")


if __name__ == "__main__":
    main()
