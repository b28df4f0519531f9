"""Measure the cost of monitoring: `python benchmarks/live_view.py` writes docs/data/live-view-timing.json, and a table.

A control loop of 100 Hz runs in this process and emits a campaign's events: a pour's progress ten times a second, a
simulation every half second, every tenth with its particles, and a surrogate every two seconds. The benchmark measures
the loop's lateness, the time to emit, and the CPU time of control, of the writer process and of Rerun's server. Cases:
no monitor; a recording; the live view with 0, 1, 20 viewers; a viewer, the server or the writer stopped by SIGSTOP; the
server killed; a full disk. Measurements start after programs are loaded and the first frames are drawn (`--warm-up`).

Viewers are Rerun's own program without a screen; they receive the stream as a browser does. On a machine with other
load, only the ratios of the times are meaningful. When the script ends, for any reason, it ends all its processes.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil

from actors.arm.arm_settings import arm_kind
from actors.interfaces import PourProgress
from actors.optimizer.questions import Data, MinimumQuery
from actors.optimizer.suggest import propose
from actors.runtime.child_process import child_environment
from orchestrator.config.file_loading import load_campaign
from orchestrator.live_view.live_server import LiveView
from orchestrator.live_view.rerun_subscriber import RerunMonitor
from orchestrator.live_view.viewer_server import environment, rerun_program
from orchestrator.requests import Pour, Simulate, Simulated, Suggest, Suggested
from orchestrator.runs.events import Event, PourProgressed, RequestFinished, RequestStarted
from orchestrator.strategies.campaign_plan import CampaignPlan
from sim_engine.outcome import PourOutcome, RecordedFrames

ROOT = Path(__file__).parents[1]

PAGE = ROOT / "docs" / "evidence" / "reliability.md"

BEGIN, END = "<!-- timing of control, by benchmarks/live_view.py -->", "<!-- end of timing -->"

RATE = 100.0
"""Frequency of the control loop [Hz]."""

PARTICLES = 2000

PATIENCE = 120.0
"""Longest time for a writer to start or end on a busy machine [s]."""


def main() -> None:
    """Measure all cases."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seconds", type=float, default=40.0, help="measured time per case [s]")
    parser.add_argument("--warm-up", type=float, default=15.0, help="time before the measurement [s]")
    parser.add_argument("--only", default="", help="only cases with this prefix; keeps the page")
    parser.add_argument("--to", type=Path, default=ROOT / "docs" / "data" / "live-view-timing.json")
    arguments = parser.parse_args()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # closes what is open
    plan = load_campaign(ROOT / "configs" / "campaigns" / "quickstart.yaml")
    rows = []
    for name, case in cases(plan):
        if not name.startswith(arguments.only):
            continue
        with tempfile.TemporaryDirectory() as folder, case(Path(folder)) as watching:
            measured = asyncio.run(controlled(plan, watching, arguments.seconds, arguments.warm_up))
            row = {"case": name, **measured}
        rows.append(row)
        print(json.dumps(row), flush=True)
    told = {
        "seconds": arguments.seconds,
        "warm_up": arguments.warm_up,
        "rate_hz": RATE,
        "cores": os.cpu_count(),
        "load": os.getloadavg(),
        "rows": rows,
    }
    arguments.to.write_text(json.dumps(told, indent=1) + "\n", encoding="utf-8")
    print("\n".join(table(told)))
    if not arguments.only:
        fill(PAGE, told)


COLUMNS = {
    "case": "case",
    "late_median_ms": "loop late, median [ms]",
    "late_99_ms": "99 % below [ms]",
    "emit_99_us": "an event handed on, 99 % below [µs]",
    "control_cpu_percent": "control [% of a core]",
    "writer_cpu_percent": "writer [%]",
    "server_cpu_percent": "server [%]",
    "written_kB_s": "file [kB/s]",
    "dropped": "events dropped",
}


def table(told: Mapping[str, Any]) -> list[str]:
    """Return the table and the line below it, as on the page."""
    lines = [f"| {' | '.join(COLUMNS.values())} |", f"|---|{'--:|' * (len(COLUMNS) - 1)}"]
    lines += [f"| {' | '.join(str(row[name]) for name in COLUMNS)} |" for row in told["rows"]]
    load = told["load"][0]
    return [
        *lines,
        "",
        f"{told['seconds']:g} s for each case after {told['warm_up']:g} s of warming up, a loop of {told['rate_hz']:g} "
        f"Hz, {told['cores']} cores; load of the machine at the end {load:.1f}.",
    ]


