"""Makes mug.stl beside this file: a cup with a rounded foot ring and a handle, in millimetres, z up.

    python configs/vessels/meshes/make_meshes.py

The cup is a surface of revolution; the handle is a bent tube whose ends are sunk into the wall, so the file holds two
closed bodies that overlap, as drawn vessels often do.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import trimesh

CUP = [
    (0.0, 2.0), (26.0, 2.0), (27.0, 0.6), (28.5, 0.0), (31.0, 0.0), (33.0, 0.8), (35.5, 3.5), (38.0, 8.0),
    (40.0, 16.0), (40.5, 30.0), (40.5, 86.0), (40.35, 87.0), (39.8, 87.8), (39.0, 88.0), (38.2, 87.8), (37.65, 87.0),
    (37.5, 86.0), (37.5, 30.0), (37.0, 17.0), (35.5, 11.0), (32.5, 8.0), (28.0, 6.5), (0.0, 6.0),
]  # fmt: skip
"""Half section (r, z) [mm]: underside, foot ring, outer wall, rounded rim, inner wall, floor."""

SEGMENTS = 72


def handle() -> trimesh.Trimesh:
    """A D-shaped tube in the xz plane on the side away from the pour, radii 4.5 × 6 mm [mm]."""
    angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 33)
    centre = np.column_stack([-39.0 - 26.0 * np.cos(angle), np.zeros(len(angle)), 46.0 + 24.0 * np.sin(angle)])
    along = np.gradient(centre, axis=0)
    along /= np.linalg.norm(along, axis=1, keepdims=True)
    side = np.array([0.0, 1.0, 0.0])
    out = np.cross(side, along)
    turn = 2.0 * np.pi * np.arange(20) / 20
    rings = centre[:, None] + 4.5 * np.cos(turn)[:, None] * out[:, None] + 6.0 * np.sin(turn)[:, None] * side
    count, corners = rings.shape[:2]
    faces = []
    for k in range(count - 1):
        for j in range(corners):
            a, b = k * corners + j, k * corners + (j + 1) % corners
            faces += [(a, b, b + corners), (a, b + corners, a + corners)]
    first, last = count * corners, count * corners + 1
    for j in range(corners):
        faces.append((first, (j + 1) % corners, j))
        faces.append((last, (count - 1) * corners + j, (count - 1) * corners + (j + 1) % corners))
    vertices = np.vstack([rings.reshape(-1, 3), centre[0], centre[-1]])
    return trimesh.Trimesh(vertices, faces)


def mug() -> trimesh.Trimesh:
    """The cup and its handle as one mesh of two bodies [mm]."""
    parts = [trimesh.creation.revolve(np.array(CUP), sections=SEGMENTS), handle()]
    for part in parts:
        if part.volume < 0:
            part.invert()
    return trimesh.util.concatenate(parts)


if __name__ == "__main__":
    mug().export(Path(__file__).with_name("mug.stl"))
