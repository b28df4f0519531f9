"""Disturbances of a pour: errors of execution and uncertain θ, their draws, and their representation in a surrogate.

`RiskSettings` holds the settings; `Disturbances` makes the draws. The risk measure itself is calculated in the
optimiser.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from typing import Annotated, Literal

import numpy as np

from actors.optimizer.questions import Disturbance, Point, Risk
from orchestrator.learning.campaign_plan import Draw
from sim_engine.liquids import SimulationParameters
from sim_engine.scene import PoseError, PoseNoise
from sim_engine.search_space import Axis, Space
from sim_engine.settings.model import Problems, Settings
from sim_engine.settings.quantity import Quantity

ERRORS = ("x", "y", "tilt", "speed_factor", "z")

FARTHEST = 3.5
"""Limit of drawn errors, in standard deviations; less than one draw in two thousand exceeds it."""

SLOWEST, FASTEST = 0.5, 1.5
"""Bounds of a drawn speed factor, equal to those of the virtual bench."""

WIDTH = 8.0
"""Number of standard deviations in the unit interval, for coordinates in addition to the action. The optimiser's prior
for lengthscales, 0.35, then equals 2.8 of them: an error of one changes the spillage smoothly."""

FEWEST, MOST, IN_TAIL = 32, 256, 6
"""Minimum and maximum number of draws for the surrogate's measure, and the number in the tail of CVaR."""


EXACT = PoseError(speed_factor=0.0)
"""Standard deviations without any error."""


class RiskSettings(Settings):
    """Plan for errors of execution and uncertain θ, instead of one pour that is executed exactly."""

    measure: Literal["expected", "cvar"] = "expected"
    """expected: mean loss over the errors; cvar: mean over the worst fraction 1 − level of them."""

    level: Annotated[float, Quantity("1", "0.9", 0.01, 0.99)] | None = None
    """cvar: from 0, the mean of all, to 1, the single worst; 0.9 unless given."""

    pose_error: PoseNoise = PoseNoise()
    """Standard deviations of the errors, normal and independent."""

    theta: Literal["best", "posterior"] = "best"
    """best: θ* alone; posterior: draws of all θ that fit the weighed pours, from C4 or from `--parameters`."""

    @property
    def tail(self) -> float:
        """β; 0 for the mean, which is CVaR at level 0."""
        return (0.9 if self.level is None else self.level) if self.measure == "cvar" else 0.0

    @property
    def errors(self) -> PoseError:
        """Standard deviations of the errors [m, rad, 1]."""
        return self.pose_error.deviations

    def check(self, complaints: Problems) -> None:
        """Check that a level is given for CVaR only, and that at least one quantity is uncertain."""
        if self.level is not None and self.measure != "cvar":
            complaints.add(
                "belongs to 'measure: cvar'; remove it, or ask for cvar", "risk", "level", key=True, of="risk"
            )
        if self.errors == EXACT and self.theta == "best":
            complaints.add(
                "names nothing that could go wrong; add 'pose_error: {x: 3 mm, speed_factor: 0.02}', or "
                "'theta: posterior'",
                "risk",
                key=True,
            )


