"""Explains the recordings of a first day: does the model describe the rig, and which quantity is wrong?

`diagnose` compares explanations of the same pours: `RigDiagnosis`, a list of `Explanation`.

- `lag` and `holds` are read directly, from the placing of the receiver and from repeated readings while the mass rises.
- `grip`, `height` and `viscosity` explain all readings of the pours, with one model of a cup and its lip
  (`_ReadingsModel`) that is fitted to all pours together. In each explanation, one quantity is as uncertain as `WIDE`
  says, and the others keep the tolerance of a rig in order (`NOMINAL`). The viscosity is tried at `FACTORS` of the
  file's.
- Each has an evidence: the logarithm of the Bayes factor against 'nothing is wrong' (Laplace's approximation; MacKay,
  Information Theory, Inference, and Learning Algorithms, chapter 28). More than `STANDS_OUT` counts.

What tells them apart, with θ the tilt at the onset: a grip shifts the onset by the same angle for all fills, a height
by cos²θ / R, and a lip that holds back a head by cos θ / R. A lip holds back less once it is wet. A viscosity shows in
the slow end of a pour, when the head is below a few millimetres.

Pours are fitted and doses are predicted, so that the judgement is on readings that no fit has seen.

Limitations: those of `actors.dosing.cup_flow`; a constant share of the liquid is lost along the outside of the cup.
"""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import betaln, logsumexp, xlog1py, xlogy

from actors.dosing.cup_flow import flow_of
from actors.dosing.dose_estimator import LAG_RANGE, SHAPE_RANGE
from actors.dosing.pour_response import displayed
from orchestrator.recordings.first_day import MISS
from orchestrator.recordings.recording_file import PourRecording
from orchestrator.recordings.recording_fit import SHAPE, UNKNOWNS, FittedReadings, Unknown, held_share, lag_before
from orchestrator.recordings.recording_replay import QUANTILE
from orchestrator.recordings.time_series import arrivals
from sim_engine.errors import InvalidArgumentError
from sim_engine.liquids import Liquid

Floats = NDArray[np.float64]

STANDS_OUT = 0.0
"""Evidence above which an explanation counts: it is more credible than 'nothing is wrong'."""

NOMINAL = {"grip": math.radians(0.4), "height": 0.5e-3}
"""Deviations of a rig in order, in SI."""

WIDE = {"grip": math.radians(1.0), "height": 2.0e-3}
"""Deviations of a wrong quantity, in SI."""

FACTORS = (0.01, 0.03, 0.1, 10.0, 30.0, 100.0)
"""Viscosities that are tried, over the file's; that of thin liquids has no influence."""

SHARED = {
    "grip": (0.0, WIDE["grip"]),
    "height": (0.0, WIDE["height"]),
    "lag": (math.log(0.35), 0.7),
    "shape": SHAPE,
    "flow": (0.0, 0.2),
    "dry": (1.0e-3, 0.5e-3),
    "wet": (0.3e-3, 0.2e-3),
    "lost": (0.03, 0.02),
}
"""Mean and deviation before a fit of what all pours share: tilt of the vessel beyond the recorded [rad], rim above that
of its shape [m], logarithm of the balance's lag (replaced by that of the placing), share of its slowest part, logarithm
of the flow factor, head that a dry and a wet lip hold back [m], share that runs down the outside."""

OWN = (0.2e-3, 0.02)
"""Differences between pours: head that a dry lip holds back [m], logarithm of the flow. The third is the fill."""

WETTING = 0.2
"""Time in which flow wets a lip [s]."""

READING_NOISE, FLOW_NOISE, NOISE_TIME = 0.1e-3, 0.02, 0.5
"""Deviation of the model: of a reading [kg], and for each kg/s of flow [s]; time in which it is forgotten [s]."""

DOSE_ERROR = 0.02
"""Deviation of a predicted dose, as a share of it."""

TIME_STEP = 0.025
"""[s]"""

NOMINAL_LAG = 0.35
"""Lag that a rig's plan assumes, with the delay of its line [s]."""

LAG_TOLERANCE, LAG_WIDE = 0.3, 0.9
"""Deviations of the logarithm of the lag, of a balance in order and of another one."""

HOLDS_NOMINAL = 0.10
"""Largest share of repeated readings of a balance in order; a rise of a few steps repeats some by rounding."""

