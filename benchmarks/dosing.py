"""Compare the dose controller with its rivals on the virtual bench, with the same target amounts and seeds.

    python benchmarks/dosing.py --final --json      # the figures of the evidence page: docs/data/dosing.json
    python benchmarks/dosing.py --series 20         # development seeds, for tuning

A series is six doses from one source vessel, in random order: 10, 25, 50, 100, 200 g and one more of these. The seed
draws cup, filling, balance and their errors; the bench draws the rest. If the source holds too little, it is refilled
and weighed. Development uses the seeds 0 to 99. The final seeds begin at 9100. Earlier final runs were at 5000 to 5059,
6000 to 6059, 7000 to 7049 and 9000 to 9049; their results led to changes, which were made on development seeds.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from actors.dosing.cup_flow import CupFlow
from actors.dosing.dose_controller import DoseOrder, fine_flow
from actors.dosing.dose_estimator import DoseReading
from actors.dosing.dose_series import DoseSeries, SourceContent
from actors.dosing.virtual_dosing_bench import DosingFault, TrueCup, TrueScale, VirtualDosingBench
from actors.dosing_settings import DosingSettings
from actors.interfaces import DoseEnd
from sim_engine.liquids import Liquid
from sim_engine.vessel import profile
from sim_engine.vessel.mesh_shape import MeshShape
from sim_engine.vessel.shapes import VesselSpec, cylinder
from sim_engine.vessel.vessel import Vessel, build_vessel

ROOT = Path(__file__).resolve().parent.parent
sys.path.insert(0, str(Path(__file__).parent))

from dosing_rivals import FastPid, LearnedPreact, OpenLoop, Pid, Preact, Rival, RivalMemory  # noqa: E402

DATA = ROOT / "docs" / "data" / "dosing.json"

AMOUNTS = (0.010, 0.025, 0.050, 0.100, 0.200)
FIRST_FINAL_SEED = 9100
PARTICLES = 100

CUPS = {
    "spouted beaker": TrueCup(0.040, 0.100, 0.007, 0.014),
    "spouted jug": TrueCup(0.050, 0.150, 0.012, 0.020),
    "round beaker": TrueCup(0.040, 0.100),
}
OIL = {"name": "rapeseed oil", "density": 915.0, "dynamic_viscosity": 0.07, "surface_tension": 0.033}


@dataclass(frozen=True)
class Group:
    """A part of the benchmark.

    Attributes:
        cups: names of the cups.
        lags: range of the balance's lag [s].
        oil: use oil instead of water.
        final: number of series with final seeds.
    """

    cups: tuple[str, ...]
    lags: tuple[float, float]
    oil: bool
    final: int


SPOUTED = ("spouted beaker", "spouted jug")
GROUPS = {
    "spout, water, lag 0.1 to 0.5 s": Group(SPOUTED, (0.1, 0.5), False, 50),
    "round rim": Group(("round beaker",), (0.1, 0.5), False, 20),
    "oil": Group(SPOUTED, (0.1, 0.5), True, 20),
    "lag 1 s": Group(SPOUTED, (0.9, 1.1), False, 20),
}


def spouted_vessel(cup: TrueCup) -> Vessel:
    """Return the vessel model of the controllers: a mesh with the spout's outline, not the bench's model."""
    with tempfile.TemporaryDirectory() as folder:
        return build_vessel(cup_spec(cup, Path(folder)), use_cache=False)


def cup_spec(cup: TrueCup, folder: Path) -> VesselSpec:
    """Return the vessel of a cup; the mesh of a spouted one is written into a folder."""
    if cup.spout_length == 0.0:
        return cylinder("beaker", inner_radius=cup.radius, inner_height=cup.height)
    import trimesh

    wall, top = 0.003, cup.height + 0.003
    inner = np.array([(0.0, wall), (cup.radius, wall), (cup.radius, 0.75 * top), (cup.radius, top)])
    outer = np.array([(0.0, 0.0), (cup.radius + wall, 0.0), (cup.radius + wall, 0.75 * top), (cup.radius + wall, top)])
    vertices, faces = profile.revolve(profile.solid_polygon(inner, outer), segments=180)
    x, y, z = vertices.T
    rise = np.clip((z / top - 0.75) / 0.25, 0.0, 1.0) ** 2
    spread = np.exp(-((np.arctan2(y, x) / (0.5 * cup.spout_width / cup.radius)) ** 2))
    out = 1.0 + cup.spout_length * rise * spread / np.maximum(np.hypot(x, y), 1e-6) * (np.hypot(x, y) > 0.01)
    path = folder / f"spouted-{1e3 * cup.radius:g}.stl"
    trimesh.Trimesh(np.column_stack([x * out, y * out, z]), faces).export(path)
    return VesselSpec(name="spouted", shape=MeshShape(path=path, unit="m"))


@dataclass(frozen=True)
class Dose:
    """One row of the table; masses [g], times [s]."""

    seed: int
    place: int
    cup: str
    scale: str
    lag: float
    step: float
    fill: float
    amount: float
    error: float
    spilled: float
    weighed_at: float
    end: str


class Series:
    """One source, one bench, six doses; the same for every controller.

    Args:
        group: group of the benchmark.
        seed: seed of all random choices.
        cups: returns the flow for a cup's name and a liquid (oil or not).
    """

    def __init__(self, group: Group, seed: int, cups: Callable[[str, bool], CupFlow]) -> None:
        rng = np.random.default_rng((seed, 11))
        self.seed, self.rng = seed, rng
        self.cup_name = str(rng.choice(group.cups))
        true = CUPS[self.cup_name]
        self.cup = cups(self.cup_name, group.oil)
        kind = str(rng.choice(["first", "fourth", "average", "switching"]))
        lag = float(np.exp(rng.uniform(*np.log(group.lags))))
        self.scale = TrueScale(
            kind,  # type: ignore[arg-type]
            lag,
            interval=float(rng.choice([0.1, 0.15])),
            delay=float(rng.uniform(0.02, 0.09)),
            step=float(rng.choice([1e-5, 1e-4])),
            noise=float(rng.uniform(1e-5, 4e-5)),
        )
        fields = OIL if group.oil else {}
        self.density = float(Liquid(mass=0.1, **fields).density)  # type: ignore[arg-type]
        self.fill = float(rng.uniform(0.30, 0.95))
        liquid = Liquid(mass=self.fill * true.capacity * self.density, **fields)  # type: ignore[arg-type]
        amounts = [*AMOUNTS, float(rng.choice(AMOUNTS))]
        self.amounts = [float(a) for a in rng.permutation(amounts)]
        self.bench = VirtualDosingBench(
            true, liquid, self.scale, seed, command_interval=float(rng.choice([0.05, 0.1])), fall_height=0.15
        )
        self._refills = [float(x) for x in rng.uniform(0.6, 0.95, 12)]
        self._weighing = rng.normal(0.0, 0.3e-3, 12).tolist()

    def weighed_content(self) -> float:
        """Return the weighed content of the source [kg]."""
        return self.bench.content + float(self._weighing.pop())

    def refill_for(self, amount: float) -> bool:
        """Refill the source if it holds less than the amount plus a tenth of its capacity; return whether it did."""
        capacity = self.bench.cup.capacity * self.density
        if self.bench.content > amount + 0.1 * capacity:
            return False
        self.bench.refill(self._refills.pop() * capacity)
        return True

    def controlled(self, placed: Sequence[DoseReading]) -> DoseSeries:
        """Return the doses of Decant's controller, which begin with the receiver as placed."""
        content, rng = SourceContent(self.weighed_content()), np.random.default_rng((self.seed, 3))
        return DoseSeries(self.cup, DosingSettings(), content, placed, rng, particles=PARTICLES, step=self.scale.step)

    def doses(self, pour: Callable[[float, bool], tuple[Any, str]]) -> Iterator[Dose]:
        """Yield all doses; `pour` takes the amount and whether the source was refilled, and returns record and end."""
        for place, amount in enumerate(self.amounts):
            filled = self.refill_for(amount)
            fill = self.bench.content / (self.bench.cup.capacity * self.density)
            record, end = pour(amount, filled)
            yield Dose(
                self.seed,
                place,
                self.cup_name,
                self.scale.kind,
                self.scale.lag,
                1e3 * self.scale.step,
                fill,
                1e3 * amount,
                1e3 * (record.received - amount),
                1e3 * record.spilled,
                record.duration,
                end,
            )


