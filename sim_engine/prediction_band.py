"""Prediction intervals: how far a single pour may deviate from its simulations.

Contributions are the seeds, θ, shapes, the residual of the calibration, and the resolution. `band` and `band_of` return
a `PredictionInterval`; `SampleStatistics` holds the mean over seeds and the deviation of a single one.

Model. The liquid that lands beyond the rim is the tail of a stream whose landing positions scatter about their median,
approximately normally: r = Φ(z). Here z is the median's distance past the rim, in units of the stream's width. If a
simulator's stream lands slightly off, its error is a shift of z. The shift changes r by almost nothing if the whole
stream hits or misses, and most if half of it does. Therefore errors of the simulator are stated as standard deviations
of that shift.

The calibration residual was measured with coarse particles, and contains their error in its own scenes. There, the
share of the resolution is left out, and the scatter s of the simulations, which the residual contains, is subtracted.
In other scenes the larger of the residual and the error of coarse particles is used. With n simulations of a pour:

    in a scene of the calibration:  width² = max(residual² − s², 0) + 2 s² / n
    in another scene:               width² = max(resolution, residual, finer)² + 2 s² / n
    without a calibration:          width² = max(resolution, uncalibrated, finer)² + 2 s² / n

`finer` is the shift of a simulation with many more particles, if there is one; it moves the interval, too. The
width is that of the normal distribution about each simulation; their mixture is the distribution of the pour. A band
is the interval of r that contains a single pour with probability `LEVEL`.

Source: derived here; measured in docs/evidence/validation.md (landing, convergence), and compared with unseen pours in
docs/evidence/first-pours.md.

Limitations: the shift of one pour does not determine that of another, or the liquid that stays in the pourer. The
residual contains s² twice, of the simulation and of the pour that it was compared with. It is subtracted once only, as
a residual of few pours is uncertain. A residual belongs to the number of particles it was measured with.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from statistics import NormalDist

from sim_engine.outcome import PourOutcome
from sim_engine.scene import Scene

LEVEL = 0.9
"""Probability with which a single pour lies in its band."""

RESOLUTION, RESOLUTION_AT = 0.25, 1_000
"""Shift caused by coarse particles (standard deviation), and the number of particles at which it was measured. It is
about the root mean square of Φ⁻¹(r) − Φ⁻¹(fine) over those of the nineteen pours of `benchmarks.validation.convergence`
that spill more than one in a thousand (fifteen), with the spillage of 10,000 particles as `fine`. Among pours that have
converged it is half of it; splashes, which do not converge, differ more. With 500 particles it was 0.32: the error
decreases with the spacing, as N^(−1/3)."""

UNCALIBRATED = 0.97
"""Shift of a pour from an uncalibrated simulator (standard deviation): root mean square on the ten benches of
configs/studies/benches.yaml, which were drawn before they were used (`benchmarks/uncalibrated.py`): 0.97 for the 80
pours into the vessels of its calibration, 0.93 with 40 more into those of its deployment. A bench with larger errors of
placement deviates more."""

_NORMAL = NormalDist()
_WIDEST = 8.0
"""Φ is 0 or 1 to the last bit beyond this."""
_NARROWEST = 1e-6
"""Least width of the normal distribution about a simulation."""


@dataclass(frozen=True)
class CalibrationResidual:
    """What a calibration leaves of the difference between simulated and weighed pours.

    Attributes:
        shift: standard deviation of the shift, see `left_over`.
        scenes: scenes of the weighed pours, see `scene_digest`; empty if unknown, so that every scene is another one.
        here: whether one of them is the scene of the pours that are predicted, see `at`.
    """

    shift: float
    scenes: tuple[str, ...] = ()
    here: bool = False

    @classmethod
    def of(cls, shift: float, scenes: Iterable[Scene]) -> CalibrationResidual:
        """The residual of pours in some scenes."""
        return cls(shift, tuple(sorted({digest for scene in scenes if (digest := scene_digest(scene)) is not None})))

    def at(self, scene: Scene) -> CalibrationResidual:
        """The residual for predictions of pours in a scene. It reads the mesh files of the vessels."""
        return replace(self, here=bool(self.scenes) and scene_digest(scene) in self.scenes)


def scene_digest(scene: Scene) -> str | None:
    """Identity of a scene for a residual, in 16 digits; None if the mesh file of a vessel can't be read.

    Scenes are the same if they have the same shapes of pourer and receiver and the same load of the same liquid. Names
    don't matter, nor how the pourer is moved.
    """
    try:
        vessels = scene.pourer.content_hash(), scene.receiver.content_hash()
    except OSError:
        return None
    liquid = scene.liquid.model_dump_json(exclude={"name"})
    return hashlib.sha256(" ".join((*vessels, liquid)).encode()).hexdigest()[:16]


@dataclass(frozen=True)
class PredictionInterval:
    """Interval of the spillage of a single pour.

    Attributes:
        low, high: ends of the interval of r = spilled / poured; less than half a particle counts as 0.
        level: probability with which a pour lies in it.
        simulations: standard deviation of r over the seeds, and over θ and the vessels' shapes if they varied.
        discrepancy: standard deviation due to the best θ's residual against weighed pours; None without calibration.
            In a scene of the calibration, without the scatter of the simulations.
        resolution: standard deviation due to the number of particles; 0 in a scene of the calibration, whose residual
            contains it.
    """

    low: float
    high: float
    level: float
    simulations: float
    discrepancy: float | None
    resolution: float

    def holds(self, spillage: float) -> bool:
        """Whether a pour lies in it."""
        return self.low <= spillage <= self.high

    def percent(self, decimals: int = 1) -> str:
        """As text: '1.2 … 6.0 %'."""
        return f"{100 * self.low:.{decimals}f} … {100 * self.high:.{decimals}f} %"


def resolution_shift(particles: int) -> float:
    """Standard deviation of the shift between a simulation with so many particles and its limit."""
    return float(RESOLUTION * (RESOLUTION_AT / particles) ** (1.0 / 3.0))


def lacking_shift(particles: int, residual: CalibrationResidual | None, spread: float) -> float:
    """Standard deviation of the shift between a pour and its simulations, beyond their scatter.

    Args:
        particles: of a simulation.
        residual: of the calibration, for the scene of the pour; None without calibration.
        spread: standard deviation of the shift over the simulations.
    """
    if residual is not None and residual.here:
        return math.sqrt(max(residual.shift**2 - spread**2, 0.0))
    return max(resolution_shift(particles), 0.0 if residual is None else residual.shift)


def shift_of(spillage: float, particles: int) -> float:
    """z of a simulated spillage. If no particle or every particle is spilled, half a particle is added or subtracted.

    Args:
        spillage: r.
        particles: that r was counted with.
    """
    least = 0.5 / (particles + 1)
    return _NORMAL.inv_cdf(min(max(spillage, least), 1.0 - least))


def left_over(pairs: Sequence[tuple[float, float]], fitted: int) -> float | None:
    """The residual shift of a calibration: the difference between θ* and the pours to which it was fitted.

    Args:
        pairs: measured and simulated r of every pour.
        fitted: number of fitted parameters.

    Returns:
        Standard deviation of the shift about 0; None if there are no more pours than parameters.
    """
    if len(pairs) <= fitted:
        return None
    shifts = [shift_of(measured, RESOLUTION_AT) - shift_of(simulated, RESOLUTION_AT) for measured, simulated in pairs]
    return math.sqrt(math.fsum(z * z for z in shifts) / (len(pairs) - fitted))


def band(
    spillages: Sequence[float],
    particles: int,
    residual: CalibrationResidual | None = None,
    level: float = LEVEL,
    finer: float = 0.0,
    least: float = 0.0,
) -> PredictionInterval:
    """The interval of a single pour, given its simulations.

    Args:
        spillages: r of simulations of the pour with fresh seeds, which may alternate between θ of a posterior and
            between possible shapes of the vessels; ≥ 1.
        particles: of a simulation.
        residual: of the calibration, for the scene of the pour with the vessels as they are known; None without
            calibration.
        level: probability with which a pour lies in it.
        finer: shift of a simulation with many more particles; it moves the interval, and is the least
            standard deviation of what still finer ones would add. 0 without one.
        least: standard deviation of the shift that the pour has at least, beyond the scatter of its simulations.

    Raises:
        ValueError: no simulation, or a level that is not between 0 and 1.
    """
    if not spillages or not 0.0 < level < 1.0:
        raise ValueError(f"a band needs simulations and a level between 0 and 1, not {len(spillages)} and {level}")
    count = len(spillages)
    places = [shift_of(r, particles) + finer for r in spillages]
    mean = math.fsum(places) / count
    spread = math.fsum((z - mean) ** 2 for z in places) / (count - 1) if count > 1 else 0.0
    here = residual is not None and residual.here
    lacking = max(lacking_shift(particles, residual, math.sqrt(spread)), abs(finer), least)
    # The mixture of the simulations has a variance of s² (n − 1) / n; a further one differs from their mean by
    # s² (n + 1) / n.
    width = max(math.sqrt(lacking**2 + 2.0 * spread / count), _NARROWEST)
    steep, half = _NORMAL.pdf(mean), 0.5 / (particles + 1)
    low, high = (_NORMAL.cdf(_quantile(places, width, 0.5 * (1.0 + side * level))) for side in (-1.0, 1.0))
    return PredictionInterval(
        low if low > half else 0.0,
        high if high < 1.0 - half else 1.0,
        level,
        steep * math.sqrt(spread),
        None if residual is None else steep * (lacking if here else residual.shift),
        0.0 if here else steep * max(resolution_shift(particles), abs(finer)),
    )


def band_of(
    outcomes: Sequence[PourOutcome], residual: CalibrationResidual | None = None, finer: float = 0.0
) -> PredictionInterval | None:
    """The band of one pour's simulations; None if none of them has a spillage. Without a calibration it has the width
    that an uncalibrated simulator needs.

    Args:
        outcomes: of the same action, with fresh seeds, perhaps of several θ and shapes.
        residual, finer: as in `band`.
    """
    usable = [outcome for outcome in outcomes if outcome.invalid is None]
    spillages = [r for outcome in usable if (r := outcome.fractions.spillage) is not None]
    if not spillages:
        return None
    least = UNCALIBRATED if residual is None else 0.0
    return band(spillages, usable[0].particles, residual, finer=finer, least=least)


def _quantile(places: Sequence[float], width: float, share: float) -> float:
    """The quantile of a mixture of normal distributions with equal weights, by bisection."""
    low, high = -_WIDEST, _WIDEST
    for _ in range(60):
        middle = 0.5 * (low + high)
        below = math.fsum(_NORMAL.cdf((middle - z) / width) for z in places) / len(places)
        low, high = (middle, high) if below < share else (low, middle)
    return 0.5 * (low + high)


FRACTIONS = ("received", "spilled", "retained", "in_flight", "escaped")
"""Fractions of a `PourOutcome`; they add up to 1."""


@dataclass(frozen=True)
class SampleStatistics:
    """A quantity over seeds.

    Attributes:
        mean: of all seeds.
        deviation: standard deviation of one seed (n − 1 in the denominator); None for a single one.
        count: seeds.
    """

    mean: float
    deviation: float | None
    count: int

    @classmethod
    def of(cls, values: Sequence[float]) -> SampleStatistics | None:
        """The statistics of some values; None without values."""
        if not values:
            return None
        mean = math.fsum(values) / len(values)
        if len(values) == 1:
            return cls(mean, None, 1)
        return cls(mean, math.sqrt(math.fsum((v - mean) ** 2 for v in values) / (len(values) - 1)), len(values))

    def percent(self, decimals: int = 1) -> str:
        """A fraction as text: '3.1 ± 0.4 %'; of a single seed '3.1 %'."""
        spread = "" if self.deviation is None else f" ± {100 * self.deviation:.{decimals}f}"
        return f"{100 * self.mean:.{decimals}f}{spread} %"


def spreads(outcomes: Sequence[PourOutcome]) -> dict[str, SampleStatistics]:
    """Every fraction of some outcomes of one pour, and 'spillage', r = spilled / poured, over seeds.

    Args:
        outcomes: of the same task except for the seed; invalid ones are left out. Quantities without a valid outcome
            are missing in the result, and so is r if too little was poured.
    """
    valid = [outcome for outcome in outcomes if outcome.invalid is None]
    values = {name: [float(getattr(outcome, name)) for outcome in valid] for name in FRACTIONS}
    values["spillage"] = [r for outcome in valid if (r := outcome.fractions.spillage) is not None]
    statistics = {name: SampleStatistics.of(seeds) for name, seeds in values.items()}
    return {name: spread for name, spread in statistics.items() if spread is not None}
