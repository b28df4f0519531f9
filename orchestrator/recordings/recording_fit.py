"""Fits unknown quantities of recorded pours, and judges the fit on readings that it has not seen.

- `fit_recordings` fits unknowns of several recordings together: `Fit` with values and intervals.
- `judge_recording` predicts a recording, or the rest of one, from its tilt alone, and compares it with the readings:
  `Judgement`.

The model is the tilting cup with a balance (`actors.dosing.pour_response`), not the particles: a fit takes seconds. It
minimises the weighted squares of reading minus model, together with the squares of the deviations from what is known
before (`UNKNOWNS`). Each recording has an onset, a flow and a fill of its own, which differ a little from pour to pour;
the flow and the shape of the balance's filter are always fitted.

Intervals are those of the linearised model. The deviation of a reading is that of the residuals, and residuals that
hang together count less: n (1 − ρ)/(1 + ρ) of n readings are independent, with ρ the correlation of neighbours.

Readings while the receiver was put on (`PourRecording.placed`) show the lag of the balance before the fit.

Limitations: what a lip holds back shifts the onset like an angle of grip. `grip` is relative to a lip that holds back
0.8° (`actors.dosing.dose_estimator.ONSET`), and is uncertain by `LIP` for this reason. A film that drains late looks
like a lag (`FILM`).
"""

from __future__ import annotations

import json
import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from actors.dosing.cup_flow import flow_of
from actors.dosing.dose_estimator import FACTOR_RANGE, LAG_RANGE, ONSET, SHAPE_RANGE, draw_lags
from actors.dosing.pour_response import PourHypotheses, respond
from orchestrator.recordings.recording_file import PourRecording
from orchestrator.recordings.recording_replay import (
    QUANTILE,
    SEEN,
    Onset,
    ReplayValues,
    onset_of,
    time_of_fall,
)
from orchestrator.recordings.time_series import arrivals
from sim_engine.errors import InvalidArgumentError

Floats = NDArray[np.float64]


@dataclass(frozen=True)
class Unknown:
    """A quantity that can be fitted.

    Attributes:
        unit: of display.
        factor: one display unit in SI.
        middle: before the fit, in SI.
        deviation: before the fit: standard deviation, in SI; of the logarithm, if `logarithmic`.
        logarithmic: whether it is positive, and its logarithm is fitted.
        meaning: for users.
    """

    unit: str
    factor: float
    middle: float
    deviation: float
    logarithmic: bool
    meaning: str

    def at(self, state: Any) -> Any:
        """The value in SI at a state in deviations from the middle; for an array, elementwise."""
        if self.logarithmic:
            return self.middle * np.exp(self.deviation * state)
        return self.middle + self.deviation * state


UNKNOWNS: dict[str, Unknown] = {
    "grip": Unknown("deg", math.radians(1.0), 0.0, math.radians(1.5), False, "tilt of the vessel beyond the recorded"),
    "height": Unknown("mm", 1e-3, 0.0, 2.5e-3, False, "rim of the pourer above that of its shape"),
    "fill": Unknown("g", 1e-3, 0.0, 10e-3, False, "mass in the pourer beyond the file's, the same in all recordings"),
    "lag": Unknown("s", 1.0, 0.35, 0.7, True, "of the balance, with the delay until a reading arrives"),
    "flow": Unknown("", 1.0, 1.0, 0.2, True, "flow over that of the cup's equation"),
    "viscosity": Unknown("", 1.0, 1.0, 0.4, True, "viscosity over the file's"),
}
"""What is known before a fit: the tolerances of a rig that was set up with care."""

ALWAYS = ("flow",)
"""Fitted even if it is not asked for."""

SHAPE = (0.6, 0.25)
"""Share of the balance's slowest lag before a fit: mean and standard deviation."""

ONSET_WANDER, FLOW_WANDER = math.radians(0.25), 0.05
"""Differences between pours of one rig: onset [rad], logarithm of the flow."""

LIP = math.radians(0.3)
"""Standard deviation of the angle that an unknown lip holds back [rad]."""

FILM = 0.06
"""Standard deviation of the apparent lag of films and transport [s]."""

MODEL_ERROR = 0.02
"""Standard deviation of the model's mass, as a share of what has flowed since the fitted readings."""

MODEL_NOISE = 0.3e-3
"""Deviation of a reading in the first of two passes, besides the balance's [kg]; the second takes the residuals'."""

STEPS = {"height": 0.4, "viscosity": 0.25}
"""Finite differences of quantities that need a new table of the cup, in deviations; 0.05 for the others."""


