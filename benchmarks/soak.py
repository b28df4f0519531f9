"""Run a laboratory for a day of scaled time: a daemon with two rigs, campaigns, ordered pours, faults, and clients.

- Two clients per rig submit campaigns to simulated benches over HTTP: plans, calibrations with deployments, and
  deployments alone, with and without a recording; some are paused, stopped or aborted and resumed. On the right rig an
  operator answers questions.
- Another client orders pours and repeats every order with the same id.
- Other clients read, follow events and disconnect, some in the middle of a request.

In the first part the daemon is repeatedly killed (SIGKILL) or ended, and its disk is filled. The second part has only
one full disk, so that growth of memory is visible. At intervals the clients pause until nothing runs, and all processes
and files are measured.

At the end every journal, the queue and the account of materials are compared with the responses to the clients.
The state directory is a small file system in memory, so that it can be full; this requires root. From the project's
root:

    python benchmarks/soak.py --minutes 40 --into soak     # writes soak/samples.jsonl, items.jsonl, result.json
    python benchmarks/soak.py --draw soak                  # the picture, and its table in docs/evidence/reliability.md
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import json
import os
import random
import shutil
import signal
import socket
import statistics
import subprocess
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from io import StringIO
from pathlib import Path
from typing import Any

import psutil
from daemon_page import keep
from daemon_process import EVENT_TIMEOUT, await_daemon, end, end_in_order, launched
from ruamel.yaml import YAML
from scipy import stats

from actors.runtime.child_process import child_environment
from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.daemon.api.daemon_client import Client, DaemonError
from orchestrator.daemon.rigs.submissions import Files, pack
from orchestrator.records.events import Kind
from orchestrator.records.journal import JOURNAL_NAME, JournalReader
from orchestrator.records.journal_check import check_journal
from orchestrator.reports import figure_style as style

ROOT = Path(__file__).parents[1]

TIME_SCALE = 60
"""Bench seconds per second: a day takes 24 minutes."""

DISK = 900
"""Size of the file system of the state directory [MB]."""

SETTINGS = """\
rigs: {left: left.yaml, right: right.yaml}
simulators: 1
in_process: true
keep_free: 40 MB
events: 2000
recordings: {keep: 3}
"""
"""Limits that are reached within minutes, as the usual ones are within days."""

BENCH = f"bench: {{liquid: {{particles: 200}}, time_scale: {TIME_SCALE}}}"
RIGS = {
    "left": f"{{name: left, {BENCH[:-1]}, operator_time: 20 s}}}}\n",
    "right": f"{{name: right, {BENCH}, arm: {{kind: simulated}}, balance: {{kind: simulated, placement: tray}}, "
    "operator: {answers: person}}\n",
}
"""Laboratories: without devices, and with an arm whose operator answers over the API."""

CAMPAIGN = """\
name: soak
laboratory: left.yaml
liquid: {name: water, mass: 100 g}
pourer: {name: beaker, profile: {unit: mm, inner: [[0, 0], [30, 0], [30, 70]], wall: 4 mm, floor: 4 mm}}
motion: {hold_time: 0.3 s, return_velocity: 100 deg/s}
simulator: {parameters: {particles: 200, friction: [0, 0.6]}}
calibration:
  receiver: {name: tumbler, profile: {unit: mm, inner: [[0, 0], [26, 0], [26, 70]], wall: 4 mm, floor: 4 mm}}
  motion: {x_offset: 75 mm, height: 80 mm}
  actions: {angular_velocity: [60 deg/s, 100 deg/s], max_angle: [80 deg, 115 deg]}
  pours: {count: 3, holdout: 1}
  simulations: 4
  initial_samples: 3
