"""A pour that another program orders: its request, its run, its prediction and its result.

A queued order has the task 'pour' and one pour, so that rigs, journal, questions and stops treat it as any campaign.
The id of its caller makes it unique: the same order again is the same pour.

- `PourOrder` is the order with its materials, as its snapshot stores it; `PlannedOrder` is its run.
- `PlannedOrder.predict` predicts it; nothing moves.
- `OrderBook` stores orders and results in the daemon's `Store`, and enters pours in the account of `materials`.

Amounts are poured by the strategy of `decant dose`, actions by that of `decant pour`.
"""

from __future__ import annotations

import asyncio
import hashlib
import json
import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Json

from actors.arm.arm_settings import arm_kind
from actors.interfaces import DoseSource, DoseTarget, SimulatorPool
from actors.laboratory import predicted_dose
from actors.laboratory_settings import LaboratorySettings
from actors.places import all_places
from orchestrator.campaigns.action_assignments import AssignmentError, assigned_action
from orchestrator.campaigns.campaign_checks import touch
from orchestrator.campaigns.file_loading import campaign_from, load_laboratory, vessel_from
from orchestrator.campaigns.shipped import shipped
from orchestrator.campaigns.yaml.yaml_source import Document
from orchestrator.daemon.rigs.materials import Materials, liquid_of, mass_of
from orchestrator.daemon.rigs.pour_request import PourIn, ResponseModel
from orchestrator.daemon.state.daemon_settings import Rig
from orchestrator.daemon.state.daemon_store import QueueItem, Store
from orchestrator.learning.campaign_plan import CampaignPlan
from orchestrator.learning.deployment.costing import Costing
from orchestrator.learning.dispense import Dispense, KnownSource
from orchestrator.learning.mixtures import dose_strategy
from orchestrator.learning.requests import Failed, Simulated, Slots
from orchestrator.learning.run_errors import RunError
from orchestrator.learning.single_action import OnePour, RepeatedSimulation
from orchestrator.learning.stage_result import DOSE, weighed_masses
from orchestrator.materials.vessel_account import MIXTURE, LaboratoryPlaces, Transfer
from orchestrator.records.run_record import RunPour, read_record
from orchestrator.runs.run_service import RunRequest
from orchestrator.runs.run_tasks import single_task
from orchestrator.runs.stages import POUR, scenes_of
from sim_engine.action import ACTION_DIMENSIONS, Action
from sim_engine.liquids import Liquid
from sim_engine.motion import plan_motion
from sim_engine.outcome import Loss, PourMeasurement
from sim_engine.scene import PourTask, Scene
from sim_engine.vessel.vessel import build_vessel

ORDER = "pour.json"
"""File of the order in a campaign's snapshot."""

SEEDS = 5
"""Simulations of an action that predict it."""

INTERVAL = 1.645
"""Half of an interval of 90 %, in standard deviations."""

HEIGHT, STEP, MARGIN, FARTHEST = 0.06, 0.005, 0.01, 0.3
"""Default place of the pourer [m]: height of the lip above the rim; step and margin of the search for the smallest
distance at which the vessels don't touch, and the largest distance."""

VIRTUAL = "laboratories/twin.yaml"
"""Laboratory of ordered pours where the daemon's settings name no rig."""


class OrderError(RunError):
    """The pour can't be ordered; the message gives the problem and a remedy."""

    exit_code = 2


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

    state: Literal["weighed", "failed", "unknown"]
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


