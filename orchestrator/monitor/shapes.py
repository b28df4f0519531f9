"""Our shapes as Rerun has them: vessels, poses, the bars of an arm, particles by their fate."""

from __future__ import annotations

import functools
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from orchestrator.report import style

if TYPE_CHECKING:
    from actors.arm.figure import ArmFigure
    from sim_engine.vessel.spec import VesselSpec
    from sim_engine.vessel.vessel import Vessel

FloatArray = NDArray[np.float64]

GLASS = (120, 140, 160, 110)
METAL = (95, 100, 108, 255)
TABLE = (222, 219, 212, 255)
TRAY = (205, 208, 212, 255)


def rgb(colour: str) -> list[int]:
    """'#0072b2' as three bytes."""
    return [int(colour[i : i + 2], 16) for i in (1, 3, 5)]


@functools.lru_cache(maxsize=16)
def vessel(spec: VesselSpec) -> Vessel:
    """A vessel, built once."""
    from sim_engine.vessel.build import build_vessel

    return build_vessel(spec)


def mesh(spec: VesselSpec) -> Any:
    """The true surface of a vessel."""
    import rerun as rr

    solid = vessel(spec)
    vertices, faces = np.asarray(solid.solid_vertices, np.float32), np.asarray(solid.solid_faces, np.uint32)
    # Flat normals from unshared corners: rims and floors stay sharp.
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
    """A pose (7,) x y z qw qx qy qz as a transform."""
    import rerun as rr

    turn = rr.Quaternion(xyzw=[pose[4], pose[5], pose[6], pose[3]])
    return rr.Transform3D(translation=pose[:3], quaternion=turn)


def bars(figure: ArmFigure, ends: FloatArray) -> Any:
    """What an arm's links look like, however they stand: capsules as long as they always are.

    Args:
        figure: of the arm.
        ends: of its bars for any joints, shape (bars, 2, 3) [m].
    """
    import rerun as rr

    return rr.Capsules3D(
        lengths=np.linalg.norm(ends[:, 1] - ends[:, 0], axis=-1),
        radii=[bar.radius for bar in figure.bars],
        colors=[METAL if i % 2 else (*rgb("#56b4e9"), 255) for i in range(len(figure.bars))],
        labels=[bar.name for bar in figure.bars],
        show_labels=False,
        fill_mode="solid",
    )


def stance(ends: FloatArray) -> Any:
    """Where an arm's links are; what they look like is `bars`.

    Args:
        ends: of its bars, shape (bars, 2, 3) [m].
    """
    import rerun as rr

    along = ends[:, 1] - ends[:, 0]
    axes = along / np.maximum(np.linalg.norm(along, axis=-1), 1e-9)[:, None]
    # A capsule lies along z; how it is turned about itself nobody sees. The turn from z to an axis a is the quaternion
    # (z × a, 1 + z · a), but for an axis straight down, where any half turn will do.
    turns = np.column_stack([-axes[:, 1], axes[:, 0], np.zeros(len(axes)), 1.0 + axes[:, 2]])
    turns[turns[:, 3] < 1e-9] = (1.0, 0.0, 0.0, 0.0)
    turns /= np.linalg.norm(turns, axis=-1, keepdims=True)
    return rr.Capsules3D.from_fields(translations=ends[:, 0], quaternions=turns)


def fates() -> Any:
    """What the colours of particles mean."""
    import rerun as rr

    return rr.AnnotationContext(
        [
            rr.AnnotationInfo(id=i, label=text, color=rgb(colour))
            for i, (text, colour) in enumerate(style.PARTICLE_STATES)
        ]
    )


def particles(positions: NDArray[np.float32], states: NDArray[np.uint8], radius: float) -> Any:
    """Particles by their fate, positions (N, 3) [m]."""
    import rerun as rr

    return rr.Points3D(
        np.asarray(positions, dtype=np.float32), radii=radius, class_ids=np.asarray(states, dtype=np.uint16)
    )


def spacing(positions: NDArray[np.float32], volume: float) -> float:
    """Between particles that share a volume [m³] among them [m]."""
    return float((volume / max(len(positions), 1)) ** (1.0 / 3.0))
