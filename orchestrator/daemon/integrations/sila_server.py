"""SiLA 2 server for one daemon: the feature `PouringStation`, a process of its own over the daemon's HTTP API.

`serve` runs it until SIGTERM or SIGINT. The daemon keeps the orders: this process has no state, and its end stops no
pour. An order has the caller's id, so a repeated command observes the pour that exists.

- Motion of hardware is enabled by an operator. Until then, and while an operator has to answer a question, a command is
  running, and its intermediate responses state the reason.
- Refusals of the daemon become defined execution errors with the daemon's sentence.
- SiLA 2 has no authorization here. Who reaches the port can order pours: the address is loopback, or TLS is required.

Only the command line imports this module: it needs the extra `sila`.
"""

# Without `from __future__ import annotations`: unitelabs.cdk reads the annotations of commands as types.

import asyncio
import dataclasses
import datetime
import importlib.metadata
import ipaddress
import json
import math
import time
import uuid
from collections.abc import AsyncIterator, Callable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Annotated, Any, NoReturn
from urllib.parse import quote

from sila import UndefinedExecutionError, ValidationError
from unitelabs.cdk import Connector, ConnectorBaseConfig, Logger, SiLAServerConfig, run, sila

from orchestrator.daemon.api.daemon_client import Client, DaemonError, order_body
from orchestrator.daemon.rigs.pour_request import PourIn
from orchestrator.daemon.state.daemon_store import is_complete, verdict_text
from orchestrator.learning.run_errors import RunError
from sim_engine.settings.plugin_registry import DISTRIBUTION

INTERVAL = 0.5
"""Interval at which the state of the daemon is read [s]."""

RECONNECT_TIMEOUT = 120.0
"""Time from the first failed call for which an unreachable daemon is called again [s]; a restart takes less."""

LIFETIME = 3600.0
"""Time for which the result of a command is kept after its last change of state [s]."""

SERVER_INITIATED = "org.silastandard/core/ConnectionConfigurationService/v1"
"""Feature of the CDK for connections that the server opens."""

CALLS = 64
"""Largest number of simultaneous calls to the daemon."""

LONGEST_MESSAGE = 16_000_000
"""Bytes of a call that are read: a text of SiLA has up to 2²¹ characters. Longer calls are refused, a stop, too."""

Grams = Annotated[
    float, sila.constraints.Unit(label="g", components=[sila.constraints.Unit.Component("Kilogram")], factor=1e-3)
]
Seconds = Annotated[float, sila.constraints.Unit(label="s", components=[sila.constraints.Unit.Component("Second")])]


class SilaServerError(RunError):
    """The server can't start; the message gives the reason."""

    exit_code = 2


class InvalidOrderError(RunError):
    """The call is invalid; the message states what to change. Nothing was ordered."""


class OrderRefusedError(RunError):
    """The daemon can't serve the order now, or its id belongs to another order. Nothing was ordered."""


class DaemonUnreachableError(RunError):
    """The daemon does not answer, so the call may have been executed. Repeat it with the same id."""


class OrderFailedError(RunError):
    """The pour or the campaign has failed or has not reached what was wanted; the message gives the reason."""


class OrderCancelledError(RunError):
    """The pour or the campaign was cancelled before it began, or stopped."""


CALL = (InvalidOrderError, OrderRefusedError, DaemonUnreachableError)
"""Errors of all calls."""

ORDER = (*CALL, OrderFailedError, OrderCancelledError)
"""Errors of commands that wait for an order's end."""


@dataclasses.dataclass
class ActionValue:
    """
    A value of an action.

    Attributes:
      Dimension: Name, such as 'angular_velocity'.
      Value: Value with its unit, such as '60 deg/s'.
    """

    dimension: str
    value: str


@dataclasses.dataclass
class VesselContent:
    """
    The content of a vessel.

    Attributes:
      VesselId: Id of the vessel.
      Liquid: Id of the liquid, or empty.
      Mass: Estimated mass; not a number if it is unknown.
      Deviation: Standard deviation of the mass.
    """

    vessel_id: str
    liquid: str
    mass: Grams
    deviation: Grams


class _StopCommand(sila.UnobservableCommand):  # type: ignore[misc]
    """A command with one text that is executed with an empty one if the text can't be decoded or is too long."""

    def attach(self, feature: sila.Feature) -> bool:
        """See `sila.UnobservableCommand`."""
        attached: bool = super().attach(feature)
        handler = self._handler
        if attached and handler is not None:
            execute = handler.execute

            async def executed(request: bytes = b"", metadata: dict[str, bytes] | None = None) -> bytes:
                try:
                    answer: bytes = await execute(request, metadata)
                except (ValidationError, UndefinedExecutionError):  # the latter if the call is no protobuf at all
                    answer = await execute(_EMPTY_TEXT, metadata)
                return answer

            handler.execute = executed
        return attached


