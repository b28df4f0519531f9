"""Measure how fast one core can evaluate the density constraint in plain C, as a reference for the solver's speed.

    python benchmarks/core_limit.py [--particles 2000] [--core 1] [--json]

Compiles and runs core_limit.c: neighbour lists and density iterations on a jittered lattice at rest, without walls,
forces, sweeps and the other parts of a pour. Reports nanoseconds per particle for two instruction sets, as medians of
21 repetitions.
"""

from __future__ import annotations

import argparse
import platform
import shutil
import subprocess
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from machine import describe, pin, say, show
from standard_pour import check_particles

from actors.runtime.child_process import child_environment

SOURCE = Path(__file__).with_name("core_limit.c")
MACHINES = {"x86_64": ("x86-64-v3", "native"), "AMD64": ("x86-64-v3", "native")}
"""`-march` options to try; short loops are often faster with vectors narrower than the processor's."""

KEPT = 8
"""Largest number of steps for which a neighbour list stays valid."""


def run(compiler: str, particles: int) -> list[dict[str, Any]]:
    """Return nanoseconds per particle, one row per instruction set.

    Args:
        compiler: path of the C compiler.
        particles: N.

    Raises:
        SystemExit: the program does not compile or run.
    """
    rows = []
    with tempfile.TemporaryDirectory() as folder:
        program = str(Path(folder) / "core_limit")
        for march in MACHINES.get(platform.machine(), ("native",)):
            flags = ["-O3", f"-march={march}", "-ffast-math"]
            try:
                subprocess.run(
                    [compiler, *flags, str(SOURCE), "-lm", "-o", program], check=True, env=child_environment()
                )
                done = subprocess.run(
                    [program, str(particles)], check=True, capture_output=True, text=True, env=child_environment()
                )
            except (OSError, subprocess.CalledProcessError) as problem:
                raise SystemExit(f"{SOURCE.name} with -march={march}: {problem}") from None
            names = ("full_lists_ns", "full_iteration_ns", "half_lists_ns", "half_iteration_ns")
            values = (round(float(text) / particles, 1) for text in done.stdout.split())
            rows.append({"march": march, **dict(zip(names, values, strict=True))})
    return rows


def limits(rows: Iterable[dict[str, Any]], iterations_per_step: float) -> tuple[float, float]:
    """Return the particle-iterations/s that the best of these rows would reach.

    Args:
        rows: see `run`.
        iterations_per_step: iterations per step of the solver to compare with.

    Returns:
        With lists built in every step, and with lists kept for `KEPT` steps.
    """

    def best(steps: int) -> float:
        times: list[float] = [
            row[f"{kind}_lists_ns"] / (iterations_per_step * steps) + row[f"{kind}_iteration_ns"]
            for row in rows
            for kind in ("full", "half")
        ]
        return 1e9 / min(times)

    rows = list(rows)
    return best(1), best(KEPT)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--particles", type=int, default=2000)
    parser.add_argument("--core", type=int, help="core to run on; default: the least busy one")
    parser.add_argument("--json", action="store_true", help="one line of JSON")
    options = parser.parse_args()
    particles = check_particles(options.particles)
    compiler = shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")
    if compiler is None:
        raise SystemExit("no C compiler (cc, gcc or clang) is installed; the rest of the benchmarks need none")
    core = pin(options.core)
    rows = run(compiler, particles)
    for row in rows:
        say(f"{row['march']}: {row['full_iteration_ns']} ns a particle with full lists")
    show({"particles": particles, "rows": rows, "core": core, "machine": describe()}, options.json)


if __name__ == "__main__":
    main()
