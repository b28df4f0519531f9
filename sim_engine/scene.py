"""Input of a simulation: a scene, an action, θ_s and a seed. Small values without Taichi.

- `PourTask` is one simulated pour in a `Scene`.
- `PoseError` is the difference between the real and the intended placement.
- `SampledMotion` is a motion that was read back from an arm. Planned motions are in `sim_engine.motion`.
"""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from numpy.typing import NDArray

from sim_engine.action import Action
from sim_engine.liquids import Liquid, SimulationParameters
from sim_engine.settings.model import WRITTEN_IF_SET, Settings
from sim_engine.settings.quantity import Quantity
from sim_engine.vessel.shapes import VesselSpec

FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class SampledMotion:
    """A motion read back from an arm: poses at times, interpolated in between.

    Attributes:
        times: (T,) increasing from 0 [s].
        poses: (T, 7) x y z qw qx qy qz.
    """

    times: FloatArray
    poses: FloatArray

    def __post_init__(self) -> None:
        if self.times.ndim != 1 or len(self.times) < 2 or np.any(np.diff(self.times) <= 0):
            raise ValueError("times must increase and number at least two")
        if self.poses.shape != (len(self.times), 7) or not np.all(np.isfinite(self.poses)):
            raise ValueError(f"poses must be finite, shape ({len(self.times)}, 7), got {self.poses.shape}")

    @property
    def duration(self) -> float:
        """Duration [s]."""
        return float(self.times[-1])

    def sample(self, times: FloatArray) -> FloatArray:
        """Poses at times: linear in position, normalised linear in the quaternion (accurate for samples a few degrees
        apart).
        """
        t = np.asarray(times, dtype=float)
        out = np.stack([np.interp(t, self.times, self.poses[:, k]) for k in range(7)], axis=-1)
        out[..., 3:] /= np.linalg.norm(out[..., 3:], axis=-1, keepdims=True)
        return out

    def tilt(self, times: FloatArray) -> FloatArray:
        """Angle between the vessel's axis and the vertical, signed by the turn about +y, shape (T,) [rad]."""
        q = self.sample(times)[..., 3:]
        w, x, y, z = (q[..., k] for k in range(4))
        return np.arctan2(2 * (x * z + w * y), 1 - 2 * (x * x + y * y))


@dataclass(frozen=True)
class Pivot:
    """The horizontal line (along y) about which the pourer turns.

    Attributes:
        kind: `lip`: through the inner lip's lowest point in the pouring direction; `point`: through `x`, `z`.
        x: in the vessel's frame, towards the receiver [m].
        z: in the vessel's frame, above its underside [m].
    """

    kind: str = "lip"
    x: float = 0.0
    z: float = 0.0


MIRRORED_FROM = 2_000
"""Least number of particles of a pour of which one half is simulated. From there on a mirrored pour is nearer to fine
particles than a whole one that takes as long (docs/notes/solver.md)."""


@dataclass(frozen=True)
class Scene:
    """Everything about a pour that is not chosen: vessels, liquid, pivot, fixed action dimensions.

    Attributes:
        name: key in strategies and the journal.
        fixed: action dimensions that are not searched, SI (None switches an optional one off).
        max_hold_time: longest hold 'until the predicted end of flow' [s].
        mirrored: whether one half of a pour is simulated if it is its own mirror image (`PourSimulator.mirrors`); None:
            never.
    """

    name: str
    pourer: VesselSpec
    receiver: VesselSpec
    liquid: Liquid
    pivot: Pivot = Pivot()
    fixed: dict[str, float | None] = field(default_factory=dict)
    max_hold_time: float = 5.0
    mirrored: bool | None = field(default=None, metadata=WRITTEN_IF_SET)

    def action(self, chosen: dict[str, float]) -> Action:
        """The complete action of a searched point. Raises ValueError as `Action.compose` does."""
        return Action.compose(self.fixed, chosen)

    @property
    def uncertain(self) -> bool:
        """Whether the shape of one of its vessels has a known uncertainty."""
        return self.pourer.uncertain or self.receiver.uncertain

    def drawn(self, seed: int) -> Scene:
        """The scene with vessels drawn from their uncertain shapes, see `VesselSpec.drawn`."""
        return replace(self, pourer=self.pourer.drawn(seed), receiver=self.receiver.drawn(seed))