deployment:
  strategy: D3
  receiver: {name: narrow, profile: {unit: mm, inner: [[0, 0], [20, 0], [20, 90]], wall: 4 mm, floor: 4 mm}}
  motion: {max_angle: 115 deg, height: 80 mm}
  actions: {angular_velocity: [60 deg/s, 100 deg/s], x_offset: [70 mm, 100 mm]}
  prior_simulations: 2
  pours: 2
  simulations_per_pour: 1
on_unknown: ask
outputs: {recording: false, figures: false}
"""

BEAKER = {"profile": {"unit": "mm", "inner": [[0, 0], [30, 0], [30, 70]], "wall": "4 mm", "floor": "4 mm"}}
VIAL = {"profile": {"unit": "mm", "inner": [[0, 0], [20, 0], [20, 90]], "wall": "4 mm", "floor": "4 mm"}}

ORDER = (
    "short",
    "paused",
    "short",
    "plan",
    "short",
    "stopped",
    "plain",
    "short",
    "aborted",
    "short",
    "recorded",
    "short",
)
"""Kinds of campaigns, in repeating order. Plain ones and plans calibrate and deploy; the others only pour."""

FULL_FOR = 30.0
"""Duration of a full disk [s]."""

ENDED = ("finished", "stopped", "withdrawn")
RESTS = ("paused", "failed", "unknown")


# ---- the daemon and its disk


class Laboratory:
    """A daemon on a small disk, and the state that its clients share.

    Args:
        folder: folder for settings, log and results.
        disk: file system of the state directory.
        mark: folder for temporary files, which identifies the daemon's processes.
    """

    def __init__(self, folder: Path, disk: Path, mark: str) -> None:
        self.folder, self.disk, self.mark = folder, disk, mark
        self.over, self.go = threading.Event(), threading.Event()
        self.go.set()
        self.counts: collections.Counter[str] = collections.Counter()
        self.restarts: list[float] = []
        self.spent = 0.0
        self._active, self._lock, self._own = 0, threading.Lock(), threading.local()
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self._port = free.getsockname()[1]
        self._process: subprocess.Popen[bytes] | None = None

    @property
    def state(self) -> Path:
        """The state directory."""
        return self.disk / "state"

    def start(self) -> None:
        """Start the daemon and wait until it serves requests."""
        begun = time.monotonic()
        options = self.folder / "settings.yaml", "--state", self.state, "--port", str(self._port)
        self._process = launched(self.folder, *options, environment={"TMPDIR": self.mark})

        def up() -> bool:
            with self.client() as client:
                return bool(client.get("/status"))

        await_daemon(self._process, self.folder, up)
        self.restarts.append(time.monotonic() - begun)

    def end(self, number: int = signal.SIGTERM) -> None:
        """End the daemon with a signal."""
        self.spent += _cpu(self.mark)
        process, self._process = self._process, None
        if process is not None:
            end(process, number)

    def client(self) -> Client:
        """Return a client; the daemon may not be running."""
        return Client(f"http://127.0.0.1:{self._port}", self.state)

    def call(self, method: str, path: str, body: Any = None, *, repeat: bool = True, **query: Any) -> Any:
        """Send a request, and repeat it until the daemon responds.

        Raises:
            DaemonError: it was refused, or there was no response and it may not be repeated.
        """
        while True:
            try:
                if not hasattr(self._own, "client"):  # of this thread
                    self._own.client = self.client()
                client = self._own.client
                return client.get(path, **query) if method == "get" else client.post(path, body)
            except DaemonError as error:
                again = error.unreachable and repeat
                self.counts["connections lost"] += bool(error.unreachable)
                if not again or self.over.wait(0.3):
                    raise

    @contextlib.contextmanager
    def item(self) -> Iterator[None]:
        """Run an item of a client; wait first if the clients are paused."""
        while not self.go.wait(0.2):
            if self.over.is_set():
                break
        with self._lock:
            self._active += 1
        try:
            yield
        finally:
            with self._lock:
                self._active -= 1

    def calm(self, timeout: float) -> bool:
        """Pause the clients, and wait until nothing runs; return whether this succeeded in time."""
        self.go.clear()
        end = time.monotonic() + timeout
        while time.monotonic() < end and self._active:
            time.sleep(0.1)
        return not self._active

    def fill(self) -> None:
        """Fill the disk completely."""
        with (self.disk / "filler").open("ab", buffering=0) as file:
            for size in (1 << 20, 4096, 1):
                with contextlib.suppress(OSError):
                    while True:
                        file.write(bytes(size))

    def make_room(self) -> None:
        """Free the disk."""
        (self.disk / "filler").unlink(missing_ok=True)

    def note(self, **row: Any) -> None:
        """Append a row to the items."""
        with self._lock:
            _append(self.folder / "items.jsonl", row)


@contextlib.contextmanager
def small_disk(place: Path) -> Iterator[Path]:
    """Mount a file system in memory.

    Raises:
        SystemExit: this user may not mount one.
    """
    place.mkdir(parents=True, exist_ok=True)
    made = subprocess.run(
        ["mount", "-t", "tmpfs", "-o", f"size={DISK}m", "tmpfs", str(place)],
        capture_output=True,
        text=True,
        check=False,
        env=child_environment(),
    )
    if made.returncode != 0:
        raise SystemExit(f"only root may mount a small disk: {made.stderr.strip()}")
    try:
        yield place
    finally:
        subprocess.run(["umount", "--lazy", str(place)], check=True, env=child_environment())


# ---- clients


def texts(folder: Path) -> dict[str, tuple[str, Files]]:
    """Return the submissions by kind."""
    yaml = YAML()

    def short(campaign: dict[str, Any], pours: int, outputs: dict[str, Any] | None = None) -> None:
        del campaign["calibration"]
        campaign["outputs"] = outputs or campaign["outputs"]
        campaign["simulator"]["parameters"]["friction"] = 0.3
        kept = {key: campaign["deployment"][key] for key in ("receiver", "motion", "actions")}
        campaign["deployment"] = {"strategy": "D2", **kept, "pours": pours}

    changes: dict[str, Callable[[dict[str, Any]], object]] = {
        "plain": lambda campaign: None,
        "short": lambda campaign: short(campaign, 1),
        "paused": lambda campaign: short(campaign, 4),
        "recorded": lambda campaign: short(campaign, 2, {"recording": True}),
    }
    found = {}
    for kind, change in changes.items():
        campaign = yaml.load(CAMPAIGN)
        change(campaign)
        text = StringIO()
        yaml.dump(campaign, text)
        (folder / f"{kind}.yaml").write_text(text.getvalue(), encoding="utf-8")
        found[kind] = pack(load_campaign(folder / f"{kind}.yaml"))
    return {**dict.fromkeys(ORDER, found["paused"]), **found, "plan": found["plain"]}


def submitting(lab: Laboratory, sent: dict[str, tuple[str, Files]], rig: str, first: int, most: int) -> None:
    """Run a client of one rig that submits one campaign after the other.

    Args:
        sent: submissions by kind.
        first: index of its first campaign in `ORDER`.
        most: number of campaigns.
    """
    chance = random.Random(f"{rig} {first}")
    for number in range(first, first + most):
        if lab.over.is_set():
            return
        with lab.item():
            kind, begun = ORDER[number % len(ORDER)], time.time()
            body = {"text": sent[kind][0], "files": sent[kind][1], "task": "plan" if kind == "plan" else "run"}
            if kind != "plan":
                body["rig"] = rig
            try:
                key = lab.call("post", "/campaigns", body, repeat=False)["id"]
            except DaemonError as error:
                lab.counts["submissions without an answer" if error.unreachable else "submissions refused"] += 1
                lab.over.wait(1.0)
                continue
            with contextlib.suppress(DaemonError):
                state = followed(lab, key, kind, chance)
                lab.note(
                    what="campaign", id=key, kind=kind, rig=rig, state=state, began=begun, seconds=time.time() - begun
                )


def followed(lab: Laboratory, key: str, kind: str, chance: random.Random) -> str:
    """Follow a campaign to its end, resuming it if needed; return its final state."""
    verb = {"paused": "pause", "stopped": "stop", "aborted": "abort"}.get(kind, "")
    when = time.monotonic() + chance.uniform(1.0, 6.0)
    while True:
        found = lab.call("get", f"/campaigns/{key}")
        state = str(found["state"])
        if state in ENDED:
            return state
        with contextlib.suppress(DaemonError):
            if verb and state == "running" and time.monotonic() > when:
                lab.call("post", f"/campaigns/{key}/{verb}")
                verb = ""
            elif state in RESTS and found["desired_state"] != "run":
                lab.call("post", f"/campaigns/{key}/resume")
                lab.counts[f"resumed after {state}"] += 1
        time.sleep(0.6)


def ordering(lab: Laboratory, begun: float) -> None:
    """Run a client that orders pours on both rigs alternately, and sends every order three times or more."""
    setting_up = [
        ("/materials/liquids", {"id": "water", "properties": {"name": "water"}}),
        *[("/materials/vessels", {"id": f"beaker-{rig}", "shape": BEAKER}) for rig in RIGS],
        *[("/materials/vessels", {"id": f"vial-{rig}", "shape": VIAL}) for rig in RIGS],
    ]
    for path, made in setting_up:
        lab.call("post", path, made)
    for number in range(100_000):
        rig = ("left", "right")[number % 2]
        with lab.item(), contextlib.suppress(DaemonError):
            if lab.over.is_set():
                return
            for vessel, mass in ((f"beaker-{rig}", "100 g"), (f"vial-{rig}", "0 g")):
                lab.call("post", f"/materials/vessels/{vessel}/weighed", {"mass": mass, "liquid": "water"})
            key = f"order-{number}"
            action = {"angular_velocity": "100 deg/s", "x_offset": "70 mm"}
            vessels = {"source": f"beaker-{rig}", "receiver": f"vial-{rig}"}
            body: dict[str, Any] = {
                "id": key,
                "rig": rig,
                **vessels,
                "action": action,
                "predict": False,
                "priority": 10,
            }
            ordered = lab.call("post", "/pours", body)
            lab.note(what="order", id=key, campaign=ordered.get("campaign"))
            for repetition in range(100_000):
                if repetition < 2 or repetition % 8 == 0:
                    again = lab.call("post", "/pours", body)
                    lab.counts["orders repeated"] += 1
                    if again.get("campaign") != ordered.get("campaign"):
                        lab.counts["another pour for the same order"] += 1
                state = str(lab.call("get", f"/pours/{key}")["state"])
                if state in ("weighed", "failed", "cancelled"):
                    lab.note(what="order ended", id=key, state=state)
                    break
                if state == "paused":
                    with contextlib.suppress(DaemonError):
                        lab.call("post", f"/pours/{key}/resume")
                time.sleep(0.4)
        lab.over.wait(max(10.0 - (time.monotonic() - begun) % 10.0, 0.5))


def answering(lab: Laboratory) -> None:
    """Run the operator of the right rig, who also decides about pours with unknown outcome after a kill."""
    while not lab.over.is_set():
        with contextlib.suppress(DaemonError):
            for question in lab.call("get", "/questions"):
                said = {"done": "done", "yes or no": "yes", "weight": "100 g"}.get(question["wants"], "lost")
                lab.call("post", f"/questions/{question['id']}/answer", {"answer": said})
                lab.counts["pours declared lost by the operator" if said == "lost" else "questions answered"] += 1
        lab.over.wait(0.15)


def visiting(lab: Laboratory, number: int) -> None:
    """Run a client that connects repeatedly: it reads, follows events, or disconnects in the middle of a request."""
    chance = random.Random(number)
    while not lab.over.wait(chance.uniform(1.0, 6.0)):
        lab.counts["visits"] += 1
        with contextlib.suppress(DaemonError, OSError):
            match chance.randrange(3):
                case 0:
                    for path in ("/status", "/campaigns", "/runs", "/materials"):
                        lab.call("get", path, repeat=False)
                case 1:
                    with lab.client() as client:
                        end = time.monotonic() + chance.uniform(1.0, 5.0)
                        for _ in client.events(chance.choice((0, None))):
                            if time.monotonic() > end or lab.over.is_set():
                                break
                case 2:
                    with lab.client() as client, socket.create_connection(("127.0.0.1", int(client.url[-5:]))) as raw:
                        raw.sendall(b"POST /api/v1/pours HTTP/1.1\r\nHost: x\r\nContent-Length: 400\r\n\r\n{")


# ---- faults and samples


def striking(lab: Laboratory, begun: float, disturbed: float) -> None:
    """Kill or end the daemon every 90 s, and fill its disk, until `disturbed` [s]; later fill it once."""
    for number in range(100_000):
        if lab.over.wait(90.0):
            return
        calm = time.monotonic() - begun > disturbed
        if calm and lab.counts["full disks later"]:
            continue
        if calm or number % 4 == 2:
            lab.counts["full disks later" if calm else "full disks"] += 1
            lab.fill()
            lab.over.wait(FULL_FOR)
            lab.make_room()
        else:
            kind = signal.SIGTERM if number % 4 == 3 else signal.SIGKILL
            lab.counts["ended by SIGTERM" if kind == signal.SIGTERM else "killed"] += 1
            lab.end(kind)
            lab.start()


def sampling(lab: Laboratory, every: float, begun: float) -> None:
    """Take a sample at regular intervals, between items if they end in time."""
    while not lab.over.wait(every):
        calm = lab.calm(60.0)
        try:
            row = {"minute": (time.monotonic() - begun) / 60.0, "at rest": calm, **look(lab)}
            _append(lab.folder / "samples.jsonl", row)
        finally:
            lab.go.set()


def look(lab: Laboratory) -> dict[str, Any]:
    """Return everything that may grow: memory [MB], counts, sizes on disk [MB]."""
    totals: collections.Counter[str] = collections.Counter()
    for process in ours(lab.mark):
        with contextlib.suppress(psutil.Error, OSError):
            with process.oneshot():
                name = _name(process)
                found: dict[str, Any] = {"own": _own_memory(process.pid), "pss": process.memory_full_info().pss / 1e6}
                found |= {"threads": process.num_threads(), "handles": process.num_fds(), "processes": 1}
            totals.update(found)
            if name == "daemon":
                totals.update({f"daemon {k}": v for k, v in found.items() if k != "processes"})
    sizes = {path.name: path.stat().st_size / 1e6 for path in lab.state.glob("*.sqlite*")}
    sizes["runs"], sizes["campaigns"] = (_size(lab.state / name) / 1e6 for name in ("runs", "campaigns"))
    return {
        "time": time.time(),
        "starts": len(lab.restarts),
        "cpu": round(lab.spent + _cpu(lab.mark), 1),
        **{key: round(value, 2) for key, value in totals.items()},
        "size of": {key: round(value, 3) for key, value in sizes.items()},
    }


def ours(mark: str) -> Iterator[psutil.Process]:
    """Yield the daemon and all processes it has started, including those that have left its process tree."""
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.Error, OSError):
            if process.environ().get("TMPDIR") == mark or any(mark in word for word in process.cmdline()):
                yield process


def _own_memory(pid: int) -> float:
    """Return the memory that a process has written [MB], with equal parts of shared pages and without library files.

    The share of library files changes by up to 40 MB whenever another program uses them.
    """
    lines = Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines()
    return sum(int(line.split()[1]) for line in lines if line.startswith(("Pss_Anon", "Pss_Shmem"))) * 1024 / 1e6


def _name(process: psutil.Process) -> str:
    return "daemon" if {"server", "start"} <= set(process.cmdline()) else process.name()


def _size(folder: Path) -> int:
    total = 0
    for path in folder.rglob("*"):
        with contextlib.suppress(OSError):
            total += path.lstat().st_blocks * 512
    return total


def _cpu(mark: str) -> float:
    """Return the CPU time of the daemon and its processes [s], including those that have ended and been waited for."""
    spent = 0.0
    for process in ours(mark):
        with contextlib.suppress(psutil.Error, OSError):
            spent += sum(process.cpu_times()[:4])
    return spent


def _append(path: Path, row: dict[str, Any]) -> None:
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(row) + "\n")


# ---- the complete soak


def soak(folder: Path, minutes: float, campaigns: int, every: float) -> None:
    """Keep a daemon busy, then check its records.

    Args:
        folder: working folder; receives samples.jsonl, items.jsonl and result.json.
        minutes: duration [min].
        campaigns: largest number of campaigns of each of the four clients.
        every: time between two samples [s].
    """
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "settings.yaml").write_text(SETTINGS, encoding="utf-8")
    for rig, text in RIGS.items():
        (folder / f"{rig}.yaml").write_text(text, encoding="utf-8")
    with small_disk(folder / "disk") as disk, tempfile.TemporaryDirectory(prefix="k", dir="/tmp") as mark:
        lab = Laboratory(folder, disk, mark)
        lab.start()
        begun, sent = time.monotonic(), texts(folder)
        work: list[Callable[[], None]] = [
            partial(submitting, lab, sent, rig, first, campaigns) for rig in RIGS for first in (0, 5)
        ]
        others: list[Callable[[], None]] = [
            partial(ordering, lab, begun),
            partial(answering, lab),
            *(partial(visiting, lab, number) for number in range(4)),
            partial(striking, lab, begun, 0.4 * 60.0 * minutes),
            partial(sampling, lab, every, begun),
        ]
        threads = [threading.Thread(target=one, daemon=True) for one in [*work, *others]]
        try:
            for thread in threads:
                thread.start()
            while time.monotonic() < begun + 60.0 * minutes and any(one.is_alive() for one in threads[: len(work)]):
                time.sleep(1.0)
            took = time.monotonic() - begun
            lab.make_room()
            lab.calm(EVENT_TIMEOUT)
            promised = (
                lab.call("get", "/campaigns", limit=1000),
                lab.call("get", "/pours", limit=1000),
                lab.call("get", "/materials/account", limit=100_000),
            )
        finally:
            lab.over.set()
            for thread in threads:
                thread.join(EVENT_TIMEOUT)
            lab.end()
        found = checked(lab, *promised)
        left = [f"{process.pid} {_name(process)}" for process in ours(mark)]
        shutil.copytree(lab.state, folder / "state", dirs_exist_ok=True)
    result = {
        "minutes": round(took / 60.0, 1),
        "time_scale": TIME_SCALE,
        "restart_s": [round(one, 1) for one in lab.restarts],
        "cpu_s": round(lab.spent, 1),
        "counts": dict(lab.counts),
        "left behind": left,
        **found,
    }
    (folder / "result.json").write_text(json.dumps(result, indent=1) + "\n", encoding="utf-8")
    print(json.dumps(result, indent=1))


def checked(lab: Laboratory, campaigns: list[Any], pours: list[Any], account: list[Any]) -> dict[str, Any]:
    """Compare the daemon's records with its responses to the clients.

    Args:
        campaigns, pours, account: lists from the daemon at the end.
    """
    items = [json.loads(line) for line in (lab.folder / "items.jsonl").read_text().splitlines()]
    acknowledged = [one["id"] for one in items if one["what"] == "campaign"]
    listed = collections.Counter(one["id"] for one in campaigns)
    orders = {one["id"] for one in items if one["what"] == "order"}
    ended = {one["id"]: one["state"] for one in items if one["what"] == "order ended"}
    known = collections.Counter(one["id"] for one in pours)
    entered = collections.Counter((one["pour"], one["vessel"]) for one in account if one["kind"] == "poured")
    twice, damaged, finished = 0, [], collections.Counter[str]()
    for folder in sorted((lab.state / "runs").iterdir()):
        if not (folder / JOURNAL_NAME).is_file():
            continue
        try:
            check_journal(folder / JOURNAL_NAME).require()
        except Exception as error:
            damaged.append(f"{folder.name}: {error}")
        with JournalReader(folder / JOURNAL_NAME) as journal:
            counted: collections.Counter[Any] = collections.Counter()
            for entry in journal.entries(kinds=(Kind.FINISHED, Kind.POUR_FINISHED)):
                counted[entry.stage, entry.body["id"]] += 1
                finished[str(entry.kind)] += 1
            twice += sum(count > 1 for count in counted.values())
    runs = collections.Counter(one["run"] for one in campaigns if one["run"])
    return {
        "campaigns": len(acknowledged),
        "states": dict(
            collections.Counter(f"{one['kind']}: {one['state']}" for one in items if one["what"] == "campaign")
        ),
        "campaigns lost": [key for key in acknowledged if not listed[key]],
        "campaigns with the run of another": [run for run, count in runs.items() if count > 1],
        "orders": len(orders),
        "orders ended": dict(collections.Counter(ended.values())),
        "orders lost": sorted(orders - set(known)),
        "orders doubled": [key for key in orders if known[key] > 1],
        "weighed orders not in the account once": [
            key for key, state in ended.items() if state == "weighed" and any(
                entered[one["campaign"], vessel] != 1 and entered[key, vessel] != 1
                for one in items if one["what"] == "order" and one["id"] == key
                for vessel in _vessels(pours, key)
            )
        ],
        "requests finished": dict(finished),
        "requests finished twice": twice,
        "journals damaged": damaged,
    }  # fmt: skip


def _vessels(pours: list[Any], key: str) -> list[str]:
    one = next(one for one in pours if one["id"] == key)
    return [one["source"], one["receiver"]]


# ---- the result

FIGURE = ROOT / "docs" / "images" / "daemon" / "day.png"


def draw(folder: Path) -> dict[str, Any]:
    """Draw a soak; return the contents of its table."""
    samples = [json.loads(line) for line in (folder / "samples.jsonl").read_text().splitlines()]
    result: dict[str, Any] = json.loads((folder / "result.json").read_text())
    last = max(one["starts"] for one in samples)
    size = {name: partial(_kept, name) for name in ("daemon", "events", "vessels", "runs", "campaigns")}
    figure, panels = style.new_figure(2, 2, size=(9.2, 6.0), sharex=True)
    memory, handles, threads, disk = panels.flat
    for starts in range(1, last + 1):
        rows = [one for one in samples if one["starts"] == starts and "daemon own" in one]
        minutes = [one["minute"] for one in rows]
        for axes, curves in (
            (memory, {"all processes": "own", "the daemon": "daemon own"}),
            (handles, {"all processes": "handles", "the daemon": "daemon handles"}),
            (threads, {"threads": "threads", "processes": "processes"}),
        ):
            for (name, key), colour in zip(curves.items(), (style.MEASURED, style.PREDICTED), strict=True):
                label = name if starts == last else None
                axes.plot(minutes, [one[key] for one in rows], "o-", color=colour, ms=3, lw=1.2, label=label)
    minutes = [one["minute"] for one in samples]
    names = {"daemon": "queue, questions, audit entries", "events": "events", "vessels": "materials"}
    colours = (style.MEASURED, style.PREDICTED, style.GOOD)
    for (key, name), colour in zip(names.items(), colours, strict=True):
        disk.plot(minutes, [size[key](one) for one in samples], "o-", color=colour, ms=3, lw=1.2, label=name)
    titles = {memory: "Memory [MB]", handles: "Open handles", threads: "Threads and processes", disk: "On disk [MB]"}
    for axes, title in titles.items():
        style.dress(axes, title=title, x="minutes" if axes in (threads, disk) else "")
        axes.set_ylim(0.0, None)
        axes.legend(fontsize=8, framealpha=0.85, edgecolor="none")
    style.save(figure, FIGURE)
    shown: dict[str, Callable[[dict[str, Any]], float]] = {
        "memory of all processes [MB]": lambda s: float(s["own"]),
        "memory of the daemon itself [MB]": lambda s: float(s["daemon own"]),
        "open handles": lambda s: float(s["handles"]),
        "threads": lambda s: float(s["threads"]),
        "processes": lambda s: float(s["processes"]),
        "queue, questions, audit entries with their WAL [MB]": size["daemon"],
        "events with their WAL [MB]": size["events"],
        "materials with their WAL [MB]": size["vessels"],
        "run folders [MB]": size["runs"],
        "submitted campaigns [MB]": size["campaigns"],
    }
    undisturbed = [one for one in samples if one["starts"] == last and one["at rest"]]
    counts = result["counts"]
    return {
        "minutes": result["minutes"],
        "hours scaled": round(result["minutes"] * result["time_scale"] / 60.0, 1),
        "campaigns": result["campaigns"],
        "states": result["states"],
        "orders": result["orders"],
        "orders ended": result["orders ended"],
        "counts": counts,
        "restart [s]": round(statistics.median(result["restart_s"][1:]), 1),
        "cpu share": round(result["cpu_s"] / 60.0 / result["minutes"], 3),
        "finished": result["requests finished"],
        "lost or doubled": {
            name: len(result[name])
            for name in (
                "campaigns lost",
                "campaigns with the run of another",
                "orders lost",
                "orders doubled",
                "weighed orders not in the account once",
                "journals damaged",
                "left behind",
            )
        }
        | {
            "requests finished twice": result["requests finished twice"],
            "another pour for the same order": counts.get("another pour for the same order", 0),
        },
        "undisturbed [min]": [round(one["minute"], 1) for one in (undisturbed[0], undisturbed[-1])],
        "at rest": [{"what": name, **_course(undisturbed, value)} for name, value in shown.items()],
    }


def _kept(name: str, sample: dict[str, Any]) -> float:
    return float(sum(v for k, v in sample["size of"].items() if k.startswith(name)))


def _course(rows: list[dict[str, Any]], value: Callable[[dict[str, Any]], float]) -> dict[str, float]:
    """Return the value at a third of the time and at the end, and the slope between with its standard error [1/h]."""
    begin, end = rows[0]["minute"], rows[-1]["minute"]
    late = [row for row in rows if row["minute"] >= begin + (end - begin) / 3.0]
    fit = stats.linregress([row["minute"] / 60.0 for row in late], [value(row) for row in late])
    return {
        "third": round(value(late[0]), 2),
        "end": round(value(late[-1]), 2),
        "an hour": round(float(fit.slope), 2),
        "error": round(float(fit.stderr), 2),
    }


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=40.0)
    parser.add_argument("--into", type=Path, default=Path("soak"))
    parser.add_argument("--campaigns", type=int, default=1000, help="campaigns per client, at most (four clients)")
    parser.add_argument("--every", type=float, default=60.0, help="seconds between two samples")
    parser.add_argument("--draw", type=Path, help="draw the results in this folder")
    arguments = parser.parse_args()
    if arguments.draw is not None:
        keep("day", draw(arguments.draw))
        return
    end_in_order()
    os.environ.pop("DECANT_STATE", None)
    soak(arguments.into.resolve(), arguments.minutes, arguments.campaigns, arguments.every)


if __name__ == "__main__":
    main()
