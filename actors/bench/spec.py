"""Settings of the virtual bench. Plain values."""

from __future__ import annotations

from dataclasses import dataclass, field

from sim_engine.liquid import SimulationParameters
from sim_engine.task import PoseError


@dataclass(frozen=True)
class VirtualBenchSpec:
    """The virtual bench: what is hidden from calibration, and how fast time runs.

    Attributes:
        liquid: hidden θ of the 'real' liquid.
        pose_error: systematic error of grip and placement.
        pose_noise: standard deviation of the same, drawn anew for each pour.
        time_scale: bench seconds per wall second; 0 waits for nothing.
        operator_time: refilling, placing, wiping [s of bench time].
        balance_resolution, balance_noise, balance_drift: [kg], [kg], [kg/s]; settling_time [s].
    """

    liquid: SimulationParameters
    pose_error: PoseError = field(default_factory=PoseError)
    pose_noise: PoseError = field(default_factory=lambda: PoseError(speed_factor=0.0))
    time_scale: float = 30.0
    operator_time: float = 85.0
    balance_resolution: float = 1e-4
    balance_noise: float = 1e-4
    balance_drift: float = 0.0
    settling_time: float = 1.5
