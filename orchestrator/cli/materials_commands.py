"""The commands `decant materials …`: the contents of vessels, and entries of people.

A daemon that runs on the state directory, or the one of `--url`, makes the entries, so that its checks and its audit
apply. Without a daemon the commands read and write the account of this machine (`VesselAccount`), which holds the
sources of campaigns; a daemon reads the same account later.
"""

from __future__ import annotations

import getpass
import os
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from orchestrator.cli.console import RefusalError, Refused, print_message
from orchestrator.cli.queue_commands import State, Url, connected_client

if TYPE_CHECKING:
    from orchestrator.daemon.api.daemon_client import Client
    from orchestrator.materials.vessel_account import VesselAccount

VesselName = Annotated[
    str,
    typer.Argument(
        metavar="VESSEL",
        help="Id or bar code of a vessel of the daemon, or LABORATORY/VESSEL for the source of a campaign.",
    ),
]
Deviation = Annotated[str, typer.Option(help="Standard deviation of the mass.")]
Note = Annotated[str, typer.Option(help="Text of the entry.")]


@contextmanager
def _opened(url: str | None, state: Path | None) -> Iterator[Client | VesselAccount]:
    """The daemon if there is one, else the account of this machine."""
    from orchestrator.materials.vessel_account import VesselAccount
    from orchestrator.records.run_registry import state_directory

    with Refused(OSError):
        folder = state or state_directory()
        named = url is not None or bool(os.environ.get("DECANT_URL"))
        if named or _daemon_answers(folder):
            with connected_client(url, state) as client:
                yield client
        else:
            yield VesselAccount.open(folder)


def _daemon_answers(folder: Path) -> bool:
    if not (folder / "url").is_file():
        return False
    from orchestrator.daemon.api.daemon_client import Client, DaemonError

    try:
        with Client(None, folder) as client:
            client.get("/materials")
    except DaemonError as error:
        return not error.unreachable
    return True


def _mass(text: str, option: str) -> float:
    from sim_engine.settings.quantity import QuantityError, typed_quantity

    with Refused(QuantityError, at=f"{option}: "):
        mass = typed_quantity(text, "kg", "412.3 g")
    if mass < 0.0:
        raise RefusalError(f"{option}: {text} should be 0 g or more")
    return mass


def _grams(mass: float) -> str:
    return f"{1e3 * mass:.9g} g"


def _of_campaign(vessel: str) -> str:
    """The name of a vessel that needs no daemon."""
    laboratory, slash, name = vessel.partition("/")
    if not (laboratory and slash and name):
        raise RefusalError(
            f"{vessel}: without a daemon, only sources of campaigns can be changed: write LABORATORY/VESSEL, for "
            "example virtual/beaker. A vessel of the station needs 'decant server start'"
        )
    return vessel


def list_vessels(
    vessel: Annotated[
        str | None, typer.Argument(metavar="VESSEL", help="Show the last entries of this vessel's account.")
    ] = None,
    limit: Annotated[int, typer.Option(min=1, help="Number of entries.")] = 20,
    url: Url = None,
    state: State = None,
) -> None:
    """List vessels with what is left in each one, its standard deviation, and where it stands.

    With a vessel: its fillings, weighings and pours, newest last.

    Vessels of the daemon have an id. The sources of `dispense` campaigns and of `decant dose`, and the vessels that an
    arm carries between places, are LABORATORY/VESSEL.
    """
    from orchestrator.materials.vessel_account import VesselAccount

    if vessel is not None:
        _show_entries(vessel, limit, url, state)
        return
    rows: list[dict[str, Any]]
    with _opened(url, state) as where:
        if not isinstance(where, VesselAccount):
            materials = where.get("/materials")
            rows = [{"id": row["id"], "position": row["position"], **row["content"]} for row in materials["vessels"]]
            rows += [{"id": row["id"], "position": row["position"], **row["content"]} for row in materials["sources"]]
        else:
            places = where.places()
            rows = [
                {"id": content.vessel, "position": places[content.vessel].shown() if content.vessel in places else ""}
                | {"parts": where.composition(content.vessel), **content.content.model_dump()}
                for content in where.all()
            ]
    if not rows:
        print_message("no vessel has content; 'decant materials weigh' enters one, see docs/laboratory/station.md")
    for row in rows:
        text = f"{row['id']:24s} {row['liquid'] or '-':12s} {_content(row):24s} {row['position']}"
        if parts := [part for part in row.get("parts", ()) if part.liquid and part.mass != 0.0]:
            grams = ("UNKNOWN" if part.mass is None else f"{1e3 * part.mass:.1f} g" for part in parts)
            text += " " + ", ".join(f"{part.liquid} {mass}" for part, mass in zip(parts, grams, strict=True))
        print(text.rstrip())


