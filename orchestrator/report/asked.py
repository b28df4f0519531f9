"""What a campaign asks for, for people who have not seen its file."""

from __future__ import annotations

from collections.abc import Iterable

from orchestrator.plan import CampaignPlan
from orchestrator.report import style
from orchestrator.report.units import deployment_unit
from sim_engine.space import Axis
from sim_engine.task import Scene


def what_was_asked(plan: CampaignPlan) -> list[tuple[str, str]]:
    """Names and values: what is poured, how the simulator is calibrated, how pours are found."""
    found: list[tuple[str, str]] = []
    scenes = (list(plan.calibration.poured) if plan.calibration is not None else []) + (
        list(plan.deployment.scenes) if plan.deployment is not None else []
    )
    if scenes:
        liquid = scenes[0].liquid
        volume = liquid.millilitres(liquid.mass)
        found.append(("liquid", f"{1e3 * liquid.mass:g} g of {liquid.name} ({volume:.0f} mL)"))
        found.append(("poured from", _listed(scene.pourer.name for scene in scenes)))
    if plan.calibration is not None:
        one = plan.calibration
        pours = f"{one.pour_count} pours, {one.holdout} of them kept for testing"
        if one.records is not None:
            pours = f"{len(one.records.pours)} weighed pours of {one.records.path.name}"
        found += [
            ("calibration", f"{one.strategy} on {pours}; {one.simulations} simulations"),
            ("… into", one.scene.receiver.name),
            ("… actions", _ranges(one.actions.axes)),
            ("… searched θ", _ranges(one.parameters.axes)),
            ("… fixed", _fixed(one.scene)),
        ]
    if plan.deployment is not None:
        two = plan.deployment
        found += [
            ("pouring", f"{two.strategy}, into each receiver: {two.settings.spending}"),
            ("… into", _listed(scene.receiver.name for scene in two.scenes)),
            ("… minimised", deployment_unit(two).label),
            ("… actions", _ranges(two.actions.axes)),
            ("… fixed", _fixed(two.scenes[0]) if two.scenes else ""),
        ]
        if two.confirm:
            found.append(("… afterwards", f"the recommended action is poured {two.confirm} more times"))
        if two.data is not None:
            count = sum(len(pours) for pours in two.data.pours.values())
            found.append(("… known before", f"{count} pours of {two.data.path.name}"))
    return [(name, value) for name, value in found if value]


def _ranges(axes: Iterable[Axis]) -> str:
    return ", ".join(_range(axis) for axis in axes)


def _range(axis: Axis) -> str:
    factor, unit = style.display_factor(axis.name), style.display_unit(axis.name)
    words = style.PARAMETER_NAMES.get(axis.name, axis.name.replace("_", " "))
    return f"{words} {style.number(axis.lower / factor)} … {style.number(axis.upper / factor)} {unit}".rstrip()


def _fixed(scene: Scene) -> str:
    values = {name.replace("_", " "): style.display_value(name, value) for name, value in scene.fixed.items()}
    return ", ".join(f"{name} {value}" for name, value in values.items()).replace("_", " ")


def _listed(names: Iterable[str]) -> str:
    return ", ".join(dict.fromkeys(names))
