"""Profile a pour's CPU time by pass.

    python benchmarks/profile_passes.py [--particles 2000] [--core 1] [--json]

The solver runs complete slices of a pour in one compiled kernel, which profilers cannot inspect. Therefore the kernel
records the time itself: before compilation, each pass is wrapped in two calls of the C library's clock. Then one
standard pour runs as usual. A pass that calls another one is charged only for its own part. `slower` reports the clock
overhead: CPU seconds of this pour divided by those of the same pour without clocks.

Shares are for the complete pour and around a time in full flow (2.7 s). Nothing is simulated before liquid can leave,
so there is no profile at rest. Linux only; compiling the kernels takes a quarter of a minute.
"""

from __future__ import annotations

import argparse
import ctypes
import importlib
import os
import sys
import tempfile
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from machine import describe, pin, run_self, say, show
from standard_pour import check_particles, measure, short_task

from sim_engine.resources import ENVIRONMENT_VARIABLE

PASSES = {
    "sim_engine.fluid.step.Stepper.step": "the rest of a step",
    "sim_engine.fluid.step.Stepper.predict": "predict and sweep",
    "sim_engine.fluid.step.rebuild": "neighbour lists",
    "sim_engine.fluid.step.Stepper.look_at_walls": "wall distances",
    "sim_engine.fluid.step.measure_first": "density and gradients",
    "sim_engine.fluid.step.measure": "density",
    "sim_engine.fluid.step.multiply": "multipliers",
    "sim_engine.fluid.step.displace": "displacements",
    "sim_engine.fluid.step.Stepper.apply": "moving and wall contact",
    "sim_engine.fluid.step.Stepper.finish": "finish: sweep, friction, velocities",
    "sim_engine.fluid.step.relax": "viscosity",
    "sim_engine.fluid.step.pull": "cohesion",
    "sim_engine.fluid.step.Stepper.classify": "classify",
    "sim_engine.fluid.step.Stepper.conclude": "the end of a step",
}
"""Functions of the solver by their name in a step, with readable names."""

WHOLE = "sim_engine.fluid.step.Stepper.step"

MOMENTS = {"in full flow": 2.7}
WINDOW = 0.15
"""Half length of the time window around a profile time [s]."""

ENTRIES = 1 << 20
PROCESS_CPU_CLOCK = 2
"""CLOCK_PROCESS_CPUTIME_ID of Linux, which excludes other processes."""


class Clock:
    """A log written by a compiled kernel: which pass began (k ≥ 0) or ended (−1), CPU time and simulated time."""

    def __init__(self) -> None:
        from sim_engine.fluid.engine import engine

        # After the solver, which sets Taichi's log level.
        import taichi as ti  # isort: skip
        from taichi.lang.source_builder import SourceBuilder  # isort: skip

        state = engine().state
        self.instants = np.zeros((ENTRIES, 2), np.int64)  # the C library's struct timespec
        self.passes = ti.field(ti.i32, shape=ENTRIES)
        self.simulated = ti.field(ti.f32, shape=ENTRIES)
        self.used = ti.field(ti.i64, shape=2)  # number of entries; start of `instants`
        self.clear()
        library = SourceBuilder()
        library.so, library.mode = ctypes.CDLL(None), "so"
        passes, simulated, used = self.passes, self.simulated, self.used

        @ti.func
        def note(k):  # type: ignore[no-untyped-def]
            n = used[0]
            if n < ENTRIES:
                passes[n] = k
                simulated[n] = ti.cast(state.time[0], ti.f32)
                library.clock_gettime(args=(PROCESS_CPU_CLOCK, used[1] + 16 * n), outputs=())
                used[0] = n + 1

        self.note = note

    def clear(self) -> None:
        """Clear the log."""
        self.used[0], self.used[1] = 0, self.instants.ctypes.data

    def around(self, function: Callable[..., Any], k: int) -> Callable[..., Any]:
        """Wrap a pass so that it logs its begin and end. Called while Taichi compiles, like the pass itself."""

        def timed(*arguments: Any) -> Any:
            self.note(k)
            result = function(*arguments)
            self.note(-1)
            return result

        timed.func = function.func  # type: ignore[attr-defined]
        timed._is_taichi_function = True  # type: ignore[attr-defined]
        timed._is_real_function = False  # type: ignore[attr-defined]
        return timed

    def wrap_all(self) -> None:
        """Wrap every pass.

        Raises:
            SystemExit: the solver no longer has a pass.
        """
        for k, path in enumerate(PASSES):
            place, name = _find(path)
            setattr(place, name, self.around(getattr(place, name), k))

    def log(self) -> list[tuple[int, float, float]]:
        """Return (pass or −1, CPU time [s], simulated time [s]) in order.

        Raises:
            SystemExit: the log was too short for the pour.
        """
        n = int(self.used[0])
        if n >= ENTRIES:
            raise SystemExit(f"a pour of more than {ENTRIES} passes; profile one with fewer particles")
        seconds = self.instants[:n, 0] + 1e-9 * self.instants[:n, 1]
        passes, simulated = self.passes.to_numpy()[:n], self.simulated.to_numpy()[:n]
        return list(zip(passes.tolist(), seconds.tolist(), simulated.tolist(), strict=True))