@dataclass(frozen=True)
class FittedValue:
    """One value, in SI.

    Attributes:
        name: in `UNKNOWNS`.
        low, high: interval with a probability of 90 %.
        identified: whether the readings have at least halved what was uncertain before.
        deviations: distance from the value before the fit, in its standard deviations.
    """

    name: str
    value: float
    low: float
    high: float
    identified: bool
    deviations: float

    @property
    def text(self) -> str:
        """As shown: '0.42 deg (0.11 to 0.73)'."""
        unknown = UNKNOWNS[self.name]
        value, low, high = (number / unknown.factor for number in (self.value, self.low, self.high))
        unit = f" {unknown.unit}" if unknown.unit else ""
        return f"{value:.3g}{unit} ({low:.3g} to {high:.3g})" + ("" if self.identified else "; hardly identified")


@dataclass(frozen=True, eq=False)
class Fit:
    """Fitted values.

    Attributes:
        values: of the unknowns that were asked for, and of those that are always fitted.
        fitted_on: names of the recordings.
        until: readings after this time [s] were not used; None: all were.
        rms: of the residuals of each recording [kg].
        held: share of the readings that repeat the one before while the mass rises, with its 90 % interval; None
            without such readings.
    """

    values: tuple[FittedValue, ...]
    fitted_on: tuple[str, ...]
    until: float | None
    rms: tuple[float, ...]
    held: tuple[float, float, float] | None
    _names: tuple[str, ...]
    _lag: Unknown
    _mean: Floats
    _covariance: Floats
    _noise: float

    @property
    def own_deviations(self) -> tuple[float, ...]:
        """Largest distance of onset, flow and fill of each recording from what is usual, in standard deviations."""
        own = np.abs(self._mean[len(self._names) + 1 :]).reshape(-1, OWN).max(axis=1)
        return tuple(map(float, own))

    def __getitem__(self, name: str) -> FittedValue:
        """The value of an unknown. Raises KeyError if it was not fitted."""
        return {estimate.name: estimate for estimate in self.values}[name]

    @property
    def replay_values(self) -> ReplayValues:
        """For `orchestrator.recordings.recording_replay`; the flow has no counterpart in the particle simulation."""
        values = {estimate.name: estimate.value for estimate in self.values if estimate.name != "flow"}
        return ReplayValues(**values, fitted_on=self.fitted_on)

    def document(self) -> dict[str, Any]:
        """JSON-ready, in display units."""
        values = {}
        for estimate in self.values:
            unknown = UNKNOWNS[estimate.name]
            numbers = [round(number / unknown.factor, 5) for number in (estimate.value, estimate.low, estimate.high)]
            values[estimate.name] = {
                "value": numbers[0],
                "interval": numbers[1:],
                "unit": unknown.unit or "1",
                "identified": estimate.identified,
            }
        return {
            "fitted": values,
            "fitted_on": list(self.fitted_on),
            "until_s": self.until,
            "rms_g": [round(1e3 * rms, 4) for rms in self.rms],
            "held_readings": None if self.held is None else [round(bound, 4) for bound in self.held],
        }


@dataclass(frozen=True, eq=False)
class Judgement:
    """A prediction from the tilt alone, and the readings.

    Attributes:
        name: of the recording.
        fitted: whether its earlier readings were fitted.
        times, measured, predicted, deviation: of the judged readings (R,) [s], [kg].
        rms: of measured minus predicted [kg].
        coverage: share of them inside the 90 % interval.
        final: predicted mass at the end: value and 90 % interval [kg].
        measured_final: [kg].
        onset, predicted_onset: None if nothing flowed among the judged readings.
    """

    name: str
    fitted: bool
    times: Floats
    measured: Floats
    predicted: Floats
    deviation: Floats
    rms: float
    coverage: float
    final: tuple[float, float, float]
    measured_final: float
    onset: Onset | None
    predicted_onset: Onset | None

    def document(self) -> dict[str, Any]:
        """JSON-ready; masses in grams, angles in degrees."""

        def onset(at: Onset | None) -> dict[str, float] | None:
            return None if at is None else {"time_s": round(at.time, 3), "tilt_deg": round(math.degrees(at.tilt), 2)}

        return {
            "recording": self.name,
            "earlier_readings_fitted": self.fitted,
            "readings": len(self.times),
            "rms_g": round(1e3 * self.rms, 4),
            "coverage": round(self.coverage, 3),
            "predicted_g": round(1e3 * self.final[0], 3),
            "interval_g": [round(1e3 * mass, 3) for mass in self.final[1:]],
            "measured_g": round(1e3 * self.measured_final, 3),
            "onset": onset(self.onset),
            "predicted_onset": onset(self.predicted_onset),
        }


