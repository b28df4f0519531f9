"""Write the daemon's measurements into docs/evidence/reliability.md: `python benchmarks/daemon_page.py`.

The figures are in docs/data/daemon.json. `daemon_stops` and `soak` store them there and call this script.
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

DOCS = Path(__file__).parents[1] / "docs"
FIGURES, PAGE = DOCS / "data" / "daemon.json", DOCS / "evidence" / "reliability.md"
MARKED = re.compile(r"(<!-- measured: ([\w-]+) -->\n).*?(<!-- end of what was measured -->)", re.DOTALL)

UNTIL = {
    "pause": "noted",
    "stop": "noted",
    "abort": "the arm stands",
    "emergency stop": "the arm stands",
}
BENCHES = {"numbers": "", "wires": " over wires"}


def keep(name: str, found: Mapping[str, Any]) -> None:
    """Store a measurement and update the page."""
    figures = measured()
    figures[name] = dict(found)
    FIGURES.write_text(json.dumps(figures, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")
    main()


def measured() -> dict[str, Any]:
    """Return all stored measurements."""
    found: dict[str, Any] = json.loads(FIGURES.read_text(encoding="utf-8")) if FIGURES.is_file() else {}
    return found


def render(page: str, figures: Mapping[str, Any]) -> str:
    """Return the page with updated tables; tables without measurements stay unchanged."""

    def table(match: re.Match[str]) -> str:
        found = figures.get(match[2])
        return match[0] if found is None else f"{match[1]}{TABLES[match[2]](found)}{match[3]}"

    return MARKED.sub(table, page)


def stops(found: Mapping[str, Any]) -> str:
    """Return the table of the median and worst stop time of each grade, by load [ms]."""
    loads = {"idle": "idle", "readers": "200 readers of events", "saturated": "saturated"}
    rows = []
    for bench, words in BENCHES.items():
        for grade, until in UNTIL.items():
            cells = {
                one["load"]: f"{one['median']:.0f} / {one['worst']:.0f}"
                for one in found["stops"]
                if (one["bench"], one["grade"]) == (bench, grade)
            }
            if cells:
                rows.append((f"{grade}{words}, until {until}", *(cells.get(load, "") for load in loads)))
    return (
        f"Median / worst of {found['times']} [ms], on {found['cores']} cores with a load of {found['load before']} "
        "beforehand.\n\n" + markdown_table(("", *loads.values()), rows)
    )


def day(found: Mapping[str, Any]) -> str:
    """Return the tables of a day in scaled time: load and faults, losses, and growth."""
    counts = found["counts"]
    states = ", ".join(f"{name} {count}" for name, count in sorted(_by_state(found["states"]).items()))
    ended = ", ".join(f"{name} {count}" for name, count in sorted(found["orders ended"].items()))
    rows = [
        ("scaled time, two rigs", f"{found['hours scaled']:.0f} h in {found['minutes']:.0f} min"),
        ("campaigns", f"{found['campaigns']} ({states})"),
        ("ordered pours", f"{found['orders']} ({ended}), sent again {counts['orders repeated']} times"),
        ("`kill -9`, SIGTERM", f"{counts.get('killed', 0)}, {counts.get('ended by SIGTERM', 0)}"),
        ("full disk for 30 s", f"{counts.get('full disks', 0) + counts.get('full disks later', 0)}"),
        ("pours declared lost after a kill", f"{counts.get('pours declared lost by the operator', 0)}"),
    ]
    begin, end = found["undisturbed [min]"]
    hourly = 60 * (found["campaigns"] + found["orders"]) / found["minutes"]
    memory = next(one for one in found["at rest"] if one["what"].startswith("memory of the daemon"))
    return (
        "Two rigs on simulated benches without Ray; in the first part a fault every 90 seconds. Each order is sent "
        "three times or more. If a pour is killed, the operator declares it lost.\n\n"
        + markdown_table(("", ""), rows)
        + "\nLost or doubled, by the journals, the queue and the account of materials: "
        + (", ".join(f"{name} {count}" for name, count in found["lost or doubled"].items() if count) or "nothing")
        + ".\n"
        + f"\nFrom minute {begin:.0f} to {end:.0f}, when the daemon was not restarted, it took "
        f"{100 * found['cpu share']:.0f} % of a core on average. At {hourly:.0f} campaigns and orders an hour the "
        f"daemon's memory grew by {memory['an hour']:+.0f} ± {memory['error']:.0f} MB an hour (standard error); the "
        "files of the runs grow until they are removed.\n"
    )


def _by_state(states: Mapping[str, int]) -> dict[str, int]:
    """Return the counts by the last word of their names."""
    words = [(name.rpartition(" ")[2], count) for name, count in states.items()]
    return {word: sum(count for other, count in words if other == word) for word, _ in words}


TABLES: dict[str, Callable[[Mapping[str, Any]], str]] = {"stops": stops, "day": day}


def markdown_table(head: Sequence[str], rows: Sequence[Sequence[Any]]) -> str:
    """Return a table in Markdown."""
    lines = [head, ["---"] * len(head), *rows]
    return "".join(f"| {' | '.join(map(str, line))} |\n" for line in lines)


def main() -> None:
    """Update the page."""
    PAGE.write_text(render(PAGE.read_text(encoding="utf-8"), measured()), encoding="utf-8")


if __name__ == "__main__":
    main()
