"""Emergency stops: their requests over HTTP, the stops of the arms, and what stays latched until it is cleared.

Nothing that comes with a request prevents the stop. Path and token suffice; rig and reason are in the query. A body is
never read. What the rest of the request can't say is ignored, and a note reports it.

- `EmergencyStops` stops the arms of one rig or of all, latches the stop, and clears it.
- `route_scope` gives a stop in any legal form of a request the path and method of its route; `StopForms` is the
  middleware that does so. `StopProtocol` keeps uvicorn from refusing a stop before it is a request.
- `recorded_reason` shortens a reason for the records; `later_stop` merges the records of several stops.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import posixpath
import re
import sqlite3
import time
from collections.abc import Awaitable, Callable, MutableMapping, Sequence
from typing import Any
from urllib.parse import quote_from_bytes

import h11
from uvicorn.protocols.http.h11_impl import H11Protocol

from orchestrator.daemon import PHYSICAL
from orchestrator.daemon.rigs.rig_worker import RigWorker, SharedServices
from orchestrator.daemon.state.daemon_store import DesiredState
from orchestrator.learning.run_errors import RunError

STOP_PATH = "/api/v1/emergency-stop"

LONGEST_LINE = 65536
"""Bytes of a request line that are waited for."""

LONGEST_REASON = 500
"""Characters of a reason that are recorded."""

EMERGENCY = "emergency"
"""Flag of the emergency stop of all rigs; that of one rig has the rig's name after it."""

UNSTORED = (RunError, OSError, sqlite3.Error)
"""Errors of a store that can't be used: none of them prevents a stop."""

LEAVING_STEPS = 4
"""Turns of the event loop in which the orders to stop leave the process, before the disk is written."""

REPLACEMENT = "\N{REPLACEMENT CHARACTER}"

_ABSOLUTE = re.compile(r"https?://([^/?#]*)", re.IGNORECASE)
_PATHS = re.compile(
    r"(?:/.*)?/(?:(emergency[-_]stop)|(?:api/v1/campaigns/([^/]+)/abort)|(admin/(?:\w+\.)?safety_stop))", re.IGNORECASE
)
_VISIBLE = bytes(range(0x21, 0x7F))

Scope = MutableMapping[str, Any]
Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]
Send = Callable[[MutableMapping[str, Any]], Awaitable[None]]
App = Callable[[Scope, Receive, Send], Awaitable[None]]

_IS_STOP = "decant.is_stop"


def stop_path(path: str) -> str | None:
    """Return the route's own path if a path is that of a stop or an abort in another spelling; None for others."""
    match = _PATHS.fullmatch("/" + posixpath.normpath(path).lstrip("/"))
    if match is None:
        return None
    stop, campaign, node = match.groups()
    return STOP_PATH if stop else f"/{node}" if node else f"/api/v1/campaigns/{campaign}/abort"


def route_scope(scope: Scope) -> Scope:
    """Return the scope of a request for its route.

    A target in absolute form (RFC 9112, section 3.2.2), which clients send that believe in a proxy, becomes a path, and
    its authority replaces `Host`. A request that stops an arm, in any spelling and with any method that may change
    something, gets the path and the method of the route.
    """
    path, changes = scope["path"], {}
    if absolute := _ABSOLUTE.match(path):
        path = path[absolute.end() :] or "/"
        host = absolute[1].rpartition("@")[2].encode("latin-1", "replace")
        changes = {"path": path, "headers": [*((n, v) for n, v in scope["headers"] if n != b"host"), (b"host", host)]}
    path, _, query = path.partition("?")  # an encoded question mark
    stop = stop_path(path)
    if stop is None:
        return {**scope, **changes}
    changes |= {"path": stop, _IS_STOP: True, "query_string": scope["query_string"] or query.encode("utf-8", "replace")}
    if scope["method"].upper() in ("POST", "PUT", "PATCH"):
        changes["method"] = "POST"
    return {**scope, **changes}


def is_stop(scope: Scope) -> bool:
    """Whether a request, as `route_scope` returns it, is to stop an arm."""
    return bool(scope.get(_IS_STOP))


def not_stopped(text: str) -> str:
    """Return the text of a refused stop: it begins with NOT STOPPED and names the physical stop."""
    return f"NOT STOPPED: {text.rstrip('.')}. If an arm moves, {PHYSICAL}"