class PourOrder(BaseModel):
    """One pour as ordered, with its materials. Masses in kg."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    id: str
    """Of the caller."""

    source: str
    receiver: str
    """Ids of vessels."""

    liquid: str
    """Id of the liquid."""

    amount: float | None
    """Wanted in the receiver; None: the action is poured."""

    tolerance: float
    """Of the amount; the excess that the pour avoids."""

    action: dict[str, str]
    """Values by dimension, such as {'angular_velocity': '60 deg/s'}; for an amount, the place of the pourer."""

    properties: dict[str, Any]
    """Of the liquid, as in a campaign, without its mass."""

    pourer: dict[str, Any]
    vessel: dict[str, Any]
    """Source and receiver, as in vessel files."""

    load: float
    """Content of the source when the pour begins."""

    deviation: float = 1e-4
    """Its standard deviation."""

    stand: str = ""
    position: str = ""
    """Positions of source and receiver; '' if they stand nowhere. In a laboratory with places, those of the arm."""

    @classmethod
    def of(cls, request: PourIn, materials: Materials) -> PourOrder:
        """The order of a request, with ids instead of bar codes, and with the present content of the source.

        Raises:
            OrderError: neither amount nor action is given, or a value is invalid.
            MaterialError: a vessel or the liquid is unknown.
        """
        action = request.action
        try:
            amount = None if request.amount is None else mass_of(request.amount, "amount")
            limit = mass_of(request.tolerance, "tolerance")
        except RunError as error:
            raise OrderError(str(error)) from None
        if amount is None and "angular_velocity" not in action:
            raise OrderError("give an 'amount', such as '30 g', or an 'action' with at least 'angular_velocity'")
        if amount is not None and not 0.0 < limit < amount:
            raise OrderError("amount: should be larger than the tolerance, and both above 0 g")
        for name in ("angular_acceleration", "return_velocity"):
            if _action(action, _USUAL).values()[name] is None:
                word = ACTION_DIMENSIONS[name].switched_off
                raise OrderError(f"action: {name}: '{word}' only replays recorded pours, no arm can do it")
        source, receiver = materials.vessel(request.source), materials.vessel(request.receiver)
        content = materials.content(source.id)
        liquid = materials.liquid_id(request.liquid) if request.liquid else content.liquid
        return cls(
            id=request.id,
            source=source.id,
            receiver=receiver.id,
            liquid=liquid,
            amount=amount,
            tolerance=limit,
            action=action,
            properties={} if liquid in ("", MIXTURE) else materials.properties(liquid),
            pourer=source.shape,
            vessel=receiver.shape,
            load=content.mass or 0.0,
            stand=source.position,
            position=receiver.position,
        )

    @property
    def seed(self) -> int:
        """Seed of the pour's random numbers, from the caller's id: a repeated prediction is the same."""
        return int.from_bytes(hashlib.sha256(self.id.encode()).digest()[:4], "big") >> 1

    def write(self, folder: Path) -> None:
        """Write the order into a snapshot; one that is there is replaced at once."""
        fresh = folder / f"{ORDER}.new"
        fresh.write_text(self.model_dump_json(indent=1) + "\n", encoding="utf-8")
        fresh.replace(folder / ORDER)

    @classmethod
    def read(cls, folder: Path) -> PourOrder:
        """Read the order of a snapshot. Raises OSError, ValueError."""
        return cls.model_validate_json((folder / ORDER).read_text(encoding="utf-8"))


_USUAL = Action(angular_velocity=0.5, x_offset=0.1, height=HEIGHT).values()
"""Values of dimensions that an order may leave out; x_offset is searched."""


def renewed(order: PourOrder, materials: Materials) -> PourOrder:
    """An order that has not begun, with present load and positions: other pours may have changed or moved its vessels.

    Args:
        order: the order.
        materials: of the station.
    """
    content = materials.content(order.source)
    stand, position = (materials.vessel(vessel).position for vessel in (order.source, order.receiver))
    update = {"load": content.mass or 0.0, "deviation": content.deviation, "stand": stand, "position": position}
    return order.model_copy(update=update)


def is_carried(order: PourOrder, laboratory: LaboratorySettings | None) -> bool:
    """Whether the arm of a laboratory carries the vessels of an order."""
    places = () if laboratory is None else laboratory.places
    return bool(places) and order.amount is not None and bool(order.stand or order.position)


def refusal(order: PourOrder, materials: Materials, laboratory: LaboratorySettings | None) -> str:
    """Return the reason why its vessels can't serve an order; '' if they can.

    Args:
        order: the order.
        materials: of the station.
        laboratory: of its rig.

    Raises:
        OrderError: a vessel stands at no place for it.
    """
    reason = materials.refusal(order.source, order.receiver, order.liquid, order.amount, order.tolerance, pour=order.id)
    if reason or laboratory is None or not is_carried(order, laboratory):
        return reason
    names = [place.name for place in all_places(laboratory.places)]
    for vessel, position in ((order.source, order.stand), (order.receiver, order.position)):
        if position not in names or (vessel == order.receiver and "/" not in position):
            stands = f"at '{position}'" if position else "nowhere"
            raise OrderError(
                f"{vessel}: stands {stands}, and the arm of laboratory '{laboratory.name}' pours from a source with a "
                f"place into a cup in a rack; its places are {', '.join(names)}"
            )
        if materials.account.identity(f"{laboratory.name}/{position}") != vessel:  # the rig had another laboratory
            return f"{vessel}: does not stand at '{position}' of laboratory '{laboratory.name}'; place it there again"
    places = LaboratoryPlaces(materials.account, laboratory.name)
    mass, _ = places.composition(order.position).get(order.liquid, (0.0, 0.0))
    if mass == 0.0:
        return ""
    amount = "an UNKNOWN mass" if mass is None else f"{1e3 * mass:.1f} g"
    return (
        f"{order.receiver}: has {amount} of {order.liquid} already, and no liquid is dosed into a cup twice. If it "
        f"was emptied, enter that: decant materials weigh {order.receiver} '0 g'"
    )


@dataclass(frozen=True)
class PlannedOrder:
    """An order with its scene and its whole action."""

    plan: CampaignPlan
    order: PourOrder
    scene: Scene

    @classmethod
    def of(cls, order: PourOrder, rig: Rig, folder: Path) -> PlannedOrder:
        """Plan an order: a campaign of one pour or one dose.

        Args:
            order: the order.
            rig: whose laboratory pours it.
            folder: of its snapshot.

        Raises:
            OrderError: there is no place for the pourer.
            ConfigError: the laboratory's file is invalid.
        """
        carried = is_carried(order, rig.spec)
        pourer, receiver = (vessel_from(Document.of(vessel, folder / ORDER)) for vessel in (order.pourer, order.vessel))
        liquid = liquid_of(order.liquid, order.properties, round(order.load, 9))
        action = _action(order.action, _USUAL) if "x_offset" in order.action else _placed(
            Scene(POUR, pourer, receiver, liquid), order)  # fmt: skip
        motion = {
            name: dimension.switched_off if value is None else f"{value!r} {dimension.unit}"
            for name, dimension in ACTION_DIMENSIONS.items()
            if (value := action.values()[name]) is not None or dimension.switched_off
        }
        record = {
            "name": POUR,
            "seed": order.seed,
            "laboratory": str(rig.source or shipped(VIRTUAL)),
            "pourer": order.pourer,
            "receiver": order.vessel,
            "motion": motion,
            **_poured_sections(order, liquid, carried=carried),
            "outputs": {"recording": False, "figures": False},
        }
        plan = campaign_from(Document.of(record, folder / ORDER))
        if plan.dispense is not None:
            # the run accounts for vessels that it carries; of others `OrderBook.settle` enters the outcome, once
            vessels = {order.stand: order.source, order.position: order.receiver} if carried else {}
            plan = replace(plan, dispense=replace(plan.dispense, laboratory="", vessels=vessels))
        (scene,) = scenes_of(plan).values()
        return cls(plan, order, scene)

    @property
    def action(self) -> Action:
        """The whole action; for an amount, its place and fastest tilt."""
        return self.scene.action({})

    def request(self) -> RunRequest:
        """The run of the order."""
        return replace(single_task(self.plan, POUR, self.strategy, pours=True), as_written=False)

    @property
    def target(self) -> DoseTarget | None:
        """The wanted amount; None for an action."""
        if self.order.amount is None:
            return None
        source = DoseSource(
            self.scene.pourer.name, self.scene.liquid.mass, self.order.deviation, fill=False, constants=0
        )
        return DoseTarget(self.order.amount, self.order.tolerance, source=source)

    def strategy(self, seed: int) -> Dispense | OnePour:
        """Build the strategy."""
        if self.plan.dispense is None:
            return OnePour(self.scene, self.action, seed)
        content = KnownSource(mass=self.scene.liquid.mass, deviation=self.order.deviation)
        return dose_strategy(self.plan.dispense, seed, {self.scene.pourer.name: content})

    def duration(self) -> float:
        """Return the expected time until the pour is weighed, without waiting for a person [s of bench time]."""
        laboratory = self.plan.laboratory
        if laboratory.arm is not None:
            return arm_kind(laboratory.arm).plan(self.scene, self.action).report.duration + laboratory.operator.time
        motion = plan_motion(
            self.scene, self.action, build_vessel(self.scene.pourer), build_vessel(self.scene.receiver)
        )
        bench = laboratory.bench
        return motion.duration + (0.0 if bench is None else bench.operator_time + bench.balance.settling_time)

    async def predict(self, simulators: Callable[[], SimulatorPool]) -> PredictionOut:
        """Predict the pour; nothing moves.

        Args:
            simulators: opens the simulators, which only an action needs.

        Raises:
            InvalidActionError: the pour can't be made.
        """
        if self.target is not None:
            return await asyncio.to_thread(self._forecast)
        return await self._simulated(simulators())

    def _forecast(self) -> PredictionOut:
        assert self.target is not None
        forecast = predicted_dose(self.plan.laboratory, self.scene, self.target, self.order.seed)
        wanted = self.target.amount
        bench = self.plan.laboratory.bench
        low, high = (1e3 * value for value in forecast.interval)
        return PredictionOut(
            amount_g=1e3 * forecast.amount,
            interval_g=(low, high),
            error_g=1e3 * (forecast.amount - wanted),
            error_interval_g=(low - 1e3 * wanted, high - 1e3 * wanted),
            duration_s=forecast.duration + (0.0 if bench is None else bench.operator_time),
            reachable_tolerance_g=1e3 * forecast.reachable,
            enough=forecast.enough,
            ends={str(end): count for end, count in forecast.ends.items()},
        )

    async def _simulated(self, pool: SimulatorPool) -> PredictionOut:
        costing = Costing(Loss(), self.scene, self.plan.parameters)
        strategy = RepeatedSimulation(costing, self.action, SEEDS, self.order.seed)
        requests = strategy.ask(Slots(SEEDS + 1, 0))
        tasks = [PourTask(self.scene, r.action, r.parameters, r.seed) for r in requests]  # type: ignore[union-attr]
        done = await asyncio.gather(*map(pool.simulate, tasks), return_exceptions=True)
        for request, outcome in zip(requests, done, strict=True):
            if isinstance(outcome, BaseException):
                strategy.tell(request, Failed("simulation", str(outcome)))
            else:
                strategy.tell(request, Simulated(outcome.outcome))
        result = strategy.result()
        load = 1e3 * self.scene.liquid.mass
        poured, spilled = result.over_seeds.get("poured"), result.over_seeds.get("spilled")
        if poured is None or spilled is None:
            return PredictionOut(simulations=0, simulations_lost=result.simulations_lost, duration_s=self.duration())
        amount = load * (poured.mean - spilled.mean)
        spread = math.hypot(poured.deviation or 0.0, spilled.deviation or 0.0) * math.sqrt(1.0 + 1.0 / SEEDS)
        half = INTERVAL * load * spread
        return PredictionOut(
            amount_g=amount,
            interval_g=(max(amount - half, 0.0), min(amount + half, load)),
            spilled_g=load * spilled.mean,
            simulations=result.simulations,
            duration_s=self.duration(),
        )


def _poured_sections(order: PourOrder, liquid: Liquid, *, carried: bool) -> dict[str, Any]:
    """The sections of a campaign's file that pour an order: one pour, one dose, or one cup that the arm carries."""
    loaded = {"name": "water", **order.properties, "mass": f"{liquid.mass!r} kg"}
    amount, tolerance = f"{order.amount!r} kg", f"{order.tolerance!r} kg"
    if order.amount is None:
        return {"liquid": loaded, "pour": True}
    if not carried:
        return {"liquid": loaded, "dispense": {"doses": [{"amount": amount, "tolerance": tolerance}]}}
    rack, _, cup = order.position.partition("/")
    return {
        "mixtures": {
            "liquids": [{"name": order.liquid, "liquid": loaded, "stands": [order.stand]}],
            "cups": {"rack": rack},
            "wanted": {cup: {order.liquid: amount}},
            "tolerance": tolerance,
            "start": "as_left",
        }
    }


