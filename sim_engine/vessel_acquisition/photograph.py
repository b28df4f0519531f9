"""The outline of a vessel of revolution from one photograph of its side.

The vessel stands in front of a plain background. Its silhouette is segmented with Otsu's threshold. The axis is the
line of best symmetry, and one known length gives the scale. The wall is subtracted normal to the outline.

Source: Otsu, A threshold selection method from gray-level histograms, IEEE Trans. Syst. Man Cybern. 9 (1979).

Limitations:

- No perspective is modelled: from a distance of ten vessel widths its error is below one per cent.
- The rim seen as an ellipse, and a lens that bends straight edges, are not corrected.
- Clear glass on a bright background has no silhouette: put paper inside.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from sim_engine.vessel.shapes import VesselError
from sim_engine.vessel_acquisition.measurements import Radii

Floats = NDArray[np.float64]

LOPSIDED = 0.02
"""Largest asymmetry of a row, as a fraction of the largest width; above it there is a handle."""

UPRIGHT = 5e-4
"""Largest lean of an axis that counts as upright [rad]."""

MOST_LEAN = 0.06
"""Largest lean that is searched [rad]: that of a hand-held camera."""

ENOUGH = 300
"""Pixels of a vessel's height and width used to find its lean; pictures of a telephone have ten times as many."""

LEAST_ROWS = 60
"""Least number of rows of a silhouette."""

PIXEL = 1.0
"""Standard deviation of an edge [pixels], from blur and an inaccurate threshold."""

SCALE_DEVIATION = 0.005
"""Relative standard deviation of the scale, from the known length and perspective."""

ROWS_KEPT = 60
"""Number of independent rows: the errors of neighbouring ones are correlated."""


@dataclass(frozen=True)
class Silhouette:
    """Outer radii of a vessel in a photograph.

    Attributes:
        heights: above the underside, ascending, shape (n,) [m].
        radii: outer, shape (n,) [m].
        height: from the underside to the rim [m].
        pixel: its size [m].
        lean: of the axis from the picture's vertical [rad].
    """

    heights: Floats
    radii: Floats
    height: float
    pixel: float
    lean: float


def silhouette(grey: Floats, known: Literal["height", "width"], length: float) -> Silhouette:
    """Segment the vessel in a picture.

    Args:
        grey: brightness, rows from the top, shape (rows, columns).
        known: which outer length of the vessel is known: its height, or its largest width.
        length: that length [m].

    Raises:
        VesselError: the picture does not show a single, distinct vessel of revolution.
    """
    lean = _lean(grey)
    left, right = _cut_out(grey if abs(lean) <= UPRIGHT else _turned(grey, lean))
    rows = np.arange(len(left))
    middle = float(np.median((left + right) / 2.0))
    halves = np.column_stack([middle - left, right - middle])
    _check_turned(halves)
    radii: Floats = np.asarray(halves.mean(axis=1)[::-1], dtype=np.float64)
    heights: Floats = np.asarray(rows + 0.5, dtype=np.float64)
    pixel = length / (len(rows) if known == "height" else 2.0 * radii.max())
    return Silhouette(heights * pixel, radii * pixel, len(rows) * pixel, float(pixel), lean)


