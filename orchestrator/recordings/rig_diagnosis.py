"""Explains the recordings of a first day: does the model describe the rig, and which quantity is wrong?

`diagnose` compares explanations of the same pours: `RigDiagnosis`, a list of `Explanation`.

- `lag` and `holds` are read directly, from the placing of the receiver and from repeated readings while the mass rises.
- `grip` and `height` explain the tilts at which pours of different fills begin. In each explanation, one quantity is as
  uncertain as `WIDE` says, and the other keeps the tolerance of a rig in order (`NOMINAL`).
- `viscosity` is tried at `FACTORS` of the file's, with lag, flow and onsets fitted again.
- Each has an evidence: the logarithm of the Bayes factor against 'nothing is wrong' (Laplace's approximation; MacKay,
  Information Theory, Inference, and Learning Algorithms, chapter 28). More than `STANDS_OUT` counts.

Pours are fitted and doses are predicted, so that the judgement is on readings that no fit has seen. The lip of a cup
holds liquid back like a cup that is about 1 mm higher, so a height is told from a grip by the fills of the slow pours.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import betaln, logsumexp, xlog1py, xlogy

from actors.dosing.dose_estimator import ONSET
from orchestrator.recordings.first_day import MISS
from orchestrator.recordings.recording_file import PourRecording
from orchestrator.recordings.recording_fit import (
    OWN,
    UNKNOWNS,
    Fit,
    FitProblem,
    FittedReadings,
    Judgement,
    Unknown,
    fit_recordings,
    held_share,
    judge_recording,
    lag_before,
)
from orchestrator.recordings.recording_replay import arrivals, taller
from sim_engine.errors import InvalidArgumentError
from sim_engine.hydrostatics import retained_volume
from sim_engine.liquids import Liquid
from sim_engine.vessel.vessel import build_vessel

Floats = NDArray[np.float64]

STANDS_OUT = 2.0
"""Evidence above which an explanation counts: odds of 7 to 1."""

NOMINAL = {"grip": math.radians(0.28), "height": 0.3e-3}
"""Deviations of a rig in order, in SI."""

WIDE = {"grip": math.radians(1.5), "height": 2.5e-3}
"""Deviations of a wrong quantity, in SI."""

HOLD, LIP = (0.25e-3, 0.3e-3), math.radians(0.27)
"""Head that a lip holds back beyond the flow's own: mean and deviation [m], and its tilt; of benches in order."""

ONSET_WANDER = math.radians(0.08)
"""Differences of the onset between pours that are made in one go, with the same time to dry [rad]."""

SLOW = math.radians(8.0)
"""Largest speed of the tilt of a pour that shows the onset; faster ones slosh [rad/s]."""

OPEN_ONSET = math.radians(2.0)
"""Deviation of the onset of a pour, if nothing is known about it [rad]."""

FACTORS = (0.003, 0.03, 30.0, 300.0)
"""Viscosities that are tried, over the file's; that of water itself has no influence."""

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


@dataclass(frozen=True, eq=False)
class RigDiagnosis:
    """What a first day shows.

    Attributes:
        explanations: the most credible first: what is read directly before what is fitted.
        fit: with the quantity that explains the pours, if one does.
        judged: doses, predicted from the pours.
        missed: mass in the receiver after the deliberate miss [kg]; None without one.
        doses: weighed and wanted mass of the doses [kg]; the wanted is that of the name.
    """

    explanations: tuple[Explanation, ...]
    fit: Fit
    judged: tuple[Judgement, ...]
    missed: float | None
    doses: tuple[tuple[str, float, float], ...]

    @property
    def main(self) -> Explanation | None:
        """The first explanation that stands out; None if nothing does."""
        return next((one for one in self.explanations if one.stands_out), None)

    @property
    def describes(self) -> bool:
        """Whether the predicted doses agree: half of them or more inside their 90 % interval, or within 5 %."""
        hits = [
            one.final[1] <= one.measured_final <= one.final[2]
            or abs(one.final[0] - one.measured_final) <= 0.05 * one.measured_final
            for one in self.judged
        ]
        return 2 * sum(hits) >= len(hits)

    @property
    def dose_error(self) -> tuple[float, float] | None:
        """Mean and largest distance of the weighed from the wanted amount [kg]; None without doses."""
        errors = [abs(weighed - wanted) for _, weighed, wanted in self.doses]
        return (float(np.mean(errors)), max(errors)) if errors else None

    def document(self) -> dict[str, Any]:
        """JSON-ready; masses in grams."""
        error = self.dose_error
        return {
            "main": None if self.main is None else self.main.name,
            "describes": self.describes,
            "explanations": [
                {"name": one.name, "evidence": round(one.evidence, 2), "stands_out": one.stands_out, "text": one.text}
                for one in self.explanations
            ],
            **self.fit.document(),
            "judged": [one.document() for one in self.judged],
            "missed_g": None if self.missed is None else round(1e3 * self.missed, 3),
            "dose_error_g": None if error is None else [round(1e3 * one, 3) for one in error],
        }