def fill(page: Path, told: Mapping[str, Any]) -> None:
    """Insert the table between its markers on the page."""
    before, mark, rest = page.read_text(encoding="utf-8").partition(BEGIN)
    _, end, after = rest.partition(END)
    if not mark or not end:
        raise SystemExit(f"{page}: the marks of the table are gone")
    page.write_text(before + BEGIN + "\n" + "\n".join(table(told)) + "\n" + END + after, encoding="utf-8")


@dataclass(frozen=True)
class Watching:
    """A monitor and its processes.

    Attributes:
        monitor: monitor that receives the events.
        processes: the monitor's processes, by role.
        recording: file that is written.
    """

    monitor: RerunMonitor | None = None
    processes: Mapping[str, psutil.Process] = field(default_factory=dict)
    recording: Path | None = None


Case = Callable[[Path], contextlib.AbstractContextManager[Watching]]


def cases(plan: CampaignPlan) -> list[tuple[str, Case]]:
    """Return the cases by name, in the order of the table."""

    @contextlib.contextmanager
    def nobody(folder: Path) -> Iterator[Watching]:
        yield Watching()

    @contextlib.contextmanager
    def recorded(folder: Path) -> Iterator[Watching]:
        monitor = RerunMonitor(folder / "campaign.rrd", plan)
        with guarded(monitor.pid):
            yield Watching(monitor, {"writer": psutil.Process(monitor.pid)}, monitor.path)
            monitor.close(PATIENCE)

    def live(viewers: int, harm: Callable[[psutil.Process, list[int]], None] = lambda server, pids: None) -> Case:
        @contextlib.contextmanager
        def case(folder: Path) -> Iterator[Watching]:
            with contextlib.ExitStack() as stack:
                view = stack.enter_context(LiveView())
                server = psutil.Process(view.server_pid)
                monitor = view.watcher_for(plan, folder)
                stack.enter_context(guarded(monitor.pid))
                pids = [stack.enter_context(viewer(view, folder / f"{n}.rrd")) for n in range(viewers)]
                harm(server, pids)
                processes = {"writer": psutil.Process(monitor.pid), "server": server}
                yield Watching(monitor, processes, monitor.path)
                monitor.close(PATIENCE)

        return case

    @contextlib.contextmanager
    def full(folder: Path) -> Iterator[Watching]:
        mount = folder / "full"
        mount.mkdir()
        done = subprocess.run(
            ["mount", "-t", "tmpfs", "-o", "size=1m", "tmpfs", str(mount)], check=False, env=child_environment()
        )
        if done.returncode:
            raise SystemExit("the case of a full disk needs the right to mount a tmpfs of 1 MiB")
        try:
            monitor = RerunMonitor(mount / "campaign.rrd", plan)
            with guarded(monitor.pid):
                yield Watching(monitor, {"writer": psutil.Process(monitor.pid)}, monitor.path)
                monitor.close(PATIENCE)
        finally:
            subprocess.run(["umount", "-l", str(mount)], check=False, env=child_environment())

    @contextlib.contextmanager
    def stopped_writer(folder: Path) -> Iterator[Watching]:
        monitor = RerunMonitor(folder / "campaign.rrd", plan, capacity=200)
        os.kill(monitor.pid, signal.SIGSTOP)
        with guarded(monitor.pid):
            yield Watching(monitor, {"writer": psutil.Process(monitor.pid)})
            monitor.close(1.0)

    return [
        ("nobody watches", nobody),
        ("recording on disk", recorded),
        ("live, no viewer", live(0)),
        ("live, 1 viewer", live(1)),
        ("live, 20 viewers", live(20)),
        ("live, viewer stopped", live(1, lambda server, pids: os.kill(pids[0], signal.SIGSTOP))),
        ("live, server stopped", live(0, lambda server, pids: server.suspend())),
        ("live, server killed", live(0, lambda server, pids: server.kill())),
        ("writer stopped", stopped_writer),
        ("disk full", full),
    ]


@contextlib.contextmanager
def viewer(view: LiveView, kept: Path) -> Iterator[int]:
    """Start a viewer; yield its process id."""
    command = [rerun_program(), "--save", str(kept), "--connect", view.stream, "--port", "auto"]
    process = subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL, env=child_environment(environment())
    )
    try:
        with guarded(process.pid):
            yield process.pid
    finally:
        process.kill()
        process.wait()


_GUARD = "import os, sys; sys.stdin.read(); os.kill(int(sys.argv[1]), 9)"


@contextlib.contextmanager
def guarded(pid: int) -> Iterator[None]:
    """End a process, even a stopped one, if this script is killed."""
    guard = subprocess.Popen(
        [sys.executable, "-c", _GUARD, str(pid)], stdin=subprocess.PIPE, start_new_session=True, env=child_environment()
    )
    try:
        yield
    finally:
        guard.kill()
        guard.wait()


