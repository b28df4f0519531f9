"""What somebody would measure of a turned vessel whose shape is known, with the errors of their tools."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray

from orchestrator.extra_commands import vessel_command
from sim_engine.vessel.shapes import ProfileShape, VesselSpec
from sim_engine.vessel.vessel import build_vessel
from sim_engine.vessel_acquisition.measurements import held_when_tilted
from sim_engine.vessel_acquisition.outline_fit import volume_below

Floats = NDArray[np.float64]

WATER = 998.0


def vessel(out: Path, **options: Any) -> None:
    """Run the command of `decant vessel` whose source is among the options: a mesh, or none."""
    kind = "mesh" if "mesh" in options else "profile"
    source = [options.pop(kind)] if kind in options else []
    getattr(vessel_command, kind)(*source, out, **options)


@dataclass
class MeasuredVessel:
    """Somebody with tools beside a vessel."""

    spec: VesselSpec
    seed: int = 0

    def __post_init__(self) -> None:
        assert isinstance(self.spec.shape, ProfileShape)
        self.shape = self.spec.shape.outline()
        self.inner = np.array(self.shape.inner)
        self.vessel = build_vessel(self.spec)
        self.rng = np.random.default_rng(self.seed)

    @property
    def height(self) -> float:
        return float(self.inner[-1, 1])

    def radius(self, z: Floats) -> Floats:
        return np.asarray(np.interp(z, self.inner[1:, 1], self.inner[1:, 0]))

    def diameters(self, count: int = 5) -> str:
        heights = np.linspace(0.1, 1.0, count) * self.height
        wide = 2.0 * (self.radius(heights) + self.rng.normal(0.0, 1e-4, count))
        return ", ".join(f"{1e3 * z:.2f} mm: {1e3 * d:.2f} mm" for z, d in zip(heights, wide, strict=True))

    def fill(self, path: Path) -> Path:
        levels = np.linspace(0.1, 1.0, 10) * self.height
        volumes = volume_below(self.inner[:, 1], self.inner[:, 0], levels)
        masses = 1e3 * WATER * volumes + self.rng.normal(0.0, 0.3, 10)
        return _table(path, "level_mm", 1e3 * levels, masses)

    def tilt(self, path: Path) -> Path:
        z = np.linspace(0.0, self.height, 300)
        tilts = np.arange(15.0, 91.0, 7.5)
        volumes = [held_when_tilted(z, self.radius(z), float(np.radians(t))) for t in tilts]
        masses = np.maximum(1e3 * WATER * np.array(volumes) + self.rng.normal(0.0, 0.3, len(tilts)), 0.0)
        return _table(path, "tilt_deg", tilts, masses)

    def solid(self) -> trimesh.Trimesh:
        """Millimetres."""
        return trimesh.Trimesh(1e3 * self.vessel.solid_vertices, self.vessel.solid_faces)


def _table(path: Path, column: str, values: Floats, masses: Floats) -> Path:
    rows = np.column_stack([values, masses])
    np.savetxt(path, rows, delimiter=",", header=f"{column},mass_g", comments="", fmt="%.2f")
    return path