def diagnose(recordings: Sequence[PourRecording], lag: float = NOMINAL_LAG) -> RigDiagnosis:
    """Explain the recordings of a first day.

    Args:
        recordings: with the names of `orchestrator.recordings.first_day.first_day`.
        lag: of the balance that the rig's plan assumes [s].

    Raises:
        InvalidArgumentError: fewer than four pours have readings while they flow.
        InvalidSceneError: the pourer is a mesh, whose height can't be fitted.
    """
    doses = [one for one in recordings if "dose" in one.name]
    missed = [one for one in recordings if one.name.endswith(MISS)]
    pours = [one for one in recordings if one not in doses and one not in missed and len(one.readings) > 10]
    if len(pours) < 4:
        raise InvalidArgumentError(
            f"{len(pours)} pours have readings while they flow; a diagnosis needs 4, of two fills. Record them with "
            "the balance below the receiver"
        )
    order = explanations(recordings, pours, lag)
    main = next((one.name for one in order if one.stands_out and not one.direct), None)
    # the fit of a viscosity needs more than the tolerances of `UNKNOWNS`: the doses are then predicted without it
    unknowns = {"grip", "lag", *(() if main in (None, "viscosity") else (main,))}
    fit = fit_recordings(pours, tuple(unknowns))
    return RigDiagnosis(
        order,
        fit,
        tuple(judge_recording(fit, one) for one in doses),
        missed[0].gain if missed else None,
        tuple((one.name, one.gain, _wanted(one.name)) for one in doses if _wanted(one.name) > 0.0),
    )


def explanations(
    recordings: Sequence[PourRecording], pours: Sequence[PourRecording], lag: float = NOMINAL_LAG
) -> tuple[Explanation, ...]:
    """The explanations, the most credible first.

    Args:
        recordings: all, for lag and repeated readings.
        pours: those that are fitted.
        lag: that the rig's plan assumes [s].
    """
    direct = [_lag(recordings, lag), *_holds(recordings)]
    order = sorted(direct, key=lambda one: -one.evidence) + sorted(_fitted(pours), key=lambda one: -one.evidence)
    return tuple(sorted(order, key=lambda one: not one.stands_out))


def _wanted(name: str) -> float:
    """Wanted amount in the name of a dose [kg]; 0 if it has none."""
    parts = name.split("-")
    number = parts[parts.index("dose") + 1] if "dose" in parts[:-1] else ""
    return 1e-3 * float(number) if number.isdigit() and "g" in parts else 0.0


def _lag(recordings: Sequence[PourRecording], nominal: float) -> Explanation:
    """The lag while the receiver was put on, against the assumed one."""
    found = lag_before(recordings)
    if not any(len(one.placed) > 5 for one in recordings):
        return Explanation("lag", -math.inf, "unknown: no recording has the placing of the receiver", True)
    each = [lag_before([one]) for one in recordings if len(one.placed) > 5]
    logs = np.array([math.log(one.middle) for one in each])
    own = math.hypot(found.deviation / math.sqrt(len(each)), 0.1)
    miss = float(logs.mean()) - math.log(nominal)
    narrow, wide = math.hypot(own, LAG_TOLERANCE), math.hypot(own, LAG_WIDE)
    evidence = 0.5 * miss**2 * (narrow**-2 - wide**-2) - math.log(wide / narrow)
    value = math.exp(float(logs.mean()))
    low, high = value * math.exp(-1.645 * own), value * math.exp(1.645 * own)
    return Explanation("lag", evidence, f"{value:.2f} s ({low:.2f} to {high:.2f}), {nominal:.2f} s assumed", True)


def _holds(recordings: Sequence[PourRecording]) -> list[Explanation]:
    """Repeated readings, against the share that rounding causes."""
    share = held_share(recordings)
    if share is None:
        return []
    found = [arrivals(one.read_times, one.readings, one.step) for one in recordings]
    count, held = sum(one.rising for one in found), sum(one.repeated for one in found)
    evidence = float(
        betaln(held + 1, count - held + 1) - xlogy(held, HOLDS_NOMINAL) - xlog1py(count - held, -HOLDS_NOMINAL)
    )
    if share[0] < HOLDS_NOMINAL:
        evidence = min(evidence, 0.0)
    value, low, high = (100 * one for one in share)
    text = f"{value:.0f} % of the readings repeat while the mass rises ({low:.0f} to {high:.0f} %)"
    return [Explanation("holds", evidence, text, True)]


