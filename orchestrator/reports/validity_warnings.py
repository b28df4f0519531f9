"""Warnings about effects that a campaign's pours have and the simulator does not model, for displays and summaries.

They are warnings, never errors. `sim_engine.model_validity` defines the limits of the model.
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Callable
from functools import lru_cache
from typing import TypeVar

from orchestrator.learning.campaign_plan import CalibrationPlan, CampaignPlan, receiver_names
from orchestrator.records.codec import Results
from orchestrator.reports import figure_style as style
from orchestrator.reports.run_summary import NotSimulated
from orchestrator.reports.stage_views import deployments_of, recommended_theta_of
from sim_engine.action import Action
from sim_engine.model_validity import ModelValidity, NotCovered, regimes
from sim_engine.scene import Scene
from sim_engine.search_space import Space
from sim_engine.simulator import spacing
from sim_engine.vessel.vessel import build_vessel

MOST_CORNERS = 32
"""Maximum number of corners of a space that are tried."""

W = TypeVar("W")

_log = logging.getLogger(__name__)
_vessel = lru_cache(maxsize=16)(build_vessel)


def regimes_of(scene: Scene, action: Action, particles: float, adhesion: float) -> ModelValidity:
    """Model validity of one action.

    Args:
        particles: number of particles of a simulation.
        adhesion: its `lip_adhesion`.

    Raises:
        ValueError, OSError: its vessels can't be built, or don't hold the load.
    """
    distance = spacing(scene.liquid.volume, max(round(particles), 1))
    vessels = _vessel(scene.pourer), _vessel(scene.receiver)
    return regimes(scene, action, *vessels, spacing=distance, adhesion=adhesion)


def space_warnings(
    scene: Scene, actions: Space, particles: float, adhesion: float, receiver: str
) -> list[NotSimulated]:
    """Effects that are not simulated at the middle and the corners of an action space, each kind once.

    Args:
        receiver: display name of the scene.

    Raises:
        ValueError, OSError: as `regimes_of`.
    """
    corners = itertools.islice(itertools.product((0.0, 1.0), repeat=actions.dimension), MOST_CORNERS)
    tried = [actions.decode(point) for point in ((0.5,) * actions.dimension, *corners)]
    gaps: dict[str, list[tuple[NotCovered, dict[str, float]]]] = {}
    for values in tried:
        for gap in regimes_of(scene, scene.action(values), particles, adhesion).not_covered:
            gaps.setdefault(gap.kind, []).append((gap, values))
    warnings = []
    for kind, hits in gaps.items():
        worst, values = max(hits, key=lambda hit: hit[0].share)
        warnings.append(
            NotSimulated(
                receiver=receiver,
                kind=kind,
                share=worst.share,
                text=worst.text,
                action_si=values,
                hit=len(hits),
                tried=len(tried),
            )
        )
    return warnings


def campaign_warnings(plan: CampaignPlan) -> dict[str, list[NotSimulated]]:
    """Effects that are not simulated in a campaign's action spaces, by scene; scenes without warnings are left out.

    If calibration searches the number of particles or the adhesion, the middle of its range is used.

    Raises:
        ValueError, OSError: as `regimes_of`.
    """
    spaces: list[tuple[Scene, Space]] = []
    particles, adhesion = float(plan.parameters.particles), plan.parameters.lip_adhesion
    names = receiver_names(plan)
    if plan.calibration is not None:
        particles = _middle(plan.calibration, "particles", particles)
        adhesion = _middle(plan.calibration, "lip_adhesion", adhesion)
        spaces += [(scene, plan.calibration.actions) for scene in plan.calibration.scenes]
    if plan.deployment is not None:
        spaces += [(scene, plan.deployment.actions) for scene in plan.deployment.scenes]
    by_scene = {
        scene.name: space_warnings(scene, actions, particles, adhesion, names.get(scene.name, scene.name))
        for scene, actions in spaces
    }
    return {name: warnings for name, warnings in by_scene.items() if warnings}


def best_action_warnings(plan: CampaignPlan, results: Results) -> dict[str, list[NotCovered]]:
    """Effects that are not simulated for the action that each deployment recommends, by scene.

    Raises:
        ValueError, OSError: as `regimes_of`.
    """
    theta = recommended_theta_of(results) or plan.parameters
    scenes = {} if plan.deployment is None else {scene.name: scene for scene in plan.deployment.scenes}
    by_scene = {}
    for name, result in deployments_of(results).items():
        if name in scenes and result.recommended is not None:
            action = scenes[name].action(dict(result.recommended.action_si))
            by_scene[name] = list(regimes_of(scenes[name], action, theta.particles, theta.lip_adhesion).not_covered)
    return by_scene


def worked_out(
    work: Callable[[], dict[str, list[W]]], tell: Callable[[str], None] = _log.warning
) -> dict[str, list[W]]:
    """Warnings, or none if they can't be worked out: that is not a reason to lose a summary."""
    try:
        return work()
    except (ValueError, OSError) as error:
        tell(f"note: whether something is not simulated could not be worked out: {error}")
        return {}


def not_simulated(plan: CampaignPlan, tell: Callable[[str], None]) -> list[str]:
    """Effects that are not simulated in most of a campaign's action spaces: lines for the user before it begins.

    An effect in the minority of the actions tried is in the report only: the search may never go there, and the
    recommended action has warnings of its own.

    Args:
        plan: of the campaign.
        tell: called if that can't be worked out.
    """
    by_scene = worked_out(lambda: campaign_warnings(plan), tell)
    warnings = [gap for gap in itertools.chain.from_iterable(by_scene.values()) if 2 * gap.hit > gap.tried]
    if not warnings:
        return []
    texts = ["not simulated (docs/explanation/simulator.md has what to do):"]
    for warning in warnings:
        at = f"(at {style.display_values(warning.action_si)}; {warning.hit} of {warning.tried} actions tried)"
        texts.append(f"  into {warning.receiver}, {warning.kind}: {warning.text} {at}")
    return texts


def numbers_line(validity: ModelValidity) -> str:
    """Dimensionless numbers of a pour in one line: 'lip: Re 880 … 4 500, We 3 … 26, …; stream: …'."""
    if validity.lip is None or validity.stream is None:
        return "nothing leaves the pourer, as far as hydrostatics tells"
    parts = []
    for place, numbers in (("lip", validity.lip), ("stream", validity.stream)):
        ranges = (("Re", numbers.reynolds), ("We", numbers.weber), ("Bo", numbers.bond))
        shown = (f"{name} {style.two_digits(r.smallest)} … {style.two_digits(r.largest)}" for name, r in ranges)
        parts.append(f"{place}: {', '.join(shown)}")
    return "; ".join(parts)


def _middle(calibration: CalibrationPlan, name: str, otherwise: float) -> float:
    for axis in calibration.parameters.axes:
        if axis.name == name:
            return axis.decode(0.5)
    return calibration.fixed_parameters.get(name, otherwise)
