"""Fingerprint of a plan: the values that decide which requests are made.

A run can only be resumed with an equal fingerprint. Every field is included, unless its declaration marks it as free
(`sim_engine.settings.model`).
"""

from __future__ import annotations

import dataclasses
import hashlib
from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel

from actors.balance.scale_model import ScaleSettings
from actors.balance.simulated_balance import SimulatedBalanceSettings
from actors.laboratory_settings import TrueLiquidBase
from actors.optimizer.questions import WRITTEN_IF_SET
from orchestrator.learning.campaign_plan import CampaignPlan
from orchestrator.records.codec import to_json
from sim_engine.liquids import Liquid, SimulationParameters
from sim_engine.scene import Scene
from sim_engine.settings.model import BY_CONTENT, NOT_IN_FINGERPRINT, SET_BY_PROGRAM, marks_of
from sim_engine.vessel.shapes import ProfileShape, Shape

WITH_FREE_FIELDS = (
    TrueLiquidBase,
    Liquid,
    ProfileShape,
    ScaleSettings,
    SimulatedBalanceSettings,
    SimulationParameters,
)


def fingerprint(plan: CampaignPlan) -> dict[str, Any]:
    """JSON-ready copy of all values that decide requests. Meshes are included by content, so the project can be moved.

    Raises:
        OSError: a mesh file can't be read.
    """
    return dict(deciding(plan))


def scene_by_content(scene: Scene) -> dict[str, Any]:
    """A scene in the form of a fingerprint, comparable with a scene in the header of a journal.

    Raises:
        OSError: a mesh file can't be read.
    """
    return dict(deciding(scene))


def deciding(value: Any) -> Any:
    """The part of a value that decides requests, JSON-ready.

    Raises:
        OSError: a file that is included by content can't be read.
        CodecError: the value contains something that JSON can't represent.
    """
    if isinstance(value, ProfileShape) and value.unit != "m":
        return deciding(value.outline())  # the same shape in another unit is the same
    if isinstance(value, BaseModel) or (dataclasses.is_dataclass(value) and not isinstance(value, type)):
        free = value.free_fields() if isinstance(value, WITH_FREE_FIELDS) else _absent(value)
        fields = {
            name: (getattr(value, name), mark)
            for name, mark in marks_of(type(value)).items()
            if mark not in (NOT_IN_FINGERPRINT, SET_BY_PROGRAM) and name not in free
        }
        kind = {"kind": value.kind} if isinstance(value, Shape) else {}
        return kind | {
            name: hashlib.sha256(content.read_bytes()).hexdigest() if mark == BY_CONTENT else deciding(content)
            for name, (content, mark) in fields.items()
        }
    if isinstance(value, Mapping):
        return {key: deciding(content) for key, content in value.items()}
    if isinstance(value, list | tuple):
        return [deciding(content) for content in value]
    return to_json(value)


def _absent(value: Any) -> frozenset[str]:
    """Fields that runs of earlier versions lack, while they are None."""
    if isinstance(value, BaseModel):
        return frozenset()
    return frozenset(
        field.name
        for field in dataclasses.fields(value)
        if field.metadata == WRITTEN_IF_SET and getattr(value, field.name) is None
    )
