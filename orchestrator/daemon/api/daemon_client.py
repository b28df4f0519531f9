"""HTTP client of the daemon, for the command line on this machine or another.

`Client` makes the calls and follows the event stream; it passes refusals on unchanged as `DaemonError`.
"""

from __future__ import annotations

import getpass
import json
import os
import re
import ssl
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import httpx
from pydantic import ValidationError

from orchestrator.daemon import PHYSICAL, PORT
from orchestrator.daemon.rigs.pour_request import PourIn, problems_text
from orchestrator.daemon.state.access_tokens import LOCAL, local_token
from orchestrator.learning.run_errors import RunError
from orchestrator.records.run_registry import state_directory

V1 = "/api/v1"
TIMEOUT = httpx.Timeout(60.0, connect=5.0)
STOP_TIMEOUT = httpx.Timeout(8.0, connect=5.0)
"""Of an emergency stop: longer than the daemon waits for an arm that does not confirm it."""

SUBMISSIONS = 3
"""Number of times that a submission is sent if no response comes."""

LONGEST_SENT = 2000
"""Characters of a reason or a rig that are sent with an emergency stop; the daemon records fewer."""


class DaemonError(RunError):
    """The daemon can't be reached, or it refuses; the message is the daemon's own if there is one.

    Attributes:
        unreachable: the connection failed, so the call may or may not have been executed.
        timed_out: the daemon was reached, and did not respond in time.
    """

    def __init__(self, text: str, exit_code: int = 1, *, unreachable: bool = False, timed_out: bool = False) -> None:
        super().__init__(text)
        self.exit_code, self.unreachable, self.timed_out = exit_code, unreachable, timed_out


@dataclass(frozen=True)
class ServerReply:
    """One event of the stream."""

    id: int
    type: str
    data: dict[str, Any]


def order_body(make: Callable[[], PourIn]) -> dict[str, Any]:
    """The body of `POST /pours`.

    Args:
        make: the order.

    Raises:
        DaemonError: it is invalid, in the words of the daemon.
    """
    try:
        body: dict[str, Any] = make().model_dump(exclude_unset=True)
    except ValidationError as error:
        raise DaemonError(problems_text(error.errors()), 2) from None
    return body


class Client:
    """Calls to one daemon.

    Args:
        url: URL of the daemon; by default $DECANT_URL, the URL in the state directory, or the default port of this
            machine.
        state: the daemon's state directory, which contains the tokens.
        token: bearer token; by default $DECANT_TOKEN, or the local one in the state directory: then the user's own name
            is recorded, as '… (local)'.

    Raises:
        DaemonError: no token was found.
    """

    def __init__(self, url: str | None = None, state: Path | None = None, token: str | None = None) -> None:
        state = state or state_directory()
        self.url = (url or os.environ.get("DECANT_URL") or _stored_url(state) or f"http://127.0.0.1:{PORT}").rstrip("/")
        token = token or os.environ.get("DECANT_TOKEN") or _token(state)
        headers = {"Authorization": f"Bearer {token}", "Decant-User": _user()}
        self._http = httpx.Client(
            base_url=self.url, headers=headers, timeout=TIMEOUT, trust_env=False,
            verify=_trusted(self.url),
        )  # fmt: skip

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *exc: object) -> None:
        self._http.close()

    def get(self, path: str, **query: Any) -> Any:
        """Request JSON with GET."""
        return self._call("GET", path, params=_given(query)).json()

    def fetch(self, path: str) -> bytes:
        """Download a file."""
        return self._call("GET", path).content

    def post(self, path: str, body: Any = None) -> Any:
        """Send a command with POST."""
        return self._call("POST", path, json=body).json()

    def submit(self, body: dict[str, Any]) -> Any:
        """Submit a campaign that has an id of its caller; a call without a response is repeated with the same id."""
        for _ in range(SUBMISSIONS - 1):
            try:
                return self.post("/campaigns", body)
            except DaemonError as error:
                if not error.timed_out:
                    raise
        return self.post("/campaigns", body)

    def emergency_stop(self, reason: str = "", rig: str = "") -> Any:
        """Stop every arm, or that of one rig. Neither reason nor rig prevents the stop; the server reports in notes.

        Args:
            reason: text for the records, of any length.
            rig: name of the rig; '' for all. A rig that does not exist stops all.

        Raises:
            DaemonError: the stop was not confirmed; the message names the physical emergency stop.
        """
        texts = {"rig": rig[:LONGEST_SENT], "reason": reason[:LONGEST_SENT]}
        query = {name: re.sub("[\ud800-\udfff]", "\N{REPLACEMENT CHARACTER}", text) for name, text in texts.items()}
        try:
            state = self._call("POST", "/emergency-stop", params=query, timeout=STOP_TIMEOUT)
        except DaemonError as error:
            refusal = str(error).startswith("NOT STOPPED")
            text = str(error) if refusal else f"THE STOP WAS NOT CONFIRMED: {PHYSICAL}. {error}"
            raise DaemonError(text, error.exit_code, unreachable=error.unreachable) from None
        return state.json()

    def _call(self, method: str, path: str, **arguments: Any) -> httpx.Response:
        try:
            answer = self._http.request(method, V1 + path, **arguments)
        except httpx.HTTPError as error:
            raise self._unreachable(error) from None
        _check(answer)
        return answer

    def _unreachable(self, error: httpx.HTTPError) -> DaemonError:
        if "CERTIFICATE_VERIFY_FAILED" in str(error):
            return DaemonError(
                f"the certificate of {self.url} is not believed ({error}); name the authority that signed "
                "it, or itself where it signed itself, in $DECANT_CA"
            )
        if isinstance(error, httpx.ReadTimeout | httpx.WriteTimeout | httpx.PoolTimeout):
            return DaemonError(
                f"the daemon at {self.url} was reached and did not respond in time; it may have executed the call",
                unreachable=True,
                timed_out=True,
            )
        return DaemonError(
            f"no daemon answers at {self.url} ({error}); start one with 'decant server start', or say where it is: "
            "--url, --state",
            unreachable=True,
        )

    def events(
        self,
        after: int | None = None,
        campaign: str | None = None,
        kinds: Sequence[str] = (),
        *,
        follow: bool = True,
    ) -> Iterator[ServerReply]:
        """Yield events as they arrive. A broken connection is restored without loss of events.

        Args:
            after: id of the last event seen; None: only new events; 0: all stored events.
            campaign: only events of this campaign.
            kinds: only events of these types; all by default.
            follow: wait for further events.
        """
        failures = 0
        while True:
            query = {"campaign": campaign, "kind": kinds or None, "after": after, "until": None if follow else "true"}
            try:
                with self._http.stream(
                    "GET", f"{V1}/events", params=_given(query),
                    timeout=httpx.Timeout(40.0, connect=5.0),
                ) as answer:  # fmt: skip
                    if answer.status_code >= 400:
                        answer.read()
                    _check(answer)
                    for event in _events_in(answer.iter_lines()):
                        after, failures = event.id, 0
                        yield event
            except httpx.HTTPError as error:
                failures += 1
                if failures > 3 or not follow:
                    raise self._unreachable(error) from None
            else:
                if not follow:
                    return
                failures += 1
                if failures > 3:
                    raise DaemonError("the daemon has ended")
            time.sleep(0.3 * failures)


