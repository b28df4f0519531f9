"""`decant server token`: access tokens of a daemon, which reads them again without a restart."""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from enum import StrEnum
from typing import Annotated

import typer

from orchestrator.cli.console import RefusalError, Refused, print_message, print_note
from orchestrator.cli.queue_commands import State

Holder = Annotated[str, typer.Argument(metavar="NAME", help="Name of the holder, recorded with every action.")]


class RoleName(StrEnum):
    """Roles of tokens."""

    VIEWER = "viewer"
    OPERATOR = "operator"
    ADMIN = "admin"


def add(
    role: Annotated[RoleName, typer.Argument(help="What the holder may do.")],
    name: Holder,
    days: Annotated[
        int | None, typer.Option("--days", min=1, max=36_500, help="Days until it expires; never by default.")
    ] = None,
    state: State = None,
) -> None:
    """Make a token and print it once; the state directory keeps its digest. A running daemon accepts it at once."""
    from orchestrator.daemon.state.access_tokens import Role, TokenFileError, add_token, utc
    from orchestrator.records.run_registry import state_directory

    expires = None if days is None else (datetime.now(UTC) + timedelta(days=days)).timestamp()
    with Refused(TokenFileError), Refused(OSError):
        token = add_token((state or state_directory()) / "tokens", Role[role.name], name, expires)
    print(token)
    print_note(f"{role} {name}: give it to its holder, it is not shown again" + (
        "" if expires is None else f"; it expires on {utc(expires)}"))  # fmt: skip


def revoke(name: Holder, state: State = None) -> None:
    """Revoke the tokens of a name; a running daemon refuses them from the next request on."""
    from orchestrator.daemon.state.access_tokens import TokenFileError, revoke_token
    from orchestrator.records.run_registry import state_directory

    with Refused(TokenFileError), Refused(OSError):
        revoke_token((state or state_directory()) / "tokens", name)
    print(f"revoked: {name}")


def list_all(state: State = None) -> None:
    """List the tokens by role and name, with their expiry; never the tokens themselves."""
    from orchestrator.daemon.state.access_tokens import HASHED, TokenFileError, list_tokens, utc
    from orchestrator.records.run_registry import state_directory

    path = (state or state_directory()) / "tokens"
    if not path.exists():
        raise RefusalError(f"{path}: no such file; 'decant server token add' makes it")
    with Refused(TokenFileError):
        lines, problems = list_tokens(path)
    for line in lines:
        until = "" if line.expires is None else f"until {utc(line.expires)}"
        notes = ["expired" if line.expired else "", "" if line.token.startswith(HASHED) else "in plain text"]
        print("  ".join(filter(None, (f"{line.role.name.lower():8s}  {line.name:20s}", until, *notes))).rstrip())
    for problem in problems:
        print_message(problem)
