"""`flow_comparison`: onset and factor of a simulated flow, and what the estimator assumes because of them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from actors.dosing.dose_estimator import FLOW_FACTOR, ONSET
from actors.dosing.flow_comparison import FlowComparison, compare_flows
from sim_engine.liquids import Liquid, SimulationParameters
from sim_engine.scene import Scene
from sim_engine.vessel.shapes import cylinder
from tests.support.equation_pours import EquationPours

SCENE = Scene(
    "doses",
    cylinder("beaker", inner_radius=0.04, inner_height=0.1),
    cylinder("bowl", inner_radius=0.06, inner_height=0.1),
    Liquid(mass=0.35),
    fixed={"angular_velocity": 1.0, "x_offset": 0.06, "height": 0.12},
)


def compared(pours: EquationPours) -> FlowComparison:
    return compare_flows(SCENE, 0.05, SimulationParameters(), pours)


@pytest.mark.parametrize(("onset", "factor"), [(0.8, 1.0), (2.0, 0.7), (-1.0, 1.1)])
def test_onset_and_factor_of_a_flow_are_found(onset: float, factor: float) -> None:
    found = compared(EquationPours(math.radians(onset), factor))
    assert math.degrees(found.onset) == pytest.approx(onset, abs=0.3)
    assert found.factor == pytest.approx(factor, abs=0.1)
    assert found.simulated[-1] == pytest.approx(0.05, abs=2e-3)
    assert found.left_over < 0.5e-3
    assert not found.differs(1e-3)


def test_a_flow_that_no_onset_and_factor_explain_differs() -> None:
    found = compared(EquationPours(stops=1.0))
    assert found.left_over > 1e-3
    assert found.differs(1e-3)
    assert not found.differs(2.0 * found.left_over)


def test_a_usual_flow_leaves_the_first_belief_and_an_unusual_one_widens_it() -> None:
    usual, late = (compared(EquationPours(math.radians(degrees))).knowledge() for degrees in (0.8, 3.0))
    deviations = [np.sqrt(np.reshape(shown.covariance, (2, 2)).diagonal()) for shown in (usual, late)]
    assert deviations[0] == pytest.approx([ONSET[1], FLOW_FACTOR[1]], rel=0.05)
    assert math.degrees(deviations[1][0]) > 2.0
    assert usual.onset_flow == late.onset_flow == (ONSET[0], 0.0)
    assert (late.doses, late.lag) == (0, None)
