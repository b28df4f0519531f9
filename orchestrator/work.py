"""What the stages of a campaign are expected to do, from its plan: for forecasts only, nothing is decided by it."""

from __future__ import annotations

import math
from collections.abc import Sequence

from actors.spec import LaboratorySpec
from orchestrator.forecast import PRICE, Work
from orchestrator.plan import CalibrationPlan, CampaignPlan, DeploymentPlan
from orchestrator.stages import CALIBRATION, CONFIRMATION, DEPLOYMENT, EVALUATION, POURS
from orchestrator.strategies.calibration.scorecard import DRAWS
from sim_engine.action import ACTION_DIMENSIONS
from sim_engine.space import Space
from sim_engine.task import Scene

WEIGHINGS = 15.0
"""Weighing and settling in one pour [s of bench time]; see `actors.bench`."""

WAYS = 8.0
"""Way to the pour and back home [s of bench time]."""


def work_of(plan: CampaignPlan, stages: Sequence[str]) -> dict[str, Work]:
    """What each stage is expected to do, by name; nothing is known of stages that are not the plan's own."""
    return {name: _work(plan, name) for name in stages}


def _work(plan: CampaignPlan, name: str) -> Work:
    calibration, deployment = plan.calibration, plan.deployment
    if calibration is not None:
        pour = pour_time(plan.laboratory, calibration.scene, calibration.actions)
        if name == POURS:
            designing = calibration.design_simulations
            return Work(designing, particles=particles_of(plan), pours=calibration.pour_count, pour_time=pour)
        if name == CALIBRATION:
            return Work(calibration.simulations, particles=particles_of(plan))
        if name == EVALUATION:
            # Random θ and the uncalibrated one need no θ*: see `orchestrator.rehearsal`.
            rivals = _weighed(calibration) + calibration.random_baseline * _unseen(calibration)
            return Work(_scored(calibration), ahead=rivals if calibration.pour_count else 0)
    if deployment is not None and name.startswith((DEPLOYMENT, CONFIRMATION)):
        pour = pour_time(plan.laboratory, deployment.scenes[0], deployment.actions)
        confirming = name.startswith(CONFIRMATION)
        return Work(pours=deployment.confirm, pour_time=pour) if confirming else _deployed(deployment, pour)
    return Work()


def _weighed(plan: CalibrationPlan) -> int:
    """Pours that θ* is scored on: made by then, or recorded."""
    records = 0 if plan.records is None else len(plan.records.pours)
    return plan.pour_count + records + (0 if plan.transfer is None else len(plan.transfer.pours))


def _unseen(plan: CalibrationPlan) -> int:
    """Those of them that calibration has not seen."""
    records = [] if plan.records is None else list(plan.records.pours)
    transfer = 0 if plan.transfer is None else len(plan.transfer.pours)
    return plan.holdout + sum(pour.split != "train" for pour in records) + transfer


def _scored(plan: CalibrationPlan) -> int:
    """θ* and the uncalibrated θ on all pours; draws of θ and random rivals on those that calibration has not seen."""
    drawn = DRAWS if plan.random_baseline and plan.settings.makes_posterior else 0
    return 2 * _weighed(plan) + (plan.random_baseline + drawn) * _unseen(plan)


def particles_of(plan: CampaignPlan) -> float:
    """Particles of a simulation: their mean over what is searched, where they are; else what they are."""
    calibration = plan.calibration
    if calibration is None:
        return float(plan.parameters.particles)
    axis = next((axis for axis in calibration.parameters.axes if axis.name == "particles"), None)
    if axis is None:
        return float(calibration.fixed_parameters.get("particles", plan.parameters.particles))
    return math.sqrt(axis.lower * axis.upper)


def _deployed(plan: DeploymentPlan, pour: float) -> Work:
    settings = plan.settings
    pours = plan.pours if settings.learns_on_pours else min(plan.pours, 1)
    return Work(settings.simulations, pours, settings.simulations_beside, pour_time=pour)


def pour_time(laboratory: LaboratorySpec, scene: Scene, actions: Space) -> float:
    """Time of one whole pour with the operator's part, as planned [s of the clock].

    Args:
        laboratory: whose operator and bench make it.
        scene: with what is not chosen of the motion.
        actions: with what is; its middle counts.
    """
    values = {**{name: d.lower for name, d in ACTION_DIMENSIONS.items()}, **scene.fixed}
    values |= {axis.name: 0.5 * (axis.lower + axis.upper) for axis in actions.axes}
    angle, speed, back, hold = (
        values.get(name) for name in ("max_angle", "angular_velocity", "return_velocity", "hold_time")
    )
    motion = (angle or 0.0) / (speed or math.inf) + (scene.hold_cap / 2.0 if hold is None else hold)
    motion += (angle or 0.0) / back if back else 0.0
    bench = laboratory.bench
    liquid = 0.0 if bench is None else PRICE * bench.liquid.particles  # that of a virtual bench is simulated
    if laboratory.arm is not None:
        whole = laboratory.operator.time + laboratory.arm.announcement + WAYS + motion + WEIGHINGS
        return laboratory.arm.on_clock(whole) + liquid
    if bench is None or bench.time_scale <= 0.0:
        return liquid
    return (bench.operator_time + WAYS + motion + WEIGHINGS) / bench.time_scale + liquid
