"""A daemon that is kept busy for an hour or a week: does anything of it grow?

A daemon with one simulator gets campaigns over HTTP, one after the other, on benches whose clock is scaled:
plans, calibrations with deployments, with and without a recording, with an operator whose questions are answered over
the API, paused and resumed, aborted while the arm tilts and resumed with its question, stopped, and some over wires.
Every minute all processes that it has started are looked at, and everything that it keeps. It waits between campaigns
so that it takes no more of a core than it may. Run from the project's root:

    python benchmarks/soak.py --minutes 60 --into soak     # writes soak/samples.jsonl and soak/campaigns.jsonl
    python benchmarks/soak.py --draw soak                  # the picture, and its table in docs/evidence/reliability.md
"""

from __future__ import annotations

import argparse
import collections
import contextlib
import itertools
import json
import os
import statistics
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from functools import partial
from io import StringIO
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from daemon_page import keep
from daemon_process import end_in_order, serving
from ruamel.yaml import YAML

from orchestrator.config.file_loading import load_campaign
from orchestrator.daemon.daemon_client import Client, DaemonError
from orchestrator.daemon.submissions import Files, pack
from orchestrator.journal.journal import JOURNAL_NAME
from orchestrator.results import figure_style as style

ROOT = Path(__file__).parents[1]

SETTINGS = """\
simulators: 1
keep_free: 40 MB
events: 2000
recordings: {keep: 3}
"""
"""Bounds that are reached within minutes, as days reach the usual ones."""

CAMPAIGN = """\
name: soak
laboratory: {name: numbers, bench: {liquid: {particles: 200}, time_scale: 60, operator_time: 20 s}}
liquid: {name: water, mass: 100 g}
pourer: {name: beaker, profile: {unit: mm, inner: [[0, 0], [30, 0], [30, 70]], wall: 4 mm, floor: 4 mm}}
motion: {hold_time: 0.3 s, return_velocity: 100 deg/s}
simulator: {parameters: {particles: 200, friction: [0, 0.6]}}
calibration:
  receiver: {name: tumbler, profile: {unit: mm, inner: [[0, 0], [26, 0], [26, 70]], wall: 4 mm, floor: 4 mm}}
  motion: {x_offset: 75 mm, height: 80 mm}
  actions: {angular_velocity: [60 deg/s, 100 deg/s], max_angle: [80 deg, 115 deg]}
  pours: {count: 3, holdout: 1}
  simulations: 5
  initial_samples: 3
deployment:
  strategy: D3
  receiver: {name: narrow, profile: {unit: mm, inner: [[0, 0], [20, 0], [20, 90]], wall: 4 mm, floor: 4 mm}}
  motion: {max_angle: 115 deg, height: 80 mm}
  actions: {angular_velocity: [60 deg/s, 100 deg/s], x_offset: [70 mm, 100 mm]}
  prior_simulations: 3
  pours: 2
  simulations_per_pour: 1
on_unknown: ask
outputs: {recording: false, figures: false}
"""

ORDER = (
    "plan",
    "plain",
    "paused",
    "asked",
    "plan",
    "stopped",
    "plain",
    "aborted",
    "recorded",
    "plain",
    "asked",
    "wired",
)
"""Kinds of campaigns, again and again."""


# ---- campaigns


def texts(folder: Path) -> dict[str, tuple[str, Files]]:
    """What is submitted, by kind."""
    yaml = YAML()
    changes: dict[str, Callable[[dict[str, Any]], object]] = {
        "plain": lambda campaign: None,
        "asked": lambda campaign: campaign.update(laboratory=_asked()),
        "recorded": lambda campaign: campaign.update(outputs={"recorded_simulations": 1}),
        "wired": lambda campaign: campaign.update(laboratory=_wired()),
    }
    found = {}
    for kind, change in changes.items():
        campaign = yaml.load(CAMPAIGN)
        change(campaign)
        text = StringIO()
        yaml.dump(campaign, text)
        (folder / f"{kind}.yaml").write_text(text.getvalue(), encoding="utf-8")
        found[kind] = pack(load_campaign(folder / f"{kind}.yaml"))
    return {**dict.fromkeys(ORDER, found["plain"]), **found}