Offset = Annotated[float, Quantity("m", "1 mm", -0.05, 0.05)]
Tilt = Annotated[float, Quantity("rad", "1 deg", -0.2, 0.2)]
Factor = Annotated[float, Quantity("1", "1.02", 0.5, 1.5)]
Spread = Annotated[float, Quantity("1", "0.01", 0.0, 0.5)]


@dataclass(frozen=True)
class PoseError:
    """Difference between real and intended placement (the virtual bench's errors of grip and placement).

    Attributes:
        x: displacement of the receiver away from the pourer [m].
        y: sideways displacement of the receiver [m].
        z: upward displacement of the receiver [m].
        tilt: additional tilt of the pourer beyond the command [rad].
        speed_factor: executed over commanded angular velocity.
    """

    x: float = 0.0
    y: float = 0.0
    tilt: float = 0.0
    speed_factor: float = 1.0
    z: float = 0.0

    @classmethod
    def of(cls, parameters: SimulationParameters) -> PoseError:
        """The nuisances of a bench as errors of placement and execution."""
        return cls(
            x=parameters.receiver_x,
            y=parameters.receiver_y,
            z=parameters.receiver_z,
            tilt=parameters.tilt_zero,
            speed_factor=parameters.speed_factor,
        )

    def and_then(self, other: PoseError) -> PoseError:
        """Both errors together: places and tilts add up, speeds multiply."""
        return PoseError(
            x=self.x + other.x,
            y=self.y + other.y,
            z=self.z + other.z,
            tilt=self.tilt + other.tilt,
            speed_factor=self.speed_factor * other.speed_factor,
        )


class PoseErrorSettings(Settings):
    """How the real placement differs from the intended one."""

    x: Offset = 0.0
    """The receiver stands that much further from the pourer."""

    y: Offset = 0.0
    """The receiver stands that much further sideways."""

    z: Offset = 0.0
    """The receiver stands that much higher."""

    tilt: Tilt = 0.0
    """The pourer is held that much more tilted than commanded."""

    speed_factor: Factor = 1.0
    """Executed over commanded angular velocity."""

    @property
    def error(self) -> PoseError:
        """The errors of a pour."""
        return PoseError(**self.model_dump())


class PoseNoise(Settings):
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

    @property
    def deviations(self) -> PoseError:
        """The standard deviations [m, rad, 1]."""
        return PoseError(**self.model_dump())


@dataclass(frozen=True)
class PourTask:
    """One simulated pour.

    Attributes:
        seed: of the initial positions; same task, same seed → same bits on one CPU thread.
        frame_rate: frames of all particles that are kept per simulated second; 0 keeps none.
        parameters: θ_s, and the bench's nuisances.
        pose_error: deviations of this one pour in addition to those nuisances; None for a plain simulation.
        motion: executed motion that was read back from an arm, instead of the motion planned for `action`. It must
            already contain the parts of `pose_error` that change a motion.
    """

    scene: Scene
    action: Action
    parameters: SimulationParameters
    seed: int
    frame_rate: float = 0.0
    pose_error: PoseError | None = None
    motion: SampledMotion | None = None

    def __post_init__(self) -> None:
        error = self.pose_error
        if self.motion is not None and error is not None and (error.tilt != 0.0 or error.speed_factor != 1.0):
            raise ValueError("an executed motion holds its own errors of tilt and speed; pose_error may only shift it")

    @property
    def placement(self) -> PoseError:
        """The real placement of the pour: the nuisances of the bench and `pose_error` are combined here only.

        An executed motion contains its own tilt and speed; then only the receiver's position is taken from the
        nuisances.
        """
        nuisances = PoseError.of(self.parameters)
        if self.motion is not None:
            nuisances = replace(nuisances, tilt=0.0, speed_factor=1.0)
        return nuisances if self.pose_error is None else nuisances.and_then(self.pose_error)
