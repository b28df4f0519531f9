"""Measure the CPU seconds of `decant validate` for every shipped file in new processes.

    python benchmarks/validate_cost.py [--repeats 5] [--json]

User plus system time of the complete process, including start and imports; other load hardly affects it. Bytecode and
the grids of meshes are cached by one initial run per file, which is not counted.
"""

from __future__ import annotations

import argparse
import statistics
import tempfile
from pathlib import Path
from typing import Any

from machine import ROOT, as_a_second_time, describe, run_decant, say, show, single_threaded

LIMIT = 2.0
"""Required time for the check of a shipped file [CPU s]."""

FOLDERS = ("campaigns", "studies", "laboratories", "vessels")


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=5, help="processes per file")
    parser.add_argument("--json", action="store_true", help="one line of JSON")
    options = parser.parse_args()
    if options.repeats < 1:
        raise SystemExit(f"--repeats {options.repeats}: at least one process is needed")
    rows: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory(prefix="decant-") as kept:
        environment = single_threaded() | as_a_second_time(Path(kept))
        for folder in FOLDERS:
            for file in sorted((ROOT / "configs" / folder).glob("*.yaml")):
                name = file.relative_to(ROOT).as_posix()
                runs = [run_decant("validate", file, environment=environment) for _ in range(options.repeats + 1)]
                seconds = [cpu for _, _, cpu in runs[1:]]
                rows.append({"file": name, "cpu_s": round(statistics.median(seconds), 2)})
                say(f"{name}: {rows[-1]['cpu_s']:.2f} CPU s")
    result = {
        "files": rows,
        "limit_s": LIMIT,
        "within_limit": all(row["cpu_s"] <= LIMIT for row in rows),
        "repeats": options.repeats,
        "core": None,
        "machine": describe(),
    }
    show(result, options.json)


if __name__ == "__main__":
    main()