def _action(assigned: Mapping[str, str], fixed: Mapping[str, float | None]) -> Action:
    try:
        return assigned_action([f"{name}={value}" for name, value in assigned.items()], fixed=fixed)
    except (AssignmentError, ValueError) as error:
        raise OrderError(f"action: {error}") from None


def _placed(scene: Scene, order: PourOrder) -> Action:
    """The order's action at the smallest distance at which the vessels don't touch, and a margin."""
    pourer, receiver = build_vessel(scene.pourer), build_vessel(scene.receiver)
    offset = float(pourer.lip_point(0.0)[0])
    while offset < FARTHEST:
        if touch(scene, _action(order.action, {**_USUAL, "x_offset": offset}), pourer, receiver) is None:
            return _action(order.action, {**_USUAL, "x_offset": offset + MARGIN})
        offset += STEP
    raise OrderError("action: the vessels touch at every distance; give 'x_offset' and 'height'")


# ---- results


def weighing_deviation(laboratory: LaboratorySettings) -> float:
    """Return the standard deviation of one weighing, as the balance's settings state it [kg]."""
    if laboratory.bench is not None and laboratory.arm is None:
        scale = laboratory.bench.balance
        return math.hypot(scale.noise, scale.resolution / math.sqrt(12.0))
    balance = laboratory.balance
    if balance is None:
        return 0.0
    # settings of a plug-in's balance need not have them
    repeatability, step = (getattr(balance, name, None) or 0.0 for name in ("repeatability", "step"))
    return math.hypot(repeatability, step / math.sqrt(12.0))