def _asked() -> Any:
    bench = {"liquid": {"particles": 200}, "time_scale": 60}
    person = {"answers": "person"}
    return {
        "name": "asked",
        "bench": bench,
        "arm": {"kind": "numbers"},
        "balance": {"kind": "numbers"},
        "operator": person,
    }


def _wired() -> Any:
    laboratory = YAML().load(ROOT / "configs/laboratories/virtual.yaml")
    laboratory["simulators"] = 1
    laboratory["bench"]["liquid"]["particles"] = 200
    return laboratory


def one(client: Client, kind: str, sent: tuple[str, Files]) -> str:
    """Have a campaign run to its end, whatever is done to it on the way; the state that it ends in."""
    last = client.get("/status")["last_event"]
    verb = "plan" if kind == "plan" else "run"
    key = client.post("/campaigns", {"text": sent[0], "files": sent[1], "task": verb})["id"]
    done = False
    for told in client.events(last, key):
        match told.type:
            case "QuestionAsked":
                question = told.data["question"]
                said = {"done": "done", "yes or no": "yes"}.get(question["wants"], "repeat")
                client.post(f"/questions/{question['id']}/answer", {"answer": said})
            case "PourProgressed" if not done and told.data["progress"]["checkpoint"] == "tilt":
                if kind in ("paused", "stopped", "aborted"):
                    done = True
                    client.post(f"/campaigns/{key}/{ {'paused': 'pause', 'stopped': 'stop'}.get(kind, 'abort') }")
            case "CampaignRests":
                state = str(told.data["state"])
                if done and kind in ("paused", "aborted") and state in ("paused", "unknown"):
                    client.post(f"/campaigns/{key}/resume")
                else:
                    return state
    raise AssertionError("the stream of events has ended")


# ---- looking


def look(folder: Path, mark: str) -> dict[str, Any]:
    """Everything that might grow, now: memory [MB], counts, sizes on disk [MB]."""
    memory: collections.Counter[str] = collections.Counter()
    totals: collections.Counter[str] = collections.Counter()
    for process in ours(mark):
        with contextlib.suppress(psutil.Error, OSError):
            with process.oneshot():
                name = _name(process)
                found = {"pss": process.memory_full_info().pss, "rss": process.memory_info().rss}
                found |= {"threads": process.num_threads(), "handles": process.num_fds(), "processes": 1}
            memory[name] += found["pss"]
            totals.update(found)
            if name == "daemon":
                totals.update({f"daemon {k}": v for k, v in found.items() if k != "processes"})
    state = folder / "state"
    sizes = {path.name: path.stat().st_size for path in state.glob("*.sqlite*")}
    sizes["runs"], sizes["ray"] = _size(state / "runs"), _size(Path(mark))
    counts = {k: v for k, v in totals.items() if "ss" not in k.split()[-1] or k == "processes"}
    return {
        "time": time.time(),
        "cpu": round(_cpu(mark), 1),
        **counts,
        **{k: round(v / 1e6, 2) for k, v in totals.items() if k not in counts},
        "memory of": {k: round(v / 1e6, 1) for k, v in memory.items()},
        "size of": {k: round(v / 1e6, 3) for k, v in sizes.items()},
    }


def ours(mark: str) -> Iterator[psutil.Process]:
    """The daemon and all that it has started, those included that have left its tree."""
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.Error, OSError):
            if process.environ().get("TMPDIR") == mark or any(mark in word for word in process.cmdline()):
                yield process


def _name(process: psutil.Process) -> str:
    words = process.cmdline()
    line = " ".join(words)
    if "serve" in words:
        return "daemon"
    for part, name in (
        ("virtual_ur", "controller"),
        ("ur.worker", "worker of the arm"),
        ("orchestrator.live_view", "recording"),
    ):
        if part in line:
            return name
    return "Ray" if "ray" in line else process.name()


def _size(folder: Path) -> int:
    total = 0
    for path in folder.rglob("*"):
        with contextlib.suppress(OSError):
            total += path.lstat().st_blocks * 512
    return total


# ---- the hour


