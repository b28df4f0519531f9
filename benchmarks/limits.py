"""Compare the limits of fine particles of Decant and SPlisHSPlasH for six pours into three receivers.

    python benchmarks/limits.py --store FILE [--ours 1000 2000 5000 10000 20000] [--theirs 1000 2000 5000 10000]
                                [--seeds 2] [--table | --write]

The pours are six of `sim_engine.validation.convergence`, two into each of its first three receivers, chosen before any
run of SPlisHSPlasH: water without surface tension, uncalibrated, spilled over poured. Below 5,000 particles, both
solvers run with several seeds. The limit of a pour is the value at zero spacing of a straight line through all its
runs, with weights 1/d. Its 95 % interval uses the residuals of all six pours of a solver. Question, fixed before the
first run: do the limits differ by at most 0.03?

SPlisHSPlasH runs with walls of particles (Akinci et al. 2012): through walls of 3 mm, liquid leaks with volume maps. It
simulates 0.3 s more than Decant, so that the last drops land. Finished runs are in the store, so an interrupted
comparison continues. `--write` makes no runs; it writes the table to docs/data/results.json.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np
import peer
from convergence import VOLUME, Store
from machine import say, write_table
from numpy.typing import NDArray
from scipy.stats import t as student
from standard_pour import Floats, in_cup, in_frame

from sim_engine.liquids import SimulationParameters
from sim_engine.motion import plan_motion
from sim_engine.simulator import PourSimulator, spacing
from sim_engine.validation.convergence import FOUND, LIP_RADIUS, ConvergencePour, spillage
from sim_engine.vessel.vessel import build_vessel

POURS = (FOUND[0], FOUND[1], FOUND[4], FOUND[3], FOUND[5], FOUND[6])
COARSE = 5_000
"""Below this number of particles, several seeds are run."""
LANDING = 0.3
"""Duration after the end of the pour in which the peer's last drops land [s]."""
GOAL = 0.03
OURS, THEIRS = "Decant", peer.NAME


def peer_scene(pour: ConvergencePour) -> peer.PeerScene:
    """Return the scene of a pour for the peer."""
    task = pour.task(SimulationParameters(), 0)
    pourer, receiver = build_vessel(task.scene.pourer), build_vessel(task.scene.receiver)
    motion = plan_motion(task.scene, task.action, pourer, receiver)
    return peer.PeerScene(pourer, receiver, motion, task.scene.liquid.volume, motion.duration + LANDING)


def peer_spillage(scene: peer.PeerScene, points: Floats, time: float, slack: float) -> float:
    """Return spilled over poured.

    Args:
        scene: what was simulated.
        points: the particles at the end (N, 3) [m].
        time: time of these places [s].
        slack: depth in a wall that counts as inside [m].
    """
    retained = in_pourer(scene, points, time, slack)
    across = float(np.hypot(*scene.receiver.solid_vertices[:, :2].T).max())
    received = in_cup(points, scene.receiver, across, slack, above=slack) & ~retained
    poured = 1.0 - float(np.mean(retained))
    return max(poured - float(np.mean(received)), 0.0) / max(poured, 1e-9)


def in_pourer(scene: peer.PeerScene, points: Floats, time: float, slack: float) -> NDArray[np.bool_]:
    """Return which points (N, 3) are in the pourer; arguments as in `peer_spillage`."""
    local = in_frame(points, time, scene.motion)
    return in_cup(local, scene.pourer, LIP_RADIUS + slack, slack, above=slack)


def run_peer(python: Path, pour: ConvergencePour, particles: int, seed: int) -> tuple[float, float]:
    """Run the peer; return spilled over poured, and CPU seconds.

    Raises:
        SystemExit: liquid leaked from the pourer before it flows.
    """
    scene, slack = peer_scene(pour), 0.5 * spacing(VOLUME, particles)
    arrays = peer.simulate(python, scene, particles, seed, particle_walls=True)
    times, frames = arrays["times"], arrays["frames"].astype(float)
    early = int(np.argmax(scene.motion.tilt(times) > math.radians(20.0)))
    kept = in_pourer(scene, frames[early], float(times[early]), slack)
    if not kept.all():
        raise SystemExit(f"{pour.name}, {particles} particles: {np.sum(~kept)} leaked from the pourer at 20°")
    return peer_spillage(scene, frames[-1], float(times[-1]), slack), float(arrays["cpu_s"])


