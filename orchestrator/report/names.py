"""What people call a scene: by its receiver. The scene's own name is a key, for the journal and for programs."""

from __future__ import annotations

from orchestrator.plan import CampaignPlan


def receiver_names(plan: CampaignPlan) -> dict[str, str]:
    """Scene name → the receiver's name; of two deployment scenes with receivers of one name, the scenes' own names."""
    names: dict[str, str] = {}
    if plan.deployment is not None:
        scenes = plan.deployment.scenes
        distinct = len({scene.receiver.name for scene in scenes}) == len(scenes)
        names = {scene.name: scene.receiver.name if distinct else scene.name for scene in scenes}
    if plan.calibration is not None:
        for known in (plan.calibration.records, plan.calibration.transfer):
            if known is not None:
                names.setdefault(known.scene.name, known.scene.receiver.name)
        for scene in plan.calibration.poured:
            names.setdefault(scene.name, scene.receiver.name)
    return names


def receiver_name(plan: CampaignPlan, scene: str) -> str:
    """What people call a scene; its own name if the plan doesn't know it."""
    return receiver_names(plan).get(scene, scene)