ADVICE = {
    "lag": "measure the balance with 'decant balance check'; select a faster filter in its menu",
    "holds": "select a faster output or continuous mode in the balance's menu; pour slower, or use another balance",
    "grip": "measure how the gripper holds the pourer, and correct 'grip' of the laboratory's arm",
    "height": "measure the inner height of the pourer, and correct its vessel file",
    "viscosity": "check which liquid was poured, and measure its viscosity; correct 'liquid'",
}
"""What to calibrate next."""


@dataclass(frozen=True)
class Explanation:
    """One quantity that may be wrong.

    Attributes:
        name: 'lag', 'holds', 'grip', 'height' or 'viscosity'.
        evidence: logarithm of the Bayes factor against 'nothing is wrong'.
        text: the value with its 90 % interval, and what was expected.
        direct: read from the balance, without the model of the pour.
    """

    name: str
    evidence: float
    text: str
    direct: bool

    @property
    def stands_out(self) -> bool:
        """Whether it counts."""
        return self.evidence > STANDS_OUT


@dataclass(frozen=True)
class PredictedDose:
    """A dose, predicted from its tilt and the fitted pours [kg].

    Attributes:
        name: of the recording.
        predicted, low, high: value and 90 % interval.
        weighed: in the receiver.
        wanted: as the name says; 0 if it does not.
    """

    name: str
    predicted: float
    low: float
    high: float
    weighed: float
    wanted: float

    @property
    def inside(self) -> bool:
        """Whether the weighed mass is in the interval."""
        return self.low <= self.weighed <= self.high


@dataclass(frozen=True)
class RigDiagnosis:
    """What a first day shows.

    Attributes:
        explanations: those that stand out first: what is read directly, then what is fitted; by their evidence. None
            if fewer than four pours have readings while they flow.
        doses: predicted from the pours, and weighed.
        missed: mass in the receiver after the deliberate miss [kg]; None without one.
    """

    explanations: tuple[Explanation, ...]
    doses: tuple[PredictedDose, ...]
    missed: float | None

    @property
    def main(self) -> Explanation | None:
        """The first explanation that stands out; None if nothing does."""
        return next((cause for cause in self.explanations if cause.stands_out), None)

    @property
    def describes(self) -> bool:
        """Whether half of the doses or more are inside their interval, or within 5 %."""
        hits = [dose.inside or abs(dose.predicted - dose.weighed) <= 0.05 * dose.weighed for dose in self.doses]
        return bool(hits) and 2 * sum(hits) >= len(hits)

    @property
    def dose_error(self) -> tuple[float, float] | None:
        """Mean and largest distance of the weighed from the wanted amount [kg]; None without doses."""
        errors = [abs(dose.weighed - dose.wanted) for dose in self.doses if dose.wanted > 0.0]
        return (float(np.mean(errors)), max(errors)) if errors else None

    def document(self) -> dict[str, Any]:
        """JSON-ready; masses in grams."""

        def grams(value: float) -> float:
            return round(1e3 * value, 3)

        return {
            "main": None if self.main is None else self.main.name,
            "describes": self.describes,
            "explanations": [
                {"name": e.name, "evidence": round(e.evidence, 2), "stands_out": e.stands_out, "text": e.text}
                for e in self.explanations
            ],
            "doses": [
                {
                    "recording": dose.name,
                    "predicted_g": grams(dose.predicted),
                    "interval_g": [grams(dose.low), grams(dose.high)],
                    "weighed_g": grams(dose.weighed),
                    "wanted_g": grams(dose.wanted),
                }
                for dose in self.doses
            ],
            "missed_g": None if self.missed is None else grams(self.missed),
            "dose_error_g": None if self.dose_error is None else [grams(error) for error in self.dose_error],
        }


def diagnose(recordings: Sequence[PourRecording], lag: float = NOMINAL_LAG) -> RigDiagnosis:
    """Explain the recordings of a first day.

    Args:
        recordings: with the names of `orchestrator.recordings.first_day.first_day`.
        lag: of the balance that the rig's plan assumes [s].

    Raises:
        InvalidArgumentError: not all are of one pourer.
    """
    doses = [recording for recording in recordings if "dose" in recording.name]
    missed = [recording for recording in recordings if recording.name.endswith(MISS)]
    pours = [pour for pour in recordings if pour not in doses and pour not in missed and len(pour.readings) > 10]
    arrived = missed[0].gain if missed else None
    if len(pours) < 4:
        return RigDiagnosis((), (), arrived)
    if other := next((pour for pour in [*pours, *doses] if pour.scene.pourer != pours[0].scene.pourer), None):
        raise InvalidArgumentError(f"{other.name}: has another pourer than {pours[0].name}; record a day with one")
    fitted, best = _fitted(pours)
    direct = sorted([_lag(recordings, lag), *_holds(recordings)], key=lambda e: -e.evidence)
    order = sorted([*direct, *sorted(fitted, key=lambda e: -e.evidence)], key=lambda e: not e.stands_out)
    return RigDiagnosis(tuple(order), tuple(best.predicted(recording) for recording in doses), arrived)


