"""The flow out of a vessel over its tilt, by the estimator's equation and by particles.

`compare_flows` tilts the pourer of a scene once, slowly, and simulates the liquid until an amount has left. The
equation (`actors.dosing.cup_flow`) follows the same tilt; onset and flow factor with which it is nearest are what the
estimator would find. `FlowComparison.knowledge` is the first belief with this difference as an additional error.

Limitations: one seed; the flow is as lumpy as particles, and a film thinner than one does not flow. Nothing dribbles.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from actors.dosing.cup_flow import LARGEST_TILT, CupFlow, flow_of
from actors.dosing.dose_estimator import FIRST_AIM, FLOW_FACTOR, ONSET
from actors.dosing.particle_liquid import ParticleFlow, dose_task
from actors.interfaces import DoseKnowledge
from sim_engine.liquids import SimulationParameters
from sim_engine.live_pour import LivePours
from sim_engine.motion import recorded_motion
from sim_engine.scene import PoseError, Scene
from sim_engine.vessel.vessel import build_vessel

Floats = NDArray[np.float64]

PARTICLES = 2_000
"""In a full source; a simulation takes three to five seconds of a core."""

LEAST_COMPARED = 60
"""Particles that leave at least, whatever the amount."""

RESOLVED = 6
"""A smaller difference than this number of particles is not told from their lumps."""

BEFORE = math.radians(4.0)
"""Tilt before the expected onset from which the vessel is turned slowly [rad]."""

FLOW, SPEEDS = 0.012, (math.radians(2.0), math.radians(5.0))
"""Flow that the slow turn is to cause [kg/s], and the range of its speed [rad/s]."""

STEP, SLICE = 0.02, 5
"""Time between two poses [s], and their number in a call of the simulation."""

RAISED = math.radians(30.0)
"""Speed of the tilt before the slow turn [rad/s]."""


@dataclass(frozen=True)
class FlowComparison:
    """Mass past the lip over the tilt; arrays (T,).

    Attributes:
        times: from the first motion [s].
        tilts: [rad].
        simulated: with particles [kg].
        expected: by the equation [kg].
        fitted: by the equation with `onset` and `factor` [kg].
        onset: tilt by which outflow begins later than the equation says [rad].
        factor: simulated flow over the equation's.
        spilled: of what had landed, next to the receiver [kg].
        grain: mass of a particle [kg].
    """

    times: Floats
    tilts: Floats
    simulated: Floats
    expected: Floats
    fitted: Floats
    onset: float
    factor: float
    spilled: float
    grain: float

    @property
    def left_over(self) -> float:
        """Difference that onset and factor do not explain, exceeded at 5 % of the times after the onset [kg]."""
        flowing = np.maximum(self.simulated, self.fitted) > 0.0
        return float(np.quantile(np.abs(self.simulated - self.fitted)[flowing], 0.95)) if flowing.any() else 0.0

    def differs(self, tolerance: float) -> bool:
        """Whether the estimator's equation does not follow the simulated flow within a tolerance [kg]."""
        return self.left_over > max(tolerance, RESOLVED * self.grain)

    def knowledge(self) -> DoseKnowledge:
        """What is assumed of the source before its first dose: the usual errors, and the difference as one more."""
        # Cov = diag(σ_b², σ_log c²) + d dᵀ with d = (onset, log factor) less their usual means
        away = np.array([self.onset - ONSET[0], math.log(self.factor / FLOW_FACTOR[0])])
        covariance = np.diag([ONSET[1] ** 2, FLOW_FACTOR[1] ** 2]) + np.outer(away, away)
        usual = (ONSET[0], math.log(FLOW_FACTOR[0]))
        return DoseKnowledge(usual, tuple(map(float, covariance.ravel())), None, FIRST_AIM, 0)


