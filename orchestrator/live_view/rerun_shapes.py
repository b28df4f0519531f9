"""Conversion of Decant's shapes to Rerun's: vessels, poses, the links of an arm, and particles by their fate."""

from __future__ import annotations

import functools
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from orchestrator.live_view.recording_sink import Columns, Track, columns_of
from orchestrator.reports import figure_style as style

if TYPE_CHECKING:
    from actors.arm.arm_interface import ArmFigure
    from orchestrator.live_view.recording_sink import RecordingSink
    from orchestrator.reports.mixture_report import RackDrawing
    from sim_engine.vessel.shapes import VesselSpec
    from sim_engine.vessel.vessel import Vessel

FloatArray = NDArray[np.float64]

GLASS = (120, 140, 160, 110)
METAL = (95, 100, 108, 255)
TABLE = (222, 219, 212, 255)
TRAY = (205, 208, 212, 255)


def rgb(colour: str) -> list[int]:
    """Convert '#0072b2' to three bytes."""
    return [int(colour[i : i + 2], 16) for i in (1, 3, 5)]


@functools.lru_cache(maxsize=16)
def vessel(spec: VesselSpec) -> Vessel:
    """Build a vessel; the result is cached."""
    from sim_engine.vessel.vessel import build_vessel

    return build_vessel(spec)


def mesh(spec: VesselSpec) -> Any:
    """Return the exact surface of a vessel."""
    solid = vessel(spec)
    vertices, faces = np.asarray(solid.solid_vertices, np.float32), np.asarray(solid.solid_faces, np.uint32)
    # Unshared vertices with flat normals keep rims and bottoms sharp.
    corners = vertices[faces]
    normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
    return rr.Mesh3D(
        vertex_positions=corners.reshape(-1, 3),
        triangle_indices=np.arange(3 * len(faces), dtype=np.uint32).reshape(-1, 3),
        vertex_normals=np.repeat(normal, 3, axis=0),
        albedo_factor=GLASS,
    )


def placed(pose: FloatArray) -> Any:
    """Convert a pose (7,) x y z qw qx qy qz to a transform."""
    turn = rr.Quaternion(xyzw=[pose[4], pose[5], pose[6], pose[3]])
    return rr.Transform3D(translation=pose[:3], quaternion=turn)


def places(poses: FloatArray) -> Columns:
    """Convert poses (T, 7) to transforms at T times."""
    return columns_of(rr.Transform3D.columns(translation=poses[:, :3], quaternion=poses[:, [4, 5, 6, 3]]))


def moving(entity: str, times: FloatArray, poses: FloatArray) -> Track:
    """Return a track of poses (T, 7) at times (T,) [s]; unchanged poses are left out."""
    some = changes(poses)
    return Track(entity, times[some], places(poses[some]))


def changes(rows: FloatArray) -> NDArray[np.intp]:
    """Return the indices of rows (T, n) that differ from the previous one, and of the first and the last."""
    differs = np.any(np.abs(np.diff(rows, axis=0)) > 1e-6, axis=1)
    return np.flatnonzero([True, *differs[:-1], True] if len(differs) else [True])


def bars(figure: ArmFigure, ends: FloatArray) -> Any:
    """Return an arm's links as capsules; their lengths do not depend on the joints.

    Args:
        figure: shape of the arm.
        ends: ends of its links for any joints, shape (bars, 2, 3) [m].
    """
    return rr.Capsules3D(
        lengths=np.linalg.norm(ends[:, 1] - ends[:, 0], axis=-1),
        radii=[bar.radius for bar in figure.bars],
        colors=[METAL if i % 2 else (*rgb("#56b4e9"), 255) for i in range(len(figure.bars))],
        labels=[bar.name for bar in figure.bars],
        show_labels=False,
        fill_mode="solid",
    )


def stances(ends: FloatArray) -> Columns:
    """Return poses of an arm's links at several times, for the capsules of `bars`.

    Args:
        ends: ends of its links, shape (T, bars, 2, 3) [m].
    """
    along = ends[..., 1, :] - ends[..., 0, :]
    axes = along / np.maximum(np.linalg.norm(along, axis=-1, keepdims=True), 1e-9)
    # A capsule lies along z; rotations about its axis are invisible. The rotation from z to an axis a is the
    # quaternion (z × a, 1 + z · a), except for an axis along −z, for which any half turn is valid.
    turns = np.stack([-axes[..., 1], axes[..., 0], np.zeros(axes.shape[:-1]), 1.0 + axes[..., 2]], axis=-1)
    turns[turns[..., 3] < 1e-9] = (1.0, 0.0, 0.0, 0.0)
    turns /= np.linalg.norm(turns, axis=-1, keepdims=True)
    columns = rr.Capsules3D.columns(translations=ends[..., 0, :].reshape(-1, 3), quaternions=turns.reshape(-1, 4))
    return columns_of(columns.partition([ends.shape[1]] * len(ends)))


def rack(sink: RecordingSink, drawing: RackDrawing) -> None:
    """Log the rack of mixtures from above, below '/rack': rings, texts of the cups, and legend."""
    for entity, legend in (("rings", False), ("legend", True)):
        lines = [line for line in drawing.lines if bool(line.liquid) is legend]
        strips = rr.LineStrips2D(
            [line.points for line in lines],
            colors=[rgb(line.colour) for line in lines],
            radii=[0.5 * line.width for line in lines],
            labels=[line.liquid for line in lines] if legend else None,
        )
        sink.log(f"/rack/{entity}", strips)
    places, colours = [text.at for text in drawing.labels], [rgb(text.colour) for text in drawing.labels]
    labels = [text.text for text in drawing.labels]
    sink.log("/rack/cups", rr.Points2D(places, colors=colours, labels=labels, radii=0.005, show_labels=True))


def fates() -> Any:
    """Return the legend of the particles' colours."""
    return rr.AnnotationContext(
        [
            rr.AnnotationInfo(id=i, label=text, color=rgb(colour))
            for i, (text, colour) in enumerate(style.PARTICLE_STATES)
        ]
    )


def swarms(positions: Sequence[NDArray[np.float32]], states: Sequence[NDArray[np.uint8]], radius: float) -> Columns:
    """Return particles by their fate at several times, with positions (N, 3) [m] and states (N,) for each."""
    places = np.concatenate([np.asarray(each, np.float32) for each in positions])
    fate = np.concatenate([np.asarray(each, np.uint16) for each in states])
    points = rr.Points3D.columns(positions=places, class_ids=fate).partition([len(each) for each in positions])
    return columns_of(points, rr.Points3D.columns(radii=np.full(len(positions), radius, np.float32)))


def spacing(positions: NDArray[np.float32], volume: float) -> float:
    """Return the distance between particles that fill a volume [m³] evenly [m]."""
    return float((volume / max(len(positions), 1)) ** (1.0 / 3.0))
