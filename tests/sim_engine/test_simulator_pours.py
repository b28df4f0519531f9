"""`simulator`: simulated pours: what goes in comes out, and physics that anybody can check."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

from sim_engine.action import DEG, Action
from sim_engine.hydrostatics import retained_volume, tilting_cup_outflow
from sim_engine.liquids import Liquid, SimulationParameters
from sim_engine.outcome import SimulatedPour
from sim_engine.scene import PoseError, PourTask, SampledMotion, Scene
from sim_engine.simulator import InvalidSceneError, PourSimulator, SimulationCancelled
from sim_engine.vessel.shapes import VesselSpec, cylinder
from sim_engine.vessel.vessel import build_vessel

CUP = cylinder("cup", inner_radius=0.04, inner_height=0.10)
GLASS = cylinder("glass", inner_radius=0.045, inner_height=0.09)
WATER = Liquid(mass=0.1996)  # 200 mL
IN_FLIGHT, RECEIVED = 1, 2


def task(
    particles: int = 600,
    *,
    pourer: VesselSpec = CUP,
    receiver: VesselSpec = GLASS,
    liquid: Liquid = WATER,
    seed: int = 1,
    frame_rate: float = 0.0,
    pose_error: PoseError | None = None,
    parameters: dict[str, float] | None = None,
    **action: float | None,
) -> PourTask:
    values: dict[str, float | None] = {
        "angular_velocity": 60 * DEG,
        "x_offset": 0.095,
        "height": 0.06,
        "max_angle": 120 * DEG,
        "hold_time": 0.5,
        **action,
    }
    theta = SimulationParameters.from_values({"particles": particles, "xsph_rate": 1.0, **(parameters or {})})
    scene = Scene("test", pourer, receiver, liquid, mirrored=True)
    return PourTask(scene, Action.compose({}, values), theta, seed, frame_rate, pose_error)


def run(simulator: PourSimulator, **kwargs: object) -> SimulatedPour:
    return simulator.simulate(task(**kwargs))  # type: ignore[arg-type]


@pytest.fixture(scope="module", params=[False, True], ids=["whole", "mirrored"], autouse=True)
def mirrored(request: pytest.FixtureRequest) -> Iterator[None]:
    """Every pour is simulated as a whole, and by half where it is symmetric: the criteria are the same."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("sim_engine.simulator.MIRRORED_FROM", 0 if request.param else 10**9)
        yield


@pytest.fixture(scope="module")
def plain(simulator: PourSimulator, mirrored: None) -> SimulatedPour:
    return run(simulator, frame_rate=20.0)


def test_every_particle_is_accounted_for(plain: SimulatedPour) -> None:
    o = plain.outcome
    assert o.received + o.spilled + o.retained + o.in_flight + o.escaped == pytest.approx(1.0)
    assert o.invalid is None
    assert o.escaped == 0.0
    assert o.particles == 600
    assert o.spacing == pytest.approx((200e-6 / 600) ** (1 / 3), rel=1e-6)
    assert o.cpu_s > 0
    assert o.steps > 100


def test_most_of_an_easy_pour_arrives(plain: SimulatedPour) -> None:
    assert plain.outcome.received > 0.9
    assert plain.outcome.retained < 0.02


def test_the_outflow_curve_only_rises_and_ends_at_the_outcome(plain: SimulatedPour) -> None:
    o = plain.outcome
    poured = np.array(o.curve_poured)
    assert np.all(np.diff(o.curve_times) > 0)
    assert poured[0] == 0.0
    assert np.min(np.diff(poured)) > -0.01  # a few particles may fall back at the lip
    assert poured[-1] == pytest.approx(1.0 - o.retained, abs=1e-6)


def test_same_seed_same_bits_and_recording_changes_nothing(simulator: PourSimulator, plain: SimulatedPour) -> None:
    again = run(simulator)
    assert replace(again.outcome, cpu_s=0.0) == replace(plain.outcome, cpu_s=0.0)
    assert again.frames is None
    other = run(simulator, seed=2)
    assert other.outcome.curve_poured != plain.outcome.curve_poured
    assert other.outcome.received == pytest.approx(plain.outcome.received, abs=0.06)


