"""The daemon as a MADSci node: the REST routes that a MADSci workcell calls, over the daemon's own orders.

`create_node` makes the application, which the daemon serves at an address of its own. The routes, status words and
schemas are those of madsci.client 0.8.1; its packages are not needed. Actions: `pour`, `predict_pour`, `run_campaign`.

- MADSci's client repeats every POST and sends no authorization. Therefore an action is started once by its id, and only
  addresses of the settings' list may call.
- Enabling the motion of hardware stays an operator's act. An emergency stop is cleared by an administrator, not by
  `reset`.
- An action that waits for a person is 'running', and the errors of its result and of the node's status state what it
  waits for. It is never 'paused': MADSci's workcell manager stops reading a paused action, and sends it again, as
  another pour, when its workflow is resumed.
- Actions and the node's lock are stored, so they outlive a restart. A pour that the restart interrupted is 'unknown'
  until an operator has stated its outcome; the workcell manager ends its workflow as failed.
"""

from __future__ import annotations

import asyncio
import importlib.metadata
import ipaddress
import json
import secrets
import time
from dataclasses import dataclass
from typing import Annotated, Any

from fastapi import FastAPI, HTTPException, Request
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from pydantic import ValidationError, WithJsonSchema
from starlette.exceptions import HTTPException as AnyHTTPException

from orchestrator.daemon.api.access_control import invalid, refused
from orchestrator.daemon.rigs.emergency_stop import StopForms
from orchestrator.daemon.rigs.ordering import Ordering, PourOut
from orchestrator.daemon.rigs.pour_request import JsonModel, PourIn, SubmissionIn, described, problems_text
from orchestrator.daemon.rigs.supervisor import Supervisor
from orchestrator.daemon.state.daemon_settings import MadsciSettings, networks
from orchestrator.daemon.state.daemon_store import ENDED, QueueItem, is_complete, verdict_text
from orchestrator.learning.run_errors import RunError
from sim_engine.settings.plugin_registry import DISTRIBUTION

PERSON = "madsci"
"""Author of the node's orders in audit entries."""

LOCKED, NODE_ID = "madsci locked", "madsci node"
"""Flags of the store."""

_CROCKFORD = "0123456789ABCDEFGHJKMNPQRSTVWXYZ"

_STATUS = {"weighed": "succeeded", "failed": "failed", "unknown": "unknown", "cancelled": "cancelled"}
"""Status words of MADSci for the states of a pour; in all others it is 'running'."""

_CAMPAIGN_STATUS = {
    "finished": "succeeded",  # with the verdict 'complete' only
    "failed": "failed",
    "unknown": "unknown",
    "stopped": "cancelled",
    "withdrawn": "cancelled",
    "refused": "failed",
}
"""The same for a campaign."""

_SELECT = """
select node_action.id, node_action.name, args, node_action.created, coalesce(started, campaign.created) as started,
    campaign.id as campaign, error, json_result
from node_action left join pour_order on pour_order.id = node_action.id
    left join campaign on campaign.id = pour_order.campaign or campaign.caller_id = node_action.id
"""
"""Actions. The order of a pour or a campaign has the id of its action, and shows that the action was started."""

_POUR = {
    name: (described(name), field.is_required())
    for name, field in PourIn.model_fields.items()
    if name in ("source", "receiver", "amount", "tolerance", "liquid", "action", "rig", "predict")
}

ACTIONS: dict[str, tuple[str, dict[str, tuple[str, bool]]]] = {
    "pour": ("Pour an amount or an action from one vessel into another, and weigh it.", _POUR),
    "predict_pour": ("Predict a pour: amount, spread, duration and limits. Nothing moves.", _POUR),
    "run_campaign": (
        "Run a campaign of the folders that the daemon may read.",
        {"path": ("Path of the campaign's file.", True), "rig": ("Rig, if several match.", False)},
    ),
}
"""Actions with their descriptions, and arguments with description and whether they are required."""


class ActionIn(JsonModel):
    """Arguments of an action."""

    args: dict[str, Any] | None = None
    var_args: Annotated[Any, WithJsonSchema({})] = None
    var_kwargs: Annotated[Any, WithJsonSchema({})] = None


@dataclass(frozen=True)
class NodeAction:
    """An action that a client has created."""

    id: str
    name: str
    args: dict[str, Any]
    created: float
    started: float | None
    campaign: str | None
    error: str | None
    json_result: Any = None


