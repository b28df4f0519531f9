"""What an arm did, small enough for a journal, and exact enough to be simulated again."""

from __future__ import annotations

import base64
import zlib
from typing import Any

import numpy as np

from actors.arm.joint_path import ExecutedPath

JOINT_UNIT = 1e-6
"""Joints are kept to this [rad]: a thousandth of what an arm repeats."""

TIME_UNIT = 1e-5
"""Times likewise [s]."""


def pack(executed: ExecutedPath) -> dict[str, Any]:
    """JSON-ready; a ten-second pour at 125 Hz takes some ten kilobytes.

    Args:
        executed: as read back.
    """
    columns = np.column_stack([executed.times / TIME_UNIT, executed.joints / JOINT_UNIT])
    whole = np.round(columns).astype("<i4")
    data = np.diff(whole, axis=0, prepend=np.zeros((1, 7), "<i4")).astype("<i4").T.tobytes()
    return {
        "samples": len(whole),
        "completed": executed.completed,
        "tracking": dict(executed.tracking),
        "packed": base64.b85encode(zlib.compress(data, 9)).decode("ascii"),
    }


def unpack(data: dict[str, Any]) -> ExecutedPath:
    """Inverse of `pack`.

    Raises:
        ValueError: it is no such thing.
    """
    try:
        raw = zlib.decompress(base64.b85decode(data["packed"]))
        steps = np.frombuffer(raw, "<i4").reshape(7, int(data["samples"])).T
        whole = np.cumsum(steps, axis=0)
        times, joints = whole[:, 0].astype(float) * TIME_UNIT, whole[:, 1:].astype(float) * JOINT_UNIT
        return ExecutedPath(times, joints, bool(data["completed"]), dict(data["tracking"]))
    except (KeyError, TypeError, ValueError, zlib.error) as error:
        raise ValueError(f"no executed path: {error!r}") from error
