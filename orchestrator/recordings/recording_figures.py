"""Pictures of recorded pours: measured and predicted mass, residuals, tilt."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from orchestrator.recordings.recording_fit import Judgement
from orchestrator.recordings.recording_replay import QUANTILE, PourReplay
from orchestrator.recordings.rig_diagnosis import RigDiagnosis
from orchestrator.reports.figure_style import BEST, GREY, INK, MEASURED, PREDICTED, dress, entitle, new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def replay_figure(replay: PourReplay, judged: Judgement | None = None) -> Figure:
    """Measured and predicted mass over time, residuals, and the tilt.

    Args:
        replay: the replay.
        judged: the prediction of a fit, shown in addition.
    """
    recording, estimated = replay.recording, replay.estimated
    figure, (mass, residual, tilt) = new_figure(
        3, 1, size=(7.2, 7.4), sharex=True, gridspec_kw={"height_ratios": (3.0, 2.0, 1.3)}
    )
    entitle(figure, f"Recorded pour {recording.name}")
    times, net = recording.read_times, 1e3 * recording.net
    if replay.simulated is not None:
        mass.plot(times, 1e3 * replay.simulated, color=PREDICTED, lw=1.8, label="simulated from the tilt")
        residual.plot(times, net - 1e3 * replay.simulated, color=PREDICTED, lw=1.2, label="reading − simulated")
    if judged is not None:
        half = QUANTILE * judged.deviation
        low, high = 1e3 * (judged.predicted - half), 1e3 * (judged.predicted + half)
        mass.fill_between(judged.times, low, high, color=BEST, alpha=0.25, lw=0, label="fitted model, 90 %")
        mass.plot(judged.times, 1e3 * judged.predicted, color=BEST, lw=1.2)
    mass.plot(times, net, ".", color=MEASURED, ms=3.5, label="measured")
    for onset, colour in ((replay.onset, MEASURED), (replay.simulated_onset, PREDICTED)):
        if onset is not None:
            mass.axvline(onset.time, color=colour, lw=0.8, ls=":")
    dress(mass, y="in the receiver [g]")
    mass.legend(frameon=False, fontsize=8.5, loc="upper left")
    half = QUANTILE * 1e3 * estimated.deviation
    residual.fill_between(estimated.times, -half, half, color=GREY, alpha=0.3, lw=0, label="estimator, 90 %")
    residual.plot(estimated.times, 1e3 * estimated.innovation, ".", color=INK, ms=3.0, label="innovation")
    limit = max(1.2 * float(np.quantile(np.abs(1e3 * estimated.innovation), 0.99)), 0.5)
    if replay.simulated is not None:
        limit = max(limit, 1.1 * float(np.abs(net - 1e3 * replay.simulated).max()))
    residual.set_ylim(-limit, limit)
    dress(residual, y="difference [g]")
    residual.legend(frameon=False, fontsize=8.5, loc="upper left", ncols=3)
    tilt.plot(recording.tilt_times, np.degrees(recording.tilts), color=INK, lw=1.2)
    dress(tilt, x="time [s]", y="tilt [deg]")
    tilt.set_xlim(recording.tilt_times[0], max(recording.tilt_times[-1], times[-1]))
    return figure


def diagnosis_figure(diagnosis: RigDiagnosis) -> Figure:
    """Evidence of each explanation, and the doses as predicted from the pours next to the weighed ones.

    Args:
        diagnosis: of a first day.
    """
    figure, (evidence, doses) = new_figure(1, 2, size=(8.6, 3.4))
    shown = [cause for cause in reversed(diagnosis.explanations) if np.isfinite(cause.evidence)]
    values = [float(np.clip(cause.evidence, -10.0, 30.0)) for cause in shown]
    evidence.barh(
        [cause.name for cause in shown], values, color=[BEST if cause.stands_out else GREY for cause in shown]
    )
    for row, cause in enumerate(shown):
        if cause.evidence > 30.0:
            evidence.text(29.5, row, f"{cause.evidence:.0f}", ha="right", va="center", color="white", fontsize=8.5)
    evidence.axvline(0.0, color=INK, lw=0.8)
    evidence.set_xlim(-10.0, 30.0)
    dress(evidence, title="Which quantity is wrong?", x="evidence (above 0: likelier than no error)", grid=None)
    for row, dose in enumerate(diagnosis.doses):
        low, high, middle = (1e3 * (mass - dose.weighed) for mass in (dose.low, dose.high, dose.predicted))
        doses.plot([low, high], [row, row], color=PREDICTED, lw=3.0, label="predicted, 90 %" if row == 0 else None)
        doses.plot(middle, row, ".", color=PREDICTED, ms=9.0)
    doses.axvline(0.0, color=MEASURED, lw=1.2, label="weighed")
    doses.set_yticks(range(len(diagnosis.doses)), [dose.name for dose in diagnosis.doses])
    doses.invert_yaxis()
    doses.legend(frameon=False, fontsize=8.5, loc="best")
    dress(doses, title="Doses, predicted from the pours", x="predicted − weighed [g]", grid=None)
    return figure