def new_ulid(now: float | None = None) -> str:
    """Return a new ULID: 48 bits of milliseconds and 80 random bits, in Crockford's base 32."""
    value = int((time.time() if now is None else now) * 1e3) << 80 | secrets.randbits(80)
    return "".join(_CROCKFORD[value >> 5 * at & 31] for at in reversed(range(26)))


class MadsciNode:
    """State and actions of the node.

    Args:
        daemon: whose rigs pour.
        ordering: places the orders.
        name: of the node.
    """

    def __init__(self, daemon: Supervisor, ordering: Ordering, name: str) -> None:
        self._daemon, self._queue, self._stops = daemon.shared, daemon.queue, daemon.stops
        self._ordering, self._name, self._store = ordering, name, daemon.shared.store
        self._starting: dict[str, asyncio.Task[None]] = {}

    def info(self) -> dict[str, Any]:
        """Return `NodeInfo`."""
        key = self._store.flag(NODE_ID)
        if key is None:
            key = new_ulid()
            self._store.set_flag(NODE_ID, key)
        able = dict.fromkeys(
            ("get_info", "get_state", "get_status", "send_action", "get_action_status", "get_action_result",
             "get_action_history", "send_admin_commands", "get_log"), True,
        )  # fmt: skip
        return {
            "node_name": self._name, "node_id": key, "node_type": "device", "module_name": "decant",
            "module_version": _semantic(importlib.metadata.version(DISTRIBUTION)), "config": {},
            "node_description": "A robot arm that pours liquids and weighs them.",
            "capabilities": {
                **able, "set_config": False, "action_files": False, "get_resources": False,
                "admin_commands": ["cancel", "lock", "pause", "reset", "resume", "safety_stop", "unlock"],
            },
            "actions": {name: _definition(name, *about) for name, about in ACTIONS.items()},
        }  # fmt: skip

    async def status(self) -> dict[str, Any]:
        """Return `NodeStatus`. Its errors state the problems of the daemon, and what waits for a person."""
        daemon, flags = self._daemon, self._flags()
        rigs = [daemon.workers[rig.name] for rig in daemon.settings.rigs]
        running = [
            action.id
            for action in self.actions()
            if action.campaign is not None and any(worker.holds(action.campaign) for worker in rigs)
        ]
        waiting = [
            f"{item.id}: {text}"
            for item in daemon.store.items()
            if (item.by == PERSON and await self._open(item)) or any(worker.holds(item.id) for worker in rigs)
            if (text := self._queue.waits_for(item))
        ]
        return {
            **flags,
            "running_actions": running,
            "errors": [_error(text) for text in (*daemon.problems.values(), *waiting)],
            "waiting_for_config": [],
            "config_values": {},
            "ready": not any(flags.values()),
            "description": "; ".join([*(name for name, holds in flags.items() if holds), *waiting]) or "Node is ready",
        }

    def _flags(self) -> dict[str, bool]:
        daemon = self._daemon
        rigs = [daemon.workers[rig.name] for rig in daemon.settings.rigs]
        return {
            "busy": all(worker.running is not None for worker in rigs),
            "paused": daemon.queue_paused,
            "locked": daemon.store.flag(LOCKED) is not None,
            "stopped": self._stops.active,
            "errored": bool(daemon.problems),
            "disconnected": False,
            "initializing": not daemon.warm.ready and daemon.settings.quick_start,
        }

    async def _open(self, item: QueueItem) -> bool:
        """Whether an action is neither ended nor failed."""
        if item.state in ENDED or (item.state == "failed" and item.run is None):
            return False
        order = self._ordering.book.of_campaign(item.id)
        if order is None:
            return item.state != "failed"
        return _status_of(await self._ordering.pour_out(order.id)) in ("running", "unknown")

    # ---- actions

    def create(self, name: str, args: dict[str, Any]) -> str:
        """Store an action that is started later; return its id."""
        key = new_ulid()
        self._store.write(
            "insert into node_action (id, name, args, created) values (?, ?, ?, ?)",
            *(key, name, json.dumps(args), time.time()),
        )
        return key

    def action(self, key: str) -> NodeAction:
        """Return an action. Raises KeyError."""
        rows = self._store.rows(f"{_SELECT} where node_action.id = ?", key)
        if not rows:
            raise KeyError(key)
        return _action(rows[0])

    def actions(self) -> list[NodeAction]:
        """Return the newest actions."""
        return [_action(row) for row in self._store.rows(f"{_SELECT} order by node_action.rowid desc limit 200")]

    async def start(self, key: str) -> dict[str, Any]:
        """Start an action, or return the result of the one that was started. Raises KeyError."""
        action = self.action(key)
        if action.started is None:
            if (reason := self._not_ready()) is not None:
                return _result(action, "not_ready", error=reason)
            task = self._starting.get(key)
            if task is None:
                task = self._starting[key] = asyncio.create_task(self._start(action))
                task.add_done_callback(lambda done: self._starting.pop(key, None))
            await asyncio.shield(task)
        return await self.result(key)

    def _not_ready(self) -> str | None:
        flags = self._flags()
        blocking = [name for name in ("locked", "stopped", "paused") if flags[name]]
        return f"the node is {', '.join(blocking)}" if blocking else None

    async def _start(self, action: NodeAction) -> None:
        """The order has the action's id, so an interrupted start is repeated without a second pour."""
        error: str | None = None
        forecast: str | None = None
        try:
            if action.name == "run_campaign":
                args = {name: action.args.get(name, "") for name in ("path", "rig")}
                await self._ordering.campaign(SubmissionIn.model_validate({**args, "id": action.id}), PERSON)
                return
            dry = action.name == "predict_pour"
            request = PourIn.model_validate({**action.args, "id": action.id, "dry_run": dry})
            pour = await self._ordering.pour(request, PERSON)
            forecast = pour.model_dump_json() if dry else None
        except ValidationError as problem:
            error = f"args: {problems_text(problem.errors())}"
        except RunError as problem:
            error = str(problem)
        if error is not None or forecast is not None:
            self._store.write(
                "update node_action set started = ?, error = ?, json_result = ? where id = ?",
                *(time.time(), error, forecast, action.id),
            )

    async def result(self, key: str) -> dict[str, Any]:
        """Return `RestActionResult`. Raises KeyError."""
        action = self.action(key)
        if action.started is None:
            return _result(action, "not_started", error="the action was not started, and nothing moved")
        if action.error is not None:
            return _result(action, "failed", error=action.error)
        if action.json_result is not None:
            return _result(action, "succeeded", action.json_result)
        assert action.campaign is not None
        item = self._queue.item(action.campaign)
        if action.name == "run_campaign":
            status, reason = _CAMPAIGN_STATUS.get(item.state, "running"), item.reason or ""
            if status == "succeeded" and not is_complete(item.verdict):
                status, reason = "failed", verdict_text(item.verdict)
            about: dict[str, Any] = {"campaign": item.id, "state": item.state, "run": item.run, "reason": reason}
            about["verdict"] = item.verdict
        else:
            pour = await self._ordering.pour_out(action.id)
            about, status, reason = pour.model_dump(), _status_of(pour), pour.reason
        waits = self._queue.waits_for(item) if status in ("running", "unknown") else ""
        match status:
            case "running":
                return _result(action, status, error=waits)  # the workcell manager stores every value that it reads
            case "unknown":
                told = "" if reason in waits else reason  # that of a question is its text
                return _result(action, status, about, "; ".join(filter(None, ("the outcome is unknown", told, waits))))
            case "failed" if about["state"] == "unknown":
                weigh = f"weigh {about['source']} and {about['receiver']}: 'decant materials weigh'"
                return _result(action, status, about, f"the outcome is unknown ({reason}); {weigh}")
            case "failed":
                return _result(action, status, about, reason)
        return _result(action, status, about)

    # ---- administration

    async def command(self, name: str) -> dict[str, Any]:
        """Execute an admin command; return `AdminCommandResponse`."""
        daemon = self._daemon
        match name:
            case "safety_stop":
                await self._stops.stop(PERSON, "safety_stop")
            case "pause":
                self._queue.pause_all(True, PERSON)
            case "resume":
                self._queue.pause_all(False, PERSON)
            case "cancel":
                for item in daemon.store.items():
                    if item.by == PERSON and item.state not in _CAMPAIGN_STATUS:
                        self._queue.stop(item.id, PERSON)
            case "lock" | "unlock":
                daemon.store.set_flag(LOCKED, {"time": time.time()} if name == "lock" else None)
                daemon.note(PERSON, name)
            case "reset":
                if self._stops.active:
                    return _refused("an administrator clears the emergency stop: decant estop --clear")
            case _:
                return _refused(f"'{name[:40]}' is not offered; an administrator ends the daemon: decant server stop")
        return {"success": True, "errors": [], "data": None}


