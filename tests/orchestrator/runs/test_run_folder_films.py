"""Moments of a dose of particles that a run keeps, and the film strip that its report shows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.learning.dispense import Dispensed, Dose
from orchestrator.reports.pour_figures import film_strip
from orchestrator.reports.run_figures import draw_figures
from orchestrator.runs.run_folder import KEPT_MOMENTS, dose_film_file, dose_moments, read_film, write_film
from orchestrator.runs.stages import DOSES
from sim_engine.outcome import ParticleState, RecordedFrames
from tests.support import small_campaign

COUNT = 40
ASIDE = (0.05, 0.0, 0.01)


def frames() -> RecordedFrames:
    """Twenty particles leave the pourer one after the other; the last five are spilled."""
    states = [np.full(COUNT, ParticleState.IN_POURER, np.uint8) for _ in range(100)]
    for i, each in enumerate(states):
        gone = min(max(i - 30, 0) // 2, 20)
        each[:gone] = ParticleState.RECEIVED
        each[15:gone] = ParticleState.SPILLED
    poses = np.tile([-0.07, 0.0, 0.1, 1.0, 0.0, 0.0, 0.0], (100, 1))
    return RecordedFrames(0.1 * np.arange(100), [np.zeros((COUNT, 3), np.float32)] * 100, states, poses, ASIDE)


def test_a_report_shows_the_film_of_a_dose_that_its_run_kept(tmp_path: Path) -> None:
    plan = load_campaign(small_campaign.write_campaign(tmp_path, small_campaign.series(20, 12)))
    assert plan.dispense is not None
    kept = dose_moments(plan.dispense.scenes[0], 0.1, frames())
    assert kept.frames is not None
    assert len(kept.frames.times) <= KEPT_MOMENTS
    left = [float(np.mean(states != ParticleState.IN_POURER)) for states in kept.frames.states]
    assert (left[0], left[-1]) == (0.0, 0.5)
    assert np.diff(left).max() < 0.1
    assert (kept.outcome.received, kept.outcome.spilled, kept.outcome.retained) == (0.375, 0.125, 0.5)
    assert kept.outcome.spacing == pytest.approx((0.1 / plan.dispense.scenes[0].liquid.density / COUNT) ** (1 / 3))
    write_film(dose_film_file(tmp_path, 1), kept)
    film = read_film(dose_film_file(tmp_path, 1))
    assert film.outcome == kept.outcome
    # the receiver stands where the liquid has met it
    for axes in film_strip(plan.dispense.scenes[0], film, title="").axes:
        across, up = axes.patches[-1].get_path().vertices.T  # type: ignore[attr-defined]
        assert (0.5 * (across.min() + across.max()), up.min()) == pytest.approx((ASIDE[0], ASIDE[2]), abs=1e-3)
    dose = Dose(number=1, wanted_g=20, received_g=20, spilled_g=0, duration_s=9, end="reached", source="beaker")
    doses = (dose, dose.model_copy(update={"number": 2}))
    drawn = draw_figures(tmp_path, plan, {DOSES: Dispensed(scene="", doses=doses)})
    assert set(drawn) == {"film of dose 1"}
    assert drawn["film of dose 1"].read_bytes().startswith(b"\x89PNG")
