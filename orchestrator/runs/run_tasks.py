"""The tasks: one function for each gives the `RunRequest` of a campaign.

`run_task`, `calibrate_task` and `plan_task` need a campaign alone; `TASKS` has them by name. `pour_task` is one pour
with a given action, `dose_task` a series of amounts. Orders of the daemon and cells of a study also are `single_task`
and `deploy_task`. Which stages a task has is decided here alone.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from orchestrator.campaigns.dose_flows import simulated_knowledge
from orchestrator.learning.campaign_plan import CampaignPlan, DispensePlan, PlannedDose
from orchestrator.learning.dispense import KnownSource
from orchestrator.learning.single_action import OnePour
from orchestrator.materials.vessel_account import VesselAccount
from orchestrator.runs.run_service import RunRequest, RunTaskError
from orchestrator.runs.stages import (
    POSTERIOR_DRAWS,
    POUR,
    StageDefinition,
    calibration_stages,
    deployment_stages,
    dispense_stages,
    named_scenes,
    prediction_stages,
    stages_of,
)

if TYPE_CHECKING:
    from orchestrator.learning.strategy import Strategy
    from sim_engine.action import Action
    from sim_engine.liquids import SimulationParameters
    from sim_engine.prediction_band import CalibrationResidual
    from sim_engine.scene import Scene
    from sim_engine.vessel.shapes import VesselSpec

Task = Literal["run", "calibrate", "plan"]

PREDICTION_SEEDS = 5

PLANNED = "-plan"
"""Suffix of the name of a campaign that is only planned."""


@dataclass(frozen=True)
class GivenTheta:
    """θ that a campaign is planned with, of a calibration or written by hand.

    Attributes:
        theta: the θ itself.
        draws: of its posterior, which the simulations use in turn; empty if it has none, or if the file recommends the
            uncalibrated θ.
        left_over: residual of the calibration; None where it is not known.
    """

    theta: SimulationParameters
    draws: tuple[SimulationParameters, ...] = ()
    left_over: CalibrationResidual | None = None


def read_theta(path: Path, plan: CampaignPlan) -> GivenTheta:
    """θ from a file, such as the `theta.json` of a calibration.

    Args:
        path: of the file.
        plan: whose θ has what the file does not name.

    Raises:
        ConfigError: anything is wrong with the file.
    """
    from orchestrator.campaigns.file_loading import (
        load_discrepancy,
        load_parameters,
        load_posterior,
        predicts_with_posterior,
    )

    draws = load_posterior(path, POSTERIOR_DRAWS, plan.parameters) if predicts_with_posterior(path) else ()
    return GivenTheta(load_parameters(path, plan.parameters), draws, load_discrepancy(path))


def recorded_sources(plan: DispensePlan) -> Mapping[str, KnownSource]:
    """What earlier doses have left in the sources of a series, by name; nothing if it begins with filled ones."""
    return VesselAccount.open().known(plan) if plan.as_left else {}


def run_task(plan: CampaignPlan) -> RunRequest:
    """Everything that the campaign contains."""
    return RunRequest(plan, stages_of(plan, recorded_sources))


def calibrate_task(plan: CampaignPlan) -> RunRequest:
    """The campaign's calibration alone.

    Raises:
        RunTaskError: it has none.
    """
    if plan.calibration is None:
        raise RunTaskError(f"{plan.source}: has no 'calibration' section; there is nothing to calibrate")
    # The deployment stays out: its vessels need not be there yet.
    return RunRequest(replace(plan, deployment=None), calibration_stages(plan.calibration))


def plan_task(
    plan: CampaignPlan,
    theta: GivenTheta | None = None,
    receiver: VesselSpec | None = None,
    iterations: int | None = None,
    seeds: int = PREDICTION_SEEDS,
    draws: Sequence[SimulationParameters] = (),
) -> RunRequest:
    """The campaign turned into D1 without pours, and the prediction of each recommended action.

    Unless the campaign has D1's own settings, each action is simulated once: simulations of other actions tell about
    it, too, and its prediction is made with new seeds.

    Args:
        plan: of the campaign.
        theta: θ to plan with; the campaign's unless given.
        receiver: instead of the campaign's.
        iterations: as the campaign says unless given.
        seeds: number of new seeds of each prediction; at least one for each of `draws`.
        draws: of a posterior, which the predictions use in turn; empty: the θ that was planned with.

    Raises:
        RunTaskError: it has nothing to plan with.
    """
    from orchestrator.campaigns.run_snapshot import record_of
    from orchestrator.learning.deployment.d1 import D1Settings

    theta = theta or GivenTheta(plan.parameters)
    deployment = plan.deployment
    if deployment is None:
        raise RunTaskError(
            f"{plan.source}: has no 'deployment' section; it says which actions may be planned (actions, motion, loss)"
        )
    scenes = deployment.scenes
    if receiver is not None:
        scenes = (replace(scenes[0], name=f"plan:{receiver.name}", receiver=receiver),)
    changes: dict[str, Any] = {"pours": 0} | ({} if iterations is None else {"iterations": iterations})
    if not isinstance(deployment.settings, D1Settings):
        changes["simulations_per_iteration"] = 1
    settings = D1Settings.like(deployment.settings, **changes)
    deployment = replace(
        deployment, settings=settings, scenes=scenes, thetas=theta.draws, left_over=theta.left_over, confirm=0
    )
    name = f"{plan.name.removesuffix(PLANNED)}{PLANNED}"
    campaign = replace(plan, name=name, parameters=theta.theta, calibration=None, deployment=deployment)
    predictions = prediction_stages(campaign, deployment, max(seeds, len(draws)), draws)
    return RunRequest(
        replace(campaign, resolved=record_of(plan.resolved, campaign)),
        [*deployment_stages(campaign, deployment), *predictions],
        as_written=receiver is None,
    )


TASKS: dict[Task, Callable[[CampaignPlan], RunRequest]] = {
    "run": run_task,
    "calibrate": calibrate_task,
    "plan": plan_task,
}
"""Tasks that need a campaign alone."""


def deploy_task(plan: CampaignPlan) -> RunRequest:
    """The campaign's deployment alone; its plan has what a calibration has found."""
    assert plan.deployment is not None
    return RunRequest(replace(plan, calibration=None), deployment_stages(plan, plan.deployment))


