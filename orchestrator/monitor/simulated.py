"""A simulated pour on its own stage: vessels, particles by their fate, and how much of the liquid is where."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from orchestrator.monitor import shapes
from orchestrator.monitor.films import Film, Films, Track
from orchestrator.monitor.outlet import Outlet, columns_of
from orchestrator.report import style
from sim_engine.simulated import RecordedFrames
from sim_engine.task import Scene

MAXIMUM_RATE = 10.0
"""Frames per second of a film: 3 000 particles cost about 36 kB each."""

PLACE = "/simulation"

SHARES = ("in the pourer", "falling", "received", "spilled")


class SimulatedStage:
    """Films of simulations. For one thread.

    Args:
        outlet: where rows go.
        films: that they are shown by.
    """

    def __init__(self, outlet: Outlet, films: Films) -> None:
        import rerun as rr

        self._rr, self._outlet, self._films = rr, outlet, films
        self._shown: dict[tuple[str, bool], str] = {}
        outlet.log(f"{PLACE}/liquid", shapes.fates(), static=True)
        for state, name in enumerate(SHARES):
            colour = shapes.rgb(style.PARTICLE_STATES[state][1])
            outlet.log(f"{PLACE}/share/{state}", rr.SeriesLines(names=name, colors=colour, widths=3), static=True)

    def film(self, frames: RecordedFrames, scene: Scene, title: str, *, now: float, step: int) -> None:
        """Show a simulation.

        Args:
            frames: that were kept; thinned to `MAXIMUM_RATE`.
            scene: what was simulated.
            title: of it, for people.
            now: on the wall clock [s since 1970].
            step: of the campaign.
        """
        times = np.asarray(frames.times, dtype=float)
        if len(times) == 0:
            return
        radius = 0.5 * shapes.spacing(frames.positions[0], scene.liquid.volume)
        kept = thinned(times)
        moments = times[kept] - times[kept[0]]
        states = [np.asarray(frames.states[index]) for index in kept]
        shares = [100.0 * np.bincount(each, minlength=5) / max(len(each), 1) for each in states]
        poses = np.asarray([frames.pourer_poses[index] for index in kept], float)
        liquid = shapes.swarms([frames.positions[index] for index in kept], states, radius)
        tracks = [shapes.moving(f"{PLACE}/pourer", moments, poses), Track(f"{PLACE}/liquid", moments, liquid)]
        for state, share in enumerate(np.transpose(shares)[: len(SHARES)]):
            curve = columns_of(self._rr.Scalars.columns(scalars=share))
            tracks.append(Track(f"{PLACE}/share/{state}", moments, curve))
        film = Film(
            float(moments[-1]),
            tracks,
            begin=lambda: self._set(scene, title),
            end=lambda: self._outlet.clear(f"{PLACE}/share", recursive=True),  # no line to the next film
        )
        self._films.add(now, step, film)

    def _set(self, scene: Scene, title: str) -> None:
        self._outlet.log(f"{PLACE}/title", self._rr.TextDocument(f"### {title}", media_type="text/markdown"))
        for what, spec in (("pourer", scene.pourer), ("receiver", scene.receiver)):
            # What is left out of the wall clock isn't there for those who watch by it.
            key, place = spec.content_hash(), (what, self._outlet.on_wall)
            if self._shown.get(place) != key:
                self._shown[place] = self._shown[what, False] = key
                self._outlet.log(f"{PLACE}/{what}/mesh", shapes.mesh(spec))


def thinned(times: NDArray[np.float64]) -> list[int]:
    """Which frames a film keeps: `MAXIMUM_RATE`, and the last one, which decides what was spilled."""
    kept = [0]
    for index in range(1, len(times)):
        if times[index] - times[kept[-1]] >= 1.0 / MAXIMUM_RATE - 1e-6:
            kept.append(index)
    if kept[-1] != len(times) - 1:
        kept.append(len(times) - 1)
    return kept
