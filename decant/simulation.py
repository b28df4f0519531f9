"""One action in the simulator of this process: its outcomes over several seeds, and its figure.

`simulate` returns a `Simulation`. It starts no laboratory and makes no pour.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from orchestrator.campaigns.action_assignments import assigned_action
from orchestrator.campaigns.campaign_checks import check_vessels
from orchestrator.campaigns.file_loading import load_vessel
from orchestrator.learning.campaign_plan import CampaignPlan
from sim_engine.errors import InvalidArgumentError, InvalidSceneError
from sim_engine.liquids import SimulationParameters
from sim_engine.outcome import SimulatedPour
from sim_engine.prediction_band import SampleStatistics, spreads
from sim_engine.scene import PourTask
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
        pours: the outcome of each seed; the first one has its frames.
    """

    task: PourTask
    pours: tuple[SimulatedPour, ...]

    @property
    def prediction(self) -> dict[str, SampleStatistics]:
        """Mean and standard deviation over the seeds, by quantity: 'received', 'spilled', 'retained', 'spillage' …"""
        return spreads([pour.outcome for pour in self.pours])

    def figure(self) -> Figure:
        """Four moments of the first seed from the side, and the place of the liquid at every time."""
        from orchestrator.reports.pour_figures import simulation_figure

        return simulation_figure(self.task, self.pours[0])


def simulate(
    campaign: CampaignPlan,
    action: Mapping[str, str | float] | None = None,
    *,
    receiver: VesselSpec | Path | str | None = None,
    theta: SimulationParameters | None = None,
    seed: int = 0,
    seeds: int = 1,
) -> Simulation:
    """Simulate an action in a campaign's scene. Vessels of uncertain shape are drawn again for each seed.

    Args:
        campaign: defines vessels, liquid and motion: the scene of its first deployment, else of its calibration.
        action: dimensions with units, '40 deg/s'; plain numbers are in display units (deg/s, deg, mm, s). Dimensions
            that the campaign fixes need not be given.
        receiver: another vessel, or its file.
        theta: simulation parameters; the campaign's unless given.
        seed: of the first pour's initial positions; later pours use the next seeds.
        seeds: how many, 1 or more.

    Raises:
        ConfigError: the receiver's file is invalid.
        ValueError: `seeds` is below 1, the action is incomplete, or the vessels touch, are too small for the load, or
            cannot be built (each is a `DecantError`).
    """
    from orchestrator.runs.stages import named_scenes
    from sim_engine.simulator import PourSimulator

    if seeds < 1:
        raise InvalidArgumentError(f"seeds={seeds!r}: should be 1 or more")
    scene, space = next(iter(named_scenes(campaign).values()))
    if receiver is not None:
        vessel = receiver if isinstance(receiver, VesselSpec) else load_vessel(Path(receiver).expanduser())
        scene = replace(scene, name=f"{scene.pourer.name} into {vessel.name}", receiver=vessel)
    chosen = assigned_action(
        [f"{name}={value}" for name, value in (action or {}).items()], fixed=scene.fixed, space=space
    )
    if problems := check_vessels(scene, campaign.source):
        raise InvalidSceneError("\n".join(map(str, problems)))
    parameters = campaign.parameters if theta is None else theta
    tasks = [
        PourTask(scene.drawn(seed + i), chosen, parameters, seed + i, FRAME_RATE if i == 0 else 0.0)
        for i in range(seeds)
    ]
    simulator = PourSimulator()
    try:
        return Simulation(tasks[0], tuple(simulator.simulate(task) for task in tasks))
    finally:
        simulator.close()
