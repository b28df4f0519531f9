"""Record doses of the virtual dosing bench, replay them, fit hidden values, and measure the cost.

    python benchmarks/recordings.py                  # fits on fresh benches, coverage, cost
    python benchmarks/recordings.py --sample configs/recordings

Each bench (`actors.dosing.virtual_dosing_bench`) has an error of grip, a lag and a discharge that the fit does not
know. Four doses are recorded, three of them are fitted, and the fourth is predicted from its tilt alone. The bench is
not the model of the fit: its lip holds liquid back, its stream dribbles, its balance has one of four filters.
"""

from __future__ import annotations

import argparse
import math
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from actors.dosing.cup_flow import CupFlow
from actors.dosing.dose_controller import DoseOrder
from actors.dosing.dose_series import DoseSeries, SourceContent
from actors.dosing.virtual_dosing_bench import TrueCup, TrueScale, VirtualDosingBench
from actors.dosing_settings import DosingSettings
from orchestrator.recordings.recording_file import PourRecording, load_recording, write_recording
from orchestrator.recordings.time_series import read_series
from sim_engine.liquids import Liquid
from sim_engine.scene import Scene
from sim_engine.vessel.shapes import cylinder
from sim_engine.vessel.vessel import build_vessel

sys.path.insert(0, str(Path(__file__).parent))

CUP = TrueCup(0.040, 0.100)
POURER = cylinder("beaker", inner_radius=CUP.radius, inner_height=CUP.height)
RECEIVER = cylinder("tumbler", inner_radius=0.035, inner_height=0.090)
PLACED_BEFORE = 20.0
"""Time from the placing of the receiver to the dose [s]."""

FIRST_SEED = 21_000


class Bench:
    """A bench whose doses are recorded.

    Args:
        seed: of all randomness.
        step: of the display [kg].
        grip: by which the cup is held more tilted than recorded [rad].
        folder: of the recordings.
    """

    def __init__(self, seed: int, folder: Path, *, step: float = 1e-4, grip: float = 0.0) -> None:
        rng = np.random.default_rng((seed, 5))
        kind = str(rng.choice(["first", "fourth", "average", "switching"]))
        self.scale = TrueScale(kind, float(rng.uniform(0.1, 0.6)), step=step)  # type: ignore[arg-type]
        self.bench = VirtualDosingBench(CUP, Liquid(mass=0.4), self.scale, seed, held_tilt=grip)
        self.grip = -self.bench.grip
        self._folder, self._seed, self._rng = folder, seed, rng
        self._flow = CupFlow(build_vessel(POURER), Liquid(mass=0.4))

    def dose(self, number: int, fill: float, amount: float) -> PourRecording:
        """Record one dose.

        Args:
            number: of the dose.
            fill: mass in the cup before it [kg].
            amount: wanted [kg].
        """
        bench = self.bench
        bench.refill(fill)
        placed = bench.place_receiver()
        series = DoseSeries(
            self._flow, DosingSettings(), SourceContent(fill), placed, self._rng, particles=60, step=self.scale.step
        )
        order = DoseOrder(amount, receiver_mass=bench.receiver_mass)
        record = bench.dose(series.controller(order, seed=self._seed + number))
        every = slice(None, None, 3)
        columns = {
            "tilt_deg": list(zip(record.times[every], np.degrees(record.tilts[every]).round(3), strict=True)),
            "mass_g": [(one.time - PLACED_BEFORE, round(1e3 * one.mass, 3)) for one in placed]
            + [(one.time, round(1e3 * one.mass, 3)) for one in record.readings],
        }
        path = self._folder / f"dose-{number}.yaml"
        write_recording(
            path,
            Scene(path.stem, POURER, RECEIVER, Liquid(mass=fill)),
            columns,
            recorded={
                "how": "virtual dosing bench: tilt of the arm, readings as they arrived",
                "source": f"benchmarks/recordings.py, seed {self._seed}",
                "licence": "Apache-2.0",
            },
            placement={"x_offset": "90 mm", "height": "80 mm"},
            balance={"model": f"emulated, {self.scale.kind}", "step": f"{1e3 * self.scale.step:g} g"},
            fill_deviation=0.5e-3,
        )
        return load_recording(path)


DOSES = ((0.30, 0.050), (0.40, 0.100), (0.25, 0.080), (0.35, 0.060))
"""Fill and amount of the doses of a bench [kg]."""


