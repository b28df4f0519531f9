"""What watching costs control: `python benchmarks/live_view.py`; writes docs/live-view-timing.json.

A control loop of 100 Hz runs in this process and emits what a campaign emits: a pour's progress ten times a second, a
simulation every half second, every tenth with its particles. Measured is how late the loop wakes, how long emitting
takes, and CPU time, with no monitor, with a recording, with the live view and 0, 1, 20 viewers, with a viewer and with
the server stopped by SIGSTOP, with the server killed, and with a full disk.

Viewers are Rerun's own program without a screen: they take the stream as a browser does. Times on a machine that does
something else as well are worth their ratios, no more.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import signal
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from actors.protocols import PourProgress
from orchestrator.config.load import load_campaign
from orchestrator.events import Event, PourProgressed, RequestFinished, RequestStarted
from orchestrator.monitor.live import LiveView
from orchestrator.monitor.monitor import RerunMonitor
from orchestrator.monitor.server import environment, rerun_program
from orchestrator.plan import CampaignPlan
from orchestrator.requests import Pour, Simulate, Simulated
from sim_engine.outcome import PourOutcome
from sim_engine.simulated import RecordedFrames

ROOT = Path(__file__).parents[1]

RATE = 100.0
"""Of the control loop [Hz]."""

PARTICLES = 2000


def main() -> None:
    """Measure all cases."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=20.0, help="per case")
    parser.add_argument("--to", type=Path, default=ROOT / "docs" / "live-view-timing.json")
    arguments = parser.parse_args()
    plan = load_campaign(ROOT / "configs" / "campaigns" / "quickstart.yaml")
    rows = []
    for name, case in cases(plan):
        with tempfile.TemporaryDirectory() as folder, case(Path(folder)) as (watcher, processes):
            row = {"case": name, **asyncio.run(controlled(plan, watcher, processes, arguments.seconds))}
        rows.append(row)
        print(json.dumps(row), flush=True)
    told = {
        "seconds": arguments.seconds,
        "rate_hz": RATE,
        "cores": os.cpu_count(),
        "load": os.getloadavg(),
        "rows": rows,
    }
    arguments.to.write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")


Watching = tuple[RerunMonitor | None, list[psutil.Process]]
Case = Callable[[Path], contextlib.AbstractContextManager[Watching]]


