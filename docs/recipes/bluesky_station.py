"""A station as a bluesky device, and a plan that fills vials. It needs bluesky and httpx, and no ophyd.

With the queue server, this file is one of the startup files, next to one that makes the run engine; the queue's item is
{"name": "fill_vials", "args": ["plate-1", "beaker-1", "30 g", ["vial-1", "vial-2"]], "item_type": "plan"}.
"""

import os
import threading
import time
from concurrent.futures import Future

import bluesky.plan_stubs as bps
import bluesky.preprocessors as bpp
import httpx

HEADERS = {"Authorization": f"Bearer {os.environ['DECANT_TOKEN']}"}


class PourStatus:
    """`bluesky.protocols.Status` of a pour."""

    def __init__(self) -> None:
        self.future = Future()

    @property
    def done(self) -> bool:
        """Whether the pour has ended."""
        return self.future.done()

    @property
    def success(self) -> bool:
        """Whether it was weighed."""
        return self.done and self.future.exception() is None

    def exception(self, timeout=0.0):
        """Wait for the end; return the error, or None."""
        return self.future.exception(timeout)

    def add_callback(self, callback) -> None:
        """Call a function at the end."""
        self.future.add_done_callback(lambda future: callback(self))


class PouringStation:
    """`Movable` and `Readable`: `set` pours an order, `read` returns the last weighed result."""

    parent = None

    def __init__(self, name: str, url: str) -> None:
        self.name, self._url = name, f"{url}/api/v1/pours"
        self._last, self._time = {}, 0.0

    def set(self, order: dict) -> PourStatus:
        """Pour. The run engine may repeat this message after a pause: the order's id makes the pour unique."""
        status = PourStatus()
        threading.Thread(target=self._pour, args=(order, status), daemon=True).start()
        return status

    def _pour(self, order: dict, status: PourStatus) -> None:
        try:
            self._last, self._time = self._weighed(order), time.time()
            status.future.set_result(None)
        except Exception as error:
            status.future.set_exception(error)

    def _weighed(self, order: dict) -> dict:
        while True:
            try:
                answer = httpx.post(self._url, params={"wait": 60}, json=order, headers=HEADERS, timeout=90)
            except httpx.TransportError:  # the same order again returns the pour
                time.sleep(2)
                continue
            if answer.is_error:
                raise RuntimeError(f"{order['id']}: {answer.json()['detail']}")
            found = answer.json()
            if found["state"] == "weighed":
                return found["result"]
            if found["state"] in ("failed", "cancelled"):
                raise RuntimeError(f"{order['id']}: {found['state']}: {found['reason']}")
            time.sleep(2)  # 'unknown', 'waiting for operator': an operator answers on the station's page

    def describe(self) -> dict:
        """The data keys."""
        key = {"source": self._url, "dtype": "number", "shape": [], "units": "g"}
        return {f"{self.name}_{what}": key for what in ("received", "spilled")}

    def read(self) -> dict:
        """The last result."""
        values = {what: self._last.get(f"{what}_g") for what in ("received", "spilled")}
        return {
            f"{self.name}_{what}": {"value": float("nan") if value is None else value, "timestamp": self._time}
            for what, value in values.items()
        }


station = PouringStation("station", os.environ.get("DECANT_URL", "http://127.0.0.1:8377"))


def fill_vials(plan: str, source: str, amount: str, receivers: list[str]):
    """Fill vials; the ids come from the plan's name, so the same plan again pours nothing again."""

    @bpp.run_decorator(md={"plan": plan})
    def pours():
        for vial in receivers:
            order = {"id": f"{plan}:{vial}", "source": source, "receiver": vial, "amount": amount, "tolerance": "1 g"}
            yield from bps.mv(station, order)
            yield from bps.trigger_and_read([station])

    yield from pours()
