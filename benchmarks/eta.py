"""Compare the time left that a quickstart run reports ('about 4 min left in all') with the actual time.

    python benchmarks/eta.py [--benches numbers,wires] [--seed 7] [--json]

Runs the shipped quickstart like a user, on the simulated bench (`twin.yaml`) and over device protocols. Reads each line
of its plain progress, and compares the reported time left with the end of the campaign. The error is a share of the
whole run: (told − true) / whole. Required: every error within 20 %, from the first line on.

Run it on an idle machine, because other load distorts the result. A deployment that ends before its last pour, because
no further pour has enough value, ends earlier than predicted; the result includes the number of pours.
"""

from __future__ import annotations

import argparse
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from machine import ROOT, describe, say, show

from actors.runtime.child_process import child_environment

LIMIT = 0.2
"""Largest error of a reported time, as a share of the whole run."""

LABORATORIES = {"numbers": "twin.yaml", "wires": "virtual.yaml"}

LONGEST = 3600.0
"""Time limit of a run [s]."""

TOLD = re.compile(r"about (?:(?P<hours>\d+) h )?(?:(?P<minutes>\d+) min ?)?(?:(?P<seconds>\d+) s )?left in all")


def told(line: str) -> float | None:
    """Return the time left that a line of progress reports [s], or None."""
    found = TOLD.search(line)
    if found is None:
        return None
    hours, minutes, seconds = (float(found[name] or 0.0) for name in ("hours", "minutes", "seconds"))
    return 3600.0 * hours + 60.0 * minutes + seconds


def score(lines: list[tuple[float, str]], whole: float) -> list[dict[str, Any]]:
    """Compare each reported time with the actual one.

    Args:
        lines: times since the campaign began [s], and the printed lines.
        whole: duration of the campaign [s].
    """
    rows = []
    for at, line in lines:
        left = told(line)
        if left is not None:
            error = (left - (whole - at)) / whole
            rows.append(
                {
                    "at_s": round(at, 1),
                    "stage": line.partition(":")[0],
                    "told_s": round(left),
                    "true_s": round(whole - at),
                    "error": round(error, 3),
                }
            )
    return rows


def run(bench: str, seed: int) -> dict[str, Any]:
    """Run one quickstart; return its reported times and their errors.

    Raises:
        SystemExit: the run failed.
    """
    program = "from orchestrator.cli.app import main; main()"
    configs = ROOT / "configs"
    lines: list[tuple[float, str]] = []
    with tempfile.TemporaryDirectory(prefix="decant-eta-") as folder:
        text = (configs / "campaigns" / "quickstart.yaml").read_text(encoding="utf-8")
        text = text.replace("../../runs", f"{folder}/runs").replace("../", f"{configs}/")
        campaign = Path(folder) / "quickstart.yaml"
        campaign.write_text(text, encoding="utf-8")
        laboratory = configs / "laboratories" / LABORATORIES[bench]
        command = [sys.executable, "-c", program, "run", str(campaign), "--laboratory", str(laboratory)]
        command += ["--seed", str(seed), "--json"]
        process = subprocess.Popen(
            command, cwd=folder, stderr=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=child_environment()
        )
        begun = closed = None
        started = time.monotonic()
        try:
            assert process.stderr is not None
            for line in process.stderr:
                now = time.monotonic()
                if now - started > LONGEST:
                    raise SystemExit(f"{bench}: no end after {LONGEST:.0f} s")
                begun = now if begun is None and " begins: " in line else begun
                closed = now if line.startswith("campaign ") else closed
                lines.append((now, line.strip()))
                if told(line) is not None:
                    say(line.strip())
            process.wait(60.0)
        finally:
            if process.poll() is None:
                process.terminate()
                process.wait(60.0)
    if process.returncode != 0 or begun is None or closed is None:
        raise SystemExit(f"{bench}: ended with {process.returncode}: {' / '.join(line for _, line in lines[-5:])}")
    rows = score([(at - begun, line) for at, line in lines], closed - begun)
    worst = max((abs(row["error"]) for row in rows), default=float("nan"))
    return {
        "bench": bench,
        "whole_s": round(closed - begun),
        "ended": next(line for _, line in reversed(lines) if line.startswith("campaign ")),
        "lines": rows,
        "worst": worst,
        "within": sum(abs(row["error"]) <= LIMIT for row in rows),
        "met": worst <= LIMIT,
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--benches", default="numbers,wires", help=f"comma-separated, of {', '.join(LABORATORIES)}")
    parser.add_argument("--seed", type=int, default=7)
    parser.add_argument("--json", action="store_true", help="one line of JSON")
    options = parser.parse_args()
    benches = options.benches.split(",")
    for bench in benches:
        if bench not in LABORATORIES:
            raise SystemExit(f"--benches {bench}: there are {', '.join(LABORATORIES)}")
    result: dict[str, Any] = {bench: run(bench, options.seed) for bench in benches}
    show({**result, "limit": LIMIT, "seed": options.seed, "machine": describe()}, options.json)


if __name__ == "__main__":
    main()
