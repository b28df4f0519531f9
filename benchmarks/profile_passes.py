"""Where a pour's CPU time goes, pass by pass.

    python benchmarks/profile_passes.py [--particles 2000] [--core 1] [--json]

The solver runs whole slices of a pour in one compiled kernel, which no profiler looks into. So the kernel itself notes
the time: before it is compiled, each pass is wrapped in two calls of the C library's clock, and one standard pour is
made as users make it. A pass that calls another is charged for the rest only. What the clock itself takes is told
(`slower`: CPU seconds of this pour over those of the same pour without clocks).

Shares are given for the whole pour and around a moment in full flow (2.7 s). (Before liquid can leave nothing is
simulated, so there is no moment at rest.)
Linux only; kernels are compiled anew, which takes a quarter of a minute.
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
"""Functions of the solver by the name under which a step finds them, and what people read."""

WHOLE = "sim_engine.fluid.step.Stepper.step"

MOMENTS = {"in full flow": 2.7}
WINDOW = 0.15
"""A moment lasts from so long before to so long after [s]."""

ENTRIES = 1 << 20
PROCESS_CPU_CLOCK = 2
"""CLOCK_PROCESS_CPUTIME_ID of Linux: other work on the machine does not count."""


class Clock:
    """A log that a compiled kernel writes to: which pass began (k ≥ 0) or ended (−1), when, at which simulated time."""

    def __init__(self) -> None:
        from sim_engine.fluid.engine import engine

        # After the solver, which keeps Taichi quiet.
        import taichi as ti  # isort: skip
        from taichi.lang.source_builder import SourceBuilder  # isort: skip

        state = engine().state
        self.instants = np.zeros((ENTRIES, 2), np.int64)  # the C library's struct timespec
        self.passes = ti.field(ti.i32, shape=ENTRIES)
        self.simulated = ti.field(ti.f32, shape=ENTRIES)
        self.used = ti.field(ti.i64, shape=2)  # entries so far; where `instants` begins
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
        """Begin anew."""
        self.used[0], self.used[1] = 0, self.instants.ctypes.data

    def around(self, function: Callable[..., Any], k: int) -> Callable[..., Any]:
        """A pass that notes when it begins and ends. Called while Taichi compiles, as the pass itself is."""

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
        """Put the clock around every pass.

        Raises:
            SystemExit: the solver has no such pass any more.
        """
        for k, path in enumerate(PASSES):
            place, name = _find(path)
            setattr(place, name, self.around(getattr(place, name), k))

    def log(self) -> list[tuple[int, float, float]]:
        """(pass or −1, CPU time [s], simulated time [s]) in order.

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
    """Where a pass is kept (module or class), and its name there."""
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
    """(pass, CPU seconds of its own without the passes that it calls, simulated time) for every call.

    Args:
        log: well nested beginnings and ends.
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
    """Share of each pass, largest first, calls per step, and CPU milliseconds a step."""
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
    """Make the pour with clocks in it.

    Args:
        particles: N.
        plain_cpu_s: what the same pour takes without.
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
        "cpu_s": round(plain_cpu_s, 3),
        "slower": round(run.cpu_s / plain_cpu_s, 3),
        "explained": round(sum(own for _, own, _ in calls) / run.cpu_s, 3),
        "iterations_per_step": round(run.iterations / run.outcome.steps, 3),
        "particle_iterations_per_s": round(particles * run.iterations / plain_cpu_s),
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--particles", type=int, default=2000)
    parser.add_argument("--core", type=int, help="which core to run on; unless given, the one with the least to do")
    parser.add_argument("--json", action="store_true", help="one line of JSON")
    options = parser.parse_args()
    particles = check_particles(options.particles)
    if not sys.platform.startswith("linux"):
        raise SystemExit(f"the clock that is built into the solver is that of Linux; this is {sys.platform}")
    core = pin(options.core)
    plain = run_self(
        str(Path(__file__).with_name("scaling.py")), f"--particles={particles}", "--one=cost", "--repeats=1"
    )
    # Kernels that carry an address of this process must not be kept for another.
    with tempfile.TemporaryDirectory() as cache:
        os.environ[ENVIRONMENT_VARIABLE] = cache
        result = {**profile(particles, plain["cpu_s"]), "core": core, "machine": describe()}
    show(result, options.json)


if __name__ == "__main__":
    main()