def soak(folder: Path, minutes: float, share: float, every: float) -> None:
    """Keep a daemon busy.

    Args:
        folder: where it is done; samples.jsonl and campaigns.jsonl are appended to.
        minutes: for so long.
        share: of a core that it may take, on average.
        every: between two samples [s].
    """
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "settings.yaml").write_text(SETTINGS, encoding="utf-8")
    sent = texts(folder)
    ended, at_rest = threading.Event(), threading.Event()
    count = itertools.count()
    with tempfile.TemporaryDirectory(prefix="k", dir="/tmp") as mark:  # short, since Ray puts sockets in it
        begin, spent = time.time(), 0.0
        with serving(folder, str(folder / "settings.yaml"), environment={"TMPDIR": mark}) as client:
            sampler = threading.Thread(target=_sample, args=(folder, mark, every, ended, at_rest, begin), daemon=True)
            sampler.start()
            try:
                while time.time() < begin + 60.0 * minutes:
                    number = next(count)
                    kind = ORDER[number % len(ORDER)]
                    before = time.time()
                    at_rest.clear()
                    try:
                        state = one(client, kind, sent[kind])
                    except DaemonError as error:
                        state = f"refused: {error}"
                    row = {
                        "number": number,
                        "kind": kind,
                        "state": state,
                        "began": before,
                        "seconds": time.time() - before,
                    }
                    _append(folder / "campaigns.jsonl", {**row, **_newest_journal(folder / "state/runs")})
                    spent = max(spent, _cpu(mark))
                    time.sleep(2.0)
                    at_rest.set()
                    time.sleep(1.0)
                    while spent > share * (time.time() - begin) and time.time() < begin + 60.0 * minutes:
                        time.sleep(1.0)
            finally:
                ended.set()
                sampler.join()
        time.sleep(2.0)
        left = [f"{process.pid} {_name(process)}" for process in ours(mark)]
        print(f"{next(count)} campaigns in {(time.time() - begin) / 60:.0f} min; left behind: {left or 'nothing'}")


def _cpu(mark: str) -> float:
    """CPU time of the daemon and all that it has started [s], with those that have ended and were waited for."""
    spent = 0.0
    for process in ours(mark):
        with contextlib.suppress(psutil.Error, OSError):
            spent += sum(process.cpu_times()[:4])
    return spent


def _sample(
    folder: Path, mark: str, every: float, ended: threading.Event, at_rest: threading.Event, begin: float
) -> None:
    """Every so often, once while a campaign runs and once between two."""
    while not ended.is_set():
        for rests in (False, True):
            while at_rest.is_set() != rests and not ended.wait(0.2):
                pass
            row = {"minute": (time.time() - begin) / 60.0, "at rest": at_rest.is_set(), **look(folder, mark)}
            _append(folder / "samples.jsonl", row)
        ended.wait(every)


def _newest_journal(runs: Path) -> dict[str, Any]:
    found = max(runs.glob("*"), key=lambda path: path.stat().st_mtime, default=None)
    if found is None:
        return {}
    journals = [path.stat().st_size for path in found.glob(f"{JOURNAL_NAME}*")]
    return {"journal": sum(journals), "folder": _size(found)}


def _append(path: Path, row: dict[str, Any]) -> None:
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(row) + "\n")


# ---- what came of it

FIGURE = ROOT / "docs" / "images" / "daemon" / "soak.png"


