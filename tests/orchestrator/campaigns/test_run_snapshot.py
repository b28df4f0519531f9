"""`run_snapshot`: what a run keeps of its campaign loads to the same plan: shipped campaigns, cells of studies, and
generated ones.
"""

from __future__ import annotations

import dataclasses
import json
import math
import types
import typing
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import annotated_types
import pytest
import yaml
from hypothesis import assume, event, given, settings
from hypothesis import strategies as st

from orchestrator.campaigns.campaign_file import CALIBRATIONS, DEPLOYMENTS, CalibrationSection, DeploymentSection
from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.campaigns.fingerprint import fingerprint
from orchestrator.campaigns.yaml.yaml_errors import ConfigError
from orchestrator.cli.campaign_commands import planning_request
from orchestrator.learning.calibration.pour_design import DesignResult
from orchestrator.learning.campaign_plan import CampaignPlan
from orchestrator.learning.deployment.deployment_result import Deployed
from orchestrator.study.study_campaigns import campaign_of
from orchestrator.study.study_file import load_study
from orchestrator.study.study_plan import cells_of
from sim_engine.settings.model import Settings
from sim_engine.settings.quantity import Quantity
from tests.support import plans
from tests.support.hypothesis_examples import examples

CONFIGS = Path(__file__).parents[3] / "configs"
SHIPPED = sorted((CONFIGS / "campaigns").glob("*.yaml"))


def reloaded(plan: CampaignPlan, folder: Path) -> CampaignPlan:
    """The plan of a run's record, which knows nothing of the file that the campaign was read from."""
    path = folder / "elsewhere" / "resolved.json"
    path.parent.mkdir(exist_ok=True)
    path.write_text(json.dumps(plan.resolved), encoding="utf-8")
    again = load_campaign(path)
    assert again.resolved == plan.resolved, "a record's record is the record"
    return dataclasses.replace(again, source=plan.source)


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.stem)
def test_shipped_campaigns_are_kept_whole(path: Path, tmp_path: Path) -> None:
    plan = load_campaign(path)
    assert reloaded(plan, tmp_path) == plan


@pytest.mark.parametrize("name", ["quick", "paper"])
def test_cells_of_a_study_are_kept_in_the_language_of_campaigns(name: str, tmp_path: Path) -> None:
    study = load_study(CONFIGS / "studies" / f"{name}.yaml")
    theta = study.base.parameters.model_copy(update={"cohesion": 0.0123456789})
    kinds: set[tuple[str, str]] = set()
    for cell in cells_of(study):
        if cell.kind in ("calibration", "uncalibrated") or (cell.kind, cell.strategy) in kinds:
            continue  # those read pours from a journal
        kinds.add((cell.kind, cell.strategy))
        stage = f"deployment:{cell.receiver.removeprefix('deployment-')}"
        deployed, poured = Deployed.model_construct(recommended=None), DesignResult.model_construct(pours=())
        needed = {"pours": poured, "calibration": plans.calibrated(theta), stage: deployed}
        plan = campaign_of(study, cell, lambda other, needed=needed: needed, tmp_path / cell.id).campaign  # type: ignore[misc]
        assert reloaded(plan, tmp_path) == plan, cell.id
    assert len(kinds) > 4


MEASURED = """
name: cup
profile: {unit: mm, inner: [[0, 0], [32, 0], [33, 99]], wall: 3 mm, floor: 4 mm,
          radius_deviations: [[0, 0.21, 0.13], [0, 0.1, -0.1]], height_deviation: 0.3 mm}
"""


@pytest.mark.parametrize("vessel", ["tumbler.yaml", "mug.yaml", "measured.yaml"])
def test_a_planning_run_keeps_the_theta_and_the_vessel_that_it_planned_with(vessel: str, tmp_path: Path) -> None:
    campaign = load_campaign(CONFIGS / "campaigns" / "quickstart.yaml")
    (tmp_path / "measured.yaml").write_text(MEASURED)
    theta = tmp_path / "theta.json"
    theta.write_text(json.dumps({"theta": {"cohesion": 0.0123456789}}))
    planned = planning_request(
        campaign, theta, (tmp_path if vessel.startswith("measured") else CONFIGS / "vessels") / vessel, 3
    ).campaign
    again = reloaded(planned, tmp_path)
    assert again.parameters.cohesion == 0.0123456789
    assert [scene.receiver for scene in again.deployment.scenes] == [s.receiver for s in planned.deployment.scenes]  # type: ignore[union-attr]
    assert again.deployment.settings == planned.deployment.settings  # type: ignore[union-attr]
    assert again.calibration is None


# -- generated campaigns -----------------------------------------------------------------------------------------------