def _weighed(order: PourOrder, pour: RunPour, measured: PourMeasurement, deviation: float) -> WeighedOut:
    """Return the result of a weighed pour.

    Args:
        order: of the pour.
        pour: as its journal records it.
        measured: its weights.
        deviation: of one weighing [kg]; a mass is the difference of two.
    """
    about: dict[str, Any] = measured.notes.get(DOSE, {})
    masses = weighed_masses(measured)
    received = masses.delivered_g or 0.0
    half = INTERVAL * 1e3 * float(about.get("deviation", math.sqrt(2.0) * deviation))
    error = None if order.amount is None else received - 1e3 * order.amount
    return WeighedOut(
        state="weighed",
        received_g=received,
        received_interval_g=(received - half, received + half),
        spilled_g=masses.spilled_g,
        left_in_source_g=masses.retained_g,
        error_g=error,
        error_interval_g=None if error is None else (error - half, error + half),
        within_tolerance=None if error is None else abs(error) <= 1e3 * order.tolerance,
        end=str(about.get("end", "")),
        duration_s=about.get("duration"),
        seconds=pour.seconds,
    )


@dataclass(frozen=True)
class SettledOrder:
    """A pour as its journal records it, with the deviation of one weighing [kg]."""

    order: PourOrder
    pour: RunPour
    deviation: float