def _wanted(name: str) -> float:
    """Wanted amount in the name of a dose [kg]; 0 if it has none."""
    parts = name.split("-")
    number = parts[parts.index("dose") + 1] if "dose" in parts[:-1] else ""
    return 1e-3 * float(number) if number.isdigit() and "g" in parts else 0.0


def _lag(recordings: Sequence[PourRecording], nominal: float) -> Explanation:
    """The lag while the receiver was put on, against the assumed one."""
    lag = lag_before(recordings)
    if not any(len(recording.placed) > 5 for recording in recordings):
        return Explanation("lag", -math.inf, "unknown: no recording has the placing of the receiver", True)
    each = [lag_before([recording]) for recording in recordings if len(recording.placed) > 5]
    logs = np.array([math.log(unknown.middle) for unknown in each])
    spread = math.hypot(lag.deviation / math.sqrt(len(each)), 0.1)
    miss = float(logs.mean()) - math.log(nominal)
    narrow, wide = math.hypot(spread, LAG_TOLERANCE), math.hypot(spread, LAG_WIDE)
    evidence = 0.5 * miss**2 * (narrow**-2 - wide**-2) - math.log(wide / narrow)
    value = math.exp(float(logs.mean()))
    low, high = value * math.exp(-1.645 * spread), value * math.exp(1.645 * spread)
    return Explanation("lag", evidence, f"{value:.2f} s ({low:.2f} to {high:.2f}), {nominal:.2f} s assumed", True)


def _holds(recordings: Sequence[PourRecording]) -> list[Explanation]:
    """Repeated readings, against the share that rounding causes."""
    share = held_share(recordings)
    if share is None:
        return []
    counts = [arrivals(recording.read_times, recording.readings, recording.step) for recording in recordings]
    count, held = sum(count.rising for count in counts), sum(count.repeated for count in counts)
    evidence = float(
        betaln(held + 1, count - held + 1) - xlogy(held, HOLDS_NOMINAL) - xlog1py(count - held, -HOLDS_NOMINAL)
    )
    if share[0] < HOLDS_NOMINAL:
        evidence = min(evidence, 0.0)
    value, low, high = (100 * bound for bound in share)
    text = f"{value:.0f} % of the readings repeat while the mass rises ({low:.0f} to {high:.0f} %)"
    return [Explanation("holds", evidence, text, True)]


def _fitted(pours: Sequence[PourRecording]) -> tuple[list[Explanation], _Fit]:
    """Grip, height and viscosity, and the fit of the best viscosity."""
    plain = _fit(pours, 1.0, np.zeros(len(SHARED) + PER_POUR * len(pours)))
    nothing = plain.evidence({})
    liquid = pours[0].scene.liquid
    chosen, viscosity = plain, []
    if tried := [factor for factor in FACTORS if _possible(liquid, factor)]:
        fits = [_fit(pours, factor, plain.state) for factor in tried]
        evidences = [fit.evidence({}) - nothing for fit in fits]
        best = int(np.argmax(evidences))
        evidence = float(logsumexp(evidences)) - math.log(len(tried))
        chosen = fits[best] if evidence > STANDS_OUT else plain
        text = f"{tried[best]:.2g} × the file's fits best of {', '.join(f'{factor:.2g}' for factor in tried)}"
        viscosity.append(Explanation("viscosity", evidence, text, False))
    explanations = []
    for name in NOMINAL:
        at, unknown = list(SHARED).index(name), UNKNOWNS[name]
        middle, spread = SHARED[name][1] * chosen.state[at], SHARED[name][1] * math.sqrt(chosen.covariance[at, at])
        value, low, high = ((middle + quantile * spread) / unknown.factor for quantile in (0.0, -QUANTILE, QUANTILE))
        text = f"{value:+.2g} {unknown.unit} ({low:+.2g} to {high:+.2g})"
        explanations.append(Explanation(name, plain.evidence({name}) - nothing, text, False))
    return [*explanations, *viscosity], chosen


def _possible(liquid: Liquid, factor: float) -> bool:
    """Whether a liquid can have this multiple of its viscosity, and it makes a difference."""
    try:
        changed = Liquid(**liquid.model_dump() | {"dynamic_viscosity": factor * liquid.dynamic_viscosity})
    except ValueError:
        return False
    return liquid.is_thick or changed.is_thick