def draw(folder: Path) -> dict[str, Any]:
    """Draw a soak; what its table says."""
    samples = [json.loads(line) for line in (folder / "samples.jsonl").read_text().splitlines()]
    campaigns = [json.loads(line) for line in (folder / "campaigns.jsonl").read_text().splitlines()]
    rest, busy = ([s for s in samples if s["at rest"] is which] for which in (True, False))
    size = {name: partial(_kept, name) for name in ("daemon", "events", "ray")}
    figure, panels = style.new_figure(2, 2, size=(9.2, 6.0), sharex=True)
    memory, handles, threads, disk = panels.flat
    for rows, marker, alpha in ((rest, "o-", 1.0), (busy, ".", 0.45)):
        minutes = [s["minute"] for s in rows]
        for axes, curves in (
            (memory, {"all processes": "pss", "the daemon": "daemon pss"}),
            (handles, {"all processes": "handles", "the daemon": "daemon handles"}),
            (threads, {"threads": "threads", "processes": "processes"}),
        ):
            for (name, key), colour in zip(curves.items(), (style.MEASURED, style.PREDICTED), strict=True):
                label = name if rows is rest else None
                axes.plot(minutes, [s[key] for s in rows], marker, color=colour, ms=3, lw=1.2, alpha=alpha, label=label)
    minutes = [s["minute"] for s in rest]
    names = {"daemon": "queue, questions, audit entries", "events": "events", "ray": "Ray's logs"}
    for (key, name), colour in zip(names.items(), (style.MEASURED, style.PREDICTED, style.GOOD), strict=True):
        disk.plot(minutes, [size[key](s) for s in rest], "o-", color=colour, ms=3, lw=1.2, label=name)
    begin = campaigns[0]["began"]
    ran = [c for c in campaigns if c["kind"] == "plain"]
    when = [(c["began"] - begin) / 60.0 for c in ran]
    disk.plot(when, [c["journal"] / 1e6 for c in ran], "x", color=style.BEST, ms=5, label="journal of one campaign")
    titles = {memory: "Memory [MB]", handles: "Open handles", threads: "Threads and processes", disk: "On disk [MB]"}
    for axes, title in titles.items():
        style.dress(axes, title=title, x="minutes" if axes in (threads, disk) else "")
        axes.set_ylim(0.0, None)
        axes.legend(fontsize=8, framealpha=0.85, edgecolor="none")
    style.save(figure, FIGURE)
    shown: dict[str, Callable[[dict[str, Any]], float]] = {
        "memory of all processes [MB]": lambda s: float(s["pss"]),
        "memory of the daemon itself [MB]": lambda s: float(s["daemon pss"]),
        "open handles": lambda s: float(s["handles"]),
        "threads": lambda s: float(s["threads"]),
        "processes": lambda s: float(s["processes"]),
        "queue, questions, audit entries with their WAL [MB]": size["daemon"],
        "events with their WAL [MB]": size["events"],
        "Ray's folder [MB]": size["ray"],
    }
    states = collections.Counter(f"{c['kind']}: {c['state']}" for c in campaigns)
    last = rest[-1]["minute"]
    return {
        "minutes": round(last, 1),
        "campaigns": len(campaigns),
        "states": dict(states),
        "cpu share": round(max(s["cpu"] for s in samples) / (60.0 * last), 3),
        "journal of one campaign [kB]": [
            round(statistics.median(c["journal"] / 1e3 for c in half))
            for half in (ran[: len(ran) // 2], ran[len(ran) // 2 :])
        ],
        "at rest": [{"what": name, **_course(rest, value)} for name, value in shown.items()],
    }


def _kept(name: str, sample: dict[str, Any]) -> float:
    return float(sum(v for k, v in sample["size of"].items() if k.startswith(name)))


def _course(rows: list[dict[str, Any]], value: Callable[[dict[str, Any]], float]) -> dict[str, float]:
    """At a third of the time, at the end, and how it went on average in the time between [1/h]."""
    late = [row for row in rows if row["minute"] >= rows[-1]["minute"] / 3.0]
    slope = float(np.polyfit([row["minute"] / 60.0 for row in late], [value(row) for row in late], 1)[0])
    return {"third": round(value(late[0]), 2), "end": round(value(late[-1]), 2), "an hour": round(slope, 2)}


def main() -> None:
    """See the module."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--minutes", type=float, default=60.0)
    parser.add_argument("--into", type=Path, default=Path("soak"))
    parser.add_argument("--share", type=float, default=0.3, help="of a core, on average")
    parser.add_argument("--every", type=float, default=60.0, help="seconds between two samples")
    parser.add_argument("--draw", type=Path, help="draw what was found there")
    arguments = parser.parse_args()
    if arguments.draw is not None:
        keep("soak", draw(arguments.draw))
        return
    end_in_order()
    os.environ.pop("DECANT_STATE", None)
    soak(arguments.into.resolve(), arguments.minutes, arguments.share, arguments.every)


if __name__ == "__main__":
    main()