def _find(path: str) -> tuple[Any, str]:
    """Return the module or class of a pass, and its name there."""
    *parts, name = path.split(".")
    for depth in range(len(parts), 0, -1):
        try:
            place: Any = importlib.import_module(".".join(parts[:depth]))
        except ModuleNotFoundError:
            continue
        for part in parts[depth:]:
            place = getattr(place, part, None)
        if hasattr(place, name):
            return place, name
    raise SystemExit(f"the solver has no pass {path}: bring PASSES in {__file__} up to date")


def own_times(log: list[tuple[int, float, float]]) -> list[tuple[int, float, float]]:
    """Return (pass, own CPU seconds without called passes, simulated time) for every call.

    Args:
        log: properly nested begins and ends.
    """
    open_calls: list[list[float]] = []  # pass, begun, inner
    calls = []
    for k, now, simulated in log:
        if k >= 0:
            open_calls.append([k, now, 0.0])
            continue
        which, begun, inner = open_calls.pop()
        calls.append((int(which), now - begun - inner, simulated))
        if open_calls:
            open_calls[-1][2] += now - begun
    return calls


def shares(calls: list[tuple[int, float, float]]) -> dict[str, Any]:
    """Return the share of each pass, largest first, calls per step, and CPU milliseconds per step."""
    names, whole = list(PASSES.values()), list(PASSES).index(WHOLE)
    seconds: dict[int, float] = defaultdict(float)
    counts: dict[int, int] = defaultdict(int)
    for k, own, _ in calls:
        seconds[k] += own
        counts[k] += 1
    total = sum(seconds.values())
    order = sorted(seconds, key=lambda k: -seconds[k])
    steps = max(counts[whole], 1)
    return {
        "share": {names[k]: round(seconds[k] / total, 4) for k in order},
        "calls_per_step": {names[k]: round(counts[k] / steps, 3) for k in order},
        "ms_per_step": round(1e3 * total / steps, 3),
        "steps": counts[whole],
    }


def profile(particles: int, plain_cpu_s: float) -> dict[str, Any]:
    """Run the pour with clocks.

    Args:
        particles: N.
        plain_cpu_s: CPU seconds of the same pour without clocks.
    """
    from sim_engine.simulator import PourSimulator

    clock = Clock()
    clock.wrap_all()
    simulator = PourSimulator()
    say("compiling the solver with clocks in it")
    simulator.simulate(short_task(particles))
    clock.clear()
    run = measure(simulator, particles, seed=1)
    calls = own_times(clock.log())
    moments = {
        name: shares([call for call in calls if abs(call[2] - moment) <= WINDOW]) for name, moment in MOMENTS.items()
    }
    return {
        "particles": particles,
        "whole pour": shares(calls),
        **moments,
        "slower": round(run.cpu_s / plain_cpu_s, 3),
        "explained": round(sum(own for _, own, _ in calls) / run.cpu_s, 3),
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--particles", type=int, default=2000)
    parser.add_argument("--core", type=int, help="core to run on; default: the least busy one")
    parser.add_argument("--json", action="store_true", help="one line of JSON")
    options = parser.parse_args()
    particles = check_particles(options.particles)
    if not sys.platform.startswith("linux"):
        raise SystemExit(f"the clock that is built into the solver is that of Linux; this is {sys.platform}")
    core = pin(options.core)
    plain = run_self(
        str(Path(__file__).with_name("scaling.py")), f"--particles={particles}", "--one=cost", "--repeats=1"
    )
    # Kernels that contain an address of this process must not be cached.
    with tempfile.TemporaryDirectory() as cache:
        os.environ[ENVIRONMENT_VARIABLE] = cache
        result = {**profile(particles, plain["cpu_s"]), "core": core, "machine": describe()}
    show(result, options.json)


if __name__ == "__main__":
    main()