def with_particles(series: Series) -> list[Dose]:
    """Pour a series with the dose controller."""
    started: list[DoseSeries] = []

    def pour(amount: float, filled: bool) -> tuple[Any, str]:
        placed = series.bench.place_receiver()
        if not started:
            started.append(series.controlled(placed))
        elif filled:
            started[0].fill(SourceContent(series.weighed_content()))
        order = DoseOrder(amount, receiver_mass=series.bench.receiver_mass)
        controller = started[0].controller(order, seed=series.seed)
        record = series.bench.dose(controller)
        assert controller.result is not None
        started[0].finish(controller.result)
        return record, str(controller.result.end)

    return list(series.doses(pour))


def with_rival(rival: type[Rival]) -> Callable[[Series], list[Dose]]:
    """Return a function that pours a series with a rival."""

    def run(series: Series) -> list[Dose]:
        memory: list[RivalMemory] = []

        def pour(amount: float, filled: bool) -> tuple[Any, str]:
            series.bench.place_receiver()
            if not memory:
                memory.append(RivalMemory(series.weighed_content() / series.density, rival.first_preact))
            elif filled:
                memory[0].volume = series.weighed_content() / series.density
            fine = fine_flow(series.cup, 1.0, DosingSettings())
            controller = rival(series.cup, amount, memory[0], fine)
            record = series.bench.dose(controller)
            controller.learn()
            return record, DoseEnd.REACHED if controller.weighed is not None else "unknown"

        return list(series.doses(pour))

    return run