def fit_recordings(
    recordings: Sequence[PourRecording], unknowns: Collection[str], *, until: float | None = None
) -> Fit:
    """Fit unknown quantities that recordings share.

    Args:
        recordings: of one rig: the same vessel, grip and balance.
        unknowns: names in `UNKNOWNS`. What is not named keeps the value of the recordings' files.
        until: use only the readings up to this time after the first tilt [s].

    Raises:
        InvalidArgumentError: an unknown name, no recordings, or no readings in that time.
        InvalidSceneError: the height of a mesh can't be fitted.
    """
    if other := [name for name in unknowns if name not in UNKNOWNS]:
        raise InvalidArgumentError(f"{', '.join(other)}: can't be fitted; known are {', '.join(UNKNOWNS)}")
    if not recordings:
        raise InvalidArgumentError("there is no recording to fit")
    names = tuple(name for name in UNKNOWNS if name in {*unknowns, *ALWAYS})
    lag = lag_before(recordings)
    problem = _Problem(names, lag, [FittedReadings.of(recording, until) for recording in recordings])
    state = problem.solved(np.zeros(problem.size), problem.noise)
    weight = problem.effective_noise(state)
    state = problem.solved(state, weight)
    covariance: Floats = np.asarray(np.linalg.inv(problem.information(state, weight)), dtype=np.float64)
    values = []
    for i, name in enumerate(names):
        unknown = problem.unknowns[name]
        middle = float(unknown.at(state[i]))
        further = LIP if name == "grip" else FILM / middle if name == "lag" else 0.0
        deviation = math.hypot(unknown.deviation * float(np.sqrt(covariance[i, i])), further)
        low, high = (float(unknown.at(state[i] + sign * QUANTILE * deviation / unknown.deviation)) for sign in (-1, 1))
        identified = deviation < 0.5 * UNKNOWNS[name].deviation
        values.append(FittedValue(name, middle, low, high, identified, float(state[i])))
    residuals = problem.residuals(state)
    return Fit(
        tuple(values),
        tuple(recording.name for recording in recordings),
        until,
        tuple(float(np.sqrt(np.mean(residual**2))) for residual in residuals),
        held_share(recordings),
        names,
        lag,
        state,
        covariance,
        float(np.sqrt(np.mean(np.concatenate(residuals) ** 2))),
    )


def judge_recording(fit: Fit, recording: PourRecording) -> Judgement:
    """Predict a recording from its tilt and fitted values, and compare it with its readings.

    Args:
        fit: by `fit_recordings`. If the recording is one of the fitted, only readings after `Fit.until` are judged.
        recording: the pour.

    Raises:
        InvalidArgumentError: all its readings were fitted.
    """
    within = recording.name in fit.fitted_on
    if within and fit.until is None:
        raise InvalidArgumentError(
            f"{recording.name}: all its readings were fitted, and none is left to judge; fit only its beginning, or "
            "judge another recording"
        )
    readings = FittedReadings.of(recording, None)
    problem = _Problem(fit._names, fit._lag, [readings])
    shared = problem.shared
    mean, covariance = np.zeros(problem.size), np.eye(problem.size)
    place = [*range(shared), *range(shared, problem.size)]
    if within:
        first = shared + OWN * fit.fitted_on.index(recording.name)
        place = [*range(shared), *range(first, first + OWN)]
        mean, covariance = fit._mean[place], fit._covariance[np.ix_(place, place)]
    else:
        mean[:shared], covariance[:shared, :shared] = fit._mean[:shared], fit._covariance[:shared, :shared]
    (predicted,), (slopes,) = problem.linearised(mean)
    variance = np.einsum("pr,pq,qr->r", slopes, covariance, slopes)
    begin = recording.read_times[0] if fit.until is None or not within else recording.tilt_times[0] + fit.until
    since = np.maximum(predicted - np.interp(begin, recording.read_times, predicted), 0.0)
    deviation = np.sqrt(variance + fit._noise**2 + recording.step**2 / 12.0 + (MODEL_ERROR * since) ** 2)
    judged = (recording.read_times > begin) if within else np.ones(len(recording.read_times), dtype=bool)
    if not judged.any():
        raise InvalidArgumentError(f"{recording.name}: has no reading after {fit.until:g} s to judge")
    net, seen = recording.net, max(SEEN, 3.0 * recording.step)
    onset, expected = onset_of(recording, net, seen), onset_of(recording, predicted, seen)
    # quiet readings before the flow would count as hits
    flowing = judged & (recording.read_times >= (begin if onset is None else onset.time - 1.0))
    miss = (net - predicted)[flowing]
    half = QUANTILE * float(deviation[-1])
    return Judgement(
        recording.name,
        within,
        recording.read_times[flowing],
        net[flowing],
        predicted[flowing],
        deviation[flowing],
        float(np.sqrt(np.mean(miss**2))),
        float(np.mean(np.abs(miss) <= QUANTILE * deviation[flowing])),
        (float(predicted[-1]), float(predicted[-1]) - half, float(predicted[-1]) + half),
        recording.gain,
        None if onset is not None and onset.time <= begin and within else onset,
        expected,
    )


