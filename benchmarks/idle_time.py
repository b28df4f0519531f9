"""Measure the wall time of complete campaigns over device protocols, with and without speculative simulations.

`decant run` runs each campaign as for a user, alternately with and without speculative execution, in one session on one
machine. The decisions must be identical. 'Without' discards the predicted requests, for this benchmark only; there is
no such setting. Run from the project's root, on an idle machine:

    python benchmarks/idle_time.py                                    # the quickstart; into docs/data/daemon.json
    python benchmarks/idle_time.py --campaigns quickstart paper --times 1
"""

from __future__ import annotations

import argparse
import json
import os
import statistics
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from daemon_page import keep
from daemon_process import end_in_order, started

from orchestrator.journal.journal import JOURNAL_NAME, JournalReader, Kind

ROOT = Path(__file__).parents[1]

WITH = "from orchestrator.cli.app import main; main()"
NONE = "SpeculativeExecution.predict = lambda self, request: None"
WITHOUT = f"from orchestrator.runs.request_executor import SpeculativeExecution; {NONE}; {WITH}"


def run_once(campaign: str, program: str) -> dict[str, Any]:
    """Run a campaign from program start to end, on its own virtual bench."""
    path = ROOT / "configs" / "campaigns" / f"{campaign}.yaml"
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder)
        begin = time.monotonic()
        with (place / "out").open("w") as out, (place / "errors").open("w") as errors:
            environment = {**os.environ, "DECANT_STATE": str(place / "state")}
            command = [sys.executable, "-c", program, "run", str(path), "--json", "--quiet"]
            process = started(command, stdout=out, stderr=errors, env=environment, start_new_session=True)
            try:
                code = process.wait()
            finally:
                if process.poll() is None:
                    process.terminate()
                    process.wait(60.0)
        wall = time.monotonic() - begin
        if code != 0:
            raise SystemExit(f"{campaign}: ended with {code}: {(place / 'errors').read_text()[-2000:]}")
        told = json.loads((place / "out").read_text().splitlines()[-1])
        known = (place / "state" / "runs.txt").read_text().splitlines()
    directory = Path(known[-1])
    with JournalReader(directory / JOURNAL_NAME) as journal:
        entries = list(journal.entries())
    began = {e.body["id"]: e.t for e in entries if e.kind == Kind.POUR_STARTED}
    pours = [e.t - began[e.body["id"]] for e in entries if e.kind == Kind.POUR_FINISHED]
    ahead = [e.body["text"] for e in entries if e.kind == Kind.NOTE and "while the arm was pouring" in e.body["text"]]
    return {
        "wall": wall,
        "arm": sum(pours),
        "pours": len(pours),
        "ahead": sum(int(text.split()[0]) for text in ahead),
        "decided": json.dumps([told.get("theta"), told.get("receivers")], sort_keys=True, default=str),
    }


def compared(campaign: str, times: int) -> list[dict[str, Any]]:
    """Return the rows of the table: medians with and without, and whether the decisions agree."""
    found: dict[str, list[dict[str, Any]]] = {"yes": [], "no": []}
    for _ in range(times):
        for ahead, program in (("no", WITHOUT), ("yes", WITH)):
            found[ahead].append(run_once(campaign, program))
            print(campaign, "ahead:", ahead, {k: v for k, v in found[ahead][-1].items() if k != "decided"}, flush=True)
    same = len({run["decided"] for runs in found.values() for run in runs}) == 1
    return [
        {
            "campaign": campaign,
            "ahead": ahead,
            **{key: statistics.median(run[key] for run in runs) for key in ("wall", "arm", "pours")},
            "made ahead": statistics.median(run["ahead"] for run in runs),
            "same decisions": same,
        }
        for ahead, runs in found.items()
    ]


def main() -> None:
    """Measure, and write the figures and their table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--campaigns", nargs="+", default=["quickstart"], help="names in configs/campaigns")
    parser.add_argument("--times", type=int, default=1)
    parser.add_argument("--to", type=Path, help="write to this file instead of the page")
    arguments = parser.parse_args()
    end_in_order()
    found: dict[str, Any] = {"cores": os.cpu_count(), "times": arguments.times}
    found["load before"] = round(os.getloadavg()[0], 2)
    found["runs"] = [row for campaign in arguments.campaigns for row in compared(campaign, arguments.times)]
    if arguments.to is None:
        keep("idle-time", found)
    else:
        arguments.to.write_text(json.dumps(found, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
