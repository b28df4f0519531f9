"""The request of an emergency stop over HTTP. Nothing that comes with it prevents the stop.

Method, path and token suffice. What the rest of the request can't say is ignored, and a note reports it.

- `is_stop` recognises the paths that stop an arm; `StopProtocol` keeps uvicorn from refusing their malformed bodies.
- `StopBody` reads a body for a limited time; `read_stop` finds reason and rig in its bytes.
- `recorded_reason` shortens a reason for the records; `later_stop` merges the records of several stops.

The arms are stopped by `supervisor`.
"""

from __future__ import annotations

import asyncio
import json
import re
import time
from collections.abc import Awaitable, Callable, MutableMapping
from dataclasses import dataclass
from itertools import islice
from typing import Any
from urllib.parse import parse_qs

from uvicorn.protocols.http.h11_impl import H11Protocol

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

REPLACEMENT = "\N{REPLACEMENT CHARACTER}"

_PATHS = re.compile(r"/+api/+v1/+(emergency-stop|campaigns/+[^/]+/+abort)/*", re.IGNORECASE)
_NODE = re.compile(r"/+admin/+(?:\w+\.)?safety_stop/*", re.IGNORECASE)

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