def held_share(recordings: Sequence[PourRecording]) -> tuple[float, float, float] | None:
    """Share of the readings that repeat the one before while the mass rises (`Arrivals`).

    Returns:
        The share and its 90 % interval (Wilson); None without such readings.
    """
    counts = [arrivals(recording.read_times, recording.readings, recording.step) for recording in recordings]
    count, held = sum(count.rising for count in counts), sum(count.repeated for count in counts)
    if not count:
        return None
    share, z = held / count, QUANTILE
    middle = (share + z * z / (2 * count)) / (1 + z * z / count)
    half = z / (1 + z * z / count) * math.sqrt(share * (1 - share) / count + z * z / (4 * count * count))
    return share, middle - half, middle + half


OWN = 3
"""Parameters of each recording: onset, flow, fill."""


@dataclass(frozen=True, eq=False)
class FittedReadings:
    """Readings of a recording that are fitted; a repeated reading while the mass rises is no new one."""

    recording: PourRecording
    fall_time: float
    used: NDArray[np.bool_]

    @classmethod
    def of(cls, recording: PourRecording, until: float | None) -> FittedReadings:
        """Those up to a time [s], or all. Raises InvalidArgumentError: fewer than five."""
        net, times = recording.net, recording.read_times
        later = np.interp(times + 0.5, times, net) - np.interp(times - 0.5, times, net)
        repeats = np.concatenate([[False], np.abs(np.diff(net)) < 0.5 * recording.step])
        used = ~(repeats & (later > 3.0 * recording.step))
        if until is not None:
            used &= times <= recording.tilt_times[0] + until
            if used.sum() < 5:
                raise InvalidArgumentError(
                    f"{recording.name}: has {used.sum()} readings in the first {until:g} s; 5 are needed"
                )
        return cls(recording, time_of_fall(recording), used)


