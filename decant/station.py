"""A station of a running daemon, for notebooks and other programs: pours, predictions, materials.

    station = Station()
    pour = station.pour("plan-1:vial-7", source="beaker-1", receiver="vial-7", amount="30 g", wait=300)
    pour.received_g

`Station` calls the daemon's HTTP API, and a call that fails on the way is repeated with the same id: the pour is made
once. It does not start a daemon and does not enable the motion of hardware.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, Self

from orchestrator.daemon.api.daemon_client import Client, DaemonError, order_body
from orchestrator.daemon.rigs.pour_request import PourIn
from sim_engine.resources import require

if TYPE_CHECKING:
    import pandas as pd

ATTEMPTS = 3
"""Times that an order is sent if the connection fails."""

PAUSE = 0.5
"""Time between attempts [s]."""

UNITS = {
    "amount_g": "g",
    "expected_g": "g",
    "expected_low_g": "g",
    "expected_high_g": "g",
    "received_g": "g",
    "spilled_g": "g",
    "error_g": "g",
    "duration_s": "s",
    "mass_g": "g",
    "deviation_g": "g",
    "promised_g": "g",
    "capacity_ml": "ml",
}
"""Units of the columns of `Station.pours` and `Station.vessels`, also in the tables' `attrs['units']`."""


@dataclass(frozen=True)
class StationPour:
    """A pour that was ordered or predicted.

    Attributes:
        id: of the caller.
        state: 'queued', 'running', 'waiting for operator', 'paused', 'weighed', 'failed', 'unknown', 'cancelled' or
            'dry run'.
        reason: of the state.
        details: everything that the API returns about it.
    """

    id: str
    state: str
    reason: str
    details: Mapping[str, Any] = field(repr=False)

    @property
    def received_g(self) -> float | None:
        """Mass weighed in the receiver [g]; None before the weighing and without an outcome."""
        return self._of("result", "received_g")

    @property
    def spilled_g(self) -> float | None:
        """Mass outside the receiver [g]; None as for `received_g`."""
        return self._of("result", "spilled_g")

    @property
    def error_g(self) -> float | None:
        """Weighed amount minus the wanted amount [g]; None for an action and without an outcome."""
        return self._of("result", "error_g")

    @property
    def expected_g(self) -> tuple[float, float] | None:
        """Interval that contains the amount with a probability of 90 % [g]; None without a prediction."""
        interval = (self.details.get("predicted") or {}).get("interval_g")
        return None if interval is None else (float(interval[0]), float(interval[1]))

    def _of(self, role: str, name: str) -> float | None:
        value = (self.details.get(role) or {}).get(name)
        return None if value is None else float(value)

    def row(self) -> dict[str, Any]:
        """The pour as a row of `Station.pours`."""
        low, high = self.expected_g or (None, None)
        return {
            "id": self.id,
            "state": self.state,
            "source": self.details["source"],
            "receiver": self.details["receiver"],
            "amount_g": self.details["amount_g"],
            "expected_low_g": low,
            "expected_high_g": high,
            "received_g": self.received_g,
            "spilled_g": self.spilled_g,
            "error_g": self.error_g,
            "duration_s": self._of("result", "duration_s"),
            "run": self.details["run"],
        }

    def _repr_html_(self) -> str:
        """The pour as a table, in notebooks."""
        from decant.run_results import html_table

        shown = {**self.row(), "reason": self.reason}
        return html_table(
            (name, f"{value:.2f}" if isinstance(value, float) else str(value))
            for name, value in shown.items()
            if value not in (None, "")
        )


