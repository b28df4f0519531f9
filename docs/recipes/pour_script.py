"""Pour once with the standard library only: python pour_script.py plate-1:7 beaker-1 vial-7 '30 g' '1 g'."""

import json
import os
import sys
import time
import urllib.error
import urllib.request

URL = os.environ.get("DECANT_URL", "http://127.0.0.1:8377") + "/api/v1/pours?wait=60"
HEADERS = {"Authorization": f"Bearer {os.environ['DECANT_TOKEN']}", "Content-Type": "application/json"}


def ordered(order: dict) -> dict:
    """Place an order, or return the pour of this order: its id makes it unique, so the call may be repeated."""
    request = urllib.request.Request(URL, json.dumps(order).encode(), HEADERS)
    with urllib.request.urlopen(request, timeout=90) as answer:
        return json.load(answer)


def poured(order: dict) -> dict:
    """Repeat the order until the pour has ended."""
    while True:
        try:
            pour = ordered(order)
        except urllib.error.HTTPError as error:  # refused: nothing was poured
            sys.exit(f"{order['id']}: {json.load(error)['detail']}")
        except OSError as error:  # the daemon is restarted, or the connection was cut: the pour may have begun
            print(f"{order['id']}: {error}; again in 2 s", file=sys.stderr)
            time.sleep(2)
            continue
        if pour["state"] in ("weighed", "failed", "cancelled"):
            return pour
        # Nothing is poured again if the outcome is unknown: an operator answers the question on the page.
        print(f"{pour['id']}: {pour['state']} {pour['reason']}", file=sys.stderr)
        time.sleep(2)


if __name__ == "__main__":
    keys = ("id", "source", "receiver", "amount", "tolerance")
    found = poured(dict(zip(keys, sys.argv[1:], strict=True)))
    print(json.dumps(found["result"] or found["reason"]))
    sys.exit(0 if found["state"] == "weighed" else 1)