_EMPTY_TEXT = b"\x0a\x00"
"""Parameters of a command in protobuf's encoding: one string, which is empty."""


class PouringStation(sila.Feature):  # type: ignore[misc]
    """
    A station that pours a wanted amount of liquid from one vessel into another and weighs it.

    Every order has an id of the caller. The same order with the same id is the same pour: it is never poured again.
    """

    def __init__(self, client: Client) -> None:
        super().__init__(originator="org.decant", category="station", version="1.0")
        self._client = client
        self._threads = ThreadPoolExecutor(CALLS, thread_name_prefix="daemon call")
        self._stopping = ThreadPoolExecutor(2, thread_name_prefix="emergency stop")

    # ---- commands

    @sila.ObservableCommand(errors=ORDER)
    async def pour(
        self,
        order_id: str,
        source: str,
        receiver: str,
        amount: Grams,
        tolerance: Grams,
        action: list[ActionValue],
        liquid: str,
        rig: str,
        *,
        status: sila.Status,
        intermediate: sila.Intermediate[tuple[str, str]],
    ) -> tuple[Grams, Grams, Seconds, str]:
        """
        Pour an amount or an action and weigh it; the command ends when the pour is weighed, has failed or is cancelled.

        A pour with unknown outcome keeps the command running until an operator has reported the outcome.

        Args:
          OrderId: Chosen by the caller: letters, digits and . _ : - with at most 80 characters.
          Source: Vessel to pour from, by id or bar code.
          Receiver: Vessel to pour into, by id or bar code.
          Amount: Wanted in the receiver; 0 if the action is given instead.
          Tolerance: Largest error of the amount, positive also for an action.
          Action: Without an amount, the whole motion, at least 'angular_velocity'; empty for the usual motion.
          Liquid: Liquid that the source has to hold, or empty.
          Rig: Name of the rig, or empty for the one where the vessels stand.

        Yields:
          State: 'queued', 'running', 'waiting for operator', 'paused' or 'unknown'.
          Reason: Reason of the state, or empty.

        Returns:
          ReceivedMass: Weighed in the receiver.
          SpilledMass: Weighed outside of the receiver; not a number if it is unknown.
          Duration: From the first motion until it was weighed; not a number if it is unknown.
          Details: Everything that the daemon returns about the pour, as JSON.
        """
        order = _order(order_id, source, receiver, amount, tolerance, action, liquid, rig)
        await self._ordered("/pours", order)
        poured = await self._ended(f"/pours/{_part(order_id)}", status, intermediate)
        result = poured["result"]
        masses = (_number(result[name]) for name in ("received_g", "spilled_g", "duration_s"))
        return (*masses, json.dumps(poured))  # type: ignore[return-value]

    @sila.UnobservableCommand(errors=CALL)
    async def predict_pour(
        self,
        source: str,
        receiver: str,
        amount: Grams,
        tolerance: Grams,
        action: list[ActionValue],
        liquid: str,
        rig: str,
    ) -> tuple[Grams, Grams, Seconds, str]:
        """
        Check and predict a pour; nothing is queued and nothing moves.

        Args:
          Source: Vessel to pour from, by id or bar code.
          Receiver: Vessel to pour into, by id or bar code.
          Amount: Wanted in the receiver; 0 if the action is given instead.
          Tolerance: Largest error of the amount.
          Action: As in 'Pour'.
          Liquid: As in 'Pour'.
          Rig: As in 'Pour'.

        Returns:
          LowestMass: Lower end of the interval that contains the received mass with a probability of 90 %.
          HighestMass: Upper end of this interval.
          Duration: Expected duration; not a number if it is unknown.
          Details: Everything that the daemon returns about the prediction, as JSON.
        """
        order = _order("prediction", source, receiver, amount, tolerance, action, liquid, rig)
        pour = await self._ordered("/pours", order | {"dry_run": True})
        predicted = pour["predicted"] or {}
        low, high = predicted.get("interval_g") or (None, None)
        return _number(low), _number(high), _number(predicted.get("duration_s")), json.dumps(pour)

    @sila.UnobservableCommand(errors=CALL)
    async def weigh(self, vessel: str, mass: Grams, deviation: Grams, liquid: str, note: str) -> None:
        """
        Enter the content of a vessel as weighed by the caller. The station's own balance weighs poured liquid only.

        Args:
          Vessel: Id or bar code.
          Mass: Mass of the content.
          Deviation: Standard deviation of the mass.
          Liquid: Liquid of a filling, or empty for a correction.
          Note: Text for the account, or empty.
        """
        body = {"mass": f"{mass!r} g", "deviation": f"{deviation!r} g", "liquid": liquid, "note": note}
        await self._post(f"/materials/vessels/{_part(vessel)}/weighed", body)

    @sila.ObservableCommand(errors=ORDER)
    async def run_campaign(
        self,
        order_id: str,
        path: str,
        rig: str,
        *,
        status: sila.Status,
        intermediate: sila.Intermediate[tuple[str, str]],
    ) -> tuple[str, str, str]:
        """
        Run a campaign of the folders that the daemon may read; the same id again observes the same campaign.

        Args:
          OrderId: Chosen by the caller, as in 'Pour'. A pour and a campaign must not have the same id.
          Path: Path of the campaign's file on the daemon's machine, in one of the daemon's 'roots'.
          Rig: Name of the rig, or empty for the matching one.

        Yields:
          State: State of the campaign.
          Reason: Reason of the state, or empty.

        Returns:
          Campaign: Id in the daemon's queue.
          Run: Name of the run's folder.
          Details: Everything that the daemon returns about the campaign, as JSON.
        """
        key = (await self._ordered("/campaigns", {"id": order_id, "path": path, "rig": rig}))["id"]
        ended = await self._ended(f"/campaigns/{_part(key)}", status, intermediate)
        return key, ended["run"] or "", json.dumps(ended)

    @sila.UnobservableCommand(errors=CALL)
    async def cancel(self, order_id: str) -> None:
        """
        Cancel a pour before it begins, or stop a campaign. A pour that has begun is finished and weighed.

        Args:
          OrderId: The caller's id.
        """
        path = await self._path_of(order_id)
        await self._post(f"{path}/{'cancel' if path.startswith('/pours') else 'stop'}")

    @sila.UnobservableCommand(errors=CALL)
    async def pause(self, order_id: str) -> None:
        """
        Pause a pour before it begins, or a campaign at the next safe point.

        Args:
          OrderId: The caller's id.
        """
        await self._post(f"{await self._path_of(order_id)}/pause")

    @sila.UnobservableCommand(errors=CALL)
    async def resume(self, order_id: str) -> None:
        """
        Resume a paused pour or campaign.

        Args:
          OrderId: The caller's id.
        """
        await self._post(f"{await self._path_of(order_id)}/resume")

    @_StopCommand(errors=CALL)
    async def emergency_stop(self, reason: str) -> None:
        """
        Stop every arm by software. An administrator clears it. It does not replace the robot's emergency stop button.

        Args:
          Reason: Text for the records, or empty. Its first 500 characters are kept.
        """
        # Threads of its own: calls that wait for the daemon must not delay it.
        loop = asyncio.get_running_loop()
        try:
            await loop.run_in_executor(self._stopping, self._client.emergency_stop, reason)
        except DaemonError as error:
            _refuse(error)

    # ---- properties

    @sila.ObservableProperty(errors=CALL)
    async def state(self) -> sila.Stream[str]:
        """State of the station: 'ready', 'busy', 'paused', 'stopped', 'not ready' or 'unreachable'."""

        def read() -> str:
            try:
                return _station_state(self._client.get("/status"))
            except DaemonError as error:
                if not error.unreachable:
                    raise
                return "unreachable"

        async for value in self._changes(read):
            yield value

    @sila.ObservableProperty(errors=CALL)
    async def questions(self) -> sila.Stream[list[str]]:
        """Open questions that an operator answers on the daemon's page, oldest first."""

        def read() -> list[str]:
            return [f"{question['id']}: {question['text']}" for question in self._client.get("/questions")]

        async for value in self._changes(read):
            yield value

    @sila.ObservableProperty(errors=CALL)
    async def vessels(self) -> sila.Stream[list[VesselContent]]:
        """Registered vessels with their contents."""

        def read() -> list[VesselContent]:
            return [_content(vessel) for vessel in self._client.get("/materials")["vessels"]]

        async for value in self._changes(read):
            yield value

    async def _changes(self, read: Callable[[], Any]) -> AsyncIterator[Any]:
        """Yield the value, and every value that differs from the one before; none while the daemon is unreachable."""
        last = ""
        while True:
            try:
                value = await self._in_thread(read)
            except DaemonError as error:
                if not error.unreachable:
                    _refuse(error)
            else:
                if repr(value) != last:  # a mass that is not a number equals nothing
                    last = repr(value)
                    yield value
            await asyncio.sleep(INTERVAL)

    # ---- calls to the daemon

    async def _in_thread(self, call: Callable[..., Any], *arguments: Any) -> Any:
        return await asyncio.get_running_loop().run_in_executor(self._threads, call, *arguments)

    async def _post(self, path: str, body: Any = None) -> Any:
        try:
            return await self._in_thread(self._client.post, path, body)
        except DaemonError as error:
            _refuse(error)

    async def _ordered(self, path: str, body: dict[str, Any]) -> Any:
        """Place an order; it is repeated while the daemon is unreachable, since its id makes it unique."""
        return await self._repeated(self._client.post, path, body)

    async def _repeated(self, call: Callable[..., Any], *arguments: Any) -> Any:
        failed: float | None = None
        while True:
            try:
                return await self._in_thread(call, *arguments)
            except DaemonError as error:
                failed = failed or time.monotonic()
                if not error.unreachable or time.monotonic() > failed + RECONNECT_TIMEOUT:
                    _refuse(error)
            await asyncio.sleep(INTERVAL)

    async def _ended(self, path: str, status: Any, intermediate: Any) -> dict[str, Any]:
        """Return a pour or a campaign as soon as it has ended well; meanwhile report its state."""
        shown: tuple[str, str] | None = None
        began = time.monotonic()
        while True:
            state: dict[str, Any] = await self._repeated(self._client.get, path)
            if _has_ended(state):
                return state
            reason = state["reason"] or state.get("waits_for", "")
            if (state["state"], reason) != shown:
                shown = (state["state"], reason)
                intermediate.send(*shown)
            left = _seconds_left(state)
            since = time.monotonic() - began
            status.update(
                progress=None if left is None else since / max(since + left, 1e-3),
                remaining_time=None if left is None else datetime.timedelta(seconds=left),
                updated_lifetime=datetime.timedelta(seconds=LIFETIME),
            )
            await asyncio.sleep(INTERVAL)

    async def _path_of(self, order_id: str) -> str:
        """Path of the pour or of the campaign with a caller's id."""
        paths = f"/pours/{_part(order_id)}", f"/campaigns/{_part(order_id)}"
        pour, campaign = [await self._in_thread(self._found, path) for path in paths]
        if campaign is not None and campaign["caller_id"] != order_id:
            campaign = None  # the daemon's own id, or the beginning of one
        if pour is None and campaign is None:
            raise InvalidOrderError(f"there is no pour and no campaign with the id '{order_id[:80]}'")
        if pour is not None and campaign is not None:
            raise InvalidOrderError(
                f"a pour and a campaign have the id '{order_id}'; use the daemon's own page for them"
            )
        return paths[pour is None]

    def _found(self, path: str) -> Any:
        try:
            return self._client.get(path)
        except DaemonError as error:
            if error.exit_code != 2:
                _refuse(error)
            return None