def test_a_vessel_comes_back_after_many_others(simulator: PourSimulator, plain: SimulatedPour) -> None:
    for k in range(40):
        simulator.vessel(cylinder(f"cup {k}", inner_radius=0.03 + 1e-4 * k, inner_height=0.06))
    again = run(simulator).outcome
    assert (again.spilled, again.received) == (plain.outcome.spilled, plain.outcome.received)


def test_frames_follow_each_particle_and_the_cup(plain: SimulatedPour) -> None:
    frames = plain.frames
    assert frames is not None
    assert len(frames.times) == len(frames.positions) == len(frames.states) == len(frames.pourer_poses)
    steps = [np.linalg.norm(b - a, axis=1).max() for a, b in itertools.pairwise(frames.positions)]
    assert max(steps) < 3.0 * 0.06  # nobody moves faster than 3 m/s between two frames
    assert np.mean(frames.states[0] == 0) == 1.0
    assert np.mean(frames.states[-1] == RECEIVED) == pytest.approx(plain.outcome.received)


def test_liquid_in_flight_falls_with_g(simulator: PourSimulator) -> None:
    frames = run(simulator, frame_rate=50.0, height=0.3, parameters={"xsph_rate": 0.0, "cohesion": 0.0}).frames
    assert frames is not None
    accelerations = []
    for k in range(len(frames.times) - 2):
        flying = (frames.states[k] == IN_FLIGHT) & (frames.states[k + 2] == IN_FLIGHT)
        flying &= (frames.positions[k][:, 2] < 0.36) & (frames.positions[k + 2][:, 2] > 0.12)
        if flying.sum() < 5:
            continue
        z = [frames.positions[j][flying, 2].astype(float) for j in (k, k + 1, k + 2)]
        t = frames.times[k : k + 3]
        slopes = [(z[1] - z[0]) / (t[1] - t[0]), (z[2] - z[1]) / (t[2] - t[1])]
        accelerations.append(np.mean(slopes[1] - slopes[0]) / (0.5 * (t[2] - t[0])))
    assert len(accelerations) > 5
    assert np.mean(accelerations) == pytest.approx(-9.81, rel=0.02)


def test_a_cup_at_rest_holds_its_true_volume(simulator: PourSimulator) -> None:
    """200 mL in R = 40 mm stand 39.8 mm high: with the centres of mass at half of it."""
    frames = run(simulator, particles=2000, max_angle=5 * DEG, hold_time=0.6, frame_rate=20.0).frames
    assert frames is not None
    still = frames.positions[-1].astype(float)  # upright again
    floor = frames.pourer_poses[-1, 2] + build_vessel(CUP).inner_floor
    assert 2.0 * np.mean(still[:, 2] - floor) == pytest.approx(0.0398, rel=0.02)
    radius = np.hypot(still[:, 0] - frames.pourer_poses[-1, 0], still[:, 1])
    assert radius.max() < 0.04


def test_liquid_is_hardly_compressed(simulator: PourSimulator) -> None:
    assert run(simulator, particles=2000).outcome.density_error < 0.02


@pytest.mark.slow
@pytest.mark.parametrize("angle", [pytest.param(70, marks=pytest.mark.slow), 80])
def test_what_is_left_shortly_after_a_turn_is_what_the_flow_over_a_weir_leaves(
    simulator: PourSimulator, angle: int
) -> None:
    """A second and a half after the turn more is left than at rest: within 2 % of the brimful volume."""
    o = run(
        simulator, particles=2000, angular_velocity=20 * DEG, max_angle=angle * DEG, hold_time=1.5, return_velocity=None
    ).outcome
    cup = build_vessel(CUP)
    times = np.arange(0.0, angle / 20 + 1.5, 0.01)
    poured = tilting_cup_outflow(cup, WATER.volume, times, np.minimum(20 * times, angle) * DEG, discharge=0.7)
    assert o.retained * WATER.volume == pytest.approx(WATER.volume - poured[-1], abs=0.02 * cup.capacity)
    assert o.retained * WATER.volume > retained_volume(cup, angle * DEG)


def test_a_receiver_out_of_reach_gets_nothing(simulator: PourSimulator) -> None:
    o = run(simulator, particles=300, x_offset=0.3).outcome
    assert o.spilled > 0.95
    assert o.received == 0.0


