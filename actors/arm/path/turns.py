"""Rotations as matrices, vectors and quaternions (w first), of one or many, with numpy alone.

scipy has them too, and takes a third of a second to import: too long for those who only check a file.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


def about(axis: str, angle: float) -> FloatArray:
    """Matrix (3, 3) of a turn by `angle` [rad] about 'x', 'y' or 'z'."""
    k = "xyz".index(axis)
    return from_vector(np.eye(3)[k] * angle)


def from_vector(vector: Sequence[float] | FloatArray) -> FloatArray:
    """Matrix (3, 3) of a rotation vector: along the axis, as long as the angle [rad] (Rodrigues' formula)."""
    v = np.asarray(vector, dtype=float)
    angle = float(np.linalg.norm(v))
    x, y, z = v / angle if angle > 0.0 else v
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    # 1 − cos as 2 sin²: exact for angles of any size
    matrix: FloatArray = np.eye(3) + np.sin(angle) * cross + 2.0 * np.sin(0.5 * angle) ** 2 * (cross @ cross)
    return matrix


def to_quaternions(rotation: FloatArray) -> FloatArray:
    """Unit quaternions (T, 4) of matrices (T, 3, 3); which of the two signs is not said.

    Each from the largest of its own four components, so that nothing is divided by what is nearly nothing. Source:
    Shepperd, Quaternion from rotation matrix, J. Guidance and Control 1 (1978).
    """
    r = rotation
    trace = np.trace(r, axis1=1, axis2=2)
    diagonal = np.diagonal(r, axis1=1, axis2=2)
    # row k: 4 q_k q, for k = w, x, y, z
    products = np.empty((len(r), 4, 4))
    products[:, 0, 0] = 1.0 + trace
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        products[:, i + 1, i + 1] = 1.0 + 2.0 * diagonal[:, i] - trace
        products[:, 0, i + 1] = products[:, i + 1, 0] = r[:, k, j] - r[:, j, k]
        products[:, j + 1, k + 1] = products[:, k + 1, j + 1] = r[:, j, k] + r[:, k, j]
    largest = np.argmax(np.diagonal(products, axis1=1, axis2=2), axis=1)
    found = products[np.arange(len(r)), largest]
    return np.asarray(found / np.linalg.norm(found, axis=1, keepdims=True), dtype=float)


def between(a: FloatArray, b: FloatArray, shares: FloatArray) -> FloatArray:
    """Quaternions (N, 4) on the shortest turn from a to b, both (4,), at `shares` of its angle, 0 … 1 (N,)."""
    a, b = a / np.linalg.norm(a), b / np.linalg.norm(b)
    cosine = float(a @ b)
    if cosine < 0.0:
        b, cosine = -b, -cosine
    across = b - cosine * a
    sine = float(np.linalg.norm(across))
    if sine < 1e-12:
        return np.repeat(a[None], len(shares), axis=0)
    angle = shares[:, None] * np.arctan2(sine, cosine)
    turned: FloatArray = np.cos(angle) * a + np.sin(angle) * (across / sine)
    return turned