def _content(row: dict[str, Any]) -> str:
    if row["mass_g"] is None:
        return "unknown: weigh it"
    return f"{row['mass_g']:.1f} ± {row['deviation_g']:.1f} g"


def _show_entries(vessel: str, limit: int, url: str | None, state: Path | None) -> None:
    from orchestrator.materials.vessel_account import VesselAccount

    with _opened(url, state) as where:
        if not isinstance(where, VesselAccount):
            rows = where.get("/materials/account", vessel=vessel, limit=limit)
        else:
            rows = [content.entry.model_dump() for content in reversed(where.history(vessel, limit))]
    if not rows:
        print_message(f"{vessel}: has no entry; 'decant materials list' lists the vessels")
    for row in rows:
        when = time.strftime("%Y-%m-%d %H:%M %Z", time.localtime(row["t"]))
        about = "  ".join(text for text in (row["pour"], row["by"], row["note"]) if text)
        print(f"{when}  {row['kind']:8s} {_content(row):24s} {about}".rstrip())


def weigh(
    vessel: VesselName,
    mass: Annotated[str, typer.Argument(help="Its content, for example '123.4 g'.")],
    liquid: Annotated[str, typer.Option(help="Liquid, for an empty vessel.")] = "",
    deviation: Deviation = "0.1 g",
    note: Note = "",
    url: Url = None,
    state: State = None,
) -> None:
    """Enter what a vessel holds, as weighed: it replaces the estimate."""
    from orchestrator.materials.vessel_account import VesselAccount

    kilograms, spread = _mass(mass, "MASS"), _mass(deviation, "--deviation")
    with _opened(url, state) as where:
        if not isinstance(where, VesselAccount):
            body = {"mass": _grams(kilograms), "liquid": liquid, "deviation": _grams(spread), "note": note}
            where.post(f"/materials/vessels/{vessel}/weighed", body)
        else:
            name = _of_campaign(vessel)
            where.weigh(name, kilograms, spread, liquid=liquid, by=getpass.getuser(), note=note)
    print(f"{vessel}: {_grams(kilograms)}")


def poured(
    key: Annotated[
        str, typer.Argument(metavar="ID", help="Your id of the pour: with it, a repeated command enters it once.")
    ],
    source: Annotated[str, typer.Option("--from", help="Vessel that was poured from.")],
    receiver: Annotated[str, typer.Option("--into", help="Vessel that was poured into.")],
    mass: Annotated[str, typer.Option("--weighed", help="Mass in the receiver, for example '30.2 g'.")],
    deviation: Deviation = "0.1 g",
    note: Note = "",
    url: Url = None,
    state: State = None,
) -> None:
    """Enter a pour that you made by hand and weighed: the source holds less, the receiver more."""
    from orchestrator.materials.vessel_account import VesselAccount

    moved = _mass(mass, "--weighed"), _mass(deviation, "--deviation")
    text, new = _grams(moved[0]), True
    with _opened(url, state) as where:
        if not isinstance(where, VesselAccount):
            body = {"id": key, "source": source, "receiver": receiver, "mass": text, "deviation": _grams(moved[1])}
            where.post("/materials/pours", {**body, "note": note})
        else:
            names = _of_campaign(source), _of_campaign(receiver)
            new = where.pour_by_hand(key, *names, *moved, by=getpass.getuser(), note=note)
    if not new:
        print_message(f"{key}: is entered already, and nothing was changed; to correct it, weigh both vessels")
        return
    print(f"{key}: {text} from {source} into {receiver}")


def place(
    vessel: VesselName,
    where: Annotated[
        str, typer.Argument(metavar="PLACE", help="Place of the laboratory, or position of the daemon; '' for nowhere.")
    ],
    note: Note = "",
    url: Url = None,
    state: State = None,
) -> None:
    """Correct where a vessel stands, for example after an interrupted motion has left it UNKNOWN."""
    from orchestrator.materials.vessel_account import VesselAccount

    with _opened(url, state) as account:
        if not isinstance(account, VesselAccount):
            account.post(f"/materials/vessels/{vessel}/place", {"position": where})
        else:
            name = _of_campaign(vessel)
            account.put(name, where or None, by=getpass.getuser(), note=note or "corrected")
    print(f"{vessel}: {where or 'UNKNOWN'}")