class StopForms:
    """ASGI middleware that passes requests on as `route_scope` returns them.

    Args:
        app: application that gets them.
    """

    def __init__(self, app: App) -> None:
        self._app = app

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        """Handle one ASGI connection."""
        await self._app(route_scope(scope) if scope["type"] == "http" else scope, receive, send)


class StopProtocol(H11Protocol):
    """HTTP protocol that passes a stop on even if it is malformed where the stop does not need it.

    uvicorn's own protocol answers with status 400 and closes the connection, so that the client takes the stop as
    refused. Here empty lines before a request are ignored (RFC 9112, section 2.2), bytes in a request's target that
    should have been percent-encoded are encoded (`curl` sends a reason as it was typed), and the body of a stop ends
    at its malformed part.
    """

    _line = b""

    def data_received(self, data: bytes) -> None:
        """Pass data on, with the request line corrected."""
        if self.conn.their_state is h11.IDLE and not self.conn.trailing_data[0]:
            self._line = (self._line + data).lstrip(b"\r\n")
            line, end, remainder = self._line.partition(b"\n")
            if not end and len(line) <= LONGEST_LINE:
                return
            self._line = b""
            method, _, target = line.rstrip(b"\r").partition(b" ")
            target, _, version = target.rpartition(b" ")
            encoded = quote_from_bytes(target, _VISIBLE).encode()
            self._malformed_stop = stop_path(target.partition(b"?")[0].decode("latin-1")) is not None
            data = b" ".join((method, encoded, version)) + b"\r\n" + remainder if end else line
        super().data_received(data)

    _malformed_stop = False

    def send_400_response(self, msg: str) -> None:
        """Refuse malformed data, unless they are in the body of a stop."""
        cycle = self.cycle
        if cycle is None or cycle.response_complete or not is_stop(route_scope({**cycle.scope})):
            super().send_400_response(not_stopped(msg) if self._malformed_stop else msg)
            return
        cycle.more_body = cycle.keep_alive = False
        cycle.message_event.set()


def recorded_reason(reason: object) -> tuple[str, list[str]]:
    """Return a reason as it is recorded, at most 500 printable characters, and notes on what was changed."""
    if reason is None:
        return "", []
    notes = []
    if not isinstance(reason, str):
        try:
            reason = json.dumps(reason, ensure_ascii=False)
        except (TypeError, ValueError, RecursionError):
            reason = type(reason).__name__
        notes.append("the reason is not a text: it is recorded as JSON")
    if len(reason) > LONGEST_REASON:
        notes.append(f"the reason has {len(reason)} characters: the first {LONGEST_REASON} are recorded")
    words = reason[:LONGEST_REASON].strip()
    printable = "".join(c if c.isprintable() else " " if c.isspace() else REPLACEMENT for c in words)
    if printable.count(REPLACEMENT) > words.count(REPLACEMENT):
        notes.append("characters of the reason that can't be printed are replaced")
    return printable, notes


def later_stop(latched: dict[str, Any] | None, by: str, reason: str, now: float) -> dict[str, Any]:
    """Return the record of an emergency stop. One that is latched already keeps its time, and all authors and reasons.

    Args:
        latched: record of the stop that is in force.
        by: author of this one.
        reason: of this one; '' if none was given.
        now: time of this one, in seconds since 1970.
    """
    if latched is None:
        return {"by": by, "time": now, "reason": reason}
    authors, reasons = latched["by"].split(", "), list(filter(None, latched["reason"].split("; ")))
    authors += [by] if by not in authors else []
    reasons += [reason] if reason and reason not in reasons else []
    return {"by": ", ".join(authors), "time": latched["time"], "reason": "; ".join(reasons)[:LONGEST_REASON]}


