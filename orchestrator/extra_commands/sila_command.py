"""The command `decant server sila`: a running daemon as a SiLA 2 server."""

from __future__ import annotations

from importlib.util import find_spec
from pathlib import Path
from typing import Annotated

import typer

from orchestrator.cli.command_options import add_group
from orchestrator.cli.console import Refused, print_message
from orchestrator.cli.queue_commands import State, Url, connected_client


def serve_sila(
    url: Url = None,
    state: State = None,
    host: Annotated[str, typer.Option(help="Address to listen at; another one than loopback needs TLS.")] = "127.0.0.1",
    port: Annotated[int, typer.Option(min=0, max=65535, help="TCP port; 0 selects a free one.")] = 50052,
    certificate: Annotated[
        Path | None, typer.Option(exists=True, dir_okay=False, help="Certificate for TLS (PEM).")
    ] = None,
    key: Annotated[
        Path | None, typer.Option(exists=True, dir_okay=False, help="Key of the certificate (PEM).")
    ] = None,
    clients: Annotated[
        Path | None,
        typer.Option(
            exists=True, dir_okay=False, help="Admit only clients with a certificate of this authority (PEM).")
    ] = None,
) -> None:  # fmt: skip
    """Serve a running daemon to SiLA 2 clients: pour, weigh, run a campaign, observe the state.

    It is a process of its own over the daemon's HTTP API, with an operator's token. Ending it ends no pour. The
    motion of hardware is enabled with 'decant queue enable' only.
    """
    from orchestrator.learning.run_errors import RunError
    from sim_engine.resources import require

    require("unitelabs", "the SiLA 2 server")
    import asyncio

    from orchestrator.daemon.integrations import sila_server

    with connected_client(url, state) as client:
        client.get("/status")
        files = {"certificate": certificate, "key": key, "clients": clients}
        told = "with TLS" if certificate is not None else "without encryption"

        def ready(address: str) -> None:
            print_message(f"serving SiLA 2 at {address} {told}, for the daemon at {client.url}; Ctrl-C ends it")

        with Refused(RunError):
            asyncio.run(sila_server.serve(client, ready, host=host, port=port, **files))


def register(app: typer.Typer) -> None:
    """Add the command, if the server is installed."""
    if find_spec("orchestrator.daemon.integrations") is None:
        return
    add_group(app, "server", "")(
        serve_sila,
        "decant server sila   # for the daemon of this machine, on loopback",
        "decant server sila --host 192.0.2.7 --certificate station.pem --key station.key --clients authority.pem",
        name="sila",
    )