CONTROLLERS: dict[str, Callable[[Series], list[Dose]]] = {
    "open loop": with_rival(OpenLoop),
    "fixed preact": with_rival(Preact),
    "learned preact": with_rival(LearnedPreact),
    "PID": with_rival(Pid),
    "PID, fast": with_rival(FastPid),
    "particles": with_particles,
}


def figures(doses: Sequence[Dose]) -> dict[str, Any]:
    """Return mean |error|, bias, 95 %, worst, excess, spill and times of some doses."""
    errors = np.array([d.error for d in doses])
    sizes = np.abs(errors)
    firsts = np.array([abs(d.error) for d in doses if d.place == 0])
    fifty = [d.weighed_at for d in doses if d.amount == 50.0]
    largest = [d.weighed_at for d in doses if d.amount == 200.0]
    return {
        "doses": len(doses),
        "mean": float(sizes.mean()),
        "bias": float(errors.mean()),
        "p95": float(np.quantile(sizes, 0.95)),
        "worst": float(sizes.max()),
        "over_1g": float(np.mean(errors > 1.0)),
        "first_mean": float(firsts.mean()) if len(firsts) else None,
        "first_p95": float(np.quantile(firsts, 0.95)) if len(firsts) else None,
        "spill_mean": float(np.mean([d.spilled for d in doses])),
        "spill_p95": float(np.quantile([d.spilled for d in doses], 0.95)),
        "time_50_p95": float(np.quantile(fifty, 0.95)) if fifty else None,
        "time_200_p95": float(np.quantile(largest, 0.95)) if largest else None,
        "time_median": float(np.median([d.weighed_at for d in doses])),
        "aborted": sum(d.end not in (DoseEnd.REACHED, DoseEnd.MISSED) for d in doses),
    }


def paired(doses: Sequence[Dose], rival: Sequence[Dose], seed: int = 0) -> tuple[float, float, float]:
    """Return the mean |error| of a rival minus ours, with its 95 % interval over series (bootstrap) [g]."""
    own = {(d.seed, d.place): abs(d.error) for d in doses}
    by_series: dict[int, list[float]] = {}
    for d in rival:
        by_series.setdefault(d.seed, []).append(abs(d.error) - own[d.seed, d.place])
    means = np.array([np.mean(v) for v in by_series.values()])
    rng = np.random.default_rng(seed)
    draws = means[rng.integers(0, len(means), (4000, len(means)))].mean(axis=1)
    return float(means.mean()), float(np.quantile(draws, 0.025)), float(np.quantile(draws, 0.975))


