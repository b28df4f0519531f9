"""Replay of a recorded pour: the simulator follows its tilt, and the dosing estimator reads its readings.

- `simulate` moves the vessel along the recorded tilt in the particle simulator, and returns the poured mass.
- `estimate` runs `actors.dosing.dose_estimator` over the recorded readings, without acting. It is the only place here
  that drives the estimator.
- `replay_recording` does both and compares them with the readings: `PourReplay`.

A replay predicts, except for the values that `ReplayValues` takes from a fit, and for the lag of the balance: the
simulation's readings have the lag that the estimator found in the same recording. Reports name both.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from actors.dosing.cup_flow import flow_of
from actors.dosing.dose_estimator import DoseBelief, DoseEstimator, DoseReading, draw_lags
from actors.dosing.pour_response import displayed, fall_time
from orchestrator.recordings.recording_file import PourRecording
from orchestrator.recordings.time_series import Arrivals, arrivals
from sim_engine.action import DEG, Action
from sim_engine.errors import InvalidSceneError
from sim_engine.liquids import Liquid, SimulationParameters
from sim_engine.motion import recorded_motion
from sim_engine.scene import PourTask, Scene
from sim_engine.shared_simulator import SharedSimulator
from sim_engine.simulator import PourSimulator
from sim_engine.vessel.shapes import ProfileShape, VesselSpec
from sim_engine.vessel.vessel import build_vessel, check_holds

Floats = NDArray[np.float64]

LEVEL = 0.9
"""Probability of all intervals here."""

QUANTILE = 1.6449
"""Standard deviations of a normal distribution on either side that contain it."""

HYPOTHESES = 100
"""Particles of the estimator."""

SEEN = 0.5e-3
"""Rise of the reading that counts as the onset [kg]; three steps of the display if they are more."""


TURNED_BACK, AFTERWARDS = math.radians(10.0), 1.5
"""Angle by which a cup is below its largest tilt for good [rad], and the time after which its liquid has landed [s]:
the simulation ends then. The surface is about 7 mm lower at the lip, more than the head of a stream."""


@dataclass(frozen=True)
class ReplayValues:
    """Values that differ from a recording's file, for example fitted ones (`orchestrator.recordings.recording_fit`).

    Attributes:
        grip: further tilt of the vessel [rad].
        height: by which the vessel is higher than its shape [m].
        fill: further mass in the pourer [kg].
        viscosity: true viscosity over the liquid's.
        lag: of the balance [s]; None: as the estimator finds it.
        fitted_on: names of the recordings that they were fitted on.
    """

    grip: float = 0.0
    height: float = 0.0
    fill: float = 0.0
    viscosity: float = 1.0
    lag: float | None = None
    fitted_on: tuple[str, ...] = ()

    def scene(self, recording: PourRecording) -> Scene:
        """The scene of a recording with these values.

        Raises:
            InvalidSceneError: the vessel cannot be changed or cannot hold the liquid.
        """
        scene = recording.scene
        liquid = scene.liquid
        mass = liquid.mass + self.fill
        if mass <= 0.0:
            raise InvalidSceneError(f"{recording.name}: the pourer would hold {1e3 * mass:.4g} g")
        changed = {"mass": mass, "dynamic_viscosity": self.viscosity * liquid.dynamic_viscosity}
        liquid = Liquid(**liquid.model_dump() | changed)
        return replace(scene, pourer=taller(scene.pourer, self.height), liquid=liquid)


def taller(spec: VesselSpec, by: float) -> VesselSpec:
    """A vessel whose rim is higher; all points move in proportion.

    Args:
        spec: the vessel.
        by: rise of the rim [m]; negative for a lower one.

    Raises:
        InvalidSceneError: it is a mesh, or as low as that.
    """
    if by == 0.0:
        return spec
    outline: ProfileShape | None = spec.shape.outline()
    if outline is None:
        raise InvalidSceneError(f"{spec.name}: the height of a mesh can't be changed; give the vessel as a profile")
    height = outline.inner[-1][1]
    if height + by <= 0.0:
        raise InvalidSceneError(f"{spec.name}: is {1e3 * height:.4g} mm high, and should be {-1e3 * by:.4g} mm lower")
    inner = tuple((r, z * (1.0 + by / height)) for r, z in outline.inner)
    return VesselSpec(name=spec.name, shape=outline.with_values(inner=inner))


def time_of_fall(recording: PourRecording) -> float:
    """Time of the stream from the lip to the middle of the receiver [s]."""
    receiver = build_vessel(recording.scene.receiver)
    return fall_time(recording.placement.height + 0.5 * (receiver.rim_height - receiver.inner_floor))


def simulate(
    recording: PourRecording,
    values: ReplayValues = ReplayValues(),
    *,
    parameters: SimulationParameters | None = None,
    seed: int = 0,
    simulator: PourSimulator | None = None,
) -> tuple[Floats, Floats, float]:
    """Simulate the recorded tilt with particles.

    Args:
        recording: the pour.
        values: other values than its file's.
        parameters: θ, with the number of particles; 1,000 unless given.
        seed: of the initial positions.
        simulator: reused for several pours.

    Returns:
        Times on the recording's clock (T,) [s], mass past the lip that is not spilled (T,) [kg], and CPU time [s].

    Raises:
        InvalidSceneError: the scene is impossible, or the simulation invalid.
    """
    scene = values.scene(recording)
    pourer, receiver = build_vessel(scene.pourer), build_vessel(scene.receiver)
    check_holds(pourer, scene.liquid.volume)
    place = recording.placement
    action = Action(angular_velocity=60 * DEG, x_offset=place.x_offset, y_offset=place.y_offset, height=place.height)
    times, tilts = _while_it_flows(recording)
    motion = recorded_motion(scene, action, pourer, receiver, times, tilts + place.grip + values.grip)
    task = PourTask(scene, action, parameters or SimulationParameters(particles=1000), seed, motion=motion)
    pool = simulator or SharedSimulator()
    try:
        outcome = pool.simulate(task).outcome
    finally:
        if simulator is None:
            pool.close()
    if outcome.invalid is not None:
        raise InvalidSceneError(f"{recording.name}: the simulation is invalid: {outcome.invalid}")
    times = np.asarray(outcome.curve_times) + recording.tilt_times[0]
    mass = scene.liquid.mass * (np.asarray(outcome.curve_poured) - np.asarray(outcome.curve_spilled))
    return times, mass, outcome.cpu_s


def _while_it_flows(recording: PourRecording) -> tuple[Floats, Floats]:
    """Times and tilts without the rest after the pour."""
    times, tilts = recording.tilt_times, recording.tilts
    high = np.flatnonzero(tilts > tilts.max() - TURNED_BACK)
    end = int(np.searchsorted(times, times[high[-1]] + AFTERWARDS)) + 1
    return times[: max(end, 2)], tilts[: max(end, 2)]


@dataclass(frozen=True, eq=False)
class EstimatedPour:
    """What the estimator made of the readings, each predicted from the ones before it.

    Attributes:
        times: of the readings (R,) [s].
        predicted: mean (R,) [kg].
        deviation: standard deviation of the prediction of the reading (R,) [kg].
        innovation: reading minus prediction (R,) [kg].
        lag, lag_shape: of the balance: mean, and 5 % and 95 % quantile of the lag [s].
        final: estimated mass past the lip at the end: mean, 5 % and 95 % quantile [kg].
    """

    times: Floats
    predicted: Floats
    deviation: Floats
    innovation: Floats
    lag: tuple[float, float, float]
    lag_shape: float
    final: tuple[float, float, float]


def estimate(recording: PourRecording, values: ReplayValues = ReplayValues(), *, seed: int = 0) -> EstimatedPour:
    """Run the estimator of doses over the readings, without acting.

    Args:
        recording: the pour.
        values: other values than its file's; a fitted lag is kept to within 10 %.
        seed: of the estimator's particles.
    """
    rng = np.random.default_rng((seed, 71))
    scene = values.scene(recording)
    cup = flow_of(scene)
    lag = draw_lags(recording.placed, HYPOTHESES, rng, step=recording.step)
    if values.lag is not None:
        lag = values.lag * np.exp(0.1 * rng.standard_normal(HYPOTHESES)), lag[1]
    volume = scene.liquid.volume, recording.fill_deviation / scene.liquid.density
    estimator = DoseEstimator(
        cup,
        DoseBelief.prior(volume, lag, rng),
        fall_time=time_of_fall(recording),
        step=recording.step,
        noise=recording.balance.noise,
        rng=rng,
    )
    held = recording.placement.grip + values.grip
    estimator.start(float(recording.tilt_times[0]), float(recording.tilts[0]) + held)
    predicted, deviation, innovation = [], [], []
    events = sorted(
        [(float(t), None) for t in recording.tilt_times]
        + [(float(t), float(m)) for t, m in zip(recording.read_times, recording.net, strict=True)],
        key=lambda event: event[0],
    )
    tilts = recording.tilt_at(np.array([time for time, _ in events])) + held
    for (time, mass), tilt in zip(events, tilts, strict=True):
        estimator.advance(time, float(tilt))
        if mass is None:
            continue
        guess = estimator.predicted(time)
        predicted.append(float(guess.mean()))
        deviation.append(math.hypot(float(guess.std()), estimator.deviation()))
        innovation.append(estimator.update(DoseReading(time, mass)))
    return EstimatedPour(
        recording.read_times,
        np.array(predicted),
        np.array(deviation),
        np.array(innovation),
        _spread(estimator.lag),
        float(np.median(estimator.lag_shape)),
        _spread(estimator.mass),
    )


def _spread(values: Floats) -> tuple[float, float, float]:
    low, high = np.quantile(values, [0.5 - 0.5 * LEVEL, 0.5 + 0.5 * LEVEL])
    return float(values.mean()), float(low), float(high)


@dataclass(frozen=True)
class Onset:
    """The moment at which the readings have risen by `SEEN`.

    Attributes:
        time: on the recording's clock [s].
        tilt: recorded tilt then [rad].
    """

    time: float
    tilt: float


@dataclass(frozen=True, eq=False)
class PourReplay:
    """A recorded pour, next to its simulation and its estimate. Masses are without the receiver.

    Attributes:
        values: other values than the file's, and the recordings that they were fitted on.
        simulated: readings that the particle simulation predicts at the times of the readings (R,) [kg]; None without
            a simulation.
        cpu_s: CPU time of the simulation [s].
        estimated: by the estimator.
        onset: of the readings, None if nothing flowed.
        simulated_onset: of the simulated readings.
    """

    recording: PourRecording
    values: ReplayValues
    simulated: Floats | None
    cpu_s: float
    estimated: EstimatedPour
    onset: Onset | None
    simulated_onset: Onset | None
    arrivals: Arrivals
    compared: NDArray[np.bool_] = field(repr=False)

    @property
    def rms(self) -> float | None:
        """Root mean square of reading minus simulation, from one second before the onset on [kg]."""
        return None if self.simulated is None else _rms((self.recording.net - self.simulated)[self.compared])

    @property
    def final_difference(self) -> float | None:
        """Simulated minus measured mass at the end [kg]."""
        return None if self.simulated is None else float(self.simulated[-1]) - self.recording.gain

    @property
    def normalised_innovation(self) -> float:
        """Mean of (innovation / its standard deviation)², from one second before the onset on; 1 if they agree."""
        normalised = (self.estimated.innovation / self.estimated.deviation)[self.compared]
        return float(np.mean(normalised**2))

    @property
    def coverage(self) -> float:
        """Share of the readings inside the estimator's `LEVEL` interval, predicted from the readings before."""
        normalised = np.abs(self.estimated.innovation / self.estimated.deviation)[self.compared]
        return float(np.mean(normalised <= QUANTILE))

    def document(self) -> dict[str, Any]:
        """JSON-ready; masses in grams, angles in degrees."""

        def grams(value: float | None) -> float | None:
            return None if value is None else round(1e3 * value, 4)

        def onset(at: Onset | None) -> dict[str, float] | None:
            return None if at is None else {"time_s": round(at.time, 3), "tilt_deg": round(math.degrees(at.tilt), 2)}

        estimated, values = self.estimated, self.values
        same_file = self.recording.name in values.fitted_on
        return {
            "recording": self.recording.path,
            "readings": len(self.recording.readings),
            "measured_g": grams(self.recording.gain),
            "onset": onset(self.onset),
            "arrivals": {
                "interval_s": round(self.arrivals.interval, 4),
                "longest_gap_s": round(self.arrivals.longest, 4),
                "step_g": grams(self.arrivals.step),
                "repeated": self.arrivals.repeated,
                "rising": self.arrivals.rising,
            },
            "fitted": {
                "lag_s": "on this recording" if values.lag is None else "given",
                "on": list(values.fitted_on),
                "this_recording_was_fitted": same_file,
                "grip_deg": round(math.degrees(values.grip), 4),
                "height_mm": round(1e3 * values.height, 4),
                "fill_g": grams(values.fill),
                "viscosity": values.viscosity,
            },
            "simulation": None
            if self.simulated is None
            else {
                "final_g": grams(float(self.simulated[-1])),
                "final_difference_g": grams(self.final_difference),
                "rms_g": grams(self.rms),
                "onset": onset(self.simulated_onset),
                "cpu_s": round(self.cpu_s, 2),
            },
            "estimator": {
                "final_g": [grams(number) for number in estimated.final],
                "lag_s": [round(number, 4) for number in estimated.lag],
                "innovation_rms_g": grams(_rms(estimated.innovation[self.compared])),
                "normalised_innovation": round(self.normalised_innovation, 3),
                "coverage": round(self.coverage, 3),
            },
            "warnings": [str(warning) for warning in self.recording.warnings],
        }


