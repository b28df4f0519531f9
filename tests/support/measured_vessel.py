"""What somebody would measure of a turned vessel whose shape is known, with the errors of their tools."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFilter

from orchestrator.extra_commands import vessel_command
from sim_engine.vessel.profile import outer_profile
from sim_engine.vessel.shapes import ProfileShape, VesselSpec
from sim_engine.vessel.vessel import build_vessel
from sim_engine.vessel_acquisition.measurements import held_when_tilted
from sim_engine.vessel_acquisition.outline_fit import volume_below

Floats = NDArray[np.float64]

WATER = 998.0
PIXELS_PER_MM = 6.0


def vessel(out: Path, **options: Any) -> None:
    """Run the command of `decant vessel` whose source is among the options: photo, mesh, or none."""
    kind = next((one for one in ("photo", "mesh") if one in options), "profile")
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

    def photo(self, path: Path, *, lean: float = 1.2, handle: bool = False) -> Path:
        """Dark before a bright wall, a little out of level, blurred and noisy."""
        outer = outer_profile(self.inner, self.shape.wall, self.shape.floor)
        corners = [
            (450.0 + side * PIXELS_PER_MM * 1e3 * r, 750.0 - PIXELS_PER_MM * 1e3 * (z + self.shape.floor))
            for side, curve in ((1.0, outer), (-1.0, outer[::-1]))
            for r, z in curve
        ]
        picture = Image.new("L", (900, 800), 230)
        draw = ImageDraw.Draw(picture)
        draw.polygon(corners, fill=60)
        if handle:
            draw.ellipse((650, 300, 840, 600), outline=60, width=40)
        turned = picture.rotate(lean, resample=Image.Resampling.BICUBIC, fillcolor=230)
        grey = np.asarray(turned.filter(ImageFilter.GaussianBlur(1.5)), float)
        noisy = np.clip(grey + self.rng.normal(0.0, 6.0, grey.shape), 0, 255)
        Image.fromarray(noisy.astype(np.uint8)).save(path)
        return path

    def solid(self) -> trimesh.Trimesh:
        """Millimetres."""
        return trimesh.Trimesh(1e3 * self.vessel.solid_vertices, self.vessel.solid_faces)


def _table(path: Path, column: str, values: Floats, masses: Floats) -> Path:
    rows = np.column_stack([values, masses])
    np.savetxt(path, rows, delimiter=",", header=f"{column},mass_g", comments="", fmt="%.2f")
    return path