def test_drips_of_the_return_belong_to_the_pour(simulator: PourSimulator) -> None:
    kept = run(simulator, max_angle=75 * DEG, hold_time=0.3, frame_rate=20.0)
    assert kept.frames is not None
    assert kept.frames.pourer_poses[-1, 5] == pytest.approx(0.0, abs=0.02)  # upright again
    assert kept.outcome.retained > 0.1
    assert kept.outcome.in_flight == 0.0


@pytest.mark.slow
@pytest.mark.parametrize(
    ("wall", "particles", "speed"),
    [
        (0.001, 500, 180),
        pytest.param(0.001, 3000, 180, marks=pytest.mark.slow),
        (0.002, 800, 120),
    ],
)
def test_thin_walls_hold_fast_liquid(simulator: PourSimulator, wall: float, particles: int, speed: float) -> None:
    thin = {
        "pourer": cylinder("thin cup", inner_radius=0.03, inner_height=0.09, wall=wall, floor=wall),
        "receiver": cylinder("thin glass", inner_radius=0.035, inner_height=0.08, wall=wall, floor=wall),
    }
    o = run(simulator, particles=particles, liquid=Liquid(mass=0.15), angular_velocity=speed * DEG, **thin).outcome
    assert o.escaped == 0.0
    assert o.invalid is None


def test_viscosity_and_cohesion_are_felt(simulator: PourSimulator) -> None:
    easy = {"max_angle": 100 * DEG, "x_offset": 0.11}
    thin = run(simulator, parameters={"xsph_rate": 0.0, "cohesion": 0.0}, **easy).outcome
    thick = run(simulator, parameters={"xsph_rate": 40.0, "cohesion": 0.0}, **easy).outcome
    sticky = run(simulator, parameters={"xsph_rate": 0.0, "cohesion": 0.2}, **easy).outcome
    # What is not felt changes no bit of a pour.
    assert thick.curve_poured[: len(thin.curve_poured)] != thin.curve_poured
    assert sticky.curve_poured[: len(thin.curve_poured)] != thin.curve_poured[: len(sticky.curve_poured)]


def test_errors_of_the_bench_change_the_pour_and_none_is_none(simulator: PourSimulator, plain: SimulatedPour) -> None:
    same = run(simulator, pose_error=PoseError())
    assert replace(same.outcome, cpu_s=0.0) == replace(plain.outcome, cpu_s=0.0)
    off = run(simulator, pose_error=PoseError(x=0.05))
    assert off.outcome.spilled > plain.outcome.spilled + 0.05


def test_cups_that_touch_are_refused_before_anything_is_simulated(simulator: PourSimulator) -> None:
    with pytest.raises(InvalidSceneError, match=r"touch.*mm.*x_offset"):
        run(simulator, x_offset=0.03, height=0.0)


def test_a_load_that_does_not_fit_is_refused(simulator: PourSimulator) -> None:
    with pytest.raises(InvalidSceneError, match=r"502\.7 mL to the brim"):
        run(simulator, liquid=Liquid(mass=0.6))


def test_a_simulation_can_be_given_up(simulator: PourSimulator) -> None:
    calls = []

    def cancelled() -> bool:
        calls.append(1)
        return len(calls) >= 3

    with pytest.raises(SimulationCancelled):
        simulator.simulate(task(), cancelled=cancelled)
    assert len(calls) == 3
    assert run(simulator).outcome.invalid is None  # and the simulator is ready for the next


def test_what_an_arm_did_is_simulated_in_place_of_what_was_planned(
    simulator: PourSimulator, plain: SimulatedPour
) -> None:
    planned = simulator.prepare(task())
    times = np.append(np.arange(0.0, planned.duration, 0.008), planned.duration)
    same = simulator.simulate(replace(task(), motion=SampledMotion(times, planned.sample(times)))).outcome
    assert same.fractions.spilled == pytest.approx(plain.outcome.fractions.spilled, abs=0.03)
    assert same.fractions.poured == pytest.approx(plain.outcome.fractions.poured, abs=0.03)
    # An arm that stopped early has poured less.
    stopped = times[times < 1.1]  # at 66 of 120 degrees
    half = simulator.simulate(replace(task(), motion=SampledMotion(stopped, planned.sample(stopped)))).outcome
    assert half.fractions.retained > plain.outcome.fractions.retained + 0.2
    with pytest.raises(ValueError, match="executed motion"):
        replace(task(pose_error=PoseError(tilt=0.01)), motion=SampledMotion(times, planned.sample(times)))
