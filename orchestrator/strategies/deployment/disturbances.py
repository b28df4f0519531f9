"""Errors of execution and θ that an action has to bear: their draws, and how a surrogate sees them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from functools import cached_property
from typing import Annotated, Literal

import numpy as np

from actors.optimizer.questions import Disturbance, Point, Risk
from orchestrator.strategies.campaign_plan import Draw
from sim_engine.liquids import SimulationParameters
from sim_engine.scene import PoseError
from sim_engine.search_space import Axis, Space
from sim_engine.settings.model import Problems, Section
from sim_engine.settings.quantity import Quantity

ERRORS = ("x", "y", "tilt", "speed_factor", "z")

FARTHEST = 3.5
"""Standard deviations beyond which no error is drawn: less than one in two thousand."""

SLOWEST, FASTEST = 0.5, 1.5
"""Bounds of a drawn speed factor, those of the virtual bench."""

WIDTH = 8.0
"""Standard deviations on the unit interval, for what the surrogate sees beside the action. The optimiser's prior for
lengthscales, 0.35, is then 2.8 of them: an error of one changes the spillage smoothly."""

FEWEST, MOST, IN_TAIL = 32, 256, 6
"""Draws over which the surrogate's measure is formed: at least, at most, and so many in the tail of CVaR."""


EXACT = PoseError(speed_factor=0.0)
"""Standard deviations of errors that are none."""


Offset = Annotated[float, Quantity("m", "1 mm", -0.05, 0.05)]
Tilt = Annotated[float, Quantity("rad", "1 deg", -0.2, 0.2)]
Factor = Annotated[float, Quantity("1", "1.02", 0.5, 1.5)]
Spread = Annotated[float, Quantity("1", "0.01", 0.0, 0.5)]


class PoseErrorSection(Section):
    """How the real placement differs from the intended one."""

    x: Offset = 0.0
    """The receiver stands that much further from the pourer."""

    y: Offset = 0.0
    """… and that much sideways."""

    z: Offset = 0.0
    """… and that much higher."""

    tilt: Tilt = 0.0
    """The pourer is held that much more tilted than commanded."""

    speed_factor: Factor = 1.0
    """Executed over commanded angular velocity."""


class PoseNoiseSection(Section):
    """Standard deviations of the same from pour to pour."""

    x: Annotated[float, Quantity("m", "0.5 mm", 0.0, 0.05)] = 0.0
    """Standard deviation of the distance."""

    y: Annotated[float, Quantity("m", "0.5 mm", 0.0, 0.05)] = 0.0
    """Standard deviation of the sideways placement."""

    z: Annotated[float, Quantity("m", "0.5 mm", 0.0, 0.05)] = 0.0
    """Standard deviation of the receiver's height."""

    tilt: Annotated[float, Quantity("rad", "0.3 deg", 0.0, 0.2)] = 0.0
    """Standard deviation of the tilt."""

    speed_factor: Spread = 0.0
    """Standard deviation of executed over commanded angular velocity."""