def single_task(plan: CampaignPlan, stage: str, build: Callable[[int], Strategy], *, pours: bool = False) -> RunRequest:
    """One strategy alone.

    Args:
        plan: of the campaign.
        stage: name of its stage.
        build: makes the strategy from a seed.
        pours: whether it pours.
    """
    return RunRequest(plan, [StageDefinition(stage, lambda results, seed: build(seed), pours=pours)])


def pour_task(plan: CampaignPlan, scene: Scene, action: Action) -> RunRequest:
    """One pour with a given action, without the parts of the campaign that it does not need.

    Args:
        plan: of the campaign.
        scene: one of its scenes.
        action: of the pour.
    """
    small = replace(plan, deployment=None)
    if plan.deployment is not None and scene in plan.deployment.scenes:
        deployment = replace(plan.deployment.with_settings(pours=1), scenes=(scene,))
        small = replace(plan, calibration=None, deployment=deployment)
    outputs = plan.outputs.model_copy(update={"figures": False})
    small = replace(small, name=f"{plan.name}-pour", outputs=outputs)
    return single_task(small, POUR, lambda seed: OnePour(scene, action, seed), pours=True)


def dose_scenes(plan: CampaignPlan) -> list[Scene]:
    """Scenes to pour doses in; searched dimensions have the middle of their ranges."""
    if plan.dispense is not None:
        return list(plan.dispense.scenes)
    return [
        replace(scene, fixed={**scene.fixed, **{axis.name: axis.decode(0.5) for axis in space.axes}})
        for scene, space in named_scenes(plan).values()
    ]


def dose_task(
    plan: CampaignPlan,
    amounts: Sequence[float] = (),
    limit: float = 0.0,
    scene: Scene | None = None,
    *,
    as_left: bool = False,
) -> RunRequest:
    """A series of doses and nothing else of the campaign.

    Args:
        plan: of the campaign.
        amounts: wanted, one dose each [kg]; empty: the campaign's own series.
        limit: excess to avoid [kg].
        scene: of `dose_scenes`; the first unless given.
        as_left: the source holds what earlier doses have left.

    Raises:
        RunTaskError: there is neither an amount nor a series.
    """
    series, outputs = plan.dispense, plan.outputs
    if amounts:
        scene = scene or dose_scenes(plan)[0]
        doses = tuple(PlannedDose(amount, limit, scene.receiver.name) for amount in amounts)
        series = DispensePlan((scene,), doses, 0.0, as_left, plan.laboratory.name)
    elif series is None:
        raise RunTaskError(f"{plan.source}: has no 'dispense' section, and no amount is given")
    elif as_left:
        series = replace(series, as_left=True)
    if plan.laboratory.arm is None:  # the recording shows the motions of an arm, and there is none
        outputs = outputs.model_copy(update={"recording": False})
    small = replace(plan, name=f"{plan.name}-dose", calibration=None, deployment=None, dispense=series, outputs=outputs)
    stages = dispense_stages(series, recorded_sources, simulated=partial(simulated_knowledge, small))
    return RunRequest(small, stages, as_written=not amounts)