def _order(
    order_id: str,
    source: str,
    receiver: str,
    amount: float,
    tolerance: float,
    action: list[ActionValue],
    liquid: str,
    rig: str,
) -> dict[str, Any]:
    """The body of `POST /pours`. Equal arguments give an equal body, which makes a repeated order the same order."""
    wanted = f"{amount!r} g" if amount else None
    motion = {setting.dimension: setting.value for setting in action}
    try:
        return order_body(
            lambda: PourIn(
                id=order_id, source=source, receiver=receiver, liquid=liquid, rig=rig, amount=wanted,
                tolerance=f"{tolerance!r} g", action=motion,
            )
        )  # fmt: skip
    except DaemonError as error:
        _refuse(error)


def _refuse(error: DaemonError) -> NoReturn:
    """Convert an error of the daemon; its sentence stays."""
    kind = OrderRefusedError
    if error.unreachable:
        kind = DaemonUnreachableError  # type: ignore[assignment]
    elif error.exit_code == 2:
        kind = InvalidOrderError  # type: ignore[assignment]
    raise kind(str(error)) from None


def _has_ended(state: dict[str, Any]) -> bool:
    """Whether a pour or a campaign has ended well; another end is an error."""
    match state["state"]:
        case "weighed" if (state["result"] or {}).get("within_tolerance") is False:
            raise OrderFailedError(state["reason"])
        case "finished" if not is_complete(state["verdict"]):
            raise OrderFailedError(verdict_text(state["verdict"]))
        case "weighed" | "finished":
            return True
        case "failed" | "refused":
            raise OrderFailedError(state["reason"] or f"{state['id']} has failed")
        case "cancelled":
            raise OrderCancelledError(state["reason"] or f"{state['id']} was cancelled")
        case "stopped" | "withdrawn":
            raise OrderCancelledError(state["reason"] or f"{state['id']} was stopped")
    return False


