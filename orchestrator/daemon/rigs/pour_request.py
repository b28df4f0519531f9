"""The requests that queue work, one ordered pour (`PourIn`) or one campaign (`SubmissionIn`), of every interface.

`decant queue pour`, `decant.Station.pour`, the SiLA 2 server and the MADSci node make this model of their parameters;
help texts and arguments have its descriptions. The module imports pydantic alone, so that the command line starts fast.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterable, Mapping
from datetime import datetime
from typing import Annotated, Any, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    WithJsonSchema,
    model_validator,
)
from pydantic_core import InitErrorDetails, PydanticCustomError

CallerId = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._:-]{0,79}$")]
Key = Annotated[str, Field(min_length=1, max_length=80)]
Quantity = Annotated[str, Field(max_length=40)]


def moment(value: object) -> object:
    """Convert a time with its zone to seconds since 1970; numbers stay.

    Args:
        value: text in ISO 8601, such as '2026-11-27T08:00:00+01:00', or seconds since 1970.

    Raises:
        ValueError: the text is no time, or has no zone.
    """
    if not isinstance(value, str):
        return value
    try:
        read = datetime.fromisoformat(value.strip())
    except ValueError:
        raise ValueError(
            f"{value!r} should be a time with its zone, such as '2026-11-27T08:00:00+01:00', or seconds since 1970"
        ) from None
    if read.tzinfo is None:
        utc, local = f"{value.strip()}Z", read.astimezone().isoformat()
        raise ValueError(f"{value!r} has no zone: '{utc}' is the time in UTC, '{local}' the time at this machine")
    return read.timestamp()


def _near(value: float) -> float:
    """Refuse a time that can't be meant: in milliseconds, or counted from now. 0 stands for no time.

    Raises:
        ValueError: it is more than a year away; the message shows the readings.
    """
    now = time.time()
    if value == 0 or abs(value - now) <= YEAR:
        return value
    meant = ""
    for kind, seconds in (("in milliseconds", 1e-3 * value), ("counted from now", now + value)):
        if now - YEAR <= seconds <= now + YEAR and value > 0:
            iso = datetime.fromtimestamp(seconds).astimezone().isoformat(timespec="seconds")
            meant += f"; {kind} it would be '{iso}': give {seconds:.0f} if that is meant"
    raise ValueError(
        f"{value:.15g} is in the year {1970.0 + value / 31_556_952.0:.6g} as seconds since 1970, and a start should be "
        f"within a year{meant}"
    )


YEAR = 366.0 * 86400.0
"""Largest distance of a start from now [s]."""

Moment = Annotated[
    float,
    BeforeValidator(moment),
    Field(allow_inf_nan=False),
    AfterValidator(_near),
    WithJsonSchema(
        {
            "anyOf": [{"type": "number"}, {"type": "string", "format": "date-time"}],
            "description": "Seconds since 1970, or a time with its zone: 2026-11-27T08:00:00+01:00.",
        }
    ),
]


class JsonModel(BaseModel):
    """Base of models that are read from JSON: NaN, infinite numbers and half characters are errors of their fields."""

    @model_validator(mode="before")
    @classmethod
    def _refuse_what_json_has_not(cls, data: Any) -> Any:
        errors: list[InitErrorDetails] = []
        waiting: list[tuple[tuple[int | str, ...], Any]] = [((), data)]
        while waiting:
            place, value = waiting.pop()
            if isinstance(value, Mapping):
                waiting += [((*place, str(key)), entry) for key, entry in value.items()]
                waiting += [((*place, "key"), key) for key in value]
            elif isinstance(value, list):
                waiting += [((*place, index), entry) for index, entry in enumerate(value)]
            elif isinstance(value, float) and not math.isfinite(value):
                problem = PydanticCustomError("finite", "should be a finite number")
                errors.append({"type": problem, "loc": place, "input": None})
            elif isinstance(value, str) and any("\ud800" <= letter <= "\udfff" for letter in value):
                text = "should be text; it has half of a surrogate pair, which is no character"
                errors.append({"type": PydanticCustomError("text", text), "loc": place, "input": None})
        if errors:
            raise ValidationError.from_exception_data(cls.__name__, errors)
        return data


class RequestModel(JsonModel):
    """Base of the models of requests: an unknown key is an error, and a key with null counts as left out."""

    model_config = ConfigDict(extra="forbid", use_attribute_docstrings=True)

    @model_validator(mode="before")
    @classmethod
    def _without_nulls(cls, data: Any) -> Any:
        return {key: value for key, value in data.items() if value is not None} if isinstance(data, dict) else data


class ResponseModel(BaseModel):
    """Base of the models of responses."""

    model_config = ConfigDict(use_attribute_docstrings=True)


class PourIn(RequestModel):
    """One pour: an amount, or an action."""

    model_config = ConfigDict(
        extra="forbid",
        use_attribute_docstrings=True,
        json_schema_extra={
            "examples": [
                {
                    "id": "plan-17:step-4",
                    "source": "beaker-1",
                    "receiver": "vial-7",
                    "amount": "30 g",
                    "tolerance": "1 g",
                },
                {
                    "id": "plan-17:step-5",
                    "source": "beaker-1",
                    "receiver": "vial-8",
                    "action": {"angular_velocity": "60 deg/s", "x_offset": "90 mm"},
                    "dry_run": True,
                },
            ]
        },
    )

    id: CallerId
    """Chosen by the caller. The same order with the same id is the same pour: it is never poured twice."""

    source: Key
    """Vessel to pour from: its id or bar code, or the position where it stands."""

    receiver: Key
    """Vessel to pour into: its id or bar code, or the position where it stands, such as 'rack/A1'."""

    liquid: str = Field(default="", max_length=80)
    """Liquid that the source has to hold, by id or bar code; '' for any."""

    amount: Quantity | None = None
    """Wanted in the receiver, such as '30 g'."""

    tolerance: Quantity = "1 g"
    """Largest error of the amount. The pour ends before an excess of this size has a probability of 1 %."""

    action: dict[Annotated[str, Field(max_length=40)], Quantity] = Field(default_factory=dict, max_length=10)
    """Without an amount: the whole motion, at least `angular_velocity`. With an amount: `x_offset` and `height` only
    where they differ from the default, a distance at which the vessels don't touch."""

    rig: str = Field(default="", max_length=60)
    """Rig; '' for the one on which the vessels stand."""

    priority: int = Field(default=0, ge=-1000, le=1000)
    not_before: Moment | None = None
    """Earliest start."""

    dry_run: bool = False
    """Check and predict the pour; nothing is queued and nothing moves."""

    predict: bool = True
    """Predict the pour before it is queued. An action is predicted by simulations, which takes seconds."""


