"""Particles as the liquid of `actors.dosing.virtual_dosing_bench`: the cup turns as the bench's arm turns it.

Cup, receiver and placement are those of a scene: what misses the receiver is spilled, and nothing else is assumed about
the flow. Limitations: the impact on the balance is left out, and a film thinner than a particle does not flow.
"""

from __future__ import annotations

import math

import numpy as np

from actors.dosing.virtual_dosing_bench import TIME_STEP, VirtualDosingBench
from actors.interfaces import LaboratoryError
from sim_engine.live_pour import LivePour, LiveState
from sim_engine.motion import recorded_motion
from sim_engine.scene import PourTask, SampledMotion
from sim_engine.simulator import PourSimulator

LANDING = 1.5
"""Longest time after a dose until everything has landed [s]."""


class ParticleLiquid:
    """The liquid of one dose, in steps of `TIME_STEP`.

    Args:
        bench: whose cup's content changes.
        simulator: of this process, which simulates nothing else meanwhile.
        task: scene with the bench's content, placement, θ and seed. The pourer turns about the scene's pivot.

    Attributes:
        received, spilled: in the receiver and next to it [kg].
        flow: past the lip in the last 0.1 s [kg/s].
        first_flow, last_flow: times of the first and the last outflow [s]; infinity before.
    """

    def __init__(self, bench: VirtualDosingBench, simulator: PourSimulator, task: PourTask) -> None:
        self._bench, self._simulator, self._task = bench, simulator, task
        self._tilt = -bench.grip
        self._k = 0
        still = self._moved(self._tilt)
        self._pour = LivePour(simulator, task, still.poses[0], mirrored=simulator.mirrors(task, still))
        self._out = [0.0] * max(round(0.1 / TIME_STEP), 1)
        self.received = self.spilled = self.flow = 0.0
        self.first_flow = self.last_flow = math.inf

    def step(self, tilt: float, turned: float, *, missed: bool = False) -> float:
        """See `actors.dosing.virtual_dosing_bench.PouredLiquid`.

        Raises:
            LaboratoryError: the simulation failed.
        """
        assert not missed, "where the stream lands is simulated"
        self._k += 1
        moved = self._moved(tilt - self._bench.grip)
        self._note(self._pour.advance(moved.times[1:], moved.poses[1:]))
        return self.received

    def at_rest(self) -> float:
        """See `actors.dosing.virtual_dosing_bench.PouredLiquid`."""
        for _ in range(round(LANDING / TIME_STEP)):
            if self._pour.state.in_flight == 0.0:
                break
            self.step(0.0, 0.0)
        return self.received

    def _moved(self, tilt: float) -> SampledMotion:
        """The motion of the cup to its next tilt in a step; the first pose is the present one."""
        vessels = self._simulator.vessel(self._task.scene.pourer), self._simulator.vessel(self._task.scene.receiver)
        tilts, self._tilt = np.array([self._tilt, tilt]), tilt
        motion = recorded_motion(self._task.scene, self._task.action, *vessels, np.array([0.0, TIME_STEP]), tilts)
        return SampledMotion(motion.times + (self._k - 1) * TIME_STEP, motion.poses)

    def _note(self, state: LiveState) -> None:
        if state.invalid is not None:
            raise LaboratoryError(f"the liquid of the dose could not be simulated: {state.invalid}")
        out, time = self._task.scene.liquid.mass - state.in_pourer, self._k * TIME_STEP
        if out > self._out[-1]:
            self.first_flow, self.last_flow = min(self.first_flow, time), time
        self.flow = (out - self._out[0]) / (TIME_STEP * len(self._out))
        self._out = [*self._out[1:], out]
        self.received, self.spilled = state.received, state.spilled
        self._bench.volume = state.in_pourer / self._bench.liquid.density
