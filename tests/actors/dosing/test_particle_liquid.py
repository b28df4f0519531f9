"""`particle_liquid`: the dose controller pours particles."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from actors.dosing.cup_flow import CupFlow
from actors.dosing.dose_controller import DoseOrder
from actors.dosing.dose_series import DoseSeries, SourceContent
from actors.dosing.particle_liquid import ParticleLiquid
from actors.dosing.virtual_dosing_bench import TrueCup, TrueScale, VirtualDosingBench
from actors.dosing_settings import DosingSettings
from actors.interfaces import DoseEnd
from actors.simulators.live_worker import LocalLivePours
from sim_engine.action import DEG, Action
from sim_engine.liquids import Liquid, SimulationParameters
from sim_engine.scene import PoseError, PourTask, Scene
from sim_engine.simulator import PourSimulator
from sim_engine.vessel.shapes import cylinder

BEAKER, BOWL = (
    cylinder(name, inner_radius=radius, inner_height=0.1) for name, radius in (("beaker", 0.04), ("b", 0.06))
)
ACTION = Action(angular_velocity=60 * DEG, x_offset=0.07, height=0.13, hold_time=0.0)


@pytest.fixture(scope="module")
def simulator() -> Iterator[PourSimulator]:
    started = PourSimulator()
    yield started
    started.close()


def particles(simulator: PourSimulator, bench: VirtualDosingBench, aside: float = 0.0) -> ParticleLiquid:
    """The content of a bench's beaker, of which 1 g is a particle."""
    theta = SimulationParameters(particles=round(300 * bench.content / 0.3))
    scene = Scene("dose", BEAKER, BOWL, Liquid(mass=bench.content))
    task = PourTask(scene, ACTION, theta, 1, pose_error=PoseError(x=aside))
    return ParticleLiquid(bench, LocalLivePours(simulator), task)


def benches(simulator: PourSimulator, aside: float = 0.0) -> tuple[VirtualDosingBench, DoseSeries]:
    """A beaker with 300 g of water as 300 particles, and the doses from it."""
    bench = VirtualDosingBench(
        TrueCup(0.04, 0.1),
        Liquid(mass=0.3),
        TrueScale(lag=0.2),
        3,
        poured=lambda bench: particles(simulator, bench, aside),
    )
    flow, rng = CupFlow(simulator.vessel(BEAKER), Liquid(mass=0.1)), np.random.default_rng(3)
    return bench, DoseSeries(flow, DosingSettings(), SourceContent(0.3), bench.place_receiver(), rng, particles=60)


@pytest.mark.slow
def test_the_impact_of_a_stream_weighs_as_much_as_the_liquid_in_the_air(simulator: PourSimulator) -> None:
    bench, _ = benches(simulator)
    liquid, impacts, in_the_air = particles(simulator, bench), [], []
    for k in range(430):  # 65° in 1.5 s
        load = liquid.step(65 * DEG * min(k / 300, 1.0), 0.0)
        if liquid.received > 0.02:
            impacts.append(load - liquid.received)
            in_the_air.append(0.3 - bench.content - liquid.received - liquid.spilled)
    assert len(impacts) > 50
    assert np.mean(impacts) == pytest.approx(np.mean(in_the_air), rel=0.3)


@pytest.mark.slow
def test_a_dose_of_particles_meets_its_amount_and_the_source_keeps_the_rest(simulator: PourSimulator) -> None:
    bench, series = benches(simulator)
    controller = series.controller(DoseOrder(0.08, receiver_mass=bench.receiver_mass), seed=1)
    record, result = bench.dose(controller), controller.result
    assert result is not None
    assert result.end in (DoseEnd.REACHED, DoseEnd.MISSED)
    assert record.received == pytest.approx(0.08, abs=4e-3)  # four particles
    assert result.amount == pytest.approx(record.received, abs=0.5e-3)
    assert bench.content == pytest.approx(0.3 - record.received - record.spilled, abs=1e-3)


@pytest.mark.slow
def test_a_stream_beside_the_receiver_is_spilled_and_stops_the_dose(simulator: PourSimulator) -> None:
    bench, series = benches(simulator, aside=0.15)
    controller = series.controller(DoseOrder(0.06, receiver_mass=bench.receiver_mass), seed=1)
    record = bench.dose(controller)
    assert controller.result is not None
    assert controller.result.end is DoseEnd.STREAM_MISSED
    assert record.received < 1e-3
    assert 0.0 < record.spilled < 0.06