def fitted(runs: list[tuple[Floats, Floats]]) -> list[tuple[float, float]]:
    """Return the limit of each pour, and half of its 95 % interval.

    Args:
        runs: spacings (n,) [m] and spillage (n,) of each pour's runs.
    """
    limits, spreads, squares, free = [], [], 0.0, 0
    for spacings, values in runs:
        design = np.stack([np.ones_like(spacings), spacings], axis=1) / spacings[:, None]
        found = np.linalg.lstsq(design, values / spacings, rcond=None)[0]
        residuals = values / spacings - design @ found
        squares, free = squares + float(residuals @ residuals), free + len(values) - 2
        limits.append(float(found[0]))
        spreads.append(math.sqrt(float(np.linalg.inv(design.T @ design)[0, 0])))
    if free < 1:
        return [(limit, math.nan) for limit in limits]
    factor = float(student.ppf(0.975, free)) * math.sqrt(squares / free)
    return [(limit, factor * spread) for limit, spread in zip(limits, spreads, strict=True)]


def rows(store: Store) -> list[list[str]]:
    """Return one row per pour: its finest runs, its limits and their difference."""
    limits: dict[str, list[tuple[float, float]]] = {}
    finest: dict[str, list[str]] = {}
    for solver in (OURS, THEIRS):
        runs = []
        for pour in POURS:
            begin = f"{solver}, {pour.name} | "
            found = [(int(k.split(" | ")[1]), v[0]) for k, v in sorted(store.known.items()) if k.startswith(begin)]
            numbers, values = np.array(found).T
            runs.append((np.array([spacing(VOLUME, int(n)) for n in numbers]), values))
            most = int(numbers.max())
            finest.setdefault(solver, []).append(f"{values[numbers == most].mean():.3f} ({most:,})")
        limits[solver] = fitted(runs)
    shown = []
    for i, pour in enumerate(POURS):
        (a, da), (b, db) = limits[OURS][i], limits[THEIRS][i]
        difference = f"{a - b:+.3f} ± {math.hypot(da, db):.3f}"
        cells = [finest[OURS][i], f"{a:.3f} ± {da:.3f}", finest[THEIRS][i], f"{b:.3f} ± {db:.3f}", difference]
        shown.append([pour.name, *cells, "yes" if abs(a - b) <= GOAL else "no"])
    return shown


def main() -> None:
    """Run the missing simulations, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--store", type=Path, required=True)
    parser.add_argument("--ours", type=int, nargs="*", default=[1_000, 2_000, 5_000, 10_000, 20_000])
    parser.add_argument("--theirs", type=int, nargs="*", default=[1_000, 2_000, 5_000, 10_000])
    parser.add_argument("--seeds", type=int, default=2, help=f"seeds below {COARSE:,} particles")
    parser.add_argument("--table", action="store_true", help="only print the table")
    parser.add_argument("--write", action="store_true", help="write the table to docs/data/results.json")
    options = parser.parse_args()
    store = Store(options.store)
    if not (options.table or options.write):
        simulator, python = PourSimulator(), peer.environment()
        solvers = {OURS: sorted(options.ours), THEIRS: sorted(options.theirs)}
        wanted = [(n, solver) for solver, numbers in solvers.items() for n in numbers]
        for n, solver in wanted:
            for seed in range(1, (options.seeds if n < COARSE else 1) + 1):
                for pour in POURS:
                    key = store.key(f"{solver}, {pour.name}", n, seed)
                    if key in store.known:
                        continue
                    if solver == THEIRS:
                        values = run_peer(python, pour, n, seed)
                    else:
                        theta = SimulationParameters(particles=n, cohesion=0.0, xsph_rate=1.0)
                        values = spillage(simulator, pour, theta, seed)
                    store.put(key, values)
                    say(f"{key}: {values[0]:.3f} ({values[1]:.0f} CPU s)")
    found = rows(store)
    for row in found:
        print(" | ".join(row))
    if options.write:
        head = ["pour", f"{OURS}, finest (particles)", "limit", f"{THEIRS}, finest (particles)", "limit", "difference"]
        settings = (
            "spilled over poured; 200 mL of water, no surface tension, uncalibrated; straight line in the spacing, "
            f"95 % intervals; {peer.NAME} {peer.VERSION}: DFSPH, walls of particles"
        )
        write_table("limits", [*head, f"within {GOAL}"], found, "python benchmarks/limits.py --store FILE", settings)


if __name__ == "__main__":
    main()