def compare_flows(scene: Scene, amount: float, theta: SimulationParameters, pours: LivePours) -> FlowComparison:
    """Simulate one dose out of a full source that is tilted at a constant speed.

    Args:
        scene: with the load of a full source.
        amount: of the dose [kg].
        theta: of the simulator; with `PARTICLES` particles, and nothing runs down the outside.
        pours: simulates it.

    Raises:
        LaboratoryError: the liquid could not be simulated.
    """
    theta = theta.model_copy(update={"particles": PARTICLES, "lip_adhesion": 0.0})
    action, content = scene.action({}), scene.liquid.mass
    grain = content / PARTICLES
    flow, vessels = flow_of(scene), (build_vessel(scene.pourer), build_vessel(scene.receiver))
    times, tilts = _slow_turn(flow, scene.liquid.volume)
    motion = recorded_motion(scene, action, *vessels, times, tilts)
    placed = PoseError.of(theta)
    liquid = ParticleFlow(dose_task(scene, action, content, theta, placed, seed=0), pours, motion.poses[0])
    wanted, simulated = max(amount, LEAST_COMPARED * grain), [0.0]
    for first in range(1, len(times), SLICE):
        for k in range(first, min(first + SLICE, len(times))):
            liquid.follow(motion.times[k : k + 1], motion.poses[k : k + 1])
            simulated.append(content - liquid.left)
        if simulated[-1] >= wanted:
            break
    count, poured = len(simulated), np.array(simulated)
    times, tilts = times[:count], tilts[:count]
    onset, factor = _fit(flow, scene.liquid.volume, times, tilts, poured, grain)
    fitted, expected = (
        _by_equation(flow, scene.liquid.volume, times, tilts, *np.array([pair]).T)[:, 0]
        for pair in ((onset, factor), (0.0, 1.0))
    )
    return FlowComparison(times, tilts, poured, expected, fitted, onset, factor, liquid.spilled, grain)


def _slow_turn(flow: CupFlow, volume: float) -> tuple[Floats, Floats]:
    """Times [s] and tilts [rad] from upright to the largest tilt: quickly to before the onset, then slowly."""
    onset = float(flow.tilt_for(np.array([volume]), np.zeros(1))[0])
    before = max(onset - BEFORE, 0.0)
    # the flow of a cup that turns with the speed w is w · (−dV/dθ)
    speed = float(np.clip(FLOW / (flow.density * flow.volume_per_tilt(volume, 0.0)), *SPEEDS))
    raised = before / RAISED
    end = raised + (LARGEST_TILT - before) / speed
    times: Floats = STEP * np.arange(math.ceil(end / STEP) + 1, dtype=float)
    return times, np.interp(times, [0.0, raised, end], [0.0, before, LARGEST_TILT])


def _by_equation(flow: CupFlow, volume: float, times: Floats, tilts: Floats, onsets: Floats, factors: Floats) -> Floats:
    """Mass past the lip (T, N) [kg] for N onsets [rad] and flow factors: V′ = −c q(V, θ − b)."""
    left, poured = np.full(len(onsets), volume), [np.zeros(len(onsets))]
    for step, tilt in zip(np.diff(times), tilts[1:], strict=True):
        turned = tilt - onsets
        left = np.maximum(left - factors * flow.flow_at(flow.head(left, turned), turned) * step, 0.0)
        poured.append(flow.density * (volume - left))
    return np.array(poured)


def _fit(
    flow: CupFlow, volume: float, times: Floats, tilts: Floats, poured: Floats, grain: float
) -> tuple[float, float]:
    """The most probable onset [rad] and factor, with the estimator's first belief as their prior."""
    # A short pour hardly tells a late onset from a small factor; the prior decides between them. Ten of the compared
    # masses count as independent, each with an error of two particles.
    onsets, logs = np.meshgrid(np.radians(np.arange(-3.0, 6.01, 0.1)), np.arange(-1.0, 0.701, 0.05))
    onsets, logs = onsets.ravel(), logs.ravel()
    error = _by_equation(flow, volume, times, tilts, onsets, np.exp(logs)) - poured[:, None]
    flowing = poured > 0.0
    cost = 10.0 * (error[flowing] ** 2).mean(axis=0) / (2.0 * grain) ** 2 if flowing.any() else 0.0
    cost = cost + ((onsets - ONSET[0]) / ONSET[1]) ** 2 + (logs / FLOW_FACTOR[1]) ** 2
    best = int(np.argmin(cost))
    return float(onsets[best]), float(np.exp(logs[best]))
