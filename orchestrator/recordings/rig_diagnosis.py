"""Explains the recordings of a first day: does the model describe the rig, and which quantity is wrong?

`diagnose` compares explanations of the same pours: `RigDiagnosis`, a list of `Explanation`.

- `lag` and `holds` are read directly, from the placing of the receiver and from repeated readings while the mass rises.
- `grip`, `height` and `viscosity` are fits. In each, one quantity is as uncertain as `WIDE` says, and the others keep the
  tolerances of a rig in order (`NOMINAL`).
- Each has an evidence: the logarithm of the Bayes factor against 'nothing is wrong' (Laplace's approximation; MacKay,
  Information Theory, Inference, and Learning Algorithms, chapter 28). More than `STANDS_OUT` counts.

Pours are fitted and doses are predicted, so that the judgement is on readings that no fit has seen. The lip of a cup
holds liquid back like a cup that is about 1 mm higher, so a height is told from a grip by the fills of the slow pours.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import betaln, xlog1py, xlogy

from orchestrator.recordings.first_day import MISS
from orchestrator.recordings.recording_file import PourRecording
from orchestrator.recordings.recording_fit import (
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
from orchestrator.recordings.recording_replay import arrivals
from sim_engine.errors import InvalidArgumentError

Floats = NDArray[np.float64]

STANDS_OUT = 3.0
"""Evidence above which an explanation counts: odds of 20 to 1."""

NOMINAL = {"grip": math.radians(0.5), "height": 0.5e-3}
"""Deviations of a rig in order, in SI; the height's includes what the lip holds back."""

WIDE = {"grip": math.radians(1.5), "height": 2.5e-3, "viscosity": 1.5}
"""Deviation of a wrong quantity, in SI; of the viscosity's logarithm."""

ONSET_WANDER = math.radians(0.12)
"""Differences of the onset between pours that are made in one go, with the same time to dry [rad]."""

STARTS = (-2.5, 2.5)
"""Where the fits of the viscosity start, in deviations: at its own value, that of water has no influence."""

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
            f"{len(pours)} pours have readings while they flow; a diagnosis needs 4, of two fills. Record them with the "
            "balance below the receiver"
        )
    direct = [_lag(recordings, lag), *_holds(recordings)]
    fitted = _fitted(pours)
    order = sorted(direct, key=lambda one: -one.evidence) + sorted(fitted, key=lambda one: -one.evidence)
    order.sort(key=lambda one: not one.stands_out)
    main = next((one.name for one in order if one.stands_out and not one.direct), None)
    # the fit of a viscosity needs more than the tolerances of `UNKNOWNS`: the doses are then predicted without it
    unknowns = {"grip", "lag", *(() if main in (None, "viscosity") else (main,))}
    fit = fit_recordings(pours, tuple(unknowns))
    return RigDiagnosis(
        tuple(order),
        fit,
        tuple(judge_recording(fit, one) for one in doses),
        missed[0].gain if missed else None,
        tuple((one.name, one.gain, _wanted(one.name)) for one in doses if _wanted(one.name) > 0.0),
    )


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
    """The explanations by fits, each alone."""
    readings = [FittedReadings.of(one, None) for one in pours]
    lag = lag_before(pours)
    wide = _problem(readings, lag, {"grip": WIDE["grip"], "height": WIDE["height"]})
    state = wide.solved(np.zeros(wide.size), wide.noise)
    noise = wide.effective_noise(state)
    state = wide.solved(state, noise)
    information = wide.information(state, noise)
    data, slope = information - np.eye(wide.size), information @ state

    def fitted(*free: str) -> tuple[float, Floats, Floats]:
        """Evidence, state and covariance if only these are as uncertain as `WIDE`; exact for a linear model."""
        prior = np.ones(wide.size)
        for name, tolerance in NOMINAL.items():
            if name not in free:
                prior[wide.names.index(name)] = (WIDE[name] / tolerance) ** 2
        covariance: Floats = np.asarray(np.linalg.inv(data + np.diag(prior)), dtype=np.float64)
        _, volume = np.linalg.slogdet(np.eye(wide.size) + data / prior[:, None])
        return 0.5 * float(slope @ covariance @ slope - volume), covariance @ slope, covariance

    plain, first, _ = fitted()
    found = []
    for name in NOMINAL:
        evidence, own, covariance = fitted(name)
        found.append(_explained(wide, name, own, covariance, evidence - plain))
    tight = _problem(readings, lag, NOMINAL)
    before = dict(zip(wide.names, first, strict=False))
    for name, tolerance in NOMINAL.items():
        before[name] *= WIDE[name] / tolerance
    rest = first[len(wide.names) :]
    reference = _log_evidence(tight, np.concatenate([[before[name] for name in tight.names], rest]), noise)
    other = _problem(readings, lag, {**NOMINAL, "viscosity": WIDE["viscosity"]})
    solved = []
    for start in STARTS:
        known = {**before, "viscosity": start}
        solved.append(other.solved(np.concatenate([[known[name] for name in other.names], rest]), noise))
    best = max(solved, key=lambda one: _log_evidence(other, one, noise))
    covariance = np.asarray(np.linalg.inv(other.information(best, noise)), dtype=np.float64)
    evidence = _log_evidence(other, best, noise) - reference
    found.append(_explained(other, "viscosity", best, covariance, evidence))
    return found


def _explained(problem: FitProblem, name: str, state: Floats, covariance: Floats, evidence: float) -> Explanation:
    unknown, place = problem.unknowns[name], problem.names.index(name)
    half = 1.645 * math.sqrt(float(covariance[place, place]))
    value, low, high = (float(unknown.at(state[place] + one)) / unknown.factor for one in (0.0, -half, half))
    unit = f" {unknown.unit}" if unknown.unit else " × the file's"
    return Explanation(name, evidence, f"{value:.2g}{unit} ({low:.2g} to {high:.2g})", False)


def _problem(readings: Sequence[FittedReadings], lag: Unknown, deviations: Mapping[str, float]) -> FitProblem:
    """A fit of lag, flow, and quantities with these deviations before it."""
    problem = FitProblem([name for name in UNKNOWNS if name in {"lag", "flow", *deviations}], lag, readings)
    for name, deviation in deviations.items():
        problem.unknowns[name] = replace(problem.unknowns[name], deviation=deviation)
    problem.onset_wander = ONSET_WANDER
    return problem


def _log_evidence(problem: FitProblem, state: Floats, noise: Floats) -> float:
    """Laplace's approximation, without the terms that all problems of the same readings and noise share."""
    misses = sum(float(np.sum((r / s) ** 2)) for r, s in zip(problem.residuals(state), noise, strict=True))
    _, information = np.linalg.slogdet(problem.information(state, noise))
    return -0.5 * (misses + float(state @ state) + float(information))