PER_POUR = len(OWN) + 1


class _ReadingsModel:
    """The readings of several pours for several states at once, from a tilting cup with a lip that wets.

    A state (P,) is in deviations from what was known before: `SHARED`, then `PER_POUR` for each pour.
    """

    def __init__(self, pours: Sequence[PourRecording], factor: float) -> None:
        liquid = pours[0].scene.liquid
        liquid = Liquid(**liquid.model_dump() | {"dynamic_viscosity": factor * liquid.dynamic_viscosity})
        self._cup = flow_of(replace(pours[0].scene, liquid=liquid))
        self.pours = [FittedReadings.of(pour, None) for pour in pours]
        self._fills = np.array([[pour.scene.liquid.mass, pour.fill_deviation] for pour in pours])
        end = max(max(pour.tilt_times[-1], pour.read_times[-1]) - pour.tilt_times[0] for pour in pours)
        self._times = np.arange(0.0, end + 2.0 * TIME_STEP, TIME_STEP)
        self._tilts = np.stack(
            [
                np.interp(self._times + pour.tilt_times[0], pour.tilt_times, pour.tilts) + pour.placement.grip
                for pour in pours
            ]
        )

    def readings(self, states: Floats, lag: Unknown) -> list[Floats]:
        """Readings of each pour for states (S, P) (S, R) [kg]."""
        shared = {name: mean + deviation * states[:, i] for i, (name, (mean, deviation)) in enumerate(SHARED.items())}
        per_pour = states[:, len(SHARED) :].reshape(len(states), len(self.pours), PER_POUR)
        cup, rim = self._cup, shared["height"]
        flow = np.exp(shared["flow"][:, None] + OWN[1] * per_pour[..., 1])
        held = shared["dry"][:, None] + OWN[0] * per_pour[..., 0]
        content = (self._fills[:, 0] + self._fills[:, 1] * per_pour[..., 2]) / cup.density
        volume, wet = content.copy(), np.broadcast_to(shared["wet"][:, None], held.shape)
        gone = np.zeros((len(self._times), *volume.shape))
        fullest = np.repeat(content.max(axis=0)[:, None], len(self._times), axis=1)
        highest = cup.head(fullest, self._tilts + shared["grip"].max()).max(axis=0)
        idle = highest <= min(float(held.min()), float(wet.min())) + min(float(rim.min()), 0.0)
        for k, tilts in enumerate(self._tilts.T):
            if idle[k]:
                gone[k] = content - volume
                continue
            tilted = tilts + shared["grip"][:, None]
            head = cup.head(volume, tilted) - held - rim[:, None] * np.cos(tilted)
            flows = head > 0.0
            if flows.any():
                volume = np.maximum(volume - TIME_STEP * np.where(flows, flow * cup.flow_at(head, tilted), 0.0), 0.0)
                held = np.where(flows, held + (wet - held) * (TIME_STEP / WETTING), held)
            gone[k] = content - volume
        mass = cup.density * (1.0 - shared["lost"])[:, None] * gone
        shape = np.clip(shared["shape"], *SHAPE_RANGE)
        lags = np.clip(lag.at(states[:, list(SHARED).index("lag")]), *LAG_RANGE)
        return [
            np.stack(
                [
                    displayed(
                        self._times + pour.recording.tilt_times[0],
                        mass[:, s, k],
                        pour.recording.read_times,
                        lag=float(lags[s]),
                        lag_shape=float(shape[s]),
                        fall_time=pour.fall_time,
                    )
                    for s in range(len(states))
                ]
            )
            for k, pour in enumerate(self.pours)
        ]

    def whitened(self, state: Floats, lag: Unknown, noise: float) -> tuple[Floats, Floats]:
        """Residuals (R,) of unit deviation, independent of each other, and their derivatives (R, P).

        Args:
            state: the state.
            lag: of the balance before the fit.
            noise: factor of the model's deviation.
        """
        size, step = len(state), 0.05
        probes = np.zeros((len(SHARED) + PER_POUR, size))
        probes[: len(SHARED), : len(SHARED)] = np.eye(len(SHARED))
        for j in range(PER_POUR):  # of all pours at once: a pour depends on its own alone
            probes[len(SHARED) + j, len(SHARED) + j :: PER_POUR] = 1.0
        residuals, slopes = [], []
        shown = self.readings(np.vstack([state, state + step * probes]), lag)
        for k, (pour, readings) in enumerate(zip(self.pours, shown, strict=True)):
            times, each = pour.recording.read_times[pour.used], readings[:, pour.used]
            rate = np.abs(np.gradient(each[0], times))
            display = math.hypot(pour.recording.step / math.sqrt(12.0), pour.recording.balance.noise)
            deviation = noise * np.sqrt(READING_NOISE**2 + display**2 + (FLOW_NOISE * rate) ** 2)
            slope = np.zeros((len(times), size))
            change = ((each[1:] - each[0]) / step).T
            first = len(SHARED) + PER_POUR * k
            slope[:, : len(SHARED)] = change[:, : len(SHARED)]
            slope[:, first : first + PER_POUR] = change[:, len(SHARED) :]
            residual, slope = (pour.recording.net[pour.used] - each[0]) / deviation, slope / deviation[:, None]
            correlation = np.exp(-np.diff(times) / NOISE_TIME)
            fresh = np.sqrt(1.0 - correlation**2)
            residuals.append(np.append(residual[:1], (residual[1:] - correlation * residual[:-1]) / fresh))
            slopes.append(np.vstack([slope[:1], (slope[1:] - correlation[:, None] * slope[:-1]) / fresh[:, None]]))
        return np.concatenate(residuals), np.vstack(slopes)