class _Problem:
    """The model of several recordings. A state (P,) is in deviations from what was known before.

    It has the unknowns, then the shape of the balance's filter, then `OWN` for each recording.
    """

    def __init__(self, names: Sequence[str], lag: Unknown, readings: Sequence[FittedReadings]) -> None:
        self._names, self._readings = tuple(names), readings
        self.unknowns = UNKNOWNS | {"lag": lag}
        self.shared = len(names) + 1
        self.size = self.shared + OWN * len(readings)
        recording = readings[0].recording
        display = math.hypot(recording.step / math.sqrt(12.0), recording.balance.noise)
        self.noise = np.full(len(readings), math.hypot(display, MODEL_NOISE))

    def _columns(self, recording: int) -> list[int]:
        first = self.shared + OWN * recording
        return [*range(self.shared), *range(first, first + OWN)]

    def _predict(self, k: int, states: Floats) -> Floats:
        """Readings of a recording for states (N, P), which agree in height and viscosity (N, R) [kg]."""
        readings = self._readings[k]
        recording = readings.recording
        unknowns = {name: self.unknowns[name].at(states[:, i]) for i, name in enumerate(self._names)}
        onset, flow, fill = (states[:, self.shared + OWN * k + i] for i in range(OWN))
        count = len(states)

        def values(name: str) -> Floats:
            return np.broadcast_to(np.asarray(unknowns.get(name, self.unknowns[name].middle), dtype=float), (count,))

        changed = ReplayValues(height=float(values("height")[0]), viscosity=float(values("viscosity")[0]))
        scene = changed.scene(recording)
        mass = scene.liquid.mass + values("fill") + recording.fill_deviation * fill
        hypotheses = PourHypotheses(
            ONSET[0] - values("grip") - recording.placement.grip + ONSET_WANDER * onset,
            np.clip(values("flow") * np.exp(FLOW_WANDER * flow), *FACTOR_RANGE),
            np.maximum(mass, 1e-4) / scene.liquid.density,
            np.clip(values("lag"), *LAG_RANGE),
            np.clip(SHAPE[0] + SHAPE[1] * states[:, len(self._names)], *SHAPE_RANGE),
        )
        shown, _ = respond(
            flow_of(scene), hypotheses, recording.tilt_times, recording.tilts, recording.read_times, readings.fall_time
        )
        return shown

    def linearised(self, state: Floats) -> tuple[list[Floats], list[Floats]]:
        """Readings of each recording (R,) [kg], and their derivatives with respect to its columns (C, R)."""
        predicted, slopes = [], []
        for k in range(len(self._readings)):
            columns = self._columns(k)
            steps = {i: STEPS.get(self._names[i] if i < len(self._names) else "", 0.05) for i in columns}
            alike = [i for i in columns if steps[i] == 0.05]
            states = np.stack([state, *(state + steps[i] * np.eye(self.size)[i] for i in alike)])
            shown = dict(zip([-1, *alike], self._predict(k, states), strict=True))
            for i in columns:
                if i not in shown:
                    shown[i] = self._predict(k, (state + steps[i] * np.eye(self.size)[i])[None])[0]
            predicted.append(shown[-1])
            slopes.append(np.stack([(shown[i] - shown[-1]) / steps[i] for i in columns]))
        return predicted, slopes

    def residuals(self, state: Floats) -> list[Floats]:
        """Reading minus model of the fitted readings of each recording [kg]."""
        return [
            (pour.recording.net - self._predict(k, state[None])[0])[pour.used] for k, pour in enumerate(self._readings)
        ]

    def solved(self, state: Floats, noise: Floats) -> Floats:
        """The state with the least weighted squares, from a first one."""

        def misses(x: Floats) -> Floats:
            return np.concatenate([*(r / s for r, s in zip(self.residuals(x), noise, strict=True)), x])

        def slopes(x: Floats) -> Floats:
            return np.vstack([*self._rows(x, noise), np.eye(self.size)])

        optimum = least_squares(misses, state, slopes, method="trf", x_scale=1.0, ftol=1e-4, xtol=1e-3, max_nfev=25)
        solution: Floats = optimum.x
        return solution

    def information(self, state: Floats, noise: Floats) -> Floats:
        """Inverse covariance of the state."""
        rows = np.vstack(self._rows(state, noise))
        return rows.T @ rows + np.eye(self.size)

    def effective_noise(self, state: Floats) -> Floats:
        """Deviation of a reading, inflated as if readings that hang together were fewer (recordings,) [kg]."""
        residuals = self.residuals(state)
        together = sum(float(r[1:] @ r[:-1]) for r in residuals) / max(sum(float(r @ r) for r in residuals), 1e-30)
        inflated = (1.0 + min(max(together, 0.0), 0.95)) / (1.0 - min(max(together, 0.0), 0.95))
        pooled = float(np.sqrt(np.mean(np.concatenate(residuals) ** 2) * inflated))
        effective: Floats = np.maximum(np.full(len(residuals), pooled), self.noise / 3.0)
        return effective

    def _rows(self, state: Floats, noise: Floats) -> list[Floats]:
        """Derivatives of the weighted residuals."""
        _, slopes = self.linearised(state)
        rows = []
        for k, (slope, readings) in enumerate(zip(slopes, self._readings, strict=True)):
            gradient = np.zeros((int(readings.used.sum()), self.size))
            gradient[:, self._columns(k)] = -slope[:, readings.used].T / noise[k]
            rows.append(gradient)
        return rows


def lag_before(recordings: Sequence[PourRecording]) -> Unknown:
    """The lag before a fit: from the placing of the receiver, if a recording has it."""
    unknown = UNKNOWNS["lag"]
    recording = next((recording for recording in recordings if len(recording.placed) > 5), None)
    if recording is None:
        return unknown
    logs = np.log(draw_lags(recording.placed, 400, np.random.default_rng(0), step=recording.step)[0])
    return replace(unknown, middle=float(np.exp(logs.mean())), deviation=max(float(logs.std()), 0.15))


def read_values(path: Path) -> ReplayValues:
    """The values of a file that `Fit.document` was written to.

    Args:
        path: JSON.

    Raises:
        ValueError: it is no such file.
        OSError: it can't be read.
    """
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
        values = {name: float(entry["value"]) * UNKNOWNS[name].factor for name, entry in data["fitted"].items()}
        fitted_on = tuple(map(str, data["fitted_on"]))
    except (KeyError, TypeError, ValueError, AttributeError):
        raise ValueError(f"{path} is no fit; 'decant recording fit --output' writes one") from None
    values.pop("flow", None)
    return ReplayValues(**values, fitted_on=fitted_on)
