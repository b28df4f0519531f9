"""Repeat doses of the virtual bench with particles, and compare the amount past the lip for the same executed tilt.

    python benchmarks/dosing_particles.py --json    # into docs/data/dosing.json
    python benchmarks/dosing_particles.py --first 40 --doses 2

The dose controller pours on the virtual dosing bench (`actors.dosing.virtual_dosing_bench`), whose liquid has one
dimension and a few coefficients. Then the particle simulator (`sim_engine.simulator`) moves the same cup, with the same
content, along the tilt that the arm executed, including the bench's grip error. The comparison is of the mass that has
passed the lip at the end, received or spilled.

The cup is the straight beaker with a round rim, because coarse particles do not resolve a spout. Amounts cycle
through 25, 50, 100 and 200 g; the source is 30 to 95 % full. 500 particles are the coarsest resolution whose outflow is
validated (docs/evidence/validation.md: within 1 % of the load); their spacing is 8 to 10 mm. The bench retains up to
2 mm of liquid at a dry lip; the particles have no such rule.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from actors.dosing.cup_flow import CupFlow
from actors.dosing.dose_controller import DoseOrder
from actors.dosing.virtual_dosing_bench import DoseRecord
from sim_engine.action import DEG, Action
from sim_engine.liquids import Liquid, SimulationParameters
from sim_engine.motion import recorded_motion
from sim_engine.scene import PourTask, SampledMotion, Scene
from sim_engine.simulator import PourSimulator
from sim_engine.vessel.shapes import cylinder
from sim_engine.vessel.vessel import build_vessel

sys.path.insert(0, str(Path(__file__).parent))

from dosing import AMOUNTS, CUPS, DATA, GROUPS, Series, cup_flows

FIRST_SEED = 7100
RESOLUTION = 500
"""Particles per simulation."""

GROUP = "round rim"
CUP = CUPS["round beaker"]
POURER = cylinder("beaker", inner_radius=CUP.radius, inner_height=CUP.height)
RECEIVER = cylinder("bowl", inner_radius=0.060, inner_height=0.100)
ACTION = Action(
    angular_velocity=60 * DEG,
    x_offset=0.110,
    height=0.080,
    max_angle=120 * DEG,
    angular_acceleration=None,
    hold_time=0.0,
    return_velocity=None,
)


@dataclass(frozen=True)
class Comparison:
    """One dose; masses past the lip [g].

    Attributes:
        wanted: target amount in the receiver.
        load: content of the source before the dose.
        bench: mass on the virtual bench.
        particles: mass in the particle simulation.
        onset: shift of the onset that explains the difference [deg]; positive if the particles flow earlier.
        cpu_s: CPU seconds of the particle simulation.
    """

    seed: int
    wanted: float
    load: float
    bench: float
    particles: float
    onset: float
    cpu_s: float


def executed(scene: Scene, record: DoseRecord, grip: float) -> SampledMotion:
    """Return the motion of the cup about its lip with the executed tilt."""
    vessels = build_vessel(scene.pourer), build_vessel(scene.receiver)
    return recorded_motion(scene, ACTION, *vessels, record.times, record.tilts - grip)


def compare(simulator: PourSimulator, flow: CupFlow, seed: int, amount: float) -> Comparison:
    """Pour one dose on the bench and with particles.

    Raises:
        SystemExit: the simulation is invalid.
    """
    series = Series(GROUPS[GROUP], seed, lambda *_: flow)
    series.refill_for(amount)
    bench = series.bench
    load, placed = bench.content, bench.place_receiver()
    controller = series.controlled(placed).controller(DoseOrder(amount, receiver_mass=bench.receiver_mass), seed=seed)
    record = bench.dose(controller)
    scene = Scene("dose", POURER, RECEIVER, Liquid(mass=load))
    task = PourTask(
        scene,
        ACTION,
        SimulationParameters(particles=RESOLUTION),
        seed,
        motion=executed(scene, record, bench.grip),
    )
    outcome = simulator.simulate(task).outcome
    if outcome.invalid is not None:
        raise SystemExit(f"dose {seed} is invalid with particles: {outcome.invalid}")
    past, simulated = record.received + record.spilled, load * (1.0 - outcome.retained)
    steep = flow.volume_per_tilt((load - 0.5 * past) / series.density, 3e-3) * series.density
    shift = math.degrees((simulated - past) / steep)
    return Comparison(seed, 1e3 * amount, 1e3 * load, 1e3 * past, 1e3 * simulated, shift, outcome.cpu_s)


def summary(found: list[Comparison]) -> dict[str, Any]:
    """Return the differences particles − bench."""
    difference = np.array([one.particles - one.bench for one in found])
    shift = np.array([one.onset for one in found])
    return {
        "doses": len(found),
        "bench": float(np.mean([one.bench for one in found])),
        "particles": float(np.mean([one.particles for one in found])),
        "difference": float(difference.mean()),
        "deviation": float(difference.std(ddof=1)) if len(found) > 1 else 0.0,
        "smallest": float(difference.min()),
        "largest": float(difference.max()),
        "onset": float(shift.mean()),
        "onset_deviation": float(shift.std(ddof=1)) if len(found) > 1 else 0.0,
    }


def main() -> None:
    """Run the comparison and print it."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--doses", type=int, default=20)
    parser.add_argument("--first", type=int, default=FIRST_SEED, help="first seed")
    parser.add_argument("--json", action="store_true", help="write docs/data/dosing.json")
    options = parser.parse_args()
    simulator, flow = PourSimulator(), cup_flows()("round beaker", False)
    found: list[Comparison] = []
    for k in range(options.doses):
        seed, amount = options.first + k, AMOUNTS[1 + k % 4]
        one = compare(simulator, flow, seed, amount)
        found.append(one)
        print(
            f"{seed}: {one.wanted:g} g wanted, {one.bench:.1f} g on the bench, {one.particles:.1f} g with particles "
            f"({one.onset:+.2f}°), {one.cpu_s:.0f} CPU s",
            flush=True,
        )
    amounts = sorted({one.wanted for one in found})
    rows = {f"{w:g} g": summary([one for one in found if one.wanted == w]) for w in amounts} | {"all": summary(found)}
    for name, row in rows.items():
        print(f"{name}: {row['difference']:+.2f} ± {row['deviation']:.2f} g, onset {row['onset']:+.2f}°")
    if options.json:
        from machine import describe

        data = json.loads(DATA.read_text(encoding="utf-8"))
        data["particle_simulation"] = {
            "machine": describe(),
            "particles": RESOLUTION,
            "first": options.first,
            "rows": rows,
        }
        DATA.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
