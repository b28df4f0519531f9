"""Toy spill functions: shaped like pouring, cheap enough to play a campaign in a second."""

from __future__ import annotations

import numpy as np

from sim_engine.action import DEG, Action
from sim_engine.liquids import SimulationParameters


def calibration_spill(action: Action, theta: SimulationParameters, rng: np.random.Generator) -> float:
    """Rises with speed and angle, as weighed spills do; the toy liquid's θ scales it and moves its onset."""
    speed = (action.angular_velocity / DEG - 15) / 105
    angle = (action.max_angle / DEG - 70) / 55
    gain = 0.25 + 0.5 * np.log(theta.particles / 500) / np.log(8)
    onset = 0.1 + 5.0 * theta.cohesion
    return float(gain * max(speed - onset, 0.0) * (0.2 + 0.8 * angle) + 0.01 * rng.standard_normal())


TRUE_THETA = SimulationParameters(particles=1600, cohesion=0.03)


def weighed(action: Action, _: SimulationParameters, rng: np.random.Generator) -> float:
    """What the toy balance says: the toy liquid with a θ that nobody is told."""
    return calibration_spill(action, TRUE_THETA, rng)


def narrow_cup(action: Action, _: SimulationParameters, rng: np.random.Generator) -> float:
    """A cup that is hard to hit: a small valley in a plateau where everything is spilled."""
    return _valley(action, 0.62, 0.30, rng)


def narrow_cup_biased(action: Action, _: SimulationParameters, rng: np.random.Generator) -> float:
    """What a simulator with a small error says of the narrow cup."""
    return _valley(action, 0.67, 0.36, rng)


def _valley(action: Action, x0: float, v0: float, rng: np.random.Generator) -> float:
    x = (action.x_offset - 0.08) / 0.07
    v = (action.angular_velocity / DEG - 15) / 105
    depth = ((x - x0 - 0.15 * (v - v0)) / 0.16) ** 2 + ((v - v0) / 0.35) ** 2
    spill = 1.0 - np.exp(-0.5 * depth)
    return float(np.clip(spill * (1.0 + 0.05 * rng.standard_normal()) + 0.01 * rng.standard_normal(), 0.0, 1.0))


def two_valleys(action: Action, _: SimulationParameters, rng: np.random.Generator) -> float:
    """A narrow valley without any spillage, beside a broad one that always spills a little."""
    return float(np.clip(quiet_valleys(action) + 0.003 * rng.standard_normal(), 0.0, 1.0))


def quiet_valleys(action: Action) -> float:
    """The same without its scatter."""
    x = (action.x_offset - 0.08) / 0.07
    v = (action.angular_velocity / DEG - 15) / 105
    sideways = (action.y_offset / 0.02) ** 2
    narrow = 1.0 - np.exp(-0.5 * (((x - 0.25) / 0.09) ** 2 + ((v - 0.5) / 0.8) ** 2 + sideways))
    broad = 1.0 - 0.95 * np.exp(-0.5 * (((x - 0.7) / 0.2) ** 2 + ((v - 0.5) / 0.8) ** 2 + sideways))
    return float(min(narrow, broad))
