"""Measure how the outcome depends on the number of particles, and the cost of an outcome near the limit.

    python benchmarks/convergence.py --store FILE [--particles 500 1000 2000] [--seeds 3] [--finest 5000 10000 20000]
    python benchmarks/convergence.py --store FILE --table [--before FILE] [--json]

Nineteen pours (`sim_engine.validation.convergence`) are simulated at each number of particles: the coarse ones with
several seeds, the finest once. Finished simulations are in the store, so an interrupted measurement continues. The
limit of each pour is the value at zero spacing of a straight line through the finest, fitted with weights 1/d.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from sim_engine.liquids import SimulationParameters
from sim_engine.simulator import PourSimulator, spacing
from sim_engine.validation.convergence import POURS, spillage

VOLUME = 200e-6


@dataclass
class Store:
    """Spillage and CPU seconds by pour, number of particles and seed, written to disk after every pour."""

    path: Path
    known: dict[str, list[float]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if self.path.exists():
            self.known = json.loads(self.path.read_text(encoding="utf-8"))

    @staticmethod
    def key(pour: str, particles: int, seed: int) -> str:
        """Return the key of one simulation."""
        return f"{pour} | {particles} | {seed}"

    def put(self, key: str, values: tuple[float, float]) -> None:
        """Store one simulation's spillage and CPU seconds."""
        self.known[key] = [round(v, 5) for v in values]
        part = self.path.with_suffix(".part")
        part.write_text(json.dumps(self.known, indent=0), encoding="utf-8")
        part.replace(self.path)

    def of(self, pour: str, particles: int) -> list[list[float]]:
        """Return the spillage and CPU seconds of a pour for all seeds."""
        begin = f"{pour} | {particles} | "
        return [values for key, values in self.known.items() if key.startswith(begin)]

    def numbers(self) -> list[int]:
        """Return the stored numbers of particles in increasing order."""
        return sorted({int(key.split(" | ")[1]) for key in self.known})


def limit(store: Store, pour: str, finest: list[int]) -> float | None:
    """Return the spillage at zero spacing from a line through the finest; None if fewer than two are stored."""
    values = [(spacing(VOLUME, n), np.mean([v for v, _ in found])) for n in finest if (found := store.of(pour, n))]
    if len(values) < 2:
        return None
    d, y = np.array(values).T
    return float(np.clip(np.polyfit(d, y, 1, w=1.0 / d)[1], 0.0, 1.0))


def table(store: Store, finest: list[int], limits: dict[str, float] | None = None) -> dict[str, Any]:
    """Return all results: pours by number of particles, and the distance of each number from the limit."""
    numbers = store.numbers()
    rows: list[dict[str, Any]] = []
    for pour in POURS:
        at_zero = limit(store, pour.name, finest) if limits is None else limits.get(pour.name)
        means = {n: float(np.mean([v for v, _ in found])) for n in numbers if (found := store.of(pour.name, n))}
        rows.append({"pour": pour.name, "limit": at_zero, "spilled": means})
    errors = {}
    for n in numbers:
        off = [abs(r["spilled"][n] - r["limit"]) for r in rows if n in r["spilled"] and r["limit"] is not None]
        costs = [cpu for pour in POURS for _, cpu in store.of(pour.name, n)]
        if off:
            errors[n] = {
                "mean": float(np.mean(off)),
                "largest": float(np.max(off)),
                "within_0.03": float(np.mean(np.array(off) <= 0.03)),
                "pours": len(off),
                "cpu_s": float(np.median(costs)),
            }
    return {"rows": rows, "errors": errors, "finest": finest}


def markdown(found: dict[str, Any]) -> str:
    """Return the table in the Markdown of the docs."""
    numbers = sorted({n for row in found["rows"] for n in row["spilled"]})
    lines = [
        "| pour | " + " | ".join(f"{n:,}" for n in numbers) + " | limit |",
        "|---|" + "---|" * (len(numbers) + 1),
    ]
    for row in found["rows"]:
        cells = [f"{row['spilled'][n]:.3f}" if n in row["spilled"] else "" for n in numbers]
        cells.append("" if row["limit"] is None else f"{row['limit']:.3f}")
        lines.append(f"| {row['pour']} | " + " | ".join(cells) + " |")
    for what, digits in (("mean", 3), ("largest", 3), ("cpu_s", 1)):
        name = {"mean": "mean error", "largest": "largest error", "cpu_s": "CPU s a pour, median"}[what]
        cells = [f"{found['errors'][n][what]:.{digits}f}" if n in found["errors"] else "" for n in numbers]
        lines.append(f"| {name} | " + " | ".join(cells) + " | |")
    return "\n".join(lines)


def main() -> None:
    """Run the missing simulations, or print the table of the store."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--store", type=Path, required=True)
    parser.add_argument("--particles", type=int, nargs="*", default=[500, 1_000, 2_000])
    parser.add_argument("--seeds", type=int, default=3, help="seeds of the coarse simulations")
    parser.add_argument("--finest", type=int, nargs="*", default=[5_000, 10_000, 20_000])
    parser.add_argument("--pours", type=int, default=len(POURS), help="number of pours, from the first")
    parser.add_argument("--table", action="store_true", help="only print the table")
    parser.add_argument("--before", type=Path, help="another store, compared with the same limits")
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    store = Store(options.store)
    if not options.table:
        simulator = PourSimulator()
        wanted = [(n, seed) for n in options.particles for seed in range(1, options.seeds + 1)]
        wanted += [(n, 1) for n in options.finest]
        for n, seed in wanted:
            theta = SimulationParameters(particles=n, cohesion=0.0, xsph_rate=1.0)
            for pour in POURS[: options.pours]:
                key = store.key(pour.name, n, seed)
                if key not in store.known:
                    store.put(key, spillage(simulator, pour, theta, seed))
    found = table(store, options.finest)
    parts = {"now": found}
    if options.before is not None:
        limits = {row["pour"]: row["limit"] for row in found["rows"] if row["limit"] is not None}
        parts["before"] = table(Store(options.before), options.finest, limits)
    if options.json:
        print(json.dumps(parts, indent=1))
        return
    for name, part in parts.items():
        print(f"{name}:\n\n{markdown(part)}\n")


if __name__ == "__main__":
    main()
