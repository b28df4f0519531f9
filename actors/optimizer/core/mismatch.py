"""How a bench may differ from its simulator, as a question says it and an answer tells it: plain values."""

from __future__ import annotations

from dataclasses import dataclass

Numbers = tuple[float, ...]


@dataclass(frozen=True)
class Play:
    """How far one axis may be off, as standard deviations.

    Attributes:
        shift: of an offset, in units of the axis' unit interval.
        factor: of the logarithm of a factor on the axis' value.
        origin: lower bound over range, so that a factor f moves u to f u + (f − 1) origin.
    """

    shift: float = 0.0
    factor: float = 0.0
    origin: float = 0.0


@dataclass(frozen=True)
class Displacement:
    """The simulator's action scales · u + shifts does what u does on the bench; in units of the cube."""

    scales: Numbers
    shifts: Numbers


@dataclass(frozen=True)
class Limit:
    """No pour whose loss is above `loss` (in the cost's unit) with more than `probability`."""

    loss: float
    probability: float


@dataclass(frozen=True)
class Mismatch:
    """For `mean='adaptive'`: the ways in which the simulator may be wrong, and what a pour is worth.

    Attributes:
        play: of each axis.
        drawn: displacements that are likelier than others, equally likely: what a calibration, or pours into another
            receiver, said about the bench.
        ignorance: prior probability that the simulator says nothing of this bench.
        worst: largest cost.
        left: real observations that follow the one that is proposed.
        limit: that proposals keep, if any action does.
        looks_ahead: whether the next observation may be made for what it tells of other places.
    """

    play: tuple[Play, ...]
    drawn: tuple[Displacement, ...] = ()
    ignorance: float = 0.08
    worst: float = 1.0
    left: int = 0
    limit: Limit | None = None
    looks_ahead: bool = True


@dataclass(frozen=True)
class MismatchFound:
    """What the observations say about the simulator.

    Attributes:
        ignorance: probability that the simulator says nothing of this bench.
        shifts: of the cube's centre, by which the simulator's action differs; mean over all other hypotheses.
        deviations: of these shifts.
        factor: real over simulated cost, the median of those hypotheses.
        gain: by how much one more observation is expected to lower the least expected cost; None before any was made,
            and where no action keeps the limit.
        exceedances: at the proposals: probabilities that an observation is above the limit; empty without one.
        least_exceedance: the smallest that any action has; None without a limit.
        drawn: displacements drawn from the posterior, for another receiver; only with `count=0`.
    """

    ignorance: float
    shifts: Numbers
    deviations: Numbers
    factor: float
    gain: float | None = None
    exceedances: Numbers = ()
    least_exceedance: float | None = None
    drawn: tuple[Displacement, ...] = ()