def value_of(annotation: Any, metadata: tuple[Any, ...] = ()) -> st.SearchStrategy[Any]:
    """Anything that may be written for a setting, from its declaration alone."""
    if (quantity := next((m for m in metadata if isinstance(m, Quantity)), None)) is not None:
        number = st.floats(max(quantity.lower, -10.0), min(quantity.upper, 500.0), exclude_min=quantity.positive)
        return number if quantity.unit == "1" else number.map(lambda value: f"{value!r} {quantity.unit}")
    origin, inner = typing.get_origin(annotation), typing.get_args(annotation)
    if origin is typing.Annotated:
        return value_of(inner[0], (*inner[1:], *metadata))
    if origin in (typing.Union, types.UnionType):
        return st.one_of([value_of(part) for part in inner if part is not type(None)])
    if origin is Literal:
        return st.sampled_from(inner)
    if isinstance(annotation, type) and issubclass(annotation, Settings):
        return section_of(annotation)
    if annotation is int:
        flat = [deep for m in metadata for deep in getattr(m, "metadata", [m])]
        least = max((m.ge for m in flat if isinstance(m, annotated_types.Ge)), default=0)
        most = min((m.le for m in flat if isinstance(m, annotated_types.Le)), default=40)
        return st.integers(int(least), int(most))  # type: ignore[call-overload]
    if origin is dict:
        return st.fixed_dictionaries({name: st.integers(1, 4) for name in ("particles", "cohesion", "xsph_rate")})
    raise AssertionError(f"settings of type {annotation} are not generated: teach this function to write one")


def section_of(model: type[Settings], without: frozenset[str] = frozenset()) -> st.SearchStrategy[dict[str, Any]]:
    """A section with any of its keys, and all that must be there."""
    needed, free = {}, {}
    for key, name in model.written_keys().items():
        if name not in without:
            info = model.model_fields[name]
            (needed if key in model.required_keys() else free)[key] = value_of(info.annotation, tuple(info.metadata))
    return st.fixed_dictionaries(needed, optional=free)


def strategy_of(variants: Mapping[str, type[Settings]], common: type[Settings]) -> st.SearchStrategy[dict[str, Any]]:
    """The own keys of one of the strategies that are installed."""

    def of(name: str) -> st.SearchStrategy[dict[str, Any]]:
        own = section_of(variants[name], without=frozenset({*common.model_fields, "strategy", "data"}))
        return own.map(lambda keys: {**keys, "strategy": name})

    return st.sampled_from(sorted(variants)).flatmap(of)


def sensible(section: dict[str, Any]) -> dict[str, Any]:
    """What doesn't make sense together left out, so that most of what is generated can be asked for."""
    kept = dict(section)
    if kept["strategy"] in ("D2", "D3"):
        kept["pours"] = max(kept.get("pours", 1), 1)
    wanted = {"C1": ("grid", "points_per_axis"), "C2": ("samples",), "C3": ("iterations",), "C4": ("simulations",)}
    if own := wanted.get(kept["strategy"]):
        first = next((key for key in own if key in kept), own[-1])
        kept = {key: value for key, value in kept.items() if key not in (*own, "simulations")}
        kept |= {first: section.get(first, 9)}
        kept["initial_samples"] = (
            min(kept.get("initial_samples", 8), 9 if kept[first] == "auto" else kept[first])
            if "initial_samples" in kept or own[0] != "grid"
            else 0
        )
        if kept["strategy"] in ("C1", "C2"):
            del kept["initial_samples"]
    return kept


LOSSES = st.sampled_from(
    [
        {},
        {"loss": {"retained_weight": 0.123456789}},
        {"loss": {"name": "spilled_and_retained"}},
        {"objective": {"name": "spilled", "floor": 0.7}},
    ]
)
MOTIONS = st.sampled_from([{}, {"hold_time": "0.3 s"}, {"max_hold_time": "3.3 s", "pivot": {"x": "3 mm", "z": "4 mm"}}])


def quickstart() -> dict[str, Any]:
    path = CONFIGS / "campaigns" / "quickstart.yaml"
    content: dict[str, Any] = yaml.safe_load(path.read_text(encoding="utf-8"))
    for section, key in ((content, "laboratory"), (content, "pourer")):
        section[key] = str((path.parent / section[key]).resolve())
    for section in (content["calibration"], content["deployment"]):
        section["receiver"] = str((path.parent / section["receiver"]).resolve())
    return content


COMMON = ("receiver", "motion", "actions", "pours")


@pytest.mark.slow
@given(
    calibration=strategy_of(CALIBRATIONS, CalibrationSection),
    deployment=strategy_of(DEPLOYMENTS, DeploymentSection),
    more=LOSSES,
    motion=MOTIONS,
)
@settings(max_examples=examples(160), deadline=None)
def test_whatever_is_asked_for_is_kept(
    calibration: dict[str, Any],
    deployment: dict[str, Any],
    more: dict[str, Any],
    motion: dict[str, Any],
    tmp_path_factory: pytest.TempPathFactory,
) -> None:
    content, folder = quickstart(), tmp_path_factory.mktemp("campaign")
    content["motion"] = {**content.get("motion", {}), **motion}
    content["calibration"] = {key: content["calibration"][key] for key in COMMON if key in content["calibration"]}
    deployment = sensible(deployment)
    content["calibration"] |= sensible(calibration)
    content["deployment"] = {key: content["deployment"][key] for key in COMMON[:3]} | deployment | more
    (folder / "campaign.yaml").write_text(yaml.safe_dump(content), encoding="utf-8")
    try:
        plan = load_campaign(folder / "campaign.yaml")
    except ConfigError:
        assume(False)
        raise
    event(f"{plan.calibration and plan.calibration.strategy} {plan.deployment and plan.deployment.strategy}")
    again = reloaded(plan, folder)
    assert again == plan
    assert fingerprint(again) == fingerprint(plan)
    assert plan.deployment is not None
    for key, written in deployment.items():
        kept = getattr(plan.deployment.settings, key)
        if isinstance(written, float):
            assert math.isclose(kept, written), key
        elif isinstance(kept, str | int) and not isinstance(written, str):
            assert kept == written, key