def _seconds_left(state: dict[str, Any]) -> float | None:
    """Expected time until a pour or a campaign ends [s]."""
    left = state.get("seconds_left", (state.get("progress") or {}).get("seconds_left"))
    return None if left is None else float(left)


def _station_state(status: dict[str, Any]) -> str:
    rigs = status["rigs"]
    if status["emergency"] is not None or any(rig["emergency"] is not None for rig in rigs):
        return "stopped"
    if status["queue_paused"]:
        return "paused"
    if not status["ready"]:
        return "not ready"
    return "busy" if all(rig["campaign"] is not None for rig in rigs) else "ready"


def _content(vessel: dict[str, Any]) -> VesselContent:
    content = vessel["content"]
    return VesselContent(
        vessel["id"], content["liquid"] or "", _number(content["mass_g"]), _number(content["deviation_g"])
    )


def _number(value: float | None) -> float:
    """SiLA 2 has no missing values."""
    return math.nan if value is None else float(value)


def _part(text: str) -> str:
    return quote(text, safe="")


def check_address(host: str, certificate: Path | None, key: Path | None, clients: Path | None) -> None:
    """Check that the address is loopback or encrypted, and that the files of TLS go together.

    Args:
        host: address to listen at.
        certificate, key: of the server, in PEM.
        clients: authority of the clients' certificates, in PEM.

    Raises:
        SilaServerError: with the option to change.
    """
    if (certificate is None) != (key is None):
        raise SilaServerError("--certificate and --key belong together")
    if clients is not None and certificate is None:
        raise SilaServerError("--clients needs --certificate and --key: only TLS checks certificates of clients")
    try:
        loopback = host == "localhost" or ipaddress.ip_address(host).is_loopback
    except ValueError:
        loopback = False
    if not loopback and certificate is None:
        raise SilaServerError(
            f"--host {host}: other machines reach this address, and SiLA 2 requires encryption there; add "
            "--certificate and --key, and --clients to admit only clients with a certificate"
        )