@dataclass(frozen=True, eq=False)
class _Fit:
    """The most credible state of a model, with `WIDE` grip and height."""

    factor: float
    lag: Unknown
    state: Floats
    covariance: Floats
    misfit: float

    def evidence(self, wrong: Collection[str]) -> float:
        """Logarithm of the evidence, with `WIDE` for these quantities and `NOMINAL` for the others.

        A Gaussian posterior of grip and height is weighted with the other prior over that of the fit.
        """
        _, volume = np.linalg.slogdet(self.covariance)
        total = -0.5 * (self.misfit - volume)
        places = [list(SHARED).index(name) for name in NOMINAL]
        mean, information = self.state[places], np.linalg.inv(self.covariance[np.ix_(places, places)])
        ratio = np.array([1.0 if name in wrong else WIDE[name] / NOMINAL[name] for name in NOMINAL])
        narrowed = information + np.diag(ratio**2 - 1.0)
        pull = information @ mean
        total += float(np.log(ratio).sum()) + 0.5 * (np.linalg.slogdet(information)[1] - np.linalg.slogdet(narrowed)[1])
        return float(total - 0.5 * (mean @ pull - pull @ np.linalg.solve(narrowed, pull)))

    def predicted(self, recording: PourRecording) -> PredictedDose:
        """A dose that was not fitted, from its tilt."""
        count, model = len(SHARED), _ReadingsModel([recording], self.factor)
        state = np.append(self.state[:count], np.zeros(PER_POUR))
        covariance = np.eye(len(state))
        covariance[:count, :count] = self.covariance[:count, :count]
        shown = model.readings(np.vstack([state, state + 0.05 * np.eye(len(state))]), self.lag)[0][:, -1]
        slopes, value = (shown[1:] - shown[0]) / 0.05, float(shown[0])
        half = QUANTILE * math.hypot(math.sqrt(slopes @ covariance @ slopes), DOSE_ERROR * value, READING_NOISE)
        return PredictedDose(recording.name, value, value - half, value + half, recording.gain, _wanted(recording.name))


def _fit(pours: Sequence[PourRecording], factor: float, state: Floats) -> _Fit:
    """The fit of a multiple of the file's viscosity, by Levenberg's method from a first state."""
    model, lag = _ReadingsModel(pours, factor), lag_before(pours)
    for noise in (5.0, 1.0):
        residuals, slopes = model.whitened(state, lag, noise)
        damping = 0.0
        for _ in range(12):
            information = slopes.T @ slopes + np.eye(len(state))
            step = np.linalg.solve(information + damping * np.diag(np.diag(information)), slopes.T @ residuals - state)
            step *= min(1.0, 1.5 / float(np.abs(step).max()))
            after = model.whitened(state + step, lag, noise)
            gained = float(
                residuals @ residuals + state @ state - after[0] @ after[0] - (state + step) @ (state + step)
            )
            if gained > 0.0:
                state, (residuals, slopes), damping = state + step, after, 0.3 * damping
            else:
                damping = max(10.0 * damping, 0.01)
            if abs(gained) < 0.2 or damping > 100.0:
                break
    covariance: Floats = np.asarray(np.linalg.inv(slopes.T @ slopes + np.eye(len(state))), dtype=np.float64)
    return _Fit(factor, lag, state, covariance, float(residuals @ residuals + state @ state))