def _fitted(pours: Sequence[PourRecording]) -> list[Explanation]:
    """Grip and height from the onsets, and the viscosity from whole pours."""
    readings = [FittedReadings.of(one, None) for one in pours]
    lag = lag_before(pours)
    problem = _problem(readings, lag)
    state = problem.solved(np.zeros(problem.size), problem.noise)
    noise = problem.effective_noise(state)
    state = problem.solved(state, noise)
    plain = _log_evidence(problem, state, noise)
    covariance = np.asarray(np.linalg.inv(problem.information(state, noise)), dtype=np.float64)
    places = [problem.shared + OWN * k for k in range(len(pours))]
    onsets = ONSET[0] + OPEN_ONSET * state[places]
    speeds = [float(np.gradient(one.tilts, one.tilt_times).max()) for one in pours]
    slow = [k for k, speed in enumerate(speeds) if speed < SLOW] or [*range(len(pours))]
    places = [places[k] for k in slow]
    between = OPEN_ONSET**2 * covariance[np.ix_(places, places)]
    found = _from_onsets([pours[k] for k in slow], onsets[slow], between)
    evidences = []
    tried = [factor for factor in FACTORS if all(_possible(one.scene.liquid, factor) for one in pours)]
    for factor in tried:
        changed = _problem([replace(one, recording=_thicker(one.recording, factor)) for one in readings], lag)
        evidences.append(_log_evidence(changed, changed.solved(state, noise), noise) - plain)
    best = int(np.argmax(evidences))
    mean = float(logsumexp(evidences)) - math.log(len(evidences))
    text = f"{tried[best]:.2g} × the file's fits best of {', '.join(f'{one:.2g}' for one in tried)}"
    return [*found, Explanation("viscosity", mean, text, False)]


def _from_onsets(pours: Sequence[PourRecording], onsets: Floats, covariance: Floats) -> list[Explanation]:
    """Grip and height, from the tilts at which pours of different fills begin beyond those of an ideal rim (N,) [rad].

    An onset is later by −grip + a · height + (a / cos θ) · hold, with the ideal onset θ and its derivative a.
    """
    ideal = np.array([_ideal_onset(one, 0.0) for one in pours])
    slopes = np.array([_ideal_onset(one, 1e-3) for one in pours]) - ideal
    slopes *= 1e3
    held = slopes / np.cos(ideal)
    effects = {"grip": -np.ones(len(pours)), "height": slopes}
    miss = onsets - held * HOLD[0] - LIP
    random = covariance + ONSET_WANDER**2 * np.eye(len(pours)) + HOLD[1] ** 2 * np.outer(held, held)

    def prior(wrong: str | None) -> dict[str, float]:
        return {name: WIDE[name] if name == wrong else NOMINAL[name] for name in effects}

    def evidence(wrong: str | None) -> float:
        total = random + sum(prior(wrong)[name] ** 2 * np.outer(one, one) for name, one in effects.items())
        _, volume = np.linalg.slogdet(total)
        return -0.5 * float(miss @ np.linalg.solve(total, miss) + volume)

    found = []
    for name, effect in effects.items():
        deviation = prior(name)
        total = random + sum(deviation[other] ** 2 * np.outer(one, one) for other, one in effects.items())
        gain = deviation[name] ** 2 * np.linalg.solve(total, effect)
        middle, spread = float(gain @ miss), math.sqrt(deviation[name] ** 2 * (1.0 - float(gain @ effect)))
        unknown = UNKNOWNS[name]
        value, low, high = ((middle + part * spread) / unknown.factor for part in (0.0, -1.645, 1.645))
        text = f"{value:+.2g} {unknown.unit} ({low:+.2g} to {high:+.2g})"
        found.append(Explanation(name, evidence(name) - evidence(None), text, False))
    return found


def _ideal_onset(recording: PourRecording, height: float) -> float:
    """Tilt at which liquid at rest reaches the lip of a pourer whose rim is higher [rad]."""
    vessel = build_vessel(taller(recording.scene.pourer, height))
    volume = recording.scene.liquid.volume
    return float(brentq(lambda tilt: retained_volume(vessel, tilt) - volume, 0.0, math.radians(89.9)))


def _possible(liquid: Liquid, factor: float) -> bool:
    """Whether a liquid can have this multiple of its viscosity."""
    try:
        Liquid(**liquid.model_dump() | {"dynamic_viscosity": factor * liquid.dynamic_viscosity})
    except ValueError:
        return False
    return True


def _thicker(recording: PourRecording, factor: float) -> PourRecording:
    scene = recording.scene
    changed = {"dynamic_viscosity": factor * scene.liquid.dynamic_viscosity}
    return replace(recording, scene=replace(scene, liquid=scene.liquid.model_copy(update=changed)))


def _problem(readings: Sequence[FittedReadings], lag: Unknown) -> FitProblem:
    """A fit of lag, flow, and an onset of each pour that is as good as unknown."""
    problem = FitProblem(("lag", "flow"), lag, readings)
    problem.onset_wander = OPEN_ONSET
    return problem


def _log_evidence(problem: FitProblem, state: Floats, noise: Floats) -> float:
    """Laplace's approximation, without the terms that all problems of the same readings and noise share."""
    misses = sum(float(np.sum((r / s) ** 2)) for r, s in zip(problem.residuals(state), noise, strict=True))
    _, information = np.linalg.slogdet(problem.information(state, noise))
    return -0.5 * (misses + float(state @ state) + float(information))