class Station:
    """A running daemon.

    Args:
        url: its address; by default $DECANT_URL, or the daemon of this machine.
        token: an operator's token; by default $DECANT_TOKEN, or that of the state directory.
        state: state directory of a daemon on this machine.

    Raises:
        DecantError: there is no token.
    """

    def __init__(self, url: str | None = None, token: str | None = None, state: Path | str | None = None) -> None:
        self._client = Client(url, None if state is None else Path(state).expanduser(), token)

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Close the connection."""
        self._client.__exit__()

    def pour(
        self,
        id: str,  # noqa: A002  the API's word
        *,
        source: str,
        receiver: str,
        amount: str | None = None,
        tolerance: str = "1 g",
        action: Mapping[str, str] | None = None,
        liquid: str = "",
        rig: str = "",
        dry_run: bool = False,
        wait: float = 0.0,
    ) -> StationPour:
        """Order a pour, or return the pour of this order.

        Args:
            id: chosen by the caller; the same order with the same id is poured once.
            source, receiver: ids or bar codes of vessels.
            amount: wanted in the receiver, such as '30 g'; or give `action`.
            tolerance: largest error of the amount.
            action: values by dimension, such as {'angular_velocity': '60 deg/s'}.
            liquid: that the source has to hold; '' for any.
            rig: '' for the one on which the vessels stand.
            dry_run: predict the pour; nothing moves.
            wait: time to wait for the outcome, up to 600 [s].

        Raises:
            DecantError: the order is invalid or refused, or the daemon can't be reached; the text gives the reason.
        """
        body = order_body(
            lambda: PourIn(
                id=id, source=source, receiver=receiver, amount=amount, tolerance=tolerance, action=dict(action or {}),
                liquid=liquid, rig=rig, dry_run=dry_run,
            )
        )  # fmt: skip
        placed = _pour(self._posted("/pours", body))
        return placed if dry_run or wait <= 0.0 else self.wait(id, wait)

    def wait(self, id: str, seconds: float = 600.0) -> StationPour:  # noqa: A002
        """Wait until a pour rests: it is weighed, has failed, or waits for an operator.

        Args:
            id: of the caller.
            seconds: longest time to wait [s].

        Raises:
            DecantError: there is no such pour, or the daemon can't be reached.
        """
        end = time.monotonic() + seconds
        while True:
            left = end - time.monotonic()
            pour = _pour(self._client.get(f"/pours/{id}", wait=max(min(left, 30.0), 0.0)))
            if left <= 30.0 or pour.state not in ("queued", "running", "waiting for operator"):
                return pour

    def cancel(self, id: str) -> StationPour:  # noqa: A002
        """Remove a pour from the queue; one that has begun is finished and weighed. Raises DecantError."""
        return _pour(self._client.post(f"/pours/{id}/cancel"))

    def pours(self, limit: int = 100) -> pd.DataFrame:
        """Ordered pours, newest first; the columns' units are in `attrs['units']`. Raises DecantError."""
        return _table([_pour(pour).row() for pour in self._client.get("/pours", limit=limit)])

    def vessels(self) -> pd.DataFrame:
        """Vessels with their contents; the columns' units are in `attrs['units']`. Raises DecantError."""
        rows = [
            {**{name: value for name, value in vessel.items() if name != "content"}, **vessel["content"]}
            for vessel in self._client.get("/materials")["vessels"]
        ]
        return _table(rows)

    def weigh(self, vessel: str, mass: str, *, liquid: str = "", deviation: str = "0.1 g") -> None:
        """Enter the content of a vessel as weighed. Raises DecantError."""
        body = {"mass": mass, "liquid": liquid, "deviation": deviation}
        self._client.post(f"/materials/vessels/{vessel}/weighed", body)

    def poured_by_hand(
        self,
        id: str,  # noqa: A002
        *,
        source: str,
        receiver: str,
        mass: str,
        deviation: str = "0.1 g",
        note: str = "",
    ) -> None:
        """Enter a pour that a person has made and weighed; the same id is entered once.

        Args:
            id: of the pour, chosen by the caller.
            source, receiver: ids or bar codes of vessels, or LABORATORY/VESSEL for the source of a campaign.
            mass: weighed in the receiver, such as '30.2 g'.
            deviation: its standard deviation.
            note: text of the account's entries.

        Raises:
            DecantError: a vessel is unknown, or the daemon can't be reached.
        """
        body = {"id": id, "source": source, "receiver": receiver, "mass": mass, "deviation": deviation, "note": note}
        self._posted("/materials/pours", body)

    def add_liquid(self, id: str, properties: Mapping[str, Any] | None = None, code: str = "") -> None:  # noqa: A002
        """Register a liquid; `properties` are the keys of a campaign's liquid without its mass. Raises DecantError."""
        self._client.post("/materials/liquids", {"id": id, "code": code, "properties": dict(properties or {})})

    def add_vessel(self, id: str, shape: Mapping[str, Any], *, code: str = "", position: str = "") -> None:  # noqa: A002
        """Register an empty vessel; `shape` is the content of a vessel file. Raises DecantError."""
        body = {"id": id, "code": code, "shape": dict(shape), "position": position}
        self._client.post("/materials/vessels", body)

    def _posted(self, path: str, body: Mapping[str, Any]) -> Any:
        """Send an order; it is sent again if the connection fails, since its id makes it unique."""
        for attempt in range(ATTEMPTS):
            try:
                return self._client.post(path, body)
            except DaemonError as error:
                if not error.unreachable or attempt == ATTEMPTS - 1:
                    raise
            time.sleep(PAUSE)
        raise AssertionError("unreachable")


def _pour(state: Mapping[str, Any]) -> StationPour:
    return StationPour(state["id"], state["state"], state["reason"], state)


def _table(rows: list[dict[str, Any]]) -> pd.DataFrame:
    require("pandas", "A table")
    import pandas as pd

    table = pd.DataFrame(rows)
    table.attrs["units"] = {name: unit for name, unit in UNITS.items() if name in table.columns}
    return table
