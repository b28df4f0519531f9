"""A liquid whose spillage is a formula, for simulators in processes of their own: light to import, quick to answer.

What is simulated along a motion is the bench's liquid: only as much is poured as the motion came to, and each such pour
is written down, whoever dies afterwards.
"""

from __future__ import annotations

import hashlib
import math
import os
import time
from collections.abc import Callable
from pathlib import Path

from sim_engine.outcome import PourOutcome, SimulatedPour
from sim_engine.scene import PourTask

LOG = "DECANT_TEST_POURED"
"""Variable that names the file in which pours of the bench's liquid are written down."""

WORK = "DECANT_TEST_SIMULATED_S"
"""Variable that says how long a simulation takes [s]; 0 without it."""

WHOLE = 0.97
"""A motion that came to this share of its angle has poured everything."""


class Formula:
    """See `actors.simulators.job_runner.Simulator`."""

    def simulate(self, task: PourTask, *, cancelled: Callable[[], bool] | None = None) -> SimulatedPour:
        """A spillage by action, θ and seed, in thousandths."""
        share = 1.0
        if task.motion is not None:
            share = float(task.motion.tilt(task.motion.times).max()) / task.action.max_angle
            share = 1.0 if share > WHOLE else round(share, 3)
            with Path(os.environ[LOG]).open("a", encoding="utf-8") as file:
                file.write(f"{task.seed}\n")
        else:
            time.sleep(float(os.environ.get(WORK, "0")))  # how long a simulation takes
        spilled = share * spillage(task)
        retained = 1.0 - share * 0.99
        outcome = PourOutcome(
            received=1.0 - spilled - retained,
            spilled=spilled,
            retained=retained,
            in_flight=0.0,
            escaped=0.0,
            particles=500,
            spacing=0.0073,
            density_error=0.01,
            simulated_time=2.0,
            steps=400,
            cpu_s=0.01,
            seed=task.seed,
            curve_times=(0.0, 1.0),
            curve_poured=(0.0, 1.0 - retained),
            curve_spilled=(0.0, spilled),
        )
        return SimulatedPour(outcome)

    def close(self) -> None:
        """Nothing is kept."""


def spillage(task: PourTask) -> float:
    """As a share of the load."""
    action = task.action
    speed, offset = action.angular_velocity / math.pi, action.x_offset / 0.1
    chance = int.from_bytes(hashlib.sha256(str(task.seed).encode()).digest()[:6], "big") / 2**48
    noise = 0.02 * chance + 0.2 * abs(task.parameters.cohesion - 0.05)
    return round(min(0.01 + 0.15 * (speed - 0.55) ** 2 + 0.2 * (offset - 0.75) ** 2 + noise, 0.3), 3)
