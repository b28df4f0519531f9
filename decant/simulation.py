"""Actions in the simulator: their outcomes over several seeds, and a figure.

`simulate` returns a `Simulation`, `simulate_many` one for each of several actions. Both start no laboratory and make no
pour. Any thread may call them. They share child processes, which end with this program.
"""

from __future__ import annotations

import os
import warnings
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from actors.arm.pour_feasibility import path_of, plan_pour
from actors.interfaces import InvalidActionError
from actors.simulators.background_pool import background_pool
from decant.run_results import Run
from decant.running import given_theta
from orchestrator.campaigns.action_assignments import AssignmentError, assigned_action
from orchestrator.campaigns.campaign_checks import check_vessels
from orchestrator.campaigns.file_loading import load_vessel
from orchestrator.learning.campaign_plan import CampaignPlan
from sim_engine.action import Action
from sim_engine.errors import InvalidArgumentError, InvalidSceneError
from sim_engine.liquids import SimulationParameters
from sim_engine.outcome import SimulatedPour
from sim_engine.prediction_band import SampleStatistics, spreads
from sim_engine.scene import PourTask, Scene
from sim_engine.vessel.shapes import VesselSpec

if TYPE_CHECKING:
    from matplotlib.figure import Figure

FRAME_RATE = 20.0
"""Rate of the frames of the first seed that are kept for the figure [1/s]."""


@dataclass(frozen=True)
class Simulation:
    """One action, simulated with several seeds.

    Attributes:
        task: the first seed's.
        pours: the outcome of each seed; the first one of `simulate` has its frames.
    """

    task: PourTask
    pours: tuple[SimulatedPour, ...]

    @property
    def prediction(self) -> dict[str, SampleStatistics]:
        """Mean and standard deviation over the seeds, by quantity: 'received', 'spilled', 'retained', 'spillage' …"""
        return spreads([pour.outcome for pour in self.pours])

    def figure(self) -> Figure:
        """Four moments of the first seed from the side, and the place of the liquid at every time.

        Raises:
            InvalidArgumentError: it is one of `simulate_many`, which keeps no particles.
        """
        from orchestrator.reports.pour_figures import simulation_figure

        if self.pours[0].frames is None:
            raise InvalidArgumentError("decant.simulate_many keeps no particles: draw this action with decant.simulate")
        return simulation_figure(self.task, self.pours[0])


def simulate(
    campaign: CampaignPlan,
    action: Mapping[str, str | float] | None = None,
    *,
    receiver: VesselSpec | Path | str | None = None,
    theta: SimulationParameters | Run | Path | str | None = None,
    seed: int = 0,
    seeds: int = 1,
) -> Simulation:
    """Simulate an action in a campaign's scene. Vessels of uncertain shape are drawn again for each seed.

    Args:
        campaign: defines vessels, liquid and motion: the scene of its first deployment, else of its calibration.
        action: dimensions with units, '40 deg/s'; plain numbers are in display units (deg/s, deg, mm, s). Dimensions
            that the campaign fixes need not be given.
        receiver: another vessel, or its file.
        theta: simulation parameters, a run that has calibrated, or its `theta.json`; the campaign's unless given.
        seed: of the first pour's initial positions; later pours use the next seeds.
        seeds: how many, 1 or more.

    An action that the laboratory's arm can't make is simulated with a `UserWarning`.

    Raises:
        ConfigError: the file of the receiver or of `theta` is invalid.
        ValueError: `seeds` is below 1, the action is incomplete, or the vessels touch, are too small for the load, or
            cannot be built (each is a `DecantError`).
        LaboratoryError: a simulation has no result.
    """
    (result,) = _simulated(campaign, [(action or {}, "")], receiver, theta, seed, seeds, FRAME_RATE, None, None)
    return result


