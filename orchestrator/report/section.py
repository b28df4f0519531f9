"""Vessels cut open: the section of a mesh by its plane y = 0, and poses in that plane."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Floats = NDArray[np.float64]


class Solid(Protocol):
    """What is needed of a vessel: its closed surface in its own frame [m]."""

    @property
    def solid_vertices(self) -> Any:
        """(V, 3)."""
        ...

    @property
    def solid_faces(self) -> Any:
        """(F, 3), oriented outwards."""
        ...


def section(vertices: Floats, faces: NDArray[np.integer[Any]]) -> list[Floats]:
    """Closed outlines where a watertight mesh meets the plane y = 0.

    Args:
        vertices: (V, 3) [m].
        faces: (F, 3), consistently oriented.

    Returns:
        One (n, 2) array of (x, z) [m] for each loop, oriented as the faces are, so that holes run the other way round.

    Raises:
        ValueError: the mesh is open where it was cut.
    """
    above = vertices[:, 1] >= 0.0
    count = above[faces].sum(axis=1)
    follows: dict[tuple[int, int], tuple[int, int]] = {}
    for face in faces[(count > 0) & (count < 3)]:
        enter = leave = None
        for i in range(3):
            a, b = int(face[i]), int(face[(i + 1) % 3])
            if above[a] != above[b]:
                edge = (min(a, b), max(a, b))
                if above[b]:
                    enter = edge
                else:
                    leave = edge
        assert enter is not None
        assert leave is not None
        follows[enter] = leave
    loops = []
    while follows:
        start, edge = follows.popitem()
        loop = [start]
        while edge != start:
            loop.append(edge)
            if edge not in follows:
                raise ValueError("the mesh is open: its section by the plane y = 0 has a loose end")
            edge = follows.pop(edge)
        ends = np.array(loop)
        a, b = vertices[ends[:, 0]], vertices[ends[:, 1]]
        t = (a[:, 1] / (a[:, 1] - b[:, 1]))[:, None]
        loops.append((a + t * (b - a))[:, [0, 2]])
    return loops


def place(points: Floats, pose: Floats) -> Floats:
    """Points of a body's plane y = 0 in the world's x–z plane.

    Args:
        points: (n, 2) as (x, z) in the body's frame [m].
        pose: x y z qw qx qy qz of the body; its turn must be about y.

    Returns:
        (n, 2) as (x, z) [m].
    """
    tilt = 2.0 * np.arctan2(pose[5], pose[3])
    c, s = np.cos(tilt), np.sin(tilt)
    # A positive turn about +y tips z towards +x.
    x = c * points[:, 0] + s * points[:, 1] + pose[0]
    z = -s * points[:, 0] + c * points[:, 1] + pose[2]
    return np.column_stack([x, z])


def fill_section(axes: Axes, loops: list[Floats], **look: Any) -> None:
    """Draw outlines as one filled shape with its holes left open."""
    from matplotlib.patches import PathPatch
    from matplotlib.path import Path as Outline

    axes.add_patch(PathPatch(Outline.make_compound_path(*(Outline(loop, closed=False) for loop in loops)), **look))
