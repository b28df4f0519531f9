"""The cases by name: their descriptions, and their resolutions in the quick and the full run."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace

from sim_engine.liquids import SimulationParameters
from sim_engine.scene import MIRRORED_FROM
from sim_engine.simulator import PourSimulator

from . import (
    capillarity,
    convergence,
    dam_break,
    dribbling_onset,
    hydrostatic_cases,
    jet_landing,
    sloshing,
    torricelli,
    viscous_flows,
    wall_tightness,
    whole_pours,
)
from .case_result import CaseEffort, CaseResult, Figure, Measurement, at_least, collected

PLAIN = SimulationParameters(cohesion=0.0, xsph_rate=1.0, friction=0.0)
"""θ of the cases, as their references assume. Water's own viscosity has no effect in a cup, a liquid has no dry
friction, and tension acts on drips only. A little XSPH viscosity replaces the effects that a finer solver would
resolve."""

LOAD = 200e-6
"""Load of the cups [m³]."""

SEEDS = 5
"""Number of loads that are averaged if single ones scatter as much as a criterion allows."""


@dataclass(frozen=True)
class Case:
    """One case.

    Attributes:
        name: on the command line.
        title: in tables and pages.
        about: setup, reference and source, in a sentence or two.
        work: runs it.
        repeated: whether its full run is repeated with the mirrored liquid, by the same criteria.
    """

    name: str
    title: str
    about: str
    work: Callable[[PourSimulator, CaseEffort], tuple[list[Measurement], Figure | None]]
    repeated: bool = True

    def efforts(self, full: bool) -> list[CaseEffort]:
        """Efforts of the quick or the full run."""
        return [CaseEffort(full), CaseEffort(full, mirrored=True)] if full and self.repeated else [CaseEffort(full)]

    def run(self, simulator: PourSimulator, *efforts: CaseEffort) -> CaseResult:
        """Run the case with some efforts and measure its CPU time. A solver that stops with a fault counts as a failed
        criterion. Measurements and curves of a mirrored effort have this word at the end of their names."""
        begun, figures = time.process_time(), []
        measurements: list[Measurement] = []
        for effort in efforts:
            suffix = ", mirrored" if effort.mirrored else ""
            try:
                of_effort, figure = self.work(simulator, effort)
            except ArithmeticError as fault:
                name = f"the solver ran to the end (1: yes); it stopped {fault}"
                of_effort, figure = [at_least(name, 0.0, 1.0, criterion="yes", particles=0)], None
            measurements += [replace(m, name=m.name + suffix) for m in of_effort]
            if figure is not None:
                named = [replace(s, name=s.name + suffix) if s.kind == "measured" else s for s in figure.series]
                figures.append(replace(figure, series=tuple(named)))
        _, curves = collected(([], figure.series) for figure in figures)
        whole = replace(figures[0], series=tuple(curves)) if figures else None
        return CaseResult(tuple(measurements), whole, time.process_time() - begun)


def describe(parameters: SimulationParameters) -> str:
    """θ without its number of particles, as text."""
    infos = SimulationParameters.info()
    shown = [
        f"{name.replace('_', ' ')} {value:g} {infos[name].unit}".removesuffix(" 1")
        for name, value in parameters.model_dump().items()
        if name != "particles" and not infos[name].nuisance
    ]
    return ", ".join(shown)


def _at_rest(simulator: PourSimulator, effort: CaseEffort) -> tuple[list[Measurement], Figure]:
    numbers = effort.numbers((2_000,), (2_000, 5_000))
    runs = [hydrostatic_cases.at_rest(n, PLAIN, mirrored=effort.mirrored) for n in numbers]
    outcome, curves = collected((measurements, figure.series) for measurements, figure in runs)
    return outcome, replace(runs[-1][1], series=tuple(curves))


def _retention(simulator: PourSimulator, effort: CaseEffort) -> tuple[list[Measurement], Figure]:
    numbers = effort.numbers((500,), (500, 1_000, 2_000, 5_000), coarse=2)
    runs = [(hydrostatic_cases.straight_cup(), n) for n in numbers]
    if effort.full:
        runs += [(hydrostatic_cases.conical_cup(), 2_000), (hydrostatic_cases.mesh_jug(), 2_000)]
    angles, seeds = (hydrostatic_cases.ANGLES, SEEDS) if effort.full else (hydrostatic_cases.ANGLES[:1], 1)
    measurements, curves = collected(
        hydrostatic_cases.slow_tilt(vessel, LOAD, n, PLAIN, angles, seeds, effort.mirrored) for vessel, n in runs
    )
    return measurements, hydrostatic_cases.retention_figure(curves)


def _outflow(simulator: PourSimulator, effort: CaseEffort) -> tuple[list[Measurement], Figure]:
    numbers = effort.numbers((500, 1_000), (500, 1_000, 2_000, 5_000), coarse=2)
    measurements, curves = collected(
        whole_pours.outflow(simulator, n, PLAIN, 3 if n <= 2_000 else 1, effort.mirrored) for n in numbers
    )
    return measurements, whole_pours.outflow_figure(curves)


def _delivered(simulator: PourSimulator, effort: CaseEffort) -> tuple[list[Measurement], None]:
    return whole_pours.delivered(simulator, 2_000, PLAIN, 10 if effort.full else 3, effort.mirrored), None


def _jet(simulator: PourSimulator, effort: CaseEffort) -> tuple[list[Measurement], Figure]:
    return whole_pours.free_jet(simulator, 5_000 if effort.full else 1_000, PLAIN, effort.mirrored)


def _column(simulator: PourSimulator, effort: CaseEffort) -> tuple[list[Measurement], None]:
    numbers = effort.numbers((2_000,), (2_000, 5_000, 10_000))
    return [m for n in numbers for m in hydrostatic_cases.tall_column(n, PLAIN, effort.mirrored)], None


def _sloshing(simulator: PourSimulator, effort: CaseEffort) -> tuple[list[Measurement], Figure]:
    numbers = effort.numbers((2_000,), (2_000, 5_000, 10_000))
    measurements, curves = collected(sloshing.sloshing(n, PLAIN, effort.mirrored) for n in numbers)
    return measurements, sloshing.sloshing_figure(curves)


def _torricelli(simulator: PourSimulator, effort: CaseEffort) -> tuple[list[Measurement], Figure]:
    numbers = effort.numbers((6_000,), (6_000, 12_000))
    runs = {n: torricelli.torricelli(n, PLAIN, effort.mirrored) for n in numbers}
    measurements, curves = collected(run[:2] for run in runs.values())
    if len(runs) > 1:
        measurements.append(torricelli.steadiness({n: discharge for n, (_, _, discharge) in runs.items()}))
    return measurements, torricelli.torricelli_figure(curves)


def _dam_break(simulator: PourSimulator, effort: CaseEffort) -> tuple[list[Measurement], Figure]:
    across = 16 if effort.full else 12
    measurements, curves = collected(
        dam_break.dam_break(width, across, PLAIN, effort.mirrored) for width in dam_break.MEASURED
    )
    return measurements, dam_break.dam_figure(curves)


def _cohesion(simulator: PourSimulator, effort: CaseEffort) -> tuple[list[Measurement], Figure]:
    free = PLAIN.model_copy(update={"xsph_rate": 0.0})
    sphere = capillarity.cube_to_sphere(2_000, free, effort.mirrored)
    numbers = effort.numbers((2_000,), (2_000, 10_000))
    runs = {n: capillarity.oscillation(n, free, effort.mirrored) for n in numbers}
    measurements, curves = collected([(sphere, []), *(run[:2] for run in runs.values())])
    if len(runs) > 1:
        measurements.append(capillarity.same_tension({n: tension for n, (_, _, tension) in runs.items()}))
    return measurements, capillarity.droplet_figure(curves)


def _landing(simulator: PourSimulator, effort: CaseEffort) -> tuple[list[Measurement], Figure]:
    numbers = effort.numbers((500,), (500, 1_000, 2_000), coarse=2)
    finest, seeds = (10_000, SEEDS) if effort.full else (1_000, 1)
    return jet_landing.compared(simulator, numbers, finest, PLAIN, seeds, effort.mirrored)


def _convergence(simulator: PourSimulator, effort: CaseEffort) -> tuple[list[Measurement], Figure]:
    numbers = effort.numbers((1_000,), (500, 1_000, 2_000), coarse=2)
    pours, seeds = (convergence.POURS, 3) if effort.full else (convergence.QUICK, 1)
    return convergence.convergence(simulator, pours, numbers, seeds, PLAIN, effort.mirrored)


def _halves(simulator: PourSimulator, effort: CaseEffort) -> tuple[list[Measurement], None]:
    chosen, seeds = (convergence.POURS[:8], 30) if effort.full else (convergence.POURS[:1], 2)
    return convergence.halves(simulator, chosen, MIRRORED_FROM, seeds, PLAIN)


def _walls(simulator: PourSimulator, effort: CaseEffort) -> tuple[list[Measurement], None]:
    many = 40 if effort.full else 5
    return wall_tightness.walls(many, 10_000 if effort.full else 1_500, mirrored=effort.mirrored), None


def _dribbling(simulator: PourSimulator, effort: CaseEffort) -> tuple[list[Measurement], Figure | None]:
    numbers = effort.numbers((500,), (500, 1_000, 2_000), coarse=2)
    speeds = dribbling_onset.SPEEDS if effort.full else (20.0,)
    return dribbling_onset.onset(simulator, numbers, PLAIN, speeds, effort.mirrored)


def _repeatability(simulator: PourSimulator, effort: CaseEffort) -> tuple[list[Measurement], None]:
    return whole_pours.repeatability(simulator, 2_000 if effort.full else 500, PLAIN, effort.mirrored), None


CASES: tuple[Case, ...] = (
    Case(
        "rest",
        "Liquid at rest",
        "200 mL in a cup of radius 40 mm stand 39.8 mm high (hydrostatics). Means over 0.2 s after the first second; "
        "the height is twice that of the mass centre, the density inside is that of Voronoi cells.",
        _at_rest,
    ),
    Case(
        "column",
        "Tall column at rest",
        "240 mL in a slim cup (R 27 mm) stand 105 mm high, up to 36 layers of particles, and stay where they are.",
        _column,
    ),
    Case(
        "retention",
        "Slow-tilt retention",
        "A cup tilted at 3 °/s or slower, and held at each angle until it has stopped to drain, keeps what lies "
        "below the horizontal plane through its lip (numerical integration). Cylinder, cone and a jug with a "
        "spout from a mesh; means of five loads.",
        _retention,
    ),
    Case(
        "outflow",
        "Outflow of the standard pour",
        "200 mL, 30 °/s to 120° about the inner lip. Reference: the limit of fine particles, to which SPlisHSPlasH "
        "(DFSPH) and Decant with two corrections of the lip extrapolate within 0.003.",
        _outflow,
    ),
    Case(
        "delivered",
        "Delivery of the standard pour",
        "The same pour into a cup that it can't miss, over seeds.",
        _delivered,
    ),
    Case(
        "jet",
        "Free jet",
        "Below the lip and above the receiver nothing acts on a parcel of liquid but gravity.",
        _jet,
    ),
    Case(
        "landing",
        "Landing of the jet",
        "Where the jet crosses the height 60 mm below the lip, with the receiver set aside, at 30 and at 90 °/s: "
        "coarse particles against fine ones, five pours of each together.",
        _landing,
    ),
    Case(
        "sloshing",
        "Sloshing",
        "The cup at rest is pushed aside by 6 mm; the frequency of the first lateral mode is ω² = g k tanh(kH), "
        "k = 1.841/R.",
        _sloshing,
    ),
    Case(
        "torricelli",
        "Torricelli",
        "200 mL leave the cup through a sharp round hole of radius 10 mm in its floor; C_d from the slope of √V from "
        "0.8 to 0.2 of the load.",
        _torricelli,
    ),
    Case(
        "dam-break",
        "Dam break",
        "A column of width a and height 2a collapses in a channel ten spacings wide. Reference: Martin & Moyce "
        "1952, n² = 2; fronts are compared after the delay of their gate that fits best. Friction of the floor "
        "(0.05) replaces their boundary layer.",
        _dam_break,
    ),
    Case(
        "cohesion",
        "Cohesion",
        "Without gravity, at the tension of water: a cube of 0.5 mL becomes a sphere; a stretched drop of radius 5 mm "
        "oscillates at Rayleigh's 10.9 Hz. Steps are a tenth of the capillary limit.",
        _cohesion,
    ),
    Case(
        "convergence",
        "Convergence",
        "Spillage of nineteen pours into four receivers at few particles. Reference: 10,000 particles "
        "(`benchmarks/convergence.py`). Three pours splash and do not converge. They are not judged.",
        _convergence,
    ),
    Case(
        "halves",
        "Mirrored pours",
        "Eight of these pours with one half of the liquid and its mirror image, compared with the whole liquid: mean "
        "spillage of thirty seeds each. References are the whole pours.",
        _halves,
        repeated=False,
    ),
    Case(
        "walls",
        "Walls",
        "Random pours: walls from 1 mm, up to 180 °/s, 500 particles and more. Every particle that crosses a wall is "
        "counted, never called spilled.",
        _walls,
    ),
    Case(
        "repeatability",
        "Repeatability",
        "The standard pour, twice with one seed and once with another.",
        _repeatability,
    ),
    Case(
        "dribbling",
        "Onset of dribbling",
        "Cups tilted to 80° with `lip_adhesion` 1: what leaves at a Weber number below 1 runs down the "
        "outside (Kistler & Scriven 1994, Duez et al. 2010). Reference: the same fraction from the outflow of "
        "5,000 particles without the model, whose critical number is not tested.",
        _dribbling,
    ),
    *(Case(*entry) for entry in viscous_flows.CASES),
)


def case(name: str) -> Case:
    """A case by its name.

    Raises:
        KeyError: it does not exist; the message names the existing ones.
    """
    for candidate in CASES:
        if candidate.name == name:
            return candidate
    raise KeyError(f"no case '{name}'; there are {', '.join(c.name for c in CASES)}")
