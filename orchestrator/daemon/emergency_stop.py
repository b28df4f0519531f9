"""Emergency stops: their requests over HTTP, the stops of the arms, and what stays latched until it is cleared.

Nothing that comes with a request prevents the stop. Method, path and token suffice. What the rest of the request can't
say is ignored, and a note reports it.

- `EmergencyStops` stops the arms of one rig or of all, latches the stop, and clears it.
- `is_stop` recognises the paths that stop an arm; `StopProtocol` keeps uvicorn from refusing their malformed bodies.
- `StopBody` reads a body for a limited time; `read_stop` finds reason and rig in its bytes.
- `recorded_reason` shortens a reason for the records; `later_stop` merges the records of several stops.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import sqlite3
import time
from collections.abc import Awaitable, Callable, MutableMapping, Sequence
from dataclasses import dataclass
from itertools import islice
from typing import Any
from urllib.parse import parse_qs

from uvicorn.protocols.http.h11_impl import H11Protocol

from orchestrator.daemon.daemon_store import DesiredState
from orchestrator.daemon.rig_worker import RigWorker, SharedServices
from orchestrator.learning.run_errors import RunError

STOP_PATH = "/api/v1/emergency-stop"

RIG_TIME = 0.05
"""Longest time for which a stop of one of several rigs waits for the body that may name the rig [s]."""

BODY_TIME = 0.5
"""Longest time for which the body of a stop is read, from the request's begin [s]."""

LONGEST_BODY = 1_000_000
"""Bytes of a body that are kept; the others are read and dropped."""

LONGEST_FORM = 10_000
"""Characters of a body that is read as a form."""

LONGEST_REASON = 500
"""Characters of a reason that are recorded."""

ALL_STOPPED = ": every arm was stopped"

EMERGENCY = "emergency"
"""Flag of the emergency stop of all rigs; that of one rig has the rig's name after it."""

UNSTORED = (RunError, OSError, sqlite3.Error)
"""Errors of a store that can't be used: none of them prevents a stop."""

LEAVING_STEPS = 4
"""Turns of the event loop in which the orders to stop leave the process, before the disk is written."""

REPLACEMENT = "\N{REPLACEMENT CHARACTER}"

_PATHS = re.compile(r"/+api/+v1/+(emergency-stop|campaigns/+[^/]+/+abort)/*", re.IGNORECASE)
_NODE = re.compile(r"/+admin/+(?:\w+\.)?safety_stop/*", re.IGNORECASE)

ArmStops = dict[str, asyncio.Task[None]]
"""Stops that are under way, by rig."""

Receive = Callable[[], Awaitable[MutableMapping[str, Any]]]


def stop_path(path: str) -> str | None:
    """Return the route's own path if a path is that of a stop or an abort in another spelling; None for others."""
    if _PATHS.fullmatch(path) is None:
        return None
    words = [word for word in path.split("/") if word]
    return STOP_PATH if len(words) == 3 else f"/api/v1/campaigns/{words[3]}/abort"


def is_stop(method: str, path: str) -> bool:
    """Whether a request stops an arm: over the API, or over the MADSci node."""
    return method == "POST" and (stop_path(path) is not None or _NODE.fullmatch(path) is not None)


class StopProtocol(H11Protocol):
    """HTTP protocol that passes a stop on even if its body is malformed, such as invalid chunks.

    uvicorn's own protocol answers with status 400 and closes the connection, so that the client takes the stop as
    refused. Here the body ends at the malformed part. Requests that are no stops are refused as before.
    """

    def send_400_response(self, msg: str) -> None:
        """Refuse malformed data, unless they are in the body of a stop."""
        cycle = self.cycle
        if cycle is None or cycle.response_complete or not is_stop(cycle.scope["method"], cycle.scope["path"]):
            super().send_400_response(msg)
            return
        cycle.scope["state"]["malformed"] = True
        cycle.more_body = cycle.keep_alive = False
        cycle.message_event.set()


class StopBody:
    """The body of a stop, read for a limited time from now on.

    Args:
        receive: ASGI callable of the request.

    Attributes:
        complete: whether its end was read.
    """

    def __init__(self, receive: Receive) -> None:
        self._receive = receive
        self._begin = time.monotonic()
        self._kept, self._length = bytearray(), 0
        self.complete = False

    async def read(self, until: float) -> None:
        """Read to the end of the body, but no longer than `until` [s] after the beginning."""
        try:
            async with asyncio.timeout(self._begin + until - time.monotonic()):
                while not self.complete:
                    message = await self._receive()
                    chunk = message.get("body", b"")
                    self._length += len(chunk)
                    self._kept += chunk[: LONGEST_BODY - len(self._kept)]
                    self.complete = not message.get("more_body", False)  # also if the client has left
        except TimeoutError:
            pass

    @property
    def content(self) -> bytes:
        """Bytes that were read and kept."""
        return bytes(self._kept)

    def notes(self, *, malformed: bool) -> list[str]:
        """Describe what was not read."""
        found = []
        if malformed:
            found.append("the body is malformed HTTP and was read up to there")
        if not self.complete:
            found.append(f"the body did not end within {BODY_TIME:g} s: what came later is ignored")
        if self._length > len(self._kept):
            found.append(f"the body is longer than {LONGEST_BODY / 1e6:g} MB: the rest is ignored")
        return found


