"""Request and response models of the station's API: ordered pours and materials.

Quantities in requests are texts with units, such as '30 g'; responses state the unit in the name. Times are in seconds
since 1970. The models contain no logic.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal

from pydantic import Field

from actors.places import PlaceName
from orchestrator.daemon.api.schemas import ResponseModel
from orchestrator.daemon.rigs.pour_request import CallerId, Quantity, RequestModel

ResourceId = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,59}$")]


class PredictionOut(ResponseModel):
    """Prediction of a pour; intervals contain it with a probability of 90 %."""

    amount_g: float | None = None
    """Expected in the receiver."""

    interval_g: tuple[float, float] | None = None
    error_g: float | None = None
    """Expected amount minus the wanted amount."""

    error_interval_g: tuple[float, float] | None = None
    spilled_g: float | None = None
    duration_s: float | None = None
    """Expected time until it is weighed, in the rig's own time."""

    reachable_tolerance_g: float | None = None
    """Half of the interval that contains nine of ten doses as weighed with this balance."""

    enough: float | None = None
    """Probability that the source holds the amount."""

    ends: dict[str, int] | None = None
    """Number of predicted pours by their end."""

    simulations: int | None = None
    """Number of simulations of an action."""

    simulations_lost: int | None = None


class WeighedOut(ResponseModel):
    """Outcome of a pour; intervals state the uncertainty of the balance, with a probability of 90 %."""

    state: str
    received_g: float | None = None
    """Weighed in the receiver."""

    received_interval_g: tuple[float, float] | None = None
    spilled_g: float | None = None
    left_in_source_g: float | None = None
    error_g: float | None = None
    """Weighed amount minus the wanted amount."""

    error_interval_g: tuple[float, float] | None = None
    within_tolerance: bool | None = None
    end: str = ""
    """How the pour ended, or why it failed."""

    duration_s: float | None = None
    """From the first motion until it was weighed, in the rig's own time."""

    seconds: float | None = None
    """Duration in the journal, operator and balance included."""


class LimitsOut(ResponseModel):
    """Limits of a pour from this source into this receiver."""

    available_g: float
    """In the source for certain, without amounts that are promised to other pours."""

    room_ml: float
    """Free volume of the receiver up to the brim."""


class PourOut(ResponseModel):
    """An ordered pour."""

    id: str
    campaign: str
    """Id of its campaign in the queue; '' for a dry run."""

    state: Literal[
        "dry run", "queued", "running", "waiting for operator", "paused", "weighed", "failed", "unknown", "cancelled"
    ]
    """'unknown': it has begun and has no outcome; an operator reports it. It is never repeated by software."""

    reason: str
    """Reason of the state."""

    needs_enabling: bool
    """It waits until an operator enables the motion of the hardware."""

    source: str
    receiver: str
    amount_g: float | None
    order: dict[str, Any]
    """The request."""

    limits: LimitsOut | None = None
    """Only in a dry run."""

    predicted: PredictionOut | None
    result: WeighedOut | None
    run: str | None
    """Name of its run's folder."""

    created: float | None
    ended: float | None
    seconds_left: float | None = None
    """Expected time until it ends, while it runs."""


class LiquidIn(RequestModel):
    """A liquid."""

    id: ResourceId
    code: str = Field(default="", max_length=80)
    """Bar code."""

    properties: dict[str, Any] = Field(default_factory=dict, max_length=10)
    """As in a campaign's `liquid`, without its mass: {'name': 'ethanol'}, or density and viscosity."""


class PositionIn(RequestModel):
    """A place at a rig where one vessel can stand."""

    id: PlaceName
    """In a laboratory with places, the name of one of them, such as 'rack/A1'."""

    code: str = Field(default="", max_length=80)
    rig: str = Field(max_length=60)
    note: str = Field(default="", max_length=200)


class VesselIn(RequestModel):
    """A vessel, registered as empty."""

    id: ResourceId
    code: str = Field(default="", max_length=80)
    shape: dict[str, Any] = Field(max_length=10)
    """As in a vessel file: {'profile': {'unit': 'mm', 'inner': [[0, 0], [30, 0], [30, 70]], 'wall': '4 mm'}}."""

    position: str = Field(default="", max_length=60)


class PlaceIn(RequestModel):
    """Another position of a vessel."""

    position: str = Field(max_length=80)
    """Id or code; '' for none."""


class WeighingIn(RequestModel):
    """The content of a vessel, as weighed by an operator."""

    mass: Quantity
    deviation: Quantity = "0.1 g"
    """Standard deviation of the mass."""

    liquid: str = Field(default="", max_length=80)
    """Id or code; '' keeps the present one."""

    note: str = Field(default="", max_length=200)


class HandPourIn(RequestModel):
    """A pour that a person has made and weighed."""

    id: CallerId
    source: str = Field(max_length=200)
    """Id or code, or LABORATORY/VESSEL for the source of a campaign."""

    receiver: str = Field(max_length=200)
    """As `source`."""

    mass: Quantity
    """Weighed in the receiver."""

    deviation: Quantity = "0.1 g"
    """Standard deviation of the mass."""

    note: str = Field(default="", max_length=200)


class ContentOut(ResponseModel):
    """Content of a vessel."""

    mass_g: float | None
    """Null if a pour with unknown outcome has changed it."""

    deviation_g: float
    liquid: str
    since: float
    pour: str
    """The pour that changed it last: its caller's id, or run and number; '' after a weighing."""

    weighed: float | None
    """Time of the last weighing."""


class VesselOut(ResponseModel):
    """A vessel with its content."""

    id: str
    code: str
    position: str
    capacity_ml: float
    content: ContentOut
    promised_g: float
    """Amounts that queued pours will take."""


class SourceOut(ResponseModel):
    """A vessel that is not registered: the source of a campaign."""

    id: str
    """LABORATORY/VESSEL."""

    position: str
    """Place of the laboratory where it stands; UNKNOWN after an interrupted motion; '' without places."""

    in_use: bool
    """Whether a campaign runs in its laboratory: it may move, and its content be weighed later."""

    content: ContentOut


class LiquidOut(ResponseModel):
    """A liquid."""

    id: str
    code: str
    properties: dict[str, Any]


class PositionOut(ResponseModel):
    """A position."""

    id: str
    code: str
    rig: str
    note: str


class MaterialsOut(ResponseModel):
    """All materials of the station."""

    liquids: list[LiquidOut]
    vessels: list[VesselOut]
    sources: list[SourceOut]
    """Sources of campaigns, which need no registration."""

    positions: list[PositionOut]


class AccountOut(ResponseModel):
    """One entry of a vessel's account."""

    t: float
    vessel: str
    kind: Literal["filled", "weighed", "begun", "poured", "unknown"]
    mass_g: float | None
    """Content after it; null if it is unknown."""

    deviation_g: float
    liquid: str
    pour: str
    by: str
    note: str