def recorded(seed: int, folder: Path, grip: float = 0.0) -> tuple[Bench, list[PourRecording]]:
    """Return a bench and its recorded doses."""
    bench = Bench(seed, folder, grip=grip)
    return bench, [bench.dose(k + 1, fill, amount) for k, (fill, amount) in enumerate(DOSES)]


def fits(count: int, first: int) -> None:
    """Fit three doses of each bench, predict the fourth, and print the coverage of the intervals."""
    from orchestrator.recordings.recording_fit import fit_recordings, judge_recording

    inside = {"grip": 0, "lag": 0, "final": 0}
    error: dict[str, list[float]] = {"grip": [], "lag": [], "final": []}
    shares = []
    for seed in range(first, first + count):
        with tempfile.TemporaryDirectory() as folder:
            bench, doses = recorded(
                seed, Path(folder), grip=math.radians(np.random.default_rng(seed).uniform(-1.0, 1.0))
            )
            begin = time.process_time()
            found = fit_recordings(doses[:3], ("grip", "lag"))
            cpu = time.process_time() - begin
            judged = judge_recording(found, doses[3])
        truth = {"grip": bench.grip, "lag": bench.scale.lag + bench.scale.delay, "final": doses[3].gain}
        for name, (value, low, high) in {
            **{one.name: (one.value, one.low, one.high) for one in found.values if one.name in truth},
            "final": judged.final,
        }.items():
            inside[name] += low <= truth[name] <= high
            error[name].append(value - truth[name])
        shares.append(judged.coverage)
        print(
            f"{seed}: grip {math.degrees(error['grip'][-1]):+.2f}°, lag {error['lag'][-1]:+.3f} s, final "
            f"{1e3 * error['final'][-1]:+.2f} g, RMS {1e3 * judged.rms:.2f} g, coverage {judged.coverage:.2f}, "
            f"{cpu:.1f} CPU s",
            flush=True,
        )
    for name, factor, unit in (("grip", 180.0 / math.pi, "°"), ("lag", 1.0, " s"), ("final", 1e3, " g")):
        rms = factor * float(np.sqrt(np.mean(np.square(error[name]))))
        print(f"{name}: RMS error {rms:.3g}{unit}, inside the 90 % interval {inside[name]} of {count}")
    print(f"readings of the fourth dose inside their 90 % interval: {np.mean(shares):.2f}")


def cost(particles: int) -> None:
    """Print the cost of loading, estimating and simulating."""
    from orchestrator.recordings.recording_replay import estimate, simulate
    from sim_engine.liquids import SimulationParameters
    from sim_engine.simulator import PourSimulator

    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "hour.csv"
        lines = (f"{k / 20:.2f},{k / 1000:.3f},{'' if k % 2 else round(k / 1000, 1)}" for k in range(72_000))
        path.write_text("time_s,tilt_deg,mass_g\n" + "\n".join(lines) + "\n", encoding="utf-8")
        begin = time.process_time()
        read_series(path)
        print(f"one hour at 20 Hz: loaded in {time.process_time() - begin:.2f} CPU s")
        bench = Bench(FIRST_SEED, Path(folder))
        dose = bench.dose(1, 0.40, 0.200)
        length = float(dose.tilt_times[-1] - dose.tilt_times[0])
        estimate(dose)
        begin = time.process_time()
        estimate(dose)
        spent = time.process_time() - begin
        print(f"estimator: {spent:.2f} CPU s for {length:.1f} s recorded ({100 * spent / length:.1f} %)")
        simulator = PourSimulator()
        for state in ("cold", "warm"):
            begin = time.process_time()
            simulate(dose, parameters=SimulationParameters(particles=particles), simulator=simulator)
            spent = time.process_time() - begin
            print(f"simulation, {particles} particles, {state}: {spent:.1f} CPU s, {15 * spent / length:.1f} for 15 s")
        simulator.close()


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--benches", type=int, default=20)
    parser.add_argument("--first", type=int, default=FIRST_SEED, help="first seed")
    parser.add_argument("--particles", type=int, default=1000)
    parser.add_argument("--cost", action="store_true", help="measure the cost only")
    parser.add_argument("--sample", type=Path, help="write the doses of one bench into this folder")
    options = parser.parse_args()
    if options.sample is not None:
        recorded(options.first, options.sample)
        return
    if not options.cost:
        fits(options.benches, options.first)
    cost(options.particles)


if __name__ == "__main__":
    main()