def _given(query: dict[str, Any]) -> dict[str, Any]:
    return {name: value for name, value in query.items() if value is not None}


def _events_in(lines: Iterator[str]) -> Iterator[ServerReply]:
    number, kind, data = 0, "", ""
    for line in lines:
        name, _, value = line.partition(":")
        match name:
            case "id":
                number = int(value)
            case "event":
                kind = value.strip()
            case "data":
                data = value.strip()
            case "" if not line and data:
                yield ServerReply(number, kind, json.loads(data))
                data = ""


def _check(answer: httpx.Response) -> None:
    if answer.status_code < 400:
        return
    try:
        detail = answer.json()["detail"]
    except (ValueError, KeyError, TypeError):
        detail = answer.text[:500] or answer.reason_phrase
    if isinstance(detail, list):  # validation errors of FastAPI
        detail = problems_text(detail, 1)
    code = 2 if answer.status_code in (400, 404, 413, 422) else 1
    raise DaemonError(str(detail), code)


def _trusted(url: str) -> ssl.SSLContext | bool:
    """Return the trusted certificate authorities: those of this machine, or the file in $DECANT_CA."""
    path = os.environ.get("DECANT_CA")
    if not url.startswith("https") or not path:
        return True
    try:
        return ssl.create_default_context(cafile=path)
    except OSError as error:  # a file that is not a certificate raises SSLError, which is an OSError
        raise DaemonError(f"$DECANT_CA: {path}: can't be used as a certificate (PEM): {error}", 2) from None


def _stored_url(state: Path) -> str | None:
    try:
        return (state / "url").read_text(encoding="utf-8").strip() or None
    except OSError:
        return None


def _token(state: Path) -> str:
    if (token := local_token(state)) is None:  # no daemon was started there, or it is another user's, such as a service
        raise DaemonError(
            f"no token: {state / LOCAL} does not exist or belongs to another user. Set $DECANT_TOKEN to a token that "
            "the daemon's administrator gives you ('decant server token add'), or name the state directory of your own "
            "daemon (--state, $DECANT_STATE)",
            2,
        )
    return token


def _user() -> str:
    """Name of the user who runs this program, as far as it fits into a header."""
    try:
        name = getpass.getuser()
    except (KeyError, OSError):  # an account without a name
        name = f"uid-{os.getuid()}"
    return re.sub("[^A-Za-z0-9._-]", "_", name)[:40]