def simulate_many(
    campaign: CampaignPlan,
    actions: Iterable[Mapping[str, str | float]],
    *,
    receiver: VesselSpec | Path | str | None = None,
    theta: SimulationParameters | Run | Path | str | None = None,
    seed: int = 0,
    seeds: int = 1,
    workers: int | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> list[Simulation]:
    """Simulate several actions side by side, each with the outcomes that `simulate` gives.

    Args:
        campaign: see `simulate`.
        actions: see `simulate`; all are checked before the first simulation.
        receiver: see `simulate`.
        theta: see `simulate`.
        seed: of the first pour of each action.
        seeds: pours of each action, 1 or more.
        workers: number of processes, 1 or more; one per core unless given.
        progress: called with the number of finished simulations and of all.

    Returns:
        One for each action, in their order, without particles.

    Raises:
        ConfigError, ValueError, LaboratoryError: see `simulate`; the text names the action.
    """
    if workers is not None and workers < 1:
        raise InvalidArgumentError(f"workers={workers!r}: should be 1 or more")
    if isinstance(actions, Mapping):
        raise InvalidArgumentError("actions: should be a list of actions, not one of them")
    named = [(action, f"actions[{i}]: ") for i, action in enumerate(actions)]
    return _simulated(campaign, named, receiver, theta, seed, seeds, 0.0, workers, progress)


def _simulated(
    campaign: CampaignPlan,
    actions: list[tuple[Mapping[str, str | float], str]],
    receiver: VesselSpec | Path | str | None,
    theta: SimulationParameters | Run | Path | str | None,
    seed: int,
    seeds: int,
    frame_rate: float,
    workers: int | None,
    progress: Callable[[int, int], None] | None,
) -> list[Simulation]:
    """Simulate actions, each with its name in errors."""
    from orchestrator.runs.stages import named_scenes

    if seeds < 1:
        raise InvalidArgumentError(f"seeds={seeds!r}: should be 1 or more")
    scene, space = next(iter(named_scenes(campaign).values()))
    if receiver is not None:
        vessel = receiver if isinstance(receiver, VesselSpec) else load_vessel(Path(receiver).expanduser())
        scene = replace(scene, name=f"{scene.pourer.name} into {vessel.name}", receiver=vessel)
    parameters = given_theta(theta, campaign).theta
    if problems := check_vessels(scene, campaign.source):
        raise InvalidSceneError("\n".join(map(str, problems)))
    tasks: list[PourTask] = []
    named: list[tuple[Action, str]] = []
    for action, name in actions:
        try:
            chosen = assigned_action(
                [f"{dimension}={value}" for dimension, value in action.items()], fixed=scene.fixed, space=space
            )
        except AssignmentError as error:
            raise AssignmentError(f"{name}{error}") from None
        try:
            plan_pour(scene, chosen)
        except InvalidActionError as error:
            raise InvalidSceneError(f"{name}{error}") from None
        named.append((chosen, name))
        tasks += [
            PourTask(scene.drawn(seed + i), chosen, parameters, seed + i, frame_rate if i == 0 else 0.0)
            for i in range(seeds)
        ]
    if not tasks:
        return []
    try:
        pours = background_pool().simulate(
            tasks, workers or os.cpu_count() or 1, progress, lambda: _warn_of_the_arm(scene, named, campaign)
        )
    except InvalidActionError as error:  # of a vessel's drawn shape
        raise InvalidSceneError(str(error)) from None
    return [Simulation(tasks[i], tuple(pours[i : i + seeds])) for i in range(0, len(tasks), seeds)]


def _warn_of_the_arm(scene: Scene, actions: list[tuple[Action, str]], campaign: CampaignPlan) -> None:
    """Warn of actions that the laboratory's arm can't make."""
    for action, name in actions if campaign.laboratory.arm is not None else ():
        try:
            path_of(scene, action, campaign.laboratory.expected_arm)
        except InvalidActionError as error:
            warnings.warn(f"{name}{action.display()}: {error}", UserWarning, stacklevel=6)
