"""Events as typed JSON: every field of every event, but for particles and for what can be asked for elsewhere."""

from __future__ import annotations

import dataclasses
import json
import math
from collections.abc import Mapping
from enum import Enum
from typing import Any

from pydantic import BaseModel

from orchestrator.events import (
    CampaignOpened,
    Event,
    MadeAhead,
    PourProgressed,
    RequestFinished,
    RequestStarted,
    StrategyProgressed,
)
from orchestrator.requests import Suggest, Suggested

PASSING = (PourProgressed, StrategyProgressed, MadeAhead)
"""Events that say where something stands just now: the next one takes their place, so they are not kept on disk."""


def event_json(event: Event) -> dict[str, Any]:
    """The fields of an event, with the name of its class under 'type'.

    Recorded particles are left out (they are in the recording), a question to the optimiser has its purpose, its
    answer its points; what a strategy has learnt is in the event that closes its stage.
    """
    left_out = {"frames"}
    if isinstance(event, StrategyProgressed):
        left_out.add("result")
    table = {f.name: plain(getattr(event, f.name)) for f in dataclasses.fields(event) if f.name not in left_out}
    if isinstance(event, CampaignOpened):
        table["run_directory"] = event.run_directory.name
    if isinstance(event, RequestStarted | RequestFinished) and isinstance(event.request, Suggest):
        table["request"] = {"type": "Suggest", "purpose": event.request.purpose}
    if isinstance(event, RequestFinished) and isinstance(event.outcome, Suggested):
        table["outcome"] = {"type": "Suggested", "points": plain(event.outcome.suggestion.points)}
    return {"type": type(event).__name__, **table}


def plain(value: Any) -> Any:
    """JSON-ready, whatever it is: what has no word in JSON becomes null, what is a value of ours names its type."""
    if value is None or isinstance(value, bool | int | str):
        return value.value if isinstance(value, Enum) else value
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if isinstance(value, BaseModel):
        return plain(value.model_dump(mode="python"))
    if dataclasses.is_dataclass(value):
        table = {f.name: plain(getattr(value, f.name)) for f in dataclasses.fields(value)}
        return {"type": type(value).__name__, **table}
    if isinstance(value, Mapping):
        return {str(key): plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple | set | frozenset):
        return [plain(one) for one in value]
    if hasattr(value, "tolist"):
        return plain(value.tolist())
    return str(value)


def text(data: Any) -> str:
    """On one line."""
    return json.dumps(data, ensure_ascii=False, separators=(",", ":"))