def cup_flows() -> Callable[[str, bool], CupFlow]:
    """Return a function that gives the flow by cup and liquid, building each once."""
    vessels: dict[str, Vessel] = {}
    flows: dict[tuple[str, bool], CupFlow] = {}

    def flow(name: str, oil: bool) -> CupFlow:
        if name not in vessels:
            vessels[name] = spouted_vessel(CUPS[name])
        if (name, oil) not in flows:
            fields = OIL if oil else {}
            flows[name, oil] = CupFlow(vessels[name], Liquid(mass=0.1, **fields))  # type: ignore[arg-type]
        return flows[name, oil]

    return flow


def measure(
    groups: Sequence[str], controllers: Sequence[str], seeds: Callable[[Group], range]
) -> dict[str, dict[str, list[Dose]]]:
    """Pour all doses by group and controller; every controller pours a series before the next series begins.

    Args:
        groups, controllers: names.
        seeds: returns the seeds of a group's series.
    """
    flow = cup_flows()
    result: dict[str, dict[str, list[Dose]]] = {name: {one: [] for one in controllers} for name in groups}
    for name, by in result.items():
        for seed in seeds(GROUPS[name]):
            for controller in controllers:
                by[controller] += CONTROLLERS[controller](Series(GROUPS[name], seed, flow))
            print(f"{name}: series {seed}", flush=True)
        for controller, doses in by.items():
            print(controller, json.dumps(figures(doses)), flush=True)
    return result


def picture(path: Path, seed: int = 3) -> None:
    """Draw one dose of 50 g with all its signals.

    Args:
        path: path of the PNG.
        seed: seed of a development series.
    """
    from orchestrator.reports import figure_style as style

    series = Series(next(iter(GROUPS.values())), seed, cup_flows())
    series.refill_for(0.3)
    rng = np.random.default_rng((seed, 3))
    content, placed = SourceContent(series.bench.content), series.bench.place_receiver()
    doses = DoseSeries(series.cup, DosingSettings(), content, placed, rng, particles=PARTICLES, step=series.scale.step)
    controller = doses.controller(DoseOrder(0.05), seed=seed)
    seen: list[tuple[float, str, float, float]] = []

    class Recorder:
        """Records the controller's estimate at every step."""

        def step(self, time: float, tilt: float, readings: Any) -> Any:
            """See `actors.dosing.virtual_dosing_bench.Doser`."""
            command = controller.step(time, tilt, readings)
            seen.append((time, str(controller.phase), *controller.amount))
            return command

    record = series.bench.dose(Recorder())
    figure, (masses, tilts, flows) = style.new_figure(3, 1, size=(7.2, 6.4), sharex=True)
    times = np.array([s[0] for s in seen])
    mean, deviation = np.array([s[2] for s in seen]), np.array([s[3] for s in seen])
    zero = float(np.median([r.mass for r in record.readings[:4]]))
    masses.fill_between(times, 1e3 * (mean - 2 * deviation), 1e3 * (mean + 2 * deviation), color=style.PALE)
    masses.plot(times, 1e3 * mean, color=style.PREDICTED, label="estimated, past the lip (± 2 σ)")
    masses.plot(record.times, 1e3 * record.true_mass, color=style.MEASURED, label="true, in the receiver")
    shown = [(r.time, 1e3 * (r.mass - zero)) for r in record.readings]
    masses.plot(*zip(*shown, strict=True), ".", color=style.GREY, ms=4, label="reading")
    masses.axhline(50.0, color=style.BEST, lw=1.0, label="wanted")
    stop = next((t for t, phase, _, _ in seen if phase == "return"), None)
    for axes in (masses, tilts, flows):
        if stop is not None:
            axes.axvline(stop, color=style.BEST, lw=1.0, ls=":")
    tilts.plot(record.times, np.degrees(record.tilts), color=style.MEASURED)
    flows.plot(record.times, 1e3 * record.flow, color=style.MEASURED)
    masses.legend(fontsize=8, frameon=False)
    style.dress(masses, title="A first dose of 50 g; dotted: the order to turn back", y="mass [g]")
    style.dress(tilts, y="tilt [deg]")
    style.dress(flows, x="time [s]", y="flow past the lip [g/s]")
    figure.savefig(path, dpi=120)


FIRST_FAULT_SEED = 9900