def settled_pour(run: Path, snapshot: Path, rig: Rig) -> SettledOrder | None:
    """Read the pour of an order from the journal of its run. Reads files; don't call it in an event loop.

    Args:
        run: folder of the run.
        snapshot: folder with the order.
        rig: where it was poured.

    Returns:
        None if no pour was requested.

    Raises:
        RunError: the journal can't be read.
    """
    pours = read_record(run).pours
    if not pours:
        return None
    return SettledOrder(
        PourOrder.read(snapshot), pours[0], weighing_deviation(rig.spec or load_laboratory(shipped(VIRTUAL)))
    )


class PlacedOrder(BaseModel):
    """An order in the daemon's store."""

    id: str
    campaign: str
    body: Json[dict[str, Any]]
    source: str
    receiver: str
    amount: float | None
    predicted: Json[PredictionOut] | None
    result: Json[WeighedOut] | None


class OrderBook:
    """Orders and results in the daemon's store.

    Args:
        store: of the daemon.
    """

    def __init__(self, store: Store) -> None:
        self._store, self._materials = store, Materials(store)

    def find(self, key: str) -> PlacedOrder | None:
        """Return an order by the caller's id; None if there is none."""
        rows = self._store.rows("select * from pour_order where id = ?", key)
        return PlacedOrder(**rows[0]) if rows else None

    def of_campaign(self, campaign: str) -> PlacedOrder | None:
        """Return the order that a queued campaign pours; None if it is none."""
        rows = self._store.rows("select * from pour_order where campaign = ?", campaign)
        return PlacedOrder(**rows[0]) if rows else None

    def begun(self) -> tuple[str, ...]:
        """Return the campaigns of orders that have begun and have no result."""
        rows = self._store.rows(
            "select campaign from pour_order join campaign on campaign.id = campaign where result is null and "
            "run is not null"
        )
        return tuple(row["campaign"] for row in rows)

    def ids(self, limit: int, source: str = "") -> list[str]:
        """Return the callers' ids of orders, newest first; from one source, if it is given."""
        where = "where ? in ('', source) order by rowid desc limit ?"
        return [row["id"] for row in self._store.rows(f"select id from pour_order {where}", source, limit)]

    def add(self, order: PourOrder, campaign: str, body: Mapping[str, Any], predicted: PredictionOut | None) -> None:
        """Store an order; call it together with `Store.add` of its campaign."""
        self._store.write(
            "insert into pour_order (id, campaign, body, source, receiver, amount, predicted) "
            "values (?, ?, ?, ?, ?, ?, ?)",
            *(order.id, campaign, json.dumps(body), order.source, order.receiver, order.amount),
            None if predicted is None else predicted.model_dump_json(),
        )

    def settle(self, item: QueueItem, settled: SettledOrder | None, *, ended: bool) -> None:
        """Store the result of a pour, and enter it in the account of both vessels unless an arm has carried them.

        The run of a pour with carried vessels enters it itself. A second call changes nothing.

        Args:
            item: campaign of the order.
            settled: from its journal, see `settled_pour`; None if nothing was requested.
            ended: whether the campaign does not continue: a pour that has begun remains without outcome.
        """
        placed = self.of_campaign(item.id)
        if placed is None or placed.result is not None or settled is None:
            return
        order, pour, deviation = settled.order, settled.pour, settled.deviation
        if pour.measured is not None:
            result = _weighed(order, pour, pour.measured, deviation)
            received, spread = 1e-3 * (result.received_g or 0.0), math.sqrt(2.0) * deviation
            moved: Transfer | None = Transfer((received + pour.measured.spilled, spread), (received, spread))
        elif isinstance(pour.outcome, Failed):
            result = WeighedOut(state="failed", end=pour.reason, seconds=pour.seconds)
            # an invalid action was refused before anything moved
            moved = None if pour.outcome.kind == "invalid_action" else Transfer(None, None)
        elif ended and pour.state in ("under way", "unknown"):
            end = "stopped before an operator reported its outcome"
            result = WeighedOut(state="unknown", end=end, seconds=pour.seconds)
            moved = Transfer(None, None)
        else:
            return
        carried = pour.request.dose is not None and bool(pour.request.dose.cup)
        if moved is not None and not carried:
            self._materials.account.transfer(placed.id, placed.source, placed.receiver, moved, by=item.by)
        self._store.write("update pour_order set result = ? where campaign = ?", result.model_dump_json(), item.id)
