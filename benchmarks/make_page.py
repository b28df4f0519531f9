"""Measure all figures of docs/evidence/performance.md, and write the page.

    python benchmarks/make_page.py                      the page only, from stored measurements
    python benchmarks/make_page.py --measure            all measurements, then the page
    python benchmarks/make_page.py --measure pour-2000 start-up

Measurements are stored in docs/data/performance.json, each with its command, machine and time. Measurements that are
not repeated stay unchanged.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

import page_figures
import page_sections as sections
from machine import ROOT, run_self, say

BENCHMARKS = Path(__file__).parent

PLAN: dict[str, tuple[str, ...]] = {
    "pour-2000": ("pour_speed.py", "--particles=2000", "--repeats=5", "--peer=3"),
    "pour-5000": ("pour_speed.py", "--particles=5000", "--repeats=3", "--peer=1"),
    "pour-10000": ("pour_speed.py", "--particles=10000", "--repeats=3", "--peer=1"),
    "scaling": ("scaling.py", "--repeats=1"),
    "start-up": ("start_up.py", "--repeats=9"),
    "engines": ("engines.py",),
    "plan": ("plan_speed.py",),
    "validate": ("validate_cost.py",),
    "pool": ("pool_speed.py",),
}
"""Measurements by name: script and its arguments."""

PAGE, DATA = "evidence/performance.md", "data/performance.json"


def measure(name: str) -> dict[str, Any]:
    """Run one measurement.

    Raises:
        SystemExit: it failed.
    """
    script, *arguments = PLAN[name]
    say(f"{name}: {script} {' '.join(arguments)}")
    begun = time.monotonic()
    result = run_self(str(BENCHMARKS / script), *arguments, "--json")
    say(f"{name}: took {time.monotonic() - begun:.0f} s")
    return {"command": " ".join(["python", f"benchmarks/{script}", *arguments, "--json"]), "result": result}


def page_text(records: dict[str, Any]) -> str:
    """Return the text of the page.

    Args:
        records: measurements by name, as returned by `measure`.
    """
    pours = pour_records(records)
    parts = [
        sections.introduction(pours),
        sections.machines(records.values()),
        *stale(records),
        sections.standard_pour(pours),
        sections.cost(records["scaling"]),
        sections.start_up(records["start-up"]),
        sections.engines(records["engines"]),
        sections.plan(records["plan"]),
        sections.validate(records["validate"]),
        sections.pool(records["pool"]),
    ]
    return "\n".join(parts)


def pour_records(records: dict[str, Any]) -> list[dict[str, Any]]:
    """Return the records of the standard pour, by number of particles."""
    pours = [record for name, record in records.items() if name.startswith("pour-")]
    return sorted(pours, key=lambda record: int(record["result"]["particles"]))


def stale(records: dict[str, Any]) -> list[str]:
    """Return a warning if measurements were made with different solvers."""
    prints: dict[str, list[str]] = {}
    for name, record in records.items():
        if name == "engines":  # compares within one run
            continue
        prints.setdefault(record["result"]["machine"].get("fingerprint", "?"), []).append(name)
    if len(prints) < 2:
        return []
    groups = "; ".join(", ".join(names) for names in prints.values())
    return [f"These groups of figures were not measured with the same sources: {groups}.\n"]


def draw(records: dict[str, Any], images: Path) -> None:
    """Draw the figure if its measurements exist."""
    pours = pour_records(records)
    ours = {r["result"]["particles"]: r["result"]["whole"]["cpu_s"] for r in pours}
    if "scaling" in records:
        ours = {row["particles"]: row["cpu_s"] for row in records["scaling"]["result"]["cost"]} | ours
    theirs = [(r["result"]["particles"], r["result"]["peer"]["cpu_s"]) for r in pours if "peer" in r["result"]]
    if theirs:
        page_figures.cost_figure(images / page_figures.COST, list(ours.items()), theirs)


def write(folder: Path) -> Path:
    """Write page and figures from the measurements in a folder."""
    records = json.loads((folder / DATA).read_text(encoding="utf-8"))
    text = page_text(records)
    draw(records, folder / "images")
    (folder / PAGE).parent.mkdir(parents=True, exist_ok=True)
    (folder / PAGE).write_text(text, encoding="utf-8")
    return folder / PAGE


def keep(folder: Path, name: str, record: dict[str, Any]) -> None:
    """Store a measurement at once, so that a later failure does not lose it."""
    path = folder / DATA
    records = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    records[name] = record
    order = {known: place for place, known in enumerate(PLAN)}
    records = dict(sorted(records.items(), key=lambda item: order.get(item[0], len(order))))
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(records, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def main() -> None:
    """Run the requested measurements and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--measure", nargs="*", metavar="NAME", help=f"measurements: {', '.join(PLAN)}; default: all")
    parser.add_argument("--folder", type=Path, default=ROOT / "docs", help="folder of page, data and images")
    options = parser.parse_args()
    names = [] if options.measure is None else options.measure or list(PLAN)
    for name in names:
        if name not in PLAN:
            raise SystemExit(f"--measure {name}: there is no such measurement, only {', '.join(PLAN)}")
    for name in names:
        keep(options.folder, name, measure(name))
    say(f"written: {write(options.folder)}")


if __name__ == "__main__":
    main()
