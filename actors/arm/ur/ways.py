"""From wherever an arm was stopped back to where it waits: along the paths that were checked, slowly. Pure."""

from __future__ import annotations

import numpy as np

from actors.arm.errors import ArmRefusedError
from actors.arm.joint_path import FloatArray, JointPath, PourPath
from actors.arm.path.transforms import pourer_transforms
from actors.arm.spec import UrArmSpec

OFF_PATH = 0.1
"""Joints farther than that from every point of a path are not on it [rad]: something has moved the arm."""

HARDLY = 0.01
"""Joints so near to a point are there [rad]."""

RAMP = 0.6
"""Time to get up to speed, and down again [s]."""

_GRID = 0.02


def leans(joints: FloatArray, spec: UrArmSpec) -> FloatArray:
    """Tilt of the pourer for joints (T, 6) [rad], shape (T,) [rad]."""
    tilts: FloatArray = np.arccos(np.clip(pourer_transforms(joints, spec).rotation[..., 2, 2], -1.0, 1.0))
    return tilts


def rejoin(path: JointPath, joints: FloatArray) -> tuple[float, float]:
    """Where on a path an arm stands.

    Args:
        path: any.
        joints: (6,) [rad].

    Returns:
        Time of the nearest point of the path [s], and how far the joint that is farthest is from it [rad].
    """
    begin, along = path.joints[:-1], np.diff(path.joints, axis=0)
    squares = np.einsum("ij,ij->i", along, along)
    share = np.einsum("ij,ij->i", joints - begin, along) / np.where(squares > 0.0, squares, 1.0)
    share = np.clip(share, 0.0, 1.0)
    apart = np.abs(begin + share[:, None] * along - joints)
    nearest = int(np.argmin(np.einsum("ij,ij->i", apart, apart)))
    time = path.times[nearest] + share[nearest] * (path.times[nearest + 1] - path.times[nearest])
    return float(time), float(apart[nearest].max())


def upright_way(path: PourPath, joints: FloatArray, spec: UrArmSpec) -> tuple[JointPath, FloatArray]:
    """From a stopped pour to an upright pourer: back the way it came, or on if the pourer was coming up already.

    Args:
        path: that was being executed.
        joints: (6,) where the arm stands [rad].
        spec: how fast.

    Returns:
        The way, from rest to rest, and the pourer's tilt at its times [rad].

    Raises:
        ArmRefusedError: the arm doesn't stand on the path.
    """
    here, apart = rejoin(path.pour, joints)
    if apart > OFF_PATH:
        raise ArmRefusedError(_astray("the pour's path", apart, "bring the pourer upright at the pendant, by hand"))
    tilt = float(np.interp(here, path.pour.times, path.tilts))
    back, on = _between(path.pour.times, here, 0.0), _between(path.pour.times, here, path.pour.duration)
    back_tilts, on_tilts = (np.interp(times, path.pour.times, path.tilts) for times in (back, on))
    goes_back = back_tilts.max() <= max(on_tilts.max(), tilt + 1e-3)
    times, tilts = (back, back_tilts) if goes_back else (on, on_tilts)
    points = np.vstack([joints, path.pour.at(times)])
    tilts = np.concatenate([[tilt], tilts])
    turning = np.abs(np.diff(tilts)) / spec.untilt_speed
    costs = np.maximum(turning, np.abs(np.diff(points, axis=0)).max(axis=1) / (0.5 * spec.approach_speed))
    return _paced(points, tilts, costs)


def way_home(path: PourPath, joints: FloatArray, spec: UrArmSpec) -> JointPath:
    """From anywhere on the way to a pour or from it, upright, to where the arm waits.

    Args:
        path: that was being executed.
        joints: (6,) where the arm stands [rad].
        spec: how fast.

    Raises:
        ArmRefusedError: the arm stands on neither way.
    """
    if np.abs(path.retreat.joints[0] - joints).max() <= HARDLY:
        return path.retreat
    on, off_retreat = rejoin(path.retreat, joints)
    back, off_approach = rejoin(path.approach, joints)
    apart = min(off_retreat, off_approach)
    if apart > OFF_PATH:
        raise ArmRefusedError(_astray("the way home", apart, "un-tilt the pourer first, or bring the arm home by hand"))
    if off_retreat <= off_approach:
        chosen, times = path.retreat, _between(path.retreat.times, on, path.retreat.duration)
    else:
        chosen, times = path.approach, _between(path.approach.times, back, 0.0)
    points = np.vstack([joints, chosen.at(times)])
    # A way back may begin tilted, after a pour without a return.
    turning = np.abs(np.diff(leans(points, spec))) / spec.untilt_speed
    costs = np.maximum(turning, np.abs(np.diff(points, axis=0)).max(axis=1) / (0.5 * spec.approach_speed))
    return _paced(points, np.zeros(len(points)), costs)[0]


def _between(times: FloatArray, here: float, there: float) -> FloatArray:
    """A path's times from one to another, in the order they are passed."""
    low, high = min(here, there), max(here, there)
    inner = times[(times > low) & (times < high)]
    chosen = np.concatenate([[low], inner, [high]])
    return chosen if there >= here else chosen[::-1]


def _paced(points: FloatArray, tilts: FloatArray, costs: FloatArray) -> tuple[JointPath, FloatArray]:
    """Points passed one after the other, each stretch in its time [s] at most, with a soft begin and end."""
    along = np.concatenate([[0.0], np.cumsum(costs)])
    whole = float(along[-1])
    ramp = min(RAMP, max(whole, 1e-3))
    duration = max(whole + ramp, 0.1)
    times = np.linspace(0.0, duration, max(3, int(duration / _GRID)))
    done = np.where(times < ramp, times**2 / (2.0 * ramp), times - 0.5 * ramp)
    left = np.where(duration - times < ramp, (duration - times) ** 2 / (2.0 * ramp), duration - times - 0.5 * ramp)
    place = np.where(times < 0.5 * duration, done, duration - ramp - left) * whole / max(duration - ramp, 1e-9)
    place = np.clip(place, 0.0, whole)
    joints = np.stack([np.interp(place, along, points[:, k]) for k in range(6)], axis=-1)
    joints[0], joints[-1] = points[0], points[-1]
    return JointPath(times, joints), np.interp(place, along, tilts)


def _astray(where: str, apart: float, remedy: str) -> str:
    return f"the arm does not stand on {where}: a joint is {np.degrees(apart):.1f}° away from it; {remedy}"