def _lean(grey: Floats) -> float:
    """The lean of the axis [rad]: after it is removed, the vessel is symmetric.

    The line through the middles of the rows would work for a cup, but not for a bowl: its sides are so far apart that a
    row meets them at different heights.
    """
    from scipy.optimize import minimize_scalar

    left, right = _cut_out(grey)
    every = max(min(len(left), int((right - left).max())) // ENOUGH, 1)
    small = grey[::every, ::every]

    def crooked(angle: float) -> float:
        try:
            left, right = _cut_out(_turned(small, angle))
        except VesselError:  # at this rotation it leaves the picture
            return float(len(small))
        middles = (left + right)[len(left) // 8 : -(len(left) // 8)] / 2.0
        return float(np.abs(middles - np.median(middles)).mean())

    angles = np.linspace(-MOST_LEAN, MOST_LEAN, 13)
    step = float(angles[1] - angles[0])
    near = float(angles[int(np.argmin([crooked(angle) for angle in angles]))])
    around = (near - step, near + step)
    minimum = minimize_scalar(crooked, bounds=around, method="bounded", options={"xatol": UPRIGHT / 4.0})
    return float(minimum.x)


def _turned(grey: Floats, lean: float) -> Floats:
    """The picture, rotated so that its axis is upright."""
    from scipy import ndimage

    return np.asarray(ndimage.rotate(grey, -np.degrees(lean), reshape=False, order=1, mode="nearest"))


def _check_turned(halves: Floats) -> None:
    """Refuse a silhouette with a handle or a spout.

    Args:
        halves: widths to the left and right of the axis, rows from the top, shape (n, 2) [pixels].
    """
    from scipy import ndimage

    margin = len(halves) // 20
    crooked = ndimage.median_filter(np.abs(halves[:, 1] - halves[:, 0]) / 2.0, 5)[margin : len(halves) - margin]
    worst = int(np.argmax(crooked))
    if crooked[worst] > max(LOPSIDED * 2.0 * halves.mean(axis=1).max(), 2.0 * PIXEL):
        share = 1.0 - (worst + margin) / len(halves)
        raise VesselError(
            f"the silhouette is not the same on both sides, most at {share:.0%} of its height: this is for turned "
            "vessels. Turn a handle or a spout out of sight, or use a mesh"
        )


def _cut_out(grey: Floats) -> tuple[Floats, Floats]:
    """Columns of a silhouette's left and right edges, rows from the top, (n,) each."""
    from scipy import ndimage
    from skimage.filters import threshold_otsu

    border = np.concatenate([grey[0], grey[-1], grey[:, 0], grey[:, -1]])
    if np.ptp(grey) < 1e-6:
        raise VesselError("the photograph shows nothing: it has one brightness all over")
    level = float(threshold_otsu(grey))
    dark = float(np.median(border)) > level
    inside = grey < level if dark else grey > level
    labels, count = ndimage.label(inside)
    if count == 0:
        raise VesselError("nothing stands out from the photograph's background; use a plain one, well lit")
    sizes = ndimage.sum_labels(inside, labels, np.arange(1, count + 1))
    body = ndimage.binary_fill_holes(labels == 1 + int(np.argmax(sizes)))
    assert body is not None
    if body[0].any() or body[:, 0].any() or body[:, -1].any():
        raise VesselError("the vessel touches the picture's edge; leave some background above it and on both sides")
    rows = np.flatnonzero(body.any(axis=1))
    if len(rows) < LEAST_ROWS:
        raise VesselError(
            f"the vessel is only {len(rows)} pixels high; at least {LEAST_ROWS} are needed: go nearer, or use a larger "
            "picture"
        )
    return _edges(grey, body, rows, level)


def _edges(grey: Floats, body: NDArray[np.bool_], rows: NDArray[np.int64], level: float) -> tuple[Floats, Floats]:
    """Columns of a silhouette's left and right edges, interpolated where brightness crosses the threshold."""
    left, right = np.empty(len(rows)), np.empty(len(rows))
    for i, row in enumerate(rows):
        columns = np.flatnonzero(body[row])
        left[i] = columns[0] - _part(grey[row, columns[0]], grey[row, columns[0] - 1], level)
        right[i] = columns[-1] + _part(grey[row, columns[-1]], grey[row, columns[-1] + 1], level)
    return left, right


def _part(inside: float, outside: float, level: float) -> float:
    """Position of the threshold between the last pixel inside and the first one outside."""
    return float(np.clip((inside - level) / (inside - outside), 0.0, 1.0)) if inside != outside else 0.5


def radii_within(outer: Silhouette, wall: float, floor: float) -> Radii:
    """The inner profile according to a silhouette.

    Args:
        wall: thickness, subtracted normal to the outline [m].
        floor: thickness [m].

    Raises:
        VesselError: the wall is thicker than the vessel.
    """
    height = outer.height - floor
    if height <= 0.0 or outer.radii.max() <= wall:
        raise VesselError(
            f"the vessel on the photograph is {1e3 * outer.height:.0f} mm high and {2e3 * outer.radii.max():.0f} mm "
            f"wide: a floor of {1e3 * floor:g} mm and a wall of {1e3 * wall:g} mm leave nothing inside"
        )
    smooth = max(len(outer.heights) // 40, 1)
    slope = np.gradient(np.convolve(np.pad(outer.radii, smooth, "edge"), np.ones(2 * smooth + 1), "valid"))
    slope /= (2 * smooth + 1) * np.gradient(outer.heights)
    inner = outer.radii - wall * np.sqrt(1.0 + np.clip(slope, -3.0, 3.0) ** 2)
    z = outer.heights - floor
    rows = np.flatnonzero((z >= 0.0) & (inner > 0.0))
    chosen = rows[np.unique(np.linspace(0, len(rows) - 1, ROWS_KEPT).round().astype(int))]
    deviations = np.hypot(PIXEL * outer.pixel, SCALE_DEVIATION * inner[chosen])
    return Radii("photograph", np.clip(z[chosen], 0.0, height), inner[chosen], deviations)