def cases(plan: CampaignPlan) -> list[tuple[str, Case]]:
    """By name, in the order of the table."""

    @contextlib.contextmanager
    def nobody(folder: Path) -> Iterator[Watching]:
        yield None, []

    @contextlib.contextmanager
    def recorded(folder: Path) -> Iterator[Watching]:
        monitor = RerunMonitor(folder / "campaign.rrd", plan)
        yield monitor, [psutil.Process(monitor.pid)]
        monitor.close()

    def live(viewers: int, harm: Callable[[LiveView, list[int]], None] = lambda view, pids: None) -> Case:
        @contextlib.contextmanager
        def case(folder: Path) -> Iterator[Watching]:
            with contextlib.ExitStack() as stack:
                view = stack.enter_context(LiveView())
                monitor = view.watcher_for(plan, folder)
                pids = [stack.enter_context(viewer(view, folder / f"{n}.rrd")) for n in range(viewers)]
                harm(view, pids)
                yield monitor, [psutil.Process(monitor.pid)]
                monitor.close(20.0)
                for pid in pids:
                    os.kill(pid, signal.SIGCONT)

        return case

    def stop_server(view: LiveView, pids: list[int]) -> None:
        os.kill(view.server_pid, signal.SIGSTOP)

    def kill_server(view: LiveView, pids: list[int]) -> None:
        os.kill(view.server_pid, signal.SIGKILL)

    @contextlib.contextmanager
    def full(folder: Path) -> Iterator[Watching]:
        mount = folder / "full"
        mount.mkdir()
        done = subprocess.run(["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(mount)], check=False)
        if done.returncode:
            raise SystemExit("the case of a full disk needs the right to mount a tmpfs of 1 MiB")
        try:
            monitor = RerunMonitor(mount / "campaign.rrd", plan)
            yield monitor, [psutil.Process(monitor.pid)]
            monitor.close(20.0)
        finally:
            subprocess.run(["umount", "-l", str(mount)], check=False)

    @contextlib.contextmanager
    def stopped_writer(folder: Path) -> Iterator[Watching]:
        monitor = RerunMonitor(folder / "campaign.rrd", plan, capacity=200)
        os.kill(monitor.pid, signal.SIGSTOP)
        yield monitor, [psutil.Process(monitor.pid)]
        monitor.close(1.0)

    return [
        ("nobody watches", nobody),
        ("recording on disk", recorded),
        ("live, no viewer", live(0)),
        ("live, 1 viewer", live(1)),
        ("live, 20 viewers", live(20)),
        ("live, viewer stopped", live(1, lambda view, pids: os.kill(pids[0], signal.SIGSTOP))),
        ("live, server stopped", live(0, stop_server)),
        ("live, server killed", live(0, kill_server)),
        ("writer stopped", stopped_writer),
        ("disk full", full),
    ]


@contextlib.contextmanager
def viewer(view: LiveView, kept: Path) -> Iterator[int]:
    """One who watches; gives its process id."""
    command = [rerun_program(), "--save", str(kept), "--connect", view.stream, "--port", "auto"]
    process = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=environment())
    try:
        yield process.pid
    finally:
        process.kill()
        process.wait()


async def controlled(
    plan: CampaignPlan, watcher: RerunMonitor | None, processes: list[psutil.Process], seconds: float
) -> dict[str, Any]:
    """Run the loop, and say how it went."""
    await asyncio.sleep(4.0)  # programs are loaded
    cpu = _cpu(processes)
    late, emitting, count = [], [], 0
    events = _events(plan)
    own, begin = time.process_time(), time.monotonic()
    while (now := time.monotonic() - begin) < seconds:
        tick = round(now * RATE) + 1
        for event in events(tick):
            if watcher is not None:
                start = time.perf_counter()
                watcher(event)
                emitting.append(time.perf_counter() - start)
            count += 1
        await asyncio.sleep(max(tick / RATE - (time.monotonic() - begin), 0.0))
        late.append(time.monotonic() - begin - tick / RATE)
    own = time.process_time() - own
    spent = _cpu(processes) - cpu
    lateness = 1e3 * np.array(late)
    return {
        "late_median_ms": round(float(np.median(lateness)), 3),
        "late_99_ms": round(float(np.percentile(lateness, 99)), 2),
        "emit_99_us": round(1e6 * float(np.percentile(emitting, 99)), 1) if emitting else 0.0,
        "emit_most_us": round(1e6 * max(emitting, default=0.0), 1),
        "control_cpu_percent": round(100.0 * own / seconds, 2),
        "writer_cpu_percent": round(100.0 * spent / seconds, 2),
        "events": count,
        "dropped": 0 if watcher is None else watcher.dropped,
    }


def _events(plan: CampaignPlan) -> Callable[[int], list[Event]]:
    assert plan.deployment is not None
    scene = plan.deployment.scenes[0]
    arm = plan.laboratory.arm
    figure = None if arm is None else arm.figure()
    home = () if figure is None else figure.home
    action = scene.action({"angular_velocity": 1.5, "x_offset": 0.1})
    rng = np.random.default_rng(1)
    place = rng.uniform(-0.05, 0.05, (PARTICLES, 3)).astype(np.float32)
    outcome = PourOutcome(0.9, 0.05, 0.05, 0.0, 0.0, PARTICLES, 0.003, 0.01, 3.0, 900, 0.9, 1)
    poses = np.tile(np.array([-0.09, 0.0, 0.13, 1.0, 0.0, 0.0, 0.0]), (30, 1))
    state = np.zeros(PARTICLES, np.uint8)
    pour = Pour(scene.name, action, 1, 1)
    stage = f"deployment:{scene.name}"

    def at(tick: int) -> list[Event]:
        told: list[Event] = []
        if tick == 1:
            told.append(RequestStarted(stage=stage, id=1, request=pour))
        if tick % 10 == 0:
            joints = tuple(value + 0.1 * np.sin(tick / 100.0) for value in home)
            progress = PourProgress("tilt", 0.5, 0.3, 1e-5 * tick, stable=False, joints=joints)
            told.append(PourProgressed(stage=stage, id=1, number=1, progress=progress))
        if tick % 50 == 0:
            frames = None
            if tick % 500 == 0:
                moved = [place + np.float32(0.001 * i) for i in range(30)]
                frames = RecordedFrames(np.arange(30) / 10.0, moved, [state] * 30, poses)
            request = Simulate(scene.name, action, plan.parameters, tick, "refine")
            told.append(RequestStarted(stage=stage, id=tick, request=request))
            told.append(
                RequestFinished(
                    stage=stage,
                    id=tick,
                    request=request,
                    outcome=Simulated(replace(outcome, seed=tick)),
                    seconds=0.5,
                    frames=frames,
                )
            )
        return told

    return at


def _cpu(processes: list[psutil.Process]) -> float:
    total = 0.0
    for process in processes:
        with contextlib.suppress(psutil.Error):
            times = process.cpu_times()
            total += times.user + times.system
    return total


if __name__ == "__main__":
    main()