class Disturbances:
    """Draws of errors and θ: quasi-random, normal by the inverse distribution function.

    Some errors only shift a searched dimension (x: x_offset, y: y_offset, z: height, speed: angular_velocity). The
    surrogate represents such an error as a shifted action, and observes the executed action. These errors therefore add
    no dimension, and every simulation is informative about its neighbours. Other errors (tilt, or a dimension that is
    not searched) and θ are additional coordinates.

    Source: quasi-random normal draws: Glasserman, Monte Carlo methods in financial engineering, 2003, chapter 5.
    """

    def __init__(
        self,
        risk: RiskSettings,
        actions: Space,
        best: SimulationParameters,
        seed: int,
        thetas: tuple[SimulationParameters, ...] = (),
    ) -> None:
        """Prepare the draws.

        Args:
            best: θ*.
            seed: seed of the draws.
            thetas: equally likely draws of a posterior, used if `risk` selects them.
        """
        self.settings, self._tail, self._deviations = risk, risk.tail, risk.errors
        self._actions, self._best, self._seed = actions, best, seed
        self._thetas = thetas if risk.theta == "posterior" else ()
        self.errors = tuple(name for name in ERRORS if getattr(self._deviations, name) > 0.0)
        folded = {name: _folded(name, actions) for name in self.errors}
        self._moves = {name: axis for name, axis in folded.items() if axis is not None}

    @property
    def nominal(self) -> Draw:
        """The draw without errors, with θ*."""
        return Draw(None, self._best, (0.0,) * len(self.errors))

    def draws(self, count: int, stream: int = 0) -> list[Draw]:
        """The first draws of a sequence, any section of which covers errors and θ evenly.

        Args:
            count: number of draws, at least 1.
            stream: index of the sequence; different streams are independent.
        """
        dimension = len(self.errors) + bool(self._thetas)
        if dimension == 0:
            return [self.nominal] * count
        from scipy.stats import qmc

        sampler = qmc.Sobol(dimension, scramble=True, rng=np.random.default_rng([self._seed, stream]))
        uniform = sampler.random_base2(max(math.ceil(math.log2(count)), 0))[:count]
        return [self._draw(row) for row in uniform]

    def _draw(self, row: Sequence[float]) -> Draw:
        from scipy.special import ndtri

        z = tuple(float(np.clip(ndtri(u), -FARTHEST, FARTHEST)) for u in row[: len(self.errors)])
        offsets = {name: getattr(self._deviations, name) * value for name, value in zip(self.errors, z, strict=True)}
        offsets["speed_factor"] = min(max(1.0 + offsets.get("speed_factor", 0.0), SLOWEST), FASTEST)
        parameters = self._best
        if self._thetas:
            parameters = self._thetas[min(int(row[-1] * len(self._thetas)), len(self._thetas) - 1)]
        return Draw(PoseError(**offsets) if self.errors else None, parameters, z)

    # -- representation in the surrogate ---------------------------------------------------------------------------

    @cached_property
    def risk(self) -> Risk:
        """Disturbances of a query; they are the same for every action."""
        wanted = IN_TAIL / (1.0 - self._tail)
        count = min(max(2 ** math.ceil(math.log2(wanted)), FEWEST), MOST)
        return Risk(tuple(self.disturbance(draw) for draw in self.draws(count, stream=1)), self._tail)

    def disturbance(self, draw: Draw) -> Disturbance:
        """Change of an action in its unit cube caused by a draw."""
        scales, shifts = [1.0] * self._actions.dimension, [0.0] * self._actions.dimension
        error = draw.error or PoseError()
        for name, index in self._moves.items():
            scales[index], shifts[index] = _moved(self._actions.axes[index], name, error)
        extra = [0.5 + z / WIDTH for name, z in zip(self.errors, draw.z, strict=True) if name not in self._moves]
        return Disturbance(tuple(scales), tuple(shifts), (*extra, *self._coordinates(draw.parameters)))

    def executed(self, point: Point, draw: Draw) -> Point:
        """Point of the surrogate for a simulation of an action (in its unit cube) under a draw."""
        error = self.disturbance(draw)
        moved = [s * u + t for u, s, t in zip(point, error.scales, error.shifts, strict=True)]
        return (*moved, *error.context)

    def _coordinates(self, parameters: SimulationParameters) -> Point:
        return tuple(
            0.5 + (_number(parameters, name) - centre) / (WIDTH * spread) for name, centre, spread in self._varying
        )

    @cached_property
    def _varying(self) -> tuple[tuple[str, float, float], ...]:
        """Parameters that differ between the draws, with centre and standard deviation."""
        axes = []
        for name in type(self._best).model_fields:
            values = [_number(theta, name) for theta in self._thetas]
            if len(set(values)) > 1:
                axes.append((name, float(np.mean(values)), float(np.std(values))))
        return tuple(axes)


def _number(parameters: SimulationParameters, name: str) -> float:
    """Value for the surrogate; the number of particles as its logarithm, because it spans decades."""
    value = float(getattr(parameters, name))
    return math.log(value) if name == "particles" else value


def _folded(error: str, actions: Space) -> int | None:
    """Index of the searched axis that an error only shifts; None if there is none."""
    name = {"x": "x_offset", "y": "y_offset", "z": "height", "speed_factor": "angular_velocity"}.get(error)
    if name not in actions.names:
        return None
    index = actions.names.index(name)
    placed = error == "speed_factor" or actions.axes[index].scale == "linear"
    return index if placed else None


def _moved(axis: Axis, error: str, draw: PoseError) -> tuple[float, float]:
    """Scale and shift of an axis' unit interval under an error."""
    width = axis.upper - axis.lower
    if error == "x":
        return 1.0, draw.x / width
    if error == "y":  # the receiver moves, which shifts the pourer the other way
        return 1.0, -draw.y / width
    if error == "z":  # a higher receiver reduces the height of the lip above it
        return 1.0, -draw.z / width
    if axis.scale == "log":
        return 1.0, math.log(draw.speed_factor) / math.log(axis.upper / axis.lower)
    return draw.speed_factor, (draw.speed_factor - 1.0) * axis.lower / width
