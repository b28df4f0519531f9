"""An EOS device for a running daemon. The token of an operator is in a file that only EOS reads."""

import time
from pathlib import Path
from typing import Any

import httpx
from eos.devices.base_device import BaseDevice


class PouringStation(BaseDevice):
    """Pours; the id of an order makes it unique, so a task that EOS repeats pours nothing again."""

    async def _initialize(self, init_parameters: dict[str, Any]) -> None:
        token = Path(init_parameters["token_file"]).read_text(encoding="utf-8").strip()
        self._http = httpx.Client(
            base_url=f"{init_parameters['url']}/api/v1", headers={"Authorization": f"Bearer {token}"}, timeout=90
        )

    async def _cleanup(self) -> None:
        self._http.close()

    async def _report(self) -> dict[str, Any]:
        status = self._http.get("/status").json()
        return {"ready": status["ready"], "questions": status["questions"], "problems": status["problems"]}

    def pour(self, order: dict[str, Any]) -> dict[str, Any]:
        """Pour, and return the weighed result. With an unknown outcome it waits for the operator's answer."""
        while True:
            try:
                answer = self._http.post("/pours", params={"wait": 60}, json=order)
            except httpx.TransportError:
                time.sleep(2)
                continue
            if answer.is_error:
                raise RuntimeError(f"{order['id']}: {answer.json()['detail']}")
            found = answer.json()
            if found["state"] == "weighed":
                return found["result"]
            if found["state"] in ("failed", "cancelled"):
                raise RuntimeError(f"{order['id']}: {found['state']}: {found['reason']}")
            time.sleep(2)
