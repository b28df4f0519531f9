"""The protocol of a rig's first day: ten pours and five doses with water, each recorded.

- `first_day` lists the steps for a pourer: `DayStep` with fill, action or amount, and its purpose.
- `practice_day` records the day on the virtual dosing bench in seconds, with one quantity wrong if wanted.

`orchestrator.recordings.rig_diagnosis` explains the recordings.

Limitations: the practice bench has a cylindrical cup of its own; the deliberate miss loses its whole stream.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.optimize import brentq

from actors.balance.display_behaviour import DisplayBehaviour
from actors.dosing.cup_flow import flow_of
from actors.dosing.dose_controller import DoseOrder
from actors.dosing.dose_estimator import DoseReading
from actors.dosing.dose_series import DoseSeries, SourceContent
from actors.dosing.tilt_command import TiltCommand
from actors.dosing.virtual_dosing_bench import NO_FAULT, DosingFault, TrueCup, TrueScale, VirtualDosingBench
from actors.dosing_settings import DosingSettings
from orchestrator.recordings.recording_file import PourRecording, load_recording, write_recording
from sim_engine.errors import InvalidArgumentError
from sim_engine.hydrostatics import retained_volume
from sim_engine.liquids import Liquid
from sim_engine.scene import Scene
from sim_engine.vessel.shapes import VesselSpec, cylinder
from sim_engine.vessel.vessel import build_vessel

MISS = "miss"
"""End of the name of the pour that misses the receiver."""

DOSES = (0.020, 0.020, 0.050, 0.050, 0.100)
"""Wanted amounts [kg]."""

HOLD = 20.0
"""Time at the largest tilt [s]."""


@dataclass(frozen=True)
class DayStep:
    """One pour or dose.

    Attributes:
        name: of its recording; the names are in the order of the steps.
        fill: mass in the pourer before it [kg].
        purpose: for the operator.
        amount: wanted dose [kg]; None for a pour.
        speed: of the tilt of a pour [rad/s].
        angle: largest tilt of a pour [rad].
        misses: the receiver stands where the stream misses it.
    """

    name: str
    fill: float
    purpose: str
    amount: float | None = None
    speed: float = 0.0
    angle: float = 0.0
    misses: bool = False


_POURS = (
    ("slow-full-1", 0.85, 3.0, 0.06, "slow tilt to the onset, full"),
    ("slow-low-1", 0.25, 3.0, 0.06, "slow tilt to the onset, less full"),
    ("slow-full-2", 0.85, 3.0, 0.06, "slow tilt to the onset, full, again"),
    ("slow-low-2", 0.25, 3.0, 0.06, "slow tilt to the onset, less full, again"),
    ("slow-middle", 0.55, 3.0, 0.06, "slow tilt to the onset, a third fill"),
    ("calm-1", 0.60, 12.0, 0.16, "a calm pour"),
    ("calm-2", 0.60, 12.0, 0.16, "a calm pour, again"),
    ("fast-1", 0.60, 40.0, 0.16, "a fast pour"),
    ("fast-2", 0.60, 40.0, 0.16, "a fast pour, again"),
    (MISS, 0.60, 12.0, 0.10, "a pour next to the receiver, into the tray"),
)
"""Name, fill and outflow as shares of the capacity, speed [deg/s], and purpose of the pours."""


def first_day(pourer: VesselSpec, density: float) -> tuple[DayStep, ...]:
    """The steps for a pourer.

    Args:
        pourer: the vessel.
        density: of the liquid [kg/m³].

    Raises:
        InvalidArgumentError: the pourer is too small for the doses.
    """
    vessel = build_vessel(pourer)
    capacity = retained_volume(vessel, 0.0)
    if 0.7 * capacity * density < 1.25 * max(DOSES):
        raise InvalidArgumentError(
            f"{pourer.name}: holds {1e3 * capacity * density:.0f} g; the first day doses {1e3 * max(DOSES):.0f} g from "
            f"a pourer that is 70 % full, and needs one of {1.25e3 * max(DOSES) / 0.7:.0f} g or more"
        )
    steps: list[tuple[str, float, str, float | None, float, float]] = []
    for name, full, speed, outflow, purpose in _POURS:
        goal = (full - outflow) * capacity
        angle = float(brentq(lambda tilt, goal=goal: retained_volume(vessel, tilt) - goal, 0.0, math.radians(89.9)))
        steps.append((name, full, purpose, None, math.radians(speed), angle))
    steps += [(f"dose-{1e3 * amount:.0f}-g", 0.70, "a dose", amount, 0.0, 0.0) for amount in DOSES]
    return tuple(
        DayStep(f"{k:02d}-{name}", round(full * capacity * density, 3), purpose, amount, speed, angle, name == MISS)
        for k, (name, full, purpose, amount, speed, angle) in enumerate(steps, start=1)
    )


class _PlannedTilt:
    """Tilts to an angle, holds it, and finishes."""

    def __init__(self, step: DayStep) -> None:
        self._step, self._held = step, math.inf

    def step(self, time: float, tilt: float, readings: Sequence[DoseReading]) -> TiltCommand:
        left = self._step.angle - tilt
        if left < math.radians(0.3) and self._held == math.inf:
            self._held = time
        # the servo follows late: slow down before the angle is reached
        speed = min(self._step.speed, max(5.0 * left, 0.0))
        return TiltCommand(speed, finished=time > self._held + HOLD)


WRONG = ("lag", "holds", "grip", "height", "viscosity")
"""What can be wrong on the practice bench."""

CUP = TrueCup(0.040, 0.100)
PLACED_BEFORE = 20.0
"""Time from the placing of the receiver to the first motion [s]."""

VISCOUS = (0.05, 0.1)
"""Range of a wrong viscosity, as of thickened water or dilute syrup [Pa·s]: poured as 'water', or water as such."""


def practice_day(folder: Path, seed: int, wrong: str | None = None, sign: int = 1) -> list[PourRecording]:
    """Record a first day on the virtual dosing bench, which is not the model of any fit.

    Args:
        folder: of the recordings; it exists and has none of them.
        seed: of the bench.
        wrong: one of `WRONG`: lag 1 s, 42 % repeated readings, grip 1°, height 2 mm, viscosity × or / `VISCOUS`.
        sign: of the error of grip, height and viscosity, 1 or -1.

    Raises:
        InvalidArgumentError: an unknown name.
        OSError: a file exists or can't be written.
    """
    if wrong is not None and wrong not in WRONG:
        raise InvalidArgumentError(f"{wrong}: can't be wrong on the practice bench; known are {', '.join(WRONG)}")
    rng = np.random.default_rng((seed, 15))
    scale = TrueScale(
        str(rng.choice(["first", "fourth", "average"])),  # type: ignore[arg-type]
        1.0 if wrong == "lag" else float(rng.uniform(0.2, 0.4)),
        step=1e-4,
        behaviour=DisplayBehaviour(repeat_probability=0.42 if wrong == "holds" else 0.0),
    )
    water = Liquid(mass=0.3)
    thick = water.model_copy(update={"dynamic_viscosity": float(rng.uniform(*VISCOUS))})
    assumed, true = water, water
    if wrong == "viscosity":
        assumed, true = (water, thick) if sign > 0 else (thick, water)
    cup = replace(CUP, height=CUP.height + (2e-3 * sign if wrong == "height" else 0.0))
    held = math.radians(1.0) * sign if wrong == "grip" else 0.0
    bench = VirtualDosingBench(cup, true, scale, seed, held_tilt=held)
    pourer = cylinder("beaker", inner_radius=CUP.radius, inner_height=CUP.height)
    receiver = cylinder("tumbler", inner_radius=0.035, inner_height=0.090)
    recordings = []
    for number, step in enumerate(first_day(pourer, assumed.density)):
        bench.refill(step.fill)
        placed = bench.place_receiver()
        scene = Scene(step.name, pourer, receiver, assumed.model_copy(update={"mass": step.fill}))
        if step.amount is None:
            record = bench.dose(_PlannedTilt(step), DosingFault("miss", 0.0) if step.misses else NO_FAULT)
        else:
            series = DoseSeries(
                flow_of(scene), DosingSettings(), SourceContent(step.fill), placed, rng, particles=60, step=scale.step
            )
            order = DoseOrder(step.amount, receiver_mass=bench.receiver_mass)
            record = bench.dose(series.controller(order, seed=seed + number))
        every = slice(None, None, 3)
        columns = {
            "tilt_deg": list(zip(record.times[every], np.degrees(record.tilts[every]).round(3), strict=True)),
            "mass_g": [(reading.time - PLACED_BEFORE, round(1e3 * reading.mass, 3)) for reading in placed]
            + [(reading.time, round(1e3 * reading.mass, 3)) for reading in record.readings],
        }
        path = write_recording(
            folder / f"{step.name}.yaml",
            scene,
            columns,
            recorded={
                "how": "virtual dosing bench: tilt of the arm, readings as they arrived",
                "licence": "Apache-2.0",
            },
            placement={"x_offset": "90 mm", "height": "80 mm"},
            balance={"model": "emulated", "step": "0.1 g"},
            fill_deviation=0.5e-3,
        )
        recordings.append(load_recording(path))
    return recordings
