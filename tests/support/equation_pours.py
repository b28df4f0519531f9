"""Pours that follow the controller's equation with another onset and flow factor, in place of simulated particles."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from actors.dosing.cup_flow import flow_of
from sim_engine.live_pour import LiveState
from sim_engine.scene import PourTask, SampledMotion

Floats = NDArray[np.float64]


class EquationPours:
    """`sim_engine.live_pour.LivePours` of an equation.

    Args:
        onset: by which outflow begins later [rad].
        factor: of the flow.
        stops: time for which it flows, and then does not [s]; 0: it always flows.
        missed: share of the liquid that falls next to the receiver.
    """

    begun = 0
    """Number of pours of all of them."""

    def __init__(self, onset: float = 0.0, factor: float = 1.0, *, stops: float = 0.0, missed: float = 0.0) -> None:
        self._onset, self._factor, self._stops, self._missed = onset, factor, stops, missed

    def begin(self, task: PourTask, pose: Floats) -> None:
        """See `LivePours.begin`."""
        type(self).begun += 1
        self._task, self._flow, self._pose, self._time = task, flow_of(task.scene), pose, 0.0
        self._left = task.scene.liquid.volume

    def advance(self, times: Floats, poses: Floats) -> LiveState:
        """See `LivePours.advance`."""
        for time, pose in zip(times, poses, strict=True):
            motion = SampledMotion(np.array([0.0, 1.0]), np.stack([self._pose, pose]))
            turned = np.array([float(motion.tilt(np.ones(1))[0]) - self._onset])
            flow = self._factor * float(self._flow.flow_at(self._flow.head(np.array([self._left]), turned), turned)[0])
            if self._stops and time % (2.0 * self._stops) < self._stops:
                flow = 0.0
            self._left -= flow * (float(time) - self._time)
            self._time = float(time)
        liquid = self._task.scene.liquid
        out = liquid.density * (liquid.volume - self._left)
        return LiveState(self._time, liquid.mass - out, 0.0, (1.0 - self._missed) * out, self._missed * out)

    def particles(self) -> tuple[NDArray[np.float32], NDArray[np.uint8]]:
        """See `LivePours.particles`."""
        return np.zeros((0, 3), np.float32), np.zeros(0, np.uint8)

    def close(self) -> None:
        """See `LivePours.close`."""
