"""Residuals of single weighed pours, pours that do not fit, and θ* without them.

- `pour_residuals` compares each pour with its simulation. Its interval is that in which nearly every pour lies if it is
  a pour as the others are.
- Two training pours whose weights were exchanged pull θ* towards both, and may each stay inside their intervals. They
  are recognised as a pair, by shifts that were weighed in the opposite order of the simulated ones.
- `without_misfits` selects θ* again, from the simulations that exist, on the pours that fit. C4 with a given
  number of simulations has simulated each θ at one action only; `misfit_sentence` then advises to calibrate again.

Limitation: of two pours that spill nearly the same amount, an exchange can't be recognised. Of 12 pours, a third of
the exchanges are recognised if the shifts differ by 2.5 deviations of a pour, and seven of eight at 4, such as 1 and
6 % with 2,000 particles. Without an exchange, a pair is named in 1 of 100 tables, or in 7 if θ* leaves more than the
error of the particles, because the deviation of few pours is uncertain.

The module decides about no pour: a pour that does not fit may be a swapped weight, or the only one of its kind.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from statistics import NormalDist, fmean, median

from pydantic import Field

from orchestrator.learning.campaign_plan import MeasuredPour
from orchestrator.learning.stage_result import ResultPart, displayed_action
from sim_engine.action import ACTION_DIMENSIONS
from sim_engine.prediction_band import resolution_shift, shift_of

LEAST_POURS = 5
"""Least number of training pours whose residuals are compared with each other."""

DEVIATIONS = 3.0
"""Half width of a pour's interval, in robust standard deviations of the training pours' residuals."""

WEIGHING = 0.02
"""Deviation of a weighed pour from its repetition, as a share of the poured liquid, that is always allowed."""

SETTLED = 2.0
"""Largest residual of two pours with their weights exchanged, in deviations of a pour. After a single wrong weight it
is larger."""

EXCHANGED = 0.01
"""Largest expected number of pairs that look as exchanged as a named one in a table where nothing was exchanged."""

_NORMAL = NormalDist()
_MAD = 1.0 / _NORMAL.inv_cdf(0.75)
"""Standard deviation of a normal distribution by its median absolute deviation."""


class SpillageResidual(ResultPart):
    """A weighed pour with its simulation by θ*, as shares of the poured liquid."""

    number: int
    """Place of the pour among all weighed pours of the calibration, from 1."""

    line: int | None
    """Line of the table that the pour is from."""

    split: str
    """'train', 'test' or 'transfer'."""

    scene: str
    """Name of the scene."""

    action: dict[str, float | None]
    """Action in the units of tables: {'max_angle_deg': 100.0, …}."""

    measured: float
    """Weighed spillage r."""

    simulated: float | None
    """Simulated spillage c_s; None if it is undefined."""

    residual: float | None
    """r − c_s."""

    low: float | None
    """Lower end of the interval of r; None with fewer than five training pours."""

    high: float | None
    """Upper end of the interval of r."""

    fits: bool | None
    """Whether r lies in the interval, and is not exchanged with another pour's; None if there is no interval."""

    exchanged_with: int | None = None
    """Number of the pour whose weight seems to be exchanged with this one's."""

    remarks: dict[str, str] = Field(default_factory=dict)
    """Other columns of the table."""

    @property
    def name(self) -> str:
        """The pour as the user can find it: 'pour 3 (line 4)'."""
        return f"pour {self.number}" + ("" if self.line is None else f" (line {self.line})")


class WithoutMisfits(ResultPart):
    """θ* if the pours that do not fit were left out, selected from the simulations that exist."""

    pours: tuple[int, ...]
    """Numbers of the training pours that are left out."""

    theta: dict[str, float]
    """Searched parameters."""

    discrepancy: float
    """Mean |r − c_s| of the remaining training pours with it."""

    discrepancy_now: float
    """Mean |r − c_s| of the remaining training pours with θ*."""


@dataclass(frozen=True)
class ResidualPair:
    """A weighed pour and its simulation with θ*.

    Attributes:
        scene: name of the scene.
        simulated: c_s; None if it is undefined.
    """

    pour: MeasuredPour
    scene: str
    simulated: float | None


def pour_residuals(pours: Sequence[ResidualPair], particles: int) -> tuple[SpillageResidual, ...]:
    """Residuals of all pours with a spillage.

    The scale of a pour's interval is the median of the *other* training pours' shifts, so that it does not hide itself;
    shifts are explained in `sim_engine.prediction_band`. It is at least the error of the particles.

    Args:
        pours: weighed pours in the order of the user's table.
        particles: of a simulation.
    """
    shifts: dict[int, float] = {}
    for i, entry in enumerate(pours):
        r, c = entry.pour.spillage, entry.simulated
        if r is not None and c is not None and entry.pour.split == "train":
            shifts[i] = abs(shift_of(r, particles) - shift_of(c, particles))
    residuals = []

    def scale(*left_out: int) -> float:
        others = [z for k, z in shifts.items() if k not in left_out]
        return max(_MAD * median(others), resolution_shift(particles))

    exchanged = _exchanged(pours, sorted(shifts), particles, scale) if len(shifts) >= LEAST_POURS else {}
    for i, entry in enumerate(pours):
        r, c, pour = entry.pour.spillage, entry.simulated, entry.pour
        if r is None:
            continue
        low = high = None
        if c is not None and len(shifts) >= LEAST_POURS:
            place, half = shift_of(c, particles), DEVIATIONS * scale(i)
            low, high = (_NORMAL.cdf(place + side * half) + side * WEIGHING for side in (-1.0, 1.0))
            low, high = max(low, 0.0), min(high, 1.0)
        residuals.append(
            SpillageResidual(
                number=i + 1,
                line=pour.line,
                split=pour.split,
                scene=entry.scene,
                action=displayed_action({name: getattr(pour.action, name) for name in ACTION_DIMENSIONS}),
                measured=r,
                simulated=c,
                residual=None if c is None else r - c,
                low=low,
                high=high,
                fits=None if low is None or high is None else low <= r <= high and i not in exchanged,
                exchanged_with=exchanged[i] + 1 if i in exchanged else None,
                remarks=dict(pour.remarks),
            )
        )
    return tuple(residuals)