def create_node(daemon: Supervisor, ordering: Ordering, settings: MadsciSettings) -> FastAPI:
    """Make the application of the node.

    Args:
        daemon: whose rigs pour.
        ordering: places the orders.
        settings: name, and addresses that may call.
    """
    node = MadsciNode(daemon, ordering, settings.name)
    allowed = networks(settings.allow or ())
    app = FastAPI(title="Decant as a MADSci node", docs_url=None, redoc_url=None, openapi_url=None)

    @app.middleware("http")
    async def only_allowed(request: Request, call_next: Any) -> Any:
        address = "" if request.client is None else request.client.host
        try:
            permitted = any(ipaddress.ip_address(address) in network for network in allowed)
        except ValueError:
            permitted = False
        if not permitted:
            return await refused(request, HTTPException(403, f"{address} is not in the node's list (madsci: allow)"))
        return await call_next(request)

    app.add_middleware(StopForms)
    app.add_exception_handler(AnyHTTPException, refused)
    app.add_exception_handler(RequestValidationError, invalid)

    @app.exception_handler(KeyError)
    async def unknown(request: Request, error: KeyError) -> JSONResponse:
        return JSONResponse({"detail": f"there is no action {str(error.args[0])[:80]}"}, 404)

    @app.get("/info")
    async def info() -> Any:
        return node.info()

    @app.get("/status")
    async def status() -> Any:
        return await node.status()

    @app.get("/state")
    async def state() -> Any:
        return ordering.materials.everything(daemon.shared.running_laboratories).model_dump()

    @app.get("/log")
    async def log() -> Any:
        return {}

    @app.post("/config")
    async def config() -> Any:
        return {"success": False}

    @app.post("/admin/{command}")
    async def admin(command: str) -> Any:
        # From Python 3.11 on, the client writes 'AdminCommands.PAUSE' where it means 'pause'.
        return await node.command(command.rpartition(".")[2].lower())

    @app.get("/action")
    async def history(action_id: str | None = None) -> Any:
        keys = [action.id for action in node.actions() if action_id in (None, "", action.id)]
        return {key: [await node.result(key)] for key in keys}

    @app.post("/action/{name}")
    async def create(name: str, body: ActionIn | None = None) -> Any:
        if name not in ACTIONS:
            raise HTTPException(404, f"there is no action '{name[:80]}'; there are {', '.join(ACTIONS)}")
        return {"action_id": node.create(name, (body.args if body is not None else None) or {})}

    @app.post("/action/{name}/{key}/start")
    async def start(key: str) -> Any:
        return await node.start(key)

    @app.get("/action/{name}/{key}/status")
    @app.get("/action/{key}/status")
    async def action_status(key: str) -> Any:
        return (await node.result(key))["status"]

    @app.get("/action/{name}/{key}/result")
    @app.get("/action/{key}/result")
    async def action_result(key: str) -> Any:
        return await node.result(key)

    return app


