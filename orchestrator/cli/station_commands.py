"""Commands for ordered pours of the daemon, and for backups of its state."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated, Any

import typer

from orchestrator.cli.command_options import Assignments
from orchestrator.cli.console import RefusalError, Refused, print_message
from orchestrator.cli.queue_commands import State, Url, connected_client
from orchestrator.daemon.rigs.pour_request import PourIn, described


def order(
    key: Annotated[str, typer.Argument(metavar="ID", help=described("id"))],
    source: Annotated[str, typer.Option("--from", help=described("source"))],
    receiver: Annotated[str, typer.Option("--into", help=described("receiver"))],
    amount: Annotated[str | None, typer.Option(help=described("amount"))] = None,
    tolerance: Annotated[str, typer.Option(help=described("tolerance"))] = PourIn.model_fields["tolerance"].default,
    assignments: Assignments = None,
    dry_run: Annotated[bool, typer.Option("--dry-run", help=described("dry_run"))] = False,
    wait: Annotated[float, typer.Option(min=0, max=600, help="Wait for the result [s].")] = 0.0,
    url: Url = None,
    state: State = None,
) -> None:
    """Order one pour: an amount, or an action."""
    action = {}
    for text in assignments or []:
        name, equals, value = (word.strip() for word in text.partition("="))
        if not equals:
            raise RefusalError(f"--set: {text!r} should be name=value, for example angular_velocity='60 deg/s'")
        action[name] = value
    with connected_client(url, state) as client:
        from orchestrator.daemon.api.daemon_client import order_body

        body = order_body(
            lambda: PourIn(
                id=key, source=source, receiver=receiver, amount=amount, tolerance=tolerance, action=action,
                dry_run=dry_run,
            )
        )  # fmt: skip
        poured = client.post(f"/pours?wait={wait:g}", body)
    print(pour_text(poured))


def pour_text(pour: dict[str, Any]) -> str:
    """A pour in one line.

    Args:
        pour: as the API returns it.
    """
    result, predicted = pour["result"], pour["predicted"]
    text = f"{pour['id']}: {pour['state']}"
    if result is not None and result["received_g"] is not None:
        text += f", {result['received_g']:.1f} g weighed"
        if result["error_g"] is not None:
            text += f" ({result['error_g']:+.1f} g)"
    elif predicted is not None and predicted.get("interval_g") is not None:
        low, high = predicted["interval_g"]
        text += f", {low:.1f} to {high:.1f} g expected"
    return text + (f" ({pour['reason']})" if pour["reason"] else "")


def backup(file: Annotated[Path, typer.Argument(help="Archive to write (.zip).")], state: State = None) -> None:
    """Back up a daemon's state, also while it runs: queue, orders, materials, campaigns, runs and tokens."""
    from orchestrator.daemon.state.state_backup import back_up
    from orchestrator.learning.run_errors import RunError
    from orchestrator.records.run_registry import state_directory

    with Refused(RunError), Refused(OSError):
        written = back_up(state or state_directory(), file)
    print(f"{file}: {written['campaigns']} campaigns, {written['runs']} runs, {written['bytes'] / 1e6:.1f} MB")
    print_message("recordings are left out; the archive contains access tokens")


def restore(
    file: Annotated[Path, typer.Argument(help="Archive of 'decant server backup'.")],
    state: State = None,
) -> None:
    """Restore a backup into a new state directory. The queue is paused: check the pours made since the backup."""
    from orchestrator.daemon.state import state_backup
    from orchestrator.learning.run_errors import RunError
    from orchestrator.records.run_registry import state_directory

    with Refused(RunError), Refused(OSError):
        restored = state_backup.restore(file, state or state_directory())
    then = time.strftime("%Y-%m-%d %H:%M %Z", time.localtime(restored["time"]))
    print(f"restored the state of {then}: {restored['campaigns']:.0f} campaigns, {restored['runs']:.0f} runs")
    print_message(
        "the queue is paused. Pours made since then are not in it: weigh the vessels, then decant queue resume"
    )