async def controlled(plan: CampaignPlan, watching: Watching, seconds: float, warm_up: float) -> dict[str, Any]:
    """Run the control loop; return its figures after the warm-up."""
    watcher = watching.monitor
    late, emitting, count = [], [], 0
    events = _events(plan)
    await _begun(watching)
    begin = time.monotonic()
    cpu, size, own, measuring = _cpu(watching), _size(watching), 0.0, False
    while (now := time.monotonic() - begin) < warm_up + seconds:
        if not measuring and now >= warm_up:
            measuring, cpu, size, own = True, _cpu(watching), _size(watching), time.process_time()
        tick = round(now * RATE) + 1
        for event in events(tick):
            if watcher is not None:
                start = time.perf_counter()
                watcher(event)
                if measuring:
                    emitting.append(time.perf_counter() - start)
            count += measuring
        await asyncio.sleep(max(tick / RATE - (time.monotonic() - begin), 0.0))
        if measuring:
            late.append(time.monotonic() - begin - tick / RATE)
    own = time.process_time() - own
    spent = {name: after - cpu[name] for name, after in _cpu(watching).items()}
    lateness = 1e3 * np.array(late)
    return {
        "late_median_ms": round(float(np.median(lateness)), 3),
        "late_99_ms": round(float(np.percentile(lateness, 99)), 2),
        "emit_99_us": round(1e6 * float(np.percentile(emitting, 99)), 1) if emitting else 0.0,
        "emit_most_us": round(1e6 * max(emitting, default=0.0), 1),
        "control_cpu_percent": round(100.0 * own / seconds, 2),
        "writer_cpu_percent": round(100.0 * spent.get("writer", 0.0) / seconds, 2),
        "server_cpu_percent": round(100.0 * spent.get("server", 0.0) / seconds, 2),
        "written_kB_s": round(1e-3 * (_size(watching) - size) / seconds, 1),
        "events": count,
        "dropped": 0 if watcher is None else watcher.dropped,
    }


def _events(plan: CampaignPlan) -> Callable[[int], list[Event]]:
    assert plan.deployment is not None
    scene = plan.deployment.scenes[0]
    arm = plan.laboratory.arm
    figure = None if arm is None else arm_kind(arm).figure()
    home = () if figure is None else figure.home
    action = scene.action({"angular_velocity": 1.5, "x_offset": 0.1})
    rng = np.random.default_rng(1)
    place = rng.uniform(-0.05, 0.05, (PARTICLES, 3)).astype(np.float32)
    outcome = PourOutcome(0.9, 0.05, 0.05, 0.0, 0.0, PARTICLES, 0.003, 0.01, 3.0, 900, 0.9, 1)
    poses = np.tile(np.array([-0.09, 0.0, 0.13, 1.0, 0.0, 0.0, 0.0]), (30, 1))
    state = np.zeros(PARTICLES, np.uint8)
    pour = Pour(scene.name, action, 1, 1)
    stage = f"deployment:{scene.name}"

    space = plan.deployment.actions
    weighed = Data(tuple(map(tuple, rng.random((12, space.dimension)))), tuple(rng.random(12)))
    question = Suggest(MinimumQuery(space, weighed, map_resolution=25))
    answer = propose(question.query)

    def at(tick: int) -> list[Event]:
        told: list[Event] = []
        if tick == 1:
            told.append(RequestStarted(stage=stage, id=1, request=pour))
        if tick % 10 == 0:
            joints = tuple(value + 0.1 * np.sin(tick / 100.0) for value in home)
            progress = PourProgress("tilt", 0.5, 0.3, 1e-5 * tick, stable=False, joints=joints)
            told.append(PourProgressed(stage=stage, id=1, number=1, progress=progress))
        if tick % 200 == 0:
            told.append(RequestFinished(stage=stage, id=10**6 + tick, request=question, outcome=Suggested(answer)))
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


def _cpu(watching: Watching) -> dict[str, float]:
    """Return the CPU seconds of each process; 0 for one that has ended."""
    spent = dict.fromkeys(watching.processes, 0.0)
    for name, process in watching.processes.items():
        with contextlib.suppress(psutil.Error):
            times = process.cpu_times()
            spent[name] = times.user + times.system
    return spent


async def _begun(watching: Watching) -> None:
    """Wait until the writer has loaded its programs and written its first rows."""
    end = time.monotonic() + PATIENCE
    while watching.recording is not None and not _size(watching):
        if time.monotonic() > end:
            raise SystemExit(f"nothing was written within {PATIENCE:g} s")
        await asyncio.sleep(0.2)


def _size(watching: Watching) -> int:
    with contextlib.suppress(OSError):
        return 0 if watching.recording is None else watching.recording.stat().st_size
    return 0


if __name__ == "__main__":
    main()