def _definition(name: str, description: str, arguments: dict[str, tuple[str, bool]]) -> dict[str, Any]:
    args = {
        key: {"name": key, "description": text, "argument_type": "dict" if key == "action" else "str",
              "required": required, "default": None}
        for key, (text, required) in arguments.items()
    }  # fmt: skip
    return {"name": name, "description": description, "args": args, "blocking": False, "asynchronous": True}


def _result(action: NodeAction, status: str, value: Any = None, error: str = "") -> dict[str, Any]:
    return {
        "action_id": action.id,
        "status": status,
        "json_result": value,
        "files": None,
        "datapoints": None,
        "errors": [_error(error)] if error else [],
    }


def _error(text: str) -> dict[str, Any]:
    return {"message": text, "error_type": "DecantError"}


def _refused(text: str) -> dict[str, Any]:
    return {"success": False, "errors": [_error(text)], "data": None}


def _status_of(pour: PourOut) -> str:
    """Status word of a pour. An unknown outcome that no operator can state any more is a failure, and so is an amount
    beyond its tolerance."""
    result = pour.result
    if result is not None and (pour.state == "unknown" or result.within_tolerance is False):
        return "failed"
    return _STATUS.get(pour.state, "running")


def _action(row: dict[str, Any]) -> NodeAction:
    value = row["json_result"]
    return NodeAction(**{**row, "args": json.loads(row["args"]), "json_result": value and json.loads(value)})


def _semantic(version: str) -> str:
    """Return the version with three numbers, as MADSci requires."""
    parts = [number for number in version.split(".") if number.isdigit()]
    return ".".join((*parts, "0", "0")[:3])