@dataclass(frozen=True)
class StopRequest:
    """What the body of a stop says.

    Attributes:
        reason: any JSON value; '' if there is none.
        rig: any JSON value; '' if there is none.
        notes: what was ignored.
    """

    reason: object = ""
    rig: object = ""
    notes: tuple[str, ...] = ()


def read_stop(body: bytes) -> StopRequest:
    """Find reason and rig in a body: JSON or a form, whatever its declared type. Other text is taken as the reason."""
    text, notes = _text(body)
    if not text.strip():
        return StopRequest(notes=tuple(notes))
    try:
        value = json.loads(text, object_pairs_hook=_members)
    except (ValueError, RecursionError):
        form: dict[str, Any] = dict(parse_qs(text)) if len(text) <= LONGEST_FORM else {}
        form = {name: values[0] if len(set(values)) == 1 else values for name, values in form.items()}
        if not form.keys() & {"reason", "rig"}:
            return StopRequest(text, notes=(*notes, "the body is neither JSON nor a form: it is taken as the reason"))
        value = form
    if isinstance(value, str):
        return StopRequest(value, notes=(*notes, "the body is a text: it is taken as the reason"))
    if value is None:
        return StopRequest(notes=tuple(notes))
    if not isinstance(value, dict):
        return StopRequest(notes=(*notes, "the body is no JSON object: it is ignored"))
    others = value.keys() - {"reason", "rig"}
    if others:
        shown = sorted(_shown(key) for key in islice(others, 5))
        notes.append(f"ignored in the body: {', '.join(shown)}" + (" and others" if len(others) > 5 else ""))
    rig = value.get("rig")
    return StopRequest(value.get("reason", ""), "" if rig is None else rig, tuple(notes))


def _text(body: bytes) -> tuple[str, list[str]]:
    try:
        return body.decode(json.detect_encoding(body)), []
    except UnicodeDecodeError:
        return body.decode("latin-1"), ["the body is not UTF-8: it is read as Latin-1"]


def _members(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Return the members of a JSON object. Several different rigs stay a list, which is no rig's name."""
    rigs = [value for key, value in pairs if key == "rig"]
    found = dict(pairs)
    if any(rig != rigs[-1] for rig in rigs):
        found["rig"] = rigs
    return found


def _shown(value: object) -> str:
    """Return a value as a short text that can be stored and printed."""
    return recorded_reason(value)[0][:60]


def unknown_rig(rig: object) -> str:
    """Return the note about a rig that does not exist."""
    return f"there is no rig '{_shown(rig)}'{ALL_STOPPED}"


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
        found: dict[str, Any] | None = self._store.flag(EMERGENCY)
        return found

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

    async def stop_arms(self, rig: str, arms: ArmStops) -> None:
        """Begin to stop the arm of a rig, or ('') every arm, and let nothing start there. Part of `stop`.

        Args:
            rig: an existing rig, or ''.
            arms: stops that the same request has begun; each arm is stopped once. Those that begin are added.
        """
        for worker in self._affected(rig)[1]:
            worker.latched = True
            if worker.running is not None and worker.rig.name not in arms:
                arms[worker.rig.name] = asyncio.create_task(worker.running.emergency())
        for _ in range(LEAVING_STEPS):
            await asyncio.sleep(0)

    def latch(self, by: str, reason: str, rig: str = "") -> None:
        """Store an emergency stop, so that it holds after a restart. Authors and reasons of several are kept."""
        flag, workers = self._affected(rig)
        with contextlib.suppress(*UNSTORED):
            self._store.set_flag(flag, later_stop(self._store.flag(flag), by, reason, time.time()))
            for worker in workers:
                if worker.running is not None:
                    self._store.change(worker.running.item.id, desired_state=str(DesiredState.ABORT))

    async def stop(
        self,
        by: str,
        reason: object = "",
        rig: object = "",
        *,
        arms: ArmStops | None = None,
        notes: Sequence[str] = (),
    ) -> list[str]:
        """Stop every arm, give all work up, and accept nothing new until `clear`. The arms are stopped first.

        Args:
            by: user who triggers the stop.
            reason: reason, if given; its first 500 printable characters are recorded.
            rig: stop only this rig; '' for all. The stop of all rigs and that of one are set and cleared separately.
                A rig that does not exist stops all.
            arms: stops that the same request has begun before; see `stop_arms`.
            notes: what was changed or ignored in the request.

        Returns:
            These notes, and others on reason and rig. The audit entry has them, too.
        """
        affected, found = self.scope(rig)
        arms = {} if arms is None else arms
        await self.stop_arms(affected, arms)
        text, changes = recorded_reason(reason)
        self.latch(by, text, affected)
        found = [*notes, *found, *changes]
        with contextlib.suppress(*UNSTORED):
            detail = ": ".join(filter(None, (f"rig {affected}" if affected else "", text)))
            self._shared.note(
                by, "emergency stop", detail=f"{detail} ({'; '.join(found)})".lstrip() if found else detail
            )
        await asyncio.gather(*arms.values(), return_exceptions=True)
        return found

    def scope(self, rig: object) -> tuple[str, list[str]]:
        """Return the rig that a stop is for, '' for all, and a note if the wanted rig does not exist."""
        if isinstance(rig, str) and (not rig or rig in self.rig_names):
            return rig, []
        return "", [unknown_rig(rig)]

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
