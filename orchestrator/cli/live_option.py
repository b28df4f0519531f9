"""The live view as the command line offers it."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

from orchestrator.cli.console import BAD_INPUT, RefusalError

if TYPE_CHECKING:
    from orchestrator.live_view.live_server import LiveView
    from orchestrator.strategies.campaign_plan import CampaignPlan


def live_view(plan: CampaignPlan, *, live: bool, at: str | None) -> LiveView | None:
    """The view that was asked for, not open yet; None if none was.

    Args:
        plan: of the campaign that is to be seen.
        live: whether one was asked for.
        at: ADDRESS[:PORT]; asks for one too.

    Raises:
        RefusalError: it can't be had (exit code 2).
    """
    from orchestrator.live_view.live_server import LOOPBACK, LiveView, is_free
    from sim_engine.resources import installed

    if not live and at is None:
        return None
    if not installed("rerun"):
        raise RefusalError("--live: needs Rerun, which is not installed: pip install 'decant[live]'", BAD_INPUT)
    if not plan.outputs.rrd:
        raise RefusalError(
            f"--live: {plan.source} says 'outputs: {{rrd: false}}', and a live view shows what is recorded; "
            "leave that out",
            BAD_INPUT,
        )
    address, port = parsed(at) if at is not None else (LOOPBACK, None)
    if port is not None and not is_free(address, port):
        raise RefusalError(
            f"--live-at {at}: port {port} is taken, by another live view perhaps, or {address} is not an address of "
            "this machine; leave the port out, and a free one is found",
            BAD_INPUT,
        )
    return LiveView(address=address, web_port=port)


def parsed(at: str) -> tuple[str, int | None]:
    """'0.0.0.0:9091' → address and port; None for no port.

    Raises:
        RefusalError: it is neither.
    """
    found = re.fullmatch(r"(?P<address>[A-Za-z0-9.-]+|\[[0-9a-fA-F:]+\])(:(?P<port>\d+))?", at)
    port = None if found is None or found["port"] is None else int(found["port"])
    if found is None or (port is not None and not 0 < port < 65536):
        raise RefusalError(f"--live-at {at!r}: write ADDRESS or ADDRESS:PORT, as 127.0.0.1:9090", BAD_INPUT)
    return found["address"].strip("[]"), port