def _exchanged(
    pours: Sequence[ResidualPair], train: Sequence[int], particles: int, scale: Callable[[int, int], float]
) -> dict[int, int]:
    """The two training pours whose weights seem to be exchanged, each with the other; empty if there are none.

    Δr and Δc are the differences of two pours' weighed and simulated shifts, in deviations of a pour. An exchange makes
    the squares of both residuals larger by t = −2 Δr Δc. Without it Δr is Δc with a scatter of √2, so that t exceeds a
    value with the probability Φ(−(t / 2|Δc| + |Δc|) / √2).
    """
    weighed, simulated = {}, {}
    for i in train:
        r, c = pours[i].pour.spillage, pours[i].simulated
        assert r is not None
        assert c is not None
        weighed[i], simulated[i] = shift_of(r, particles), shift_of(c, particles)
    gains: dict[tuple[int, int], float] = {}
    distances: list[float] = []
    for i, k in itertools.combinations(train, 2):
        deviation = scale(i, k)
        apart = (simulated[i] - simulated[k]) / deviation
        distances.append(abs(apart))
        if max(abs(weighed[i] - simulated[k]), abs(weighed[k] - simulated[i])) <= SETTLED * deviation:
            gains[i, k] = -2.0 * apart * (weighed[i] - weighed[k]) / deviation
    if not gains:
        return {}
    pair = max(gains, key=lambda places: gains[places])
    expected = sum(_NORMAL.cdf(-(gains[pair] / (2.0 * d) + d) / math.sqrt(2.0)) for d in distances if d)
    return dict((pair, pair[::-1])) if gains[pair] > 0.0 and expected < EXCHANGED else {}


def without_misfits(
    residuals: Sequence[SpillageResidual], trials: Sequence[tuple[Mapping[str, float], Sequence[float | None]]]
) -> WithoutMisfits | None:
    """θ* without the training pours that do not fit; None if all fit, or no θ was simulated on all others.

    Args:
        residuals: as `pour_residuals` returns them.
        trials: θ with its |r − c_s| on every usable training pour, in the same order; None where there is none.
    """
    train = [pour for pour in residuals if pour.split == "train"]
    kept = [i for i, pour in enumerate(train) if pour.fits is not False and pour.residual is not None]
    if len(kept) == len(train) or not kept:
        return None
    complete = [
        (fmean(differences), theta)
        for theta, costs in trials
        if len(costs) == len(train)
        and len(differences := [c for i in kept if (c := costs[i]) is not None]) == len(kept)
    ]
    if not complete:
        return None
    discrepancy, theta = min(complete, key=lambda pair: pair[0])
    return WithoutMisfits(
        pours=tuple(pour.number for pour in train if pour.fits is False),
        theta=dict(theta),
        discrepancy=discrepancy,
        discrepancy_now=fmean(abs(train[i].residual or 0.0) for i in kept),
    )


def misfit_sentence(residuals: Sequence[SpillageResidual], without: WithoutMisfits | None) -> str:
    """Names the pours that do not fit and what θ* would be without them; '' if all fit."""
    misfits = [pour for pour in residuals if pour.fits is False and pour.split != "transfer"]
    if not misfits:
        return ""
    count = sum(pour.split != "transfer" for pour in residuals)
    named = "; ".join(
        f"{pour.name} weighed {_percent(pour.measured)}, simulated {_percent(pour.simulated)} "
        f"({_percent(pour.low)} … {_percent(pour.high)} expected)"
        for pour in misfits
    )
    verb = "does" if len(misfits) == 1 else "do"
    text = f"{len(misfits)} of {count} pours {verb} not fit the others: {named}; check what was entered for them"
    if exchanged := [pour for pour in misfits if pour.exchanged_with is not None]:
        text += f"; the weights of {' and '.join(pour.name for pour in exchanged)} seem to be exchanged"
    if without is not None:
        values = ", ".join(f"{name} {value:.3g}" for name, value in without.theta.items())
        text += (
            f"; without them θ* would be {values}, mean |Δ| of the others {_percent(without.discrepancy)} "
            f"(now {_percent(without.discrepancy_now)})"
        )
    elif any(pour.split == "train" and pour.line is not None for pour in misfits):
        text += "; for θ* without them, enter 'test' as their 'split' and calibrate again"
    return text


def _percent(share: float | None) -> str:
    return "undefined" if share is None else f"{100 * share:.1f} %"
