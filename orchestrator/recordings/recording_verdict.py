"""Verdict on fits and replays of recorded pours: whether they can be right, and the likely cause if not.

- `fit_doubts` compares a fit with what is known before it, and its residuals with the pour.
- `replay_doubts` compares the readings with the estimator's predictions.
- `likely_cause` tries other meanings of the columns: mass in another unit, a wrist turned by 90°, clocks that differ, a
  zero of the tilt elsewhere.

`orchestrator.recordings.recording_checks` refuses what hydrostatics excludes; here is what it allows but a rig that was
set up with care does not show.

Limitations: errors within the tolerances of `UNKNOWNS` are fitted, not seen. A cause is named only if the readings
agree with it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from orchestrator.recordings.recording_file import PourRecording
from orchestrator.recordings.recording_fit import UNKNOWNS, Fit, fit_recordings
from orchestrator.recordings.recording_replay import PourReplay

FARTHEST = 3.0
"""Largest deviation of a fitted value from what is known before, in standard deviations."""

RESIDUAL_SHARE, RESIDUAL_LEAST = 0.05, 0.5e-3
"""Largest RMS of the residuals, as a share of the poured mass, and in any case allowed [kg]."""

MOST_INNOVATION = 4.0
"""Largest mean of (innovation / its deviation)² of a replay; 1 is right, and the shipped recordings have up to 2."""

FEWEST = 10
"""Least number of compared readings of a replay that is judged."""

MASSES = {"ounces": ("oz", 28.349523), "pounds": ("lb", 453.59237)}
"""Units that a balance may have been set to: unit in a column's name, and grams."""

QUARTER = 0.5 * math.pi

CLOCKS = (-2.0, -1.0, -0.5, 0.5, 1.0, 2.0)
"""Differences of the two clocks that are tried [s]."""


def fit_doubts(fit: Fit, recordings: Sequence[PourRecording]) -> list[str]:
    """Reasons why a fit can't be right; none if it can.

    Args:
        fit: by `fit_recordings`.
        recordings: the same ones.
    """
    doubts = []
    for estimate in fit.values:
        unknown = UNKNOWNS[estimate.name]
        if abs(estimate.deviations) > FARTHEST:
            middle, spread = unknown.middle / unknown.factor, unknown.deviation / unknown.factor
            usual = f"{middle:g} × / ÷ {math.exp(spread):.2g}" if unknown.logarithmic else f"{middle:g} ± {spread:g}"
            doubts.append(
                f"{estimate.name} would have to be {estimate.value / unknown.factor:.3g}"
                f"{' ' + unknown.unit if unknown.unit else ''}, where {usual} is usual"
            )
    for recording, rms, own in zip(recordings, fit.rms, fit.own_deviations, strict=True):
        if rms > max(RESIDUAL_SHARE * abs(recording.gain), RESIDUAL_LEAST, 3.0 * recording.step):
            doubts.append(
                f"{recording.name}: residuals of {1e3 * rms:.3g} g (RMS) in a pour of {1e3 * recording.gain:.3g} g"
            )
        elif own > FARTHEST:
            doubts.append(
                f"{recording.name}: its onset, flow or fill is {own:.1f} standard deviations from the usual one"
            )
    return doubts


def replay_doubts(replay: PourReplay) -> list[str]:
    """Reasons why the readings do not belong to the recorded tilt; none if they can."""
    squared = replay.normalised_innovation
    if replay.compared.sum() < FEWEST or squared <= MOST_INNOVATION:
        return []
    return [
        f"{replay.recording.name}: the readings do not follow from the recorded tilt (mean normalised innovation "
        f"squared {squared:.1f}, where 1 is right)"
    ]


def likely_cause(recordings: Sequence[PourRecording], unknowns: Sequence[str] = ("grip", "lag")) -> str:
    """The other meaning of the columns with which the readings agree best, and what to do; '' if there is none."""
    if still := [recording for recording in recordings if not np.ptp(recording.readings)]:
        readings = still[0].readings
        return (
            f"all {len(readings)} readings of {still[0].name} are {1e3 * readings[0]:.6g} g: the balance or its "
            "recording stood still, or nothing reached the receiver; record the pour again"
        )
    explanations = []
    for order, (cause, change) in enumerate(_other_meanings(recordings)):
        changed = [change(recording) for recording in recordings]
        fit = fit_recordings(changed, unknowns)
        if not fit_doubts(fit, changed):
            misses = [rms / max(abs(recording.gain), 1e-4) for rms, recording in zip(fit.rms, changed, strict=True)]
            strain = max([*(abs(estimate.deviations) for estimate in fit.values), *fit.own_deviations])
            explanations.append((max(misses) / RESIDUAL_SHARE + strain / FARTHEST, order, cause))
    return min(explanations)[2] if explanations else ""


def _other_meanings(
    recordings: Sequence[PourRecording],
) -> Iterator[tuple[str, Callable[[PourRecording], PourRecording]]]:
    """Likely causes, each with the recording as it would then be."""

    def tilted(by: float) -> Callable[[PourRecording], PourRecording]:
        return lambda recording: replace(recording, tilts=recording.tilts + by)

    def later(by: float) -> Callable[[PourRecording], PourRecording]:
        return lambda recording: replace(recording, tilt_times=recording.tilt_times + by)

    for name, (unit, grams) in MASSES.items():
        yield f"these masses look like {name}; name the column mass_{unit}", _weighed(grams)
    for sign, text in ((-1.0, "minus"), (1.0, "plus")):
        yield (
            f"these tilts look like those of a wrist that is turned by 90°; write them {text} 90°",
            tilted(sign * QUARTER),
        )
    for by in CLOCKS:
        text = f"the times of the tilt look about {abs(by):g} s too {'late' if by < 0.0 else 'early'}"
        yield f"{text} against those of the balance; record both with one clock", later(by)
    offset = fit_recordings(recordings, ("grip",))["grip"].value
    size, side = math.degrees(abs(offset)), "high" if offset < 0.0 else "low"
    yield f"the zero of the tilt looks about {size:.0f}° too {side}; write tilts from upright", tilted(offset)


def _weighed(factor: float) -> Callable[[PourRecording], PourRecording]:
    def changed(recording: PourRecording) -> PourRecording:
        placed = tuple(replace(reading, mass=factor * reading.mass) for reading in recording.placed)
        step = None if recording.balance.step is None else min(factor * recording.balance.step, 0.1)
        noise = min(factor * recording.balance.noise, 0.1)
        return replace(
            recording,
            readings=factor * recording.readings,
            zero=factor * recording.zero,
            placed=placed,
            balance=recording.balance.model_copy(update={"step": step, "noise": noise}),
        )

    return changed


def verdict_sentence(doubts: Sequence[str], cause: str) -> str:
    """One sentence: the reasons, and the likely cause."""
    unexplained = "check unit and zero of tilt and mass, the clocks of both, vessel and fill"
    return f"{'; '.join(doubts)}; {cause or unexplained}"


def unlikely(recordings: Sequence[PourRecording], fit: Fit) -> str:
    """The verdict on a fit, with its likely cause; '' if the fit can be right."""
    doubts = fit_doubts(fit, recordings)
    asked = [estimate.name for estimate in fit.values if estimate.name != "flow"]
    return verdict_sentence(doubts, likely_cause(recordings, asked)) if doubts else ""