async def serve(
    client: Client,
    ready: Callable[[str], None],
    *,
    host: str = "127.0.0.1",
    port: int,
    certificate: Path | None = None,
    key: Path | None = None,
    clients: Path | None = None,
) -> None:
    """Serve the feature until SIGTERM or SIGINT. Pours of the daemon go on after that.

    Args:
        client: of the daemon, with an operator's token.
        ready: is called with the address as soon as the server listens.
        host, port: address to listen at; port 0 selects a free one.
        certificate, key: PEM files for TLS; None: without encryption, on loopback only.
        clients: PEM file of the authority whose clients may connect; None: all that reach the address.

    Raises:
        SilaServerError: the address can't be used.
        DaemonError: the daemon refuses the token.
    """
    check_address(host, certificate, key, clients)
    # The CDK logs each refusal as an error with its trace; refusals are answers to the caller.
    Logger.setup({"version": 1, "disable_existing_loggers": False, "root": {"level": "CRITICAL"}})
    config = ConnectorBaseConfig(
        sila_server=SiLAServerConfig(
            hostname=f"[{host}]" if ":" in host else host,
            port=port,
            tls=certificate is not None,
            require_client_auth=clients is not None,
            root_certificates=clients,
            certificate_chain=certificate,
            private_key=key,
            options={
                "grpc.so_reuseport": 0,  # else two servers share one port without an error
                "grpc.max_receive_message_length": LONGEST_MESSAGE,
            },
            uuid=str(uuid.uuid5(uuid.NAMESPACE_URL, client.url)),
            name="Decant",
            type="PouringStation",
            description="A robot arm that pours liquids and weighs them.",
            version=importlib.metadata.version(DISTRIBUTION),
            vendor_url="https://proceedings.mlr.press/v78/lopez-guevara17a.html",
            default_lifetime=LIFETIME,
        ),
        discovery=None,
    )
    app = Connector(config)
    app.sila_server.unregister_feature(SERVER_INITIATED)  # a client could make this process connect elsewhere
    app.register(PouringStation(client))
    serving, listening = asyncio.create_task(run(app)), asyncio.create_task(app.wait_for_ready())
    await asyncio.wait({serving, listening}, return_when=asyncio.FIRST_COMPLETED)
    if listening.done():
        ready(app.sila_server._address)
    listening.cancel()
    try:
        await serving
    except (RuntimeError, OSError) as error:
        raise SilaServerError(f"{host}:{port}: can't listen there: {error}") from None