class EmergencyStops:
    """The emergency stops of a daemon: of all rigs, and of single ones. They persist until they are cleared.

    Args:
        shared: what the parts of the daemon share.
    """

    def __init__(self, shared: SharedServices) -> None:
        self._shared, self._store = shared, shared.store
        for worker in shared.workers.values():
            worker.latched = self.holds(worker.rig.name)

    @property
    def of_all(self) -> dict[str, Any] | None:
        """The active emergency stop of all rigs, with its fields by, time and reason; None if there is none."""
        latch: dict[str, Any] | None = self._store.flag(EMERGENCY)
        return latch

    @property
    def of_rigs(self) -> dict[str, dict[str, Any]]:
        """Active emergency stops of single rigs, by the rig's name."""
        stops = {rig.name: self._store.flag(f"{EMERGENCY} {rig.name}") for rig in self._shared.settings.rigs}
        return {name: stop for name, stop in stops.items() if stop is not None}

    @property
    def active(self) -> bool:
        """Whether any emergency stop is latched."""
        return self.of_all is not None or bool(self.of_rigs)

    def holds(self, rig: str) -> bool:
        """Whether a rig may start nothing, because of its own emergency stop or that of all rigs."""
        return bool(self.refusal(rig))

    def refusal(self, rig: str = "") -> str:
        """Return why a stop forbids new work, of one rig or of those that are stopped for all; '' if none does."""
        if self.of_all is not None:
            return "the emergency stop is latched; requests are accepted again after it is cleared"
        if rig in self.of_rigs:
            return f"the emergency stop of rig {rig} is latched; it accepts requests again after it is cleared"
        return ""

    async def stop(self, by: str, reason: object = "", rig: object = "", notes: Sequence[str] = ()) -> list[str]:
        """Stop every arm, give all work up, and accept nothing new until `clear`. The arms are stopped first.

        Args:
            by: user who triggers the stop.
            reason: reason, if given; its first 500 printable characters are recorded.
            rig: stop only this rig; '' for all. The stop of all rigs and that of one are set and cleared separately.
                A rig that does not exist stops all.
            notes: what was ignored in the request.

        Returns:
            These notes, and others on reason and rig. The audit entry has them, too.
        """
        affected, unknown = self.scope(rig)
        flag, workers = self._affected(affected)
        arms = []
        for worker in workers:
            worker.latched = True
            if worker.running is not None:
                arms.append(asyncio.create_task(worker.running.emergency()))
        for _ in range(LEAVING_STEPS):
            await asyncio.sleep(0)
        text, changes = recorded_reason(reason)
        texts = [*notes, *unknown, *changes]
        with contextlib.suppress(*UNSTORED):  # it holds after a restart; authors and reasons of several are kept
            self._store.set_flag(flag, later_stop(self._store.flag(flag), by, text, time.time()))
            for worker in workers:
                if worker.running is not None:
                    self._store.change(worker.running.item.id, desired_state=str(DesiredState.ABORT))
        with contextlib.suppress(*UNSTORED):
            detail = ": ".join(filter(None, (f"rig {affected}" if affected else "", text)))
            self._shared.note(
                by, "emergency stop", detail=f"{detail} ({'; '.join(texts)})".lstrip() if texts else detail
            )
        await asyncio.gather(*arms, return_exceptions=True)
        return texts

    def scope(self, rig: object) -> tuple[str, list[str]]:
        """Return the rig that a stop is for, '' for all, and a note if the wanted rig does not exist."""
        if isinstance(rig, str) and (not rig or rig in self.rig_names):
            return rig, []
        return "", [f"there is no rig '{recorded_reason(rig)[0][:60]}': every arm was stopped"]

    @property
    def rig_names(self) -> list[str]:
        """Names of the rigs, in the order of the settings."""
        return [rig.name for rig in self._shared.settings.rigs]

    def clear(self, by: str, rig: str = "") -> None:
        """Accept work again. Work that was given up rests until an operator resumes it.

        Args:
            by: user who clears the stop.
            rig: rig whose own emergency stop is cleared; '' for that of all rigs.

        Raises:
            KeyError: the rig does not exist.
        """
        flag, workers = self._affected(rig)
        self._store.set_flag(flag, None)
        for worker in workers:
            worker.latched = self.holds(worker.rig.name)
        self._shared.note(by, "clear emergency stop", detail=f"rig {rig}" if rig else "")
        self._shared.wake()

    def _affected(self, rig: str) -> tuple[str, list[RigWorker]]:
        """Return the flag of an emergency stop and the rig workers it affects. Raises KeyError."""
        if not rig:
            return EMERGENCY, list(self._shared.workers.values())
        if rig not in self.rig_names:
            raise KeyError(rig)
        return f"{EMERGENCY} {rig}", [self._shared.workers[rig]]
