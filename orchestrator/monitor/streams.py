"""What goes where in a recording: entity paths, looks, and how our values become Rerun's.

Every row carries all three timelines, so that a viewer can follow any of them:
`wall` (when it was known), `pour` (number of pours finished so far in the stage) and `sim_time` (the recorded
simulations' time, one recording laid out behind the other).
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from orchestrator.monitor.blueprint import campaign_blueprint, simulation_blueprint
from orchestrator.monitor.outlet import Outlet
from orchestrator.report import style
from sim_engine.space import Space
from sim_engine.vessel.spec import VesselSpec

if TYPE_CHECKING:
    from actors.optimizer.core.problem import SurrogateMap
    from orchestrator.report.section import Solid
    from sim_engine.simulated import RecordedFrames

APPLICATION = "decant"
MAXIMUM_RATE = 10.0
"""Particle frames per simulated second that are kept: 3 000 particles cost about 36 kB each."""

MAP_PIXELS = 16
"""Pixels along each side of a map's cell, so that points can lie between cells."""

_WALL = (150, 160, 170, 90)


def rgb(colour: str) -> list[int]:
    """'#0072b2' as three bytes."""
    return [int(colour[i : i + 2], 16) for i in (1, 3, 5)]


class Streams:
    """Writes one recording (`.rrd`). For one thread.

    Args:
        path: file to write; its folder is made if needed.
        name: of the recording, for people.
        receivers: what people call each deployment scene, by its name; None for a single simulation.
        loss_label: of the pours' loss.
        url: of a Rerun server that gets the same; '' for none.

    Raises:
        OSError: the file can't be written.
    """

    def __init__(
        self,
        path: Path,
        *,
        name: str,
        receivers: Mapping[str, str] | None = None,
        loss_label: str = "loss",
        url: str = "",
    ) -> None:
        import rerun as rr

        self._rr = rr
        self._recording = Outlet(path, application=APPLICATION, name=name, url=url)
        blueprint = simulation_blueprint() if receivers is None else campaign_blueprint(receivers, loss_label)
        self._recording.show(blueprint)
        self._film_end = 0.0
        self._meshes: dict[str, str] = {}
        self._styled: set[str] = set()
        self._recording.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
        self._recording.log(
            "/scene/liquid",
            rr.AnnotationContext(
                [
                    rr.AnnotationInfo(id=i, label=text, color=rgb(colour))
                    for i, (text, colour) in enumerate(style.PARTICLE_STATES)
                ]
            ),
            static=True,
        )
        for state, (text, colour) in enumerate(style.PARTICLE_STATES[:4]):
            self._recording.log(
                f"/scene/share/{state}", rr.SeriesLines(names=text, colors=rgb(colour), widths=2), static=True
            )

    def at(self, *, wall: float, pour: int) -> None:
        """Set the time of what follows: `wall` in seconds since 1970, `pour` pours finished."""
        self._recording.times(wall=wall, pour=pour, sim_time=self._film_end)

    def film(
        self,
        frames: RecordedFrames,
        pourer: tuple[VesselSpec, Solid],
        receiver: tuple[VesselSpec, Solid],
        *,
        radius: float,
    ) -> None:
        """A simulated pour: vessels, the pourer's movement, particles coloured by state, shares of the liquid.

        Args:
            frames: kept frames; thinned to `MAXIMUM_RATE`.
            pourer, receiver: what they are and their surfaces.
            radius: of a drawn particle [m].
        """
        rr, record = self._rr, self._recording
        times = np.asarray(frames.times, dtype=float)
        if len(times) == 0:
            return
        self._mesh("/scene/pourer/mesh", *pourer)
        self._mesh("/scene/receiver/mesh", *receiver)
        start = self._film_end + (0.5 if self._film_end > 0.0 else 0.0)
        kept = self._thin(times)
        for index in kept:
            record.times(sim_time=start + float(times[index] - times[0]))
            pose = np.asarray(frames.pourer_poses[index], dtype=float)
            record.log(
                "/scene/pourer",
                rr.Transform3D(
                    translation=pose[:3], quaternion=rr.Quaternion(xyzw=[pose[4], pose[5], pose[6], pose[3]])
                ),
            )
            states = np.asarray(frames.states[index], dtype=np.uint16)
            record.log(
                "/scene/liquid",
                rr.Points3D(np.asarray(frames.positions[index], dtype=np.float32), radii=radius, class_ids=states),
            )
            shares = np.bincount(states, minlength=5) / max(len(states), 1)
            for state in range(4):
                record.log(f"/scene/share/{state}", rr.Scalars(100.0 * float(shares[state])))
        self._film_end = start + float(times[-1] - times[0])
        record.times(sim_time=self._film_end)

    @staticmethod
    def _thin(times: NDArray[np.float64]) -> list[int]:
        kept = [0]
        for index in range(1, len(times)):
            if times[index] - times[kept[-1]] >= 1.0 / MAXIMUM_RATE - 1e-6:
                kept.append(index)
        if kept[-1] != len(times) - 1:
            kept.append(len(times) - 1)  # the end decides what was spilled
        return kept

    def _mesh(self, entity: str, spec: VesselSpec, solid: Solid) -> None:
        key = spec.content_hash()
        if self._meshes.get(entity) == key:
            return
        self._meshes[entity] = key
        vertices, faces = np.asarray(solid.solid_vertices, np.float32), np.asarray(solid.solid_faces, np.uint32)
        # Flat normals from unshared corners: rims and floors stay sharp.
        corners = vertices[faces]
        normal = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        normal /= np.maximum(np.linalg.norm(normal, axis=1, keepdims=True), 1e-12)
        self._recording.log(
            entity,
            self._rr.Mesh3D(
                vertex_positions=corners.reshape(-1, 3),
                triangle_indices=np.arange(3 * len(faces), dtype=np.uint32).reshape(-1, 3),
                vertex_normals=np.repeat(normal, 3, axis=0),
                albedo_factor=_WALL,
            ),
        )

    def number(
        self, entity: str, value: float, *, name: str = "", colour: str = style.INK, points: bool = False
    ) -> None:
        """One number of a time series; its looks are told once."""
        if entity not in self._styled:
            self._styled.add(entity)
            looks: Any = (
                self._rr.SeriesPoints(names=name, colors=rgb(colour), marker_sizes=6)
                if points
                else self._rr.SeriesLines(names=name, colors=rgb(colour), widths=2)
            )
            self._recording.log(entity, looks, static=True)
        self._recording.log(entity, self._rr.Scalars(float(value)))

    def surrogate(
        self, entity: str, space: Space, surrogate: SurrogateMap, points: tuple[tuple[float, ...], ...], factor: float
    ) -> str:
        """A surrogate over two axes: pictures of mean and deviation with the observations, and the plain numbers.

        Args:
            entity: under which it goes.
            space: searched box; of the map's two axes the first goes to the right, the second upwards.
            surrogate: (R, R) values, row i at the second axis' i-th place.
            points: observations in the unit cube, projected on the map; their further coordinates
                (`SuggestProblem.context`) are ignored.
            factor: shown over own unit of the cost.

        Returns:
            A sentence with the axes, the range of values and where other axes were held: a picture has no ticks.
        """
        said = []
        plane = surrogate.plane(space)
        columns = [space.names.index(name) for name in plane.names]
        for name, grid, colours in (
            ("mean", surrogate.mean, "viridis"),
            ("deviation", surrogate.deviation, "cividis"),
        ):
            values = factor * np.asarray(grid, dtype=float)
            shown = np.maximum(values, 0.0)  # see `orchestrator.report.units.at_least_nothing`
            # Rows of a picture run downwards, our second axis upwards.
            picture = np.kron(_coloured(shown, colours)[::-1], np.ones((MAP_PIXELS, MAP_PIXELS, 1), np.uint8))
            self._recording.log(f"{entity}/{name}/picture", self._rr.Image(picture))
            self._recording.log(f"{entity}/{name}/values", self._rr.Tensor(values[::-1], dim_names=plane.names[::-1]))
            side = MAP_PIXELS * values.shape[0]
            if points:
                place = np.asarray(points, dtype=float)[:, columns]
                # A grid of R places on [0, 1] puts the first and last place at the middle of the outer cells.
                pixel = MAP_PIXELS * (0.5 + place * (values.shape[0] - 1))
                self._recording.log(
                    f"{entity}/{name}/observed",
                    self._rr.Points2D(
                        np.column_stack([pixel[:, 0], side - pixel[:, 1]]),
                        radii=0.25 * MAP_PIXELS,
                        colors=[255, 255, 255],
                        labels=[str(i) for i in range(1, len(place) + 1)],
                        show_labels=len(place) <= 30,
                        draw_order=20.0,
                    ),
                )
            said.append(f"{name} {shown.min():.3g} … {shown.max():.3g}")
        across, up = plane.axes
        held = style.display_values(dict(surrogate.held(space)))
        return (
            f"{', '.join(said)}; to the right {_range(across.name, across.lower, across.upper)}, "
            f"upwards {_range(up.name, up.lower, up.upper)}{f'; others at {held}' if held else ''}"
        )

    def line(self, text: str, level: str = "info", source: str = "campaign") -> None:
        """A line of the event log."""
        log = self._rr.TextLogLevel
        levels = {"info": log.INFO, "warning": log.WARN, "error": log.ERROR}
        self._recording.log(f"/events/{source}", self._rr.TextLog(text, level=levels.get(level, log.INFO)))

    def page(self, entity: str, markdown: str) -> None:
        """A page of text; replaces the one before."""
        self._recording.log(entity, self._rr.TextDocument(markdown, media_type="text/markdown"))

    def close(self) -> None:
        """Write everything out and end the recording; waits for the file and for no server."""
        self._recording.close()


def _coloured(values: NDArray[np.float64], name: str) -> NDArray[np.uint8]:
    from matplotlib import colormaps

    low, high = float(values.min()), float(values.max())
    unit = (values - low) / (high - low) if high > low else np.zeros_like(values)
    return np.asarray(255 * colormaps[name](unit)[..., :3], dtype=np.uint8)


def _range(name: str, lower: float, upper: float) -> str:
    return f"{name.replace('_', ' ')} {style.display_value(name, lower)} … {style.display_value(name, upper)}"
