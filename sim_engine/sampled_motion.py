"""A motion that an arm has executed, read back from it. Planned motions need a task's scene."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

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
        """[s]."""
        return float(self.times[-1])

    def sample(self, times: FloatArray) -> FloatArray:
        """Linear in position; normalised linear in the quaternion (fine for samples a few degrees apart)."""
        t = np.asarray(times, dtype=float)
        out = np.stack([np.interp(t, self.times, self.poses[:, k]) for k in range(7)], axis=-1)
        out[..., 3:] /= np.linalg.norm(out[..., 3:], axis=-1, keepdims=True)
        return out

    def tilt(self, times: FloatArray) -> FloatArray:
        """Angle between the vessel's axis and the vertical, signed by the turn about +y, shape (T,) [rad]."""
        q = self.sample(times)[..., 3:]
        w, x, y, z = (q[..., k] for k in range(4))
        return np.arctan2(2 * (x * z + w * y), 1 - 2 * (x * x + y * y))