def replay_recording(
    recording: PourRecording,
    values: ReplayValues = ReplayValues(),
    *,
    parameters: SimulationParameters | None = None,
    seed: int = 0,
    particles: bool = True,
    simulator: PourSimulator | None = None,
) -> PourReplay:
    """Replay a recorded pour.

    Args:
        recording: the pour.
        values: other values than its file's.
        parameters: θ of the simulation.
        seed: of simulation and estimator.
        particles: also simulate; otherwise only the estimator runs.
        simulator: reused for several pours.

    Raises:
        InvalidSceneError: the scene is impossible, or the simulation invalid.
        VesselError: a vessel cannot be built, or holds less than the liquid.
    """
    estimated = estimate(recording, values, seed=seed)
    shown, cpu = None, 0.0
    if particles:
        times, mass, cpu = simulate(recording, values, parameters=parameters, seed=seed, simulator=simulator)
        lag = estimated.lag[0] if values.lag is None else values.lag
        shown = displayed(
            times, mass, recording.read_times, lag=lag, lag_shape=estimated.lag_shape, fall_time=time_of_fall(recording)
        )
    seen = max(SEEN, 3.0 * recording.step)
    onset = onset_of(recording, recording.net, seen)
    begin = recording.read_times[0] if onset is None else onset.time - 1.0
    return PourReplay(
        recording,
        values,
        shown,
        cpu,
        estimated,
        onset,
        None if shown is None else onset_of(recording, shown, seen),
        arrivals(recording.read_times, recording.readings, recording.step),
        recording.read_times >= begin,
    )


def onset_of(recording: PourRecording, net: Sequence[float] | Floats, seen: float) -> Onset | None:
    """The first reading that has risen; None if none has.

    Args:
        recording: gives times and tilts.
        net: readings at its times (R,) [kg].
        seen: rise that counts [kg].
    """
    above = np.flatnonzero(np.asarray(net) > seen)
    if not len(above):
        return None
    time = float(recording.read_times[above[0]])
    return Onset(time, float(recording.tilt_at(np.array([time]))[0]))


def _rms(values: Floats) -> float:
    return float(np.sqrt(np.mean(values**2)))
