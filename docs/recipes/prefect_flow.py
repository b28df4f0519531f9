"""A Prefect flow that fills vials: python prefect_flow.py plate-1 beaker-1 '30 g' vial-1 vial-2."""

import os
import sys
import time

import httpx
from prefect import flow, get_run_logger, task

URL = os.environ.get("DECANT_URL", "http://127.0.0.1:8377") + "/api/v1/pours"
HEADERS = {"Authorization": f"Bearer {os.environ['DECANT_TOKEN']}"}


def connection_failed(task, run, state) -> bool:
    """Whether the last attempt failed on the way; a refusal is not repeated."""
    return isinstance(state.result(raise_on_failure=False), httpx.TransportError)


@task(retries=30, retry_delay_seconds=2, retry_condition_fn=connection_failed)
def pour(order: dict) -> dict:
    """Pour, and return the weighed result. A retry sends the same id, so it returns the pour that exists."""
    while True:
        answer = httpx.post(URL, params={"wait": 60}, json=order, headers=HEADERS, timeout=90)
        if answer.is_error:
            raise RuntimeError(f"{order['id']}: {answer.json()['detail']}")
        found = answer.json()
        if found["state"] == "weighed":
            return found["result"]
        if found["state"] in ("failed", "cancelled"):
            raise RuntimeError(f"{order['id']}: {found['state']}: {found['reason']}")
        # 'unknown', 'waiting for operator', 'paused': the task goes on when an operator has answered on the page.
        get_run_logger().warning("%s: %s %s", order["id"], found["state"], found["reason"])
        time.sleep(2)


@flow
def fill_vials(plan: str, source: str, amount: str, receivers: list[str]) -> dict[str, float]:
    """Fill vials. The ids come from the plan, not from the flow's run: the same plan again pours nothing again."""
    orders = [
        {"id": f"{plan}:{vial}", "source": source, "receiver": vial, "amount": amount, "tolerance": "1 g"}
        for vial in receivers
    ]
    return {order["receiver"]: pour(order)["received_g"] for order in orders}


if __name__ == "__main__":
    print(fill_vials(*sys.argv[1:4], sys.argv[4:]))