class AfterIn(RequestModel):
    """A campaign that has to end first."""

    campaign: Key
    """Its id, its caller's id, or a prefix of it."""

    verdict: Literal["complete", "any"] = "complete"
    """'complete': it has to end with this verdict; 'any': whatever it reached."""


class SubmissionIn(RequestModel):
    """A campaign: `text` with its `files`, or the `path` of a file on the daemon's machine."""

    text: str = Field(default="", max_length=500_000)
    """The campaign as YAML. Its paths refer to `files`. Without `laboratory`, it runs on the rig."""

    files: dict[str, str] = Field(default_factory=dict)
    """Files that the campaign and its files refer to: path from the campaign's file, such as '../vessels/beaker.yaml' →
    content in base64."""

    path: str = Field(default="", max_length=1000)
    """Instead of `text` and `files`: a file in one of the folders that the daemon's settings list as roots."""

    task: Literal["run", "calibrate", "plan"] = "run"
    rig: str = Field(default="", max_length=60)
    """Rig to run on; '' selects the matching one."""

    priority: int = Field(default=0, ge=-1000, le=1000)
    """Higher priorities run first."""

    id: CallerId | Literal[""] = ""
    """Chosen by the caller. The same campaign with the same id is queued once, however often it is sent."""

    not_before: Moment | None = None
    """Earliest start."""

    after: AfterIn | None = None
    """Campaign that has to end before this one starts."""


def problems_text(errors: Iterable[Mapping[str, Any]], begin: int = 0) -> str:
    """Errors of validation in one line, each with its place from a part of it on."""
    return "; ".join(f"{'.'.join(map(str, error['loc'][begin:]))}: {error['msg']}" for error in errors)


def described(name: str) -> str:
    """The description of a field of `PourIn`, in one line."""
    return " ".join((PourIn.model_fields[name].description or "").split())
