"""Measure how long `decant plan` takes for a new cup: wall and CPU seconds of new processes.

    python benchmarks/plan_speed.py [--receivers cone narrow bowl mug] [--json]

Plans the quickstart's pour with Decant's default θ; the time includes start, imports, figures and report. Bytecode and
kernels are cached by an initial plan for the tumbler, which is not counted. Each receiver is planned once, because a
second plan would also find its grid in the cache.
"""

from __future__ import annotations

import argparse
import json
import shutil
import statistics
import tempfile
from pathlib import Path
from typing import Any

from machine import ROOT, as_a_second_time, describe, run_decant, say, show

LIMIT = 15.0
"""Required time of a plan for a new cup on two cores [s]."""

RECEIVERS = ("cone", "narrow", "bowl", "mug")


def plan(configs: Path, receiver: str, environment: dict[str, str]) -> dict[str, Any]:
    """Run one plan in a new process. Raises SystemExit if it failed."""
    vessel = configs / "vessels" / f"{receiver}.yaml"
    words = ("plan", "--json", configs / "campaigns" / "quickstart.yaml", "--receiver", vessel)
    printed, seconds, cpu = run_decant(*words, environment=environment)
    answer = json.loads(printed.splitlines()[-1])
    return {
        "receiver": receiver,
        "seconds": round(seconds, 1),
        "cpu_s": round(cpu, 1),
        "simulations": answer["simulations"],
        "predicted_spillage": round(answer["predicted_spillage"], 4),
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--receivers", nargs="+", default=RECEIVERS, metavar="NAME", help="names in configs/vessels")
    parser.add_argument("--json", action="store_true", help="one line of JSON")
    options = parser.parse_args()
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory(prefix="decant-") as kept:
        configs = Path(shutil.copytree(ROOT / "configs", Path(kept) / "configs"))
        environment = as_a_second_time(Path(kept))
        plan(configs, "tumbler", environment)
        for receiver in options.receivers:
            rows.append(plan(configs, receiver, environment))
            say(f"{receiver}: {rows[-1]['seconds']:.1f} s, {rows[-1]['cpu_s']:.1f} CPU s")
    seconds = statistics.median(row["seconds"] for row in rows)
    result = {
        "plans": rows,
        "seconds": round(seconds, 1),
        "limit_s": LIMIT,
        "within_limit": seconds <= LIMIT,
        "core": None,
        "machine": describe(),
    }
    show(result, options.json)


if __name__ == "__main__":
    main()
