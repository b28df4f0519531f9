"""`convergence`: what was learnt with one number of particles holds with another."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from benchmarks.validation.convergence import CHOSEN, FOUND, ConvergencePour, spillage
from sim_engine.liquids import SimulationParameters
from sim_engine.simulator import PourSimulator

HIDDEN = 0.12
"""Friction of the liquid that is calibrated on."""
TRIED = (0.0, 0.06, 0.12, 0.18, 0.3)
TRAINING = (FOUND[1], FOUND[3], FOUND[5])
ELSEWHERE = (FOUND[2], FOUND[6], CHOSEN[4])


INTO_THE_NARROW_CUP = FOUND[4]


@pytest.mark.slow
def test_without_a_viscosity_of_eddies_coarse_particles_scatter_their_stream(simulator: PourSimulator) -> None:
    without, with_theirs = (
        spillage(
            simulator,
            INTO_THE_NARROW_CUP,
            SimulationParameters(particles=500, cohesion=0.0, smagorinsky_constant=c),
            seed=1,
        )[0]
        for c in (0.0, 0.17)
    )
    assert without > with_theirs + 0.02


def spilled(
    simulator: PourSimulator, pours: tuple[ConvergencePour, ...], particles: int, friction: float
) -> NDArray[np.float64]:
    theta = SimulationParameters(particles=particles, cohesion=0.0, xsph_rate=1.0, friction=friction)
    return np.array([spillage(simulator, pour, theta, seed=1)[0] for pour in pours])


@pytest.mark.slow
def test_what_is_calibrated_with_few_particles_predicts_with_more(simulator: PourSimulator) -> None:
    """Friction that is found by 1,000 particles on pours of 3,000 is theirs, and holds for other vessels at 500."""
    weighed = spilled(simulator, TRAINING, 3_000, HIDDEN)
    errors = [float(np.abs(spilled(simulator, TRAINING, 1_000, f) - weighed).mean()) for f in TRIED]
    found = TRIED[int(np.argmin(errors))]
    assert abs(found - HIDDEN) <= 0.06
    assert max(errors) > 1.5 * min(errors)  # the pours tell frictions apart
    truth = spilled(simulator, ELSEWHERE, 3_000, HIDDEN)
    predicted = spilled(simulator, ELSEWHERE, 500, found)
    assert float(np.abs(predicted - truth).mean()) < 0.04
