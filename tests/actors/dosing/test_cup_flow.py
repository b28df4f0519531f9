"""`CupFlow`: its short cuts give what the plain formulas give."""

from __future__ import annotations

import math

import numpy as np
import pytest

from actors.dosing.cup_flow import CupFlow, median, quantile
from orchestrator.campaigns.file_loading import load_vessel
from sim_engine.hydrostatics import DISCHARGE
from sim_engine.liquids import Liquid
from sim_engine.vessel.vessel import build_vessel


@pytest.mark.parametrize("count", [1, 2, 7, 128])
def test_median_and_quantiles_are_those_of_numpy(count: int) -> None:
    values = np.random.default_rng(count).normal(size=count)
    assert median(values) == np.median(values)
    if count > 1:
        for share in (0.0, 0.03, 0.35, 0.5, 1.0):
            assert quantile(values, share) == pytest.approx(np.quantile(values, share), rel=1e-12)


def test_the_slowest_clean_flow_is_that_of_the_whole_opening() -> None:
    cup = CupFlow(build_vessel(load_vessel("configs/vessels/beaker.yaml")), Liquid(mass=0.2))
    for tilt in np.radians([20.0, 61.3, 90.0]):
        depth = np.maximum(cup._head_grid[:, None] - cup._s * math.sin(tilt), 0.0)
        area = ((depth > 0.0) * cup._width) @ np.gradient(cup._s)
        wide = np.maximum(((depth > 0.0) * cup._width).max(axis=1), 1e-6)
        flow, film = cup._row(tilt), np.maximum(DISCHARGE * area / wide, 1e-9)
        weber = cup.density * (flow / (wide * film)) ** 2 * film / cup._tension
        for limit in (1.0, 4.0):
            assert cup.clean_flow(tilt, limit) == flow[np.flatnonzero(weber >= limit)[0]]