FAULTS = {
    "knock on the balance, 5 g for 0.2 s": DosingFault("knock", 1.5),
    "balance swings by 2 g": DosingFault("unstable"),
    "line of the balance cut in the flow": DosingFault("line cut", 1.5),
    "program pauses for 0.7 s": DosingFault("stall", 1.0),
    "program killed in the flow": DosingFault("killed", 1.0),
    "stream misses from the start": DosingFault("miss", 0.0),
    "stream misses after 1.5 s": DosingFault("miss", 1.5),
    "receiver missing": DosingFault("receiver missing"),
}


def faults(count: int = 10) -> list[dict[str, Any]]:
    """Pour first doses of 100 g of the group 'round rim' with one fault each; return one row per fault."""
    cups, rows = cup_flows(), []
    for name, fault in FAULTS.items():
        ends, above, misreported, spilled, upright = Counter[str](), [0.0], [0.0], [], []
        for seed in range(FIRST_FAULT_SEED, FIRST_FAULT_SEED + count):
            series = Series(GROUPS["round rim"], seed, cups)
            if series.bench.content < 0.15:
                series.bench.refill(0.8 * series.bench.cup.capacity * series.density)
            placed = series.bench.place_receiver()
            doses = series.controlled(placed)
            controller = doses.controller(DoseOrder(0.1, receiver_mass=series.bench.receiver_mass), seed=seed)
            record = series.bench.dose(controller, fault)
            result = controller.result
            ends["no program" if result is None else str(result.end)] += 1
            above.append(1e3 * (record.received - 0.1))
            spilled.append(1e3 * record.spilled)
            if result is not None and result.amount is not None:
                misreported.append(1e3 * abs(result.amount - record.received))
            flowing = record.times[record.flow > 1e-4]
            if len(flowing):
                upright.append(record.upright - float(flowing[0]) - fault.at)
        rows.append(
            {
                "fault": name,
                "ends": dict(ends),
                "most_above": max(above),
                "misreported": max(misreported),
                "spilled": float(np.mean(spilled)),
                "upright": max(upright, default=0.0) if fault.kind == "killed" else None,
            }
        )
    return rows


def write(update: dict[str, Any]) -> None:
    """Update a part of docs/data/dosing.json."""
    data = json.loads(DATA.read_text(encoding="utf-8")) if DATA.exists() else {"groups": {}}
    DATA.write_text(json.dumps(data | update, indent=1) + "\n", encoding="utf-8")


def main() -> None:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--final", action="store_true", help="use the final seeds instead of the development seeds")
    parser.add_argument("--series", type=int, help="number of series; default: 20, or all final seeds")
    parser.add_argument("--first", type=int, default=0, help="first development seed")
    parser.add_argument("--controllers", nargs="*", choices=list(CONTROLLERS), default=list(CONTROLLERS))
    parser.add_argument("--json", action="store_true", help=f"write {DATA.relative_to(ROOT)}")
    parser.add_argument("--picture", type=Path, help="only draw one dose")
    parser.add_argument("--faults", action="store_true", help="only pour doses with one fault each")
    options = parser.parse_args()
    if options.picture:
        return picture(options.picture)
    if options.faults:
        rows = faults()
        for row in rows:
            print(row)
        if options.json:
            from machine import describe

            write({"faults": {"rows": rows, "seeds": [FIRST_FAULT_SEED, 10], "machine": describe()}})
        return None

    def seeds(group: Group) -> range:
        if options.final:
            return range(FIRST_FINAL_SEED, FIRST_FINAL_SEED + (options.series or group.final))
        return range(options.first, min(options.first + (options.series or 20), 100))

    result = measure(list(GROUPS), options.controllers, seeds)
    for name, by in result.items():
        if "particles" in by:
            for rival, doses in by.items():
                if rival != "particles":
                    mean, low, high = paired(by["particles"], doses)
                    print(f"{name}: {rival} − particles: {mean:+.2f} g ({low:+.2f} … {high:+.2f})")
    if options.json:
        from machine import describe

        data = json.loads(DATA.read_text(encoding="utf-8")) if DATA.exists() else {"groups": {}}
        for name, by in result.items():
            measured = {c: figures(d) for c, d in by.items()}
            measured |= {"paired": {c: paired(by["particles"], d) for c, d in by.items() if c != "particles"}}
            first = [d.seed for d in by["particles"]]
            data["groups"][name] = measured | {"machine": describe(), "seeds": [min(first), max(first)]}
        write(data)


if __name__ == "__main__":
    main()