class RiskSettings(Section):
    """Plan for a robot that misses, and for not knowing θ, in place of one pour that goes exactly as planned."""

    measure: Literal["expected", "cvar"] = "expected"
    """expected: mean loss over the errors; cvar: mean over the worst share 1 − level of them."""

    level: Annotated[float, Quantity("1", "0.9", 0.01, 0.99)] | None = None
    """cvar: between 0, the mean of all, and 1, the very worst; 0.9 unless given."""

    pose_error: PoseNoiseSection = PoseNoiseSection()
    """Standard deviations of the errors, normal and independent."""

    theta: Literal["best", "posterior"] = "best"
    """best: θ* alone; posterior: draws of what else fits the weighed pours, from C4 or from `--parameters`."""

    @property
    def tail(self) -> float:
        """β, and 0 for the mean, which is CVaR at level 0."""
        return (0.9 if self.level is None else self.level) if self.measure == "cvar" else 0.0

    @property
    def errors(self) -> PoseError:
        """Standard deviations of the errors [m, rad, 1]."""
        return PoseError(**self.pose_error.model_dump())

    def check(self, complaints: Problems) -> None:
        """A level belongs to CVaR, and something has to be uncertain."""
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
    """Draws of errors and θ: quasi-random, normal by the inverse of its distribution.

    An error that only moves a searched dimension (x: x_offset, y: y_offset, z: height, speed: angular_velocity) is to
    the surrogate just that, an action a little beside the one that was asked for: what is executed is what is observed.
    So these errors cost no dimension, and every simulation tells about its neighbours. Other errors (tilt, or a
    dimension that is not searched), and θ, are coordinates beside the action.

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
        """Draw.

        Args:
            best: θ*.
            seed: of the draws.
            thetas: draws of a posterior, equally likely, used if `risk` asks for them.
        """
        self._tail, self._deviations = risk.tail, risk.errors
        self._actions, self._best, self._seed = actions, best, seed
        self._thetas = thetas if risk.theta == "posterior" else ()
        self.errors = tuple(name for name in ERRORS if getattr(self._deviations, name) > 0.0)
        folded = {name: _folded(name, actions) for name in self.errors}
        self._moves = {name: axis for name, axis in folded.items() if axis is not None}

    @property
    def nominal(self) -> Draw:
        """As planned, with θ*."""
        return Draw(None, self._best, (0.0,) * len(self.errors))

    def draws(self, count: int, stream: int = 0) -> list[Draw]:
        """The first draws of a sequence, of which any stretch covers errors and θ evenly.

        Args:
            count: at least 1.
            stream: which sequence; those of different streams have nothing to do with each other.
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
        drawn = {name: getattr(self._deviations, name) * value for name, value in zip(self.errors, z, strict=True)}
        drawn["speed_factor"] = min(max(1.0 + drawn.get("speed_factor", 0.0), SLOWEST), FASTEST)
        parameters = self._best
        if self._thetas:
            parameters = self._thetas[min(int(row[-1] * len(self._thetas)), len(self._thetas) - 1)]
        return Draw(PoseError(**drawn) if self.errors else None, parameters, z)

    # -- as the surrogate sees them --------------------------------------------------------------------------------

    @cached_property
    def risk(self) -> Risk:
        """What a question minimises: the same disturbances whichever the action is."""
        wanted = IN_TAIL / (1.0 - self._tail)
        count = min(max(2 ** math.ceil(math.log2(wanted)), FEWEST), MOST)
        return Risk(tuple(self.disturbance(draw) for draw in self.tried(count)), self._tail)

    def tried(self, count: int) -> list[Draw]:
        """The draws that `risk` is made of, in its order."""
        return self.draws(count, stream=1)

    def disturbance(self, draw: Draw) -> Disturbance:
        """How a draw changes an action in its unit cube."""
        scales, shifts = [1.0] * self._actions.dimension, [0.0] * self._actions.dimension
        error = draw.error or PoseError()
        for name, index in self._moves.items():
            scales[index], shifts[index] = _moved(self._actions.axes[index], name, error)
        beside = [0.5 + z / WIDTH for name, z in zip(self.errors, draw.z, strict=True) if name not in self._moves]
        return Disturbance(tuple(scales), tuple(shifts), (*beside, *self._coordinates(draw.parameters)))

    def executed(self, point: Point, draw: Draw) -> Point:
        """Where the surrogate sees a simulation of an action (in its unit cube) under a draw."""
        one = self.disturbance(draw)
        moved = [s * u + t for u, s, t in zip(point, one.scales, one.shifts, strict=True)]
        return (*moved, *one.context)

    def _coordinates(self, parameters: SimulationParameters) -> Point:
        return tuple(
            0.5 + (_number(parameters, name) - centre) / (WIDTH * spread) for name, centre, spread in self._varying
        )

    @cached_property
    def _varying(self) -> tuple[tuple[str, float, float], ...]:
        """Parameters that differ between the draws, with centre and spread."""
        found = []
        for name in type(self._best).model_fields:
            values = [_number(theta, name) for theta in self._thetas]
            if len(set(values)) > 1:
                found.append((name, float(np.mean(values)), float(np.std(values))))
        return tuple(found)


def _number(parameters: SimulationParameters, name: str) -> float:
    """For the surrogate; a number of particles by its logarithm, for it spans decades."""
    value = float(getattr(parameters, name))
    return math.log(value) if name == "particles" else value


def _folded(error: str, actions: Space) -> int | None:
    """Index of the searched axis that an error only moves; None: there is none."""
    name = {"x": "x_offset", "y": "y_offset", "z": "height", "speed_factor": "angular_velocity"}.get(error)
    if name not in actions.names:
        return None
    index = actions.names.index(name)
    placed = error == "speed_factor" or actions.axes[index].scale == "linear"
    return index if placed else None


def _moved(axis: Axis, error: str, drawn: PoseError) -> tuple[float, float]:
    """Scale and shift of an axis' unit interval under an error."""
    width = axis.upper - axis.lower
    if error == "x":
        return 1.0, drawn.x / width
    if error == "y":  # the receiver moves, so the pourer is off the other way
        return 1.0, -drawn.y / width
    if error == "z":  # a receiver that stands higher: the lip is that much less above it
        return 1.0, -drawn.z / width
    if axis.scale == "log":
        return 1.0, math.log(drawn.speed_factor) / math.log(axis.upper / axis.lower)
    return drawn.speed_factor, (drawn.speed_factor - 1.0) * axis.lower / width
