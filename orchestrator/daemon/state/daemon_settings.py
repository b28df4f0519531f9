"""Settings of the daemon: the YAML file and the values in force.

`DaemonFile` is the schema of the file, which is checked as strictly as a campaign. `DaemonSettings` holds the resolved
values, including defaults. `Rig` is one laboratory that campaigns lease. `load_settings` combines the file with options
of the command line.
"""

from __future__ import annotations

import ipaddress
import ssl
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar

from pydantic import Field

from actors.interfaces import RayAddress, RaySettings
from actors.laboratory_settings import LaboratorySettings
from orchestrator.campaigns.file_loading import load_laboratory
from orchestrator.campaigns.yaml.file_access import missing_file, resolved
from orchestrator.campaigns.yaml.section_validation import validate
from orchestrator.campaigns.yaml.yaml_errors import ConfigError
from orchestrator.campaigns.yaml.yaml_source import Document, Place, Report
from orchestrator.daemon import PORT
from orchestrator.daemon.state.notifications import NotifySettings, problem_of
from orchestrator.records.run_registry import state_directory
from sim_engine.settings.model import Count, FilePath, Name, Settings, Switch, Text
from sim_engine.settings.quantity import Quantity

LOOPBACK = ("127.0.0.1", "::1", "localhost")
ANY_RIG = "virtual"
"""The rig of a daemon whose settings name none: each campaign's own laboratory, which must be virtual."""

NO_RIG = "none"
"""The rig of campaigns that pour nothing: they need simulators only."""

Port = Annotated[int, Field(strict=True, ge=0, le=65535)]


class TlsSettings(Settings):
    """A TLS certificate, for addresses that other machines can reach."""

    required: ClassVar[dict[str, str]] = {"certificate": "decant.crt", "key": "decant.key"}

    certificate: FilePath | None = None
    """The server's certificate, with its chain (PEM)."""

    key: FilePath | None = None
    """Its private key (PEM)."""


class ListenSettings(Settings):
    """Address of the API. By default, only this machine can reach it."""

    host: Text = "127.0.0.1"
    """Address to listen at."""

    port: Port = PORT
    """TCP port; 0 selects a free one, which is written to the state directory."""

    names: list[Text] | None = None
    """Host names under which a proxy on this machine passes requests on to a loopback address, such as
    lab.example.org; others than the machine's own are refused without them."""

    tls: TlsSettings | None = None
    """TLS certificate; required for addresses other than loopback."""

    plain: Switch = False
    """Serve another address without TLS, because a proxy in front of the daemon encrypts."""


class LiveSettings(Settings):
    """A live view of running campaigns for browsers."""

    host: Text = "127.0.0.1"
    """Address to listen at. It has no password: anyone who can reach it can watch."""

    port: Port | None = None
    """TCP port of the viewer's page; by default the usual one or the next free one."""


class MadsciSettings(Settings):
    """Serve the daemon as a MADSci node. The protocol has no password: list the addresses that may call."""

    required: ClassVar[dict[str, str]] = {"allow": "[192.0.2.10]"}

    host: Text = "127.0.0.1"
    """Address to listen at."""

    port: Port = 2000
    """TCP port; 0 selects a free one."""

    allow: list[Text] | None = None
    """Addresses of the clients, such as that of the workcell manager; networks as 192.0.2.0/28."""

    name: Text = "decant"
    """Name of the node."""


class RecordingsSettings(Settings):
    """Retention of recordings (`.rrd`). Journals, figures and summaries are always kept."""

    keep: Count | None = None
    """Number of newest runs whose recordings are kept; all by default."""


class ClusterSettings(Settings):
    """A Ray cluster for the simulators. Arms, balances and benches of all rigs stay on the daemon's machine."""

    address: RayAddress
    """Address of its head node, host:port."""


class DaemonFile(Settings):
    """Settings of a daemon."""

    state: FilePath | None = None
    """State directory: queue, questions, events, tokens and runs."""

    listen: ListenSettings = ListenSettings()
    """Address of the API."""

    rigs: dict[Name, FilePath] | None = None
    """Laboratories by name; one campaign at a time leases the arm and the balance of each."""

    roots: list[FilePath] | None = None
    """Folders for campaigns that are submitted by path, with all files they refer to; none by default."""

    simulators: Annotated[Count, Field(le=10_000)] = 0
    """Simulators in the pool that all campaigns share; 0: one per core of this machine or of the cluster."""

    ray: ClusterSettings | None = None
    """The Ray cluster on which the simulators run; unless given, a private Ray on this machine."""

    in_process: Switch = False
    """Use one simulator in the daemon's own process, without Ray; for trying Decant out."""

    recordings: RecordingsSettings = RecordingsSettings()
    """Retention of recordings."""

    live: LiveSettings | None = None
    """Serve a live view; off by default."""

    notify: NotifySettings | None = None
    """Receivers of notifications; none by default."""

    madsci: MadsciSettings | None = None
    """Serve a MADSci node at an address of its own; off by default."""

    keep_free: Annotated[float, Quantity("MB", "500 MB", 40.0, 1e7)] = 500.0
    """Free disk space below which no campaign starts."""


@dataclass(frozen=True)
class Rig:
    """A laboratory that one campaign at a time leases.

    Attributes:
        name: unique name.
        source: laboratory file; None if each campaign brings its own.
        spec: settings read from the file.
    """

    name: str
    source: Path | None = None
    spec: LaboratorySettings | None = None

    @property
    def mode(self) -> str:
        """'virtual' or 'hardware'; 'none' for the rig of campaigns that pour nothing."""
        if self.name == NO_RIG:
            return "none"
        return "virtual" if self.spec is None else self.spec.mode


@dataclass(frozen=True)
class DaemonSettings:
    """The settings in force; see `DaemonFile` for their meaning. Sizes are in bytes, times in seconds."""

    state: Path
    host: str = "127.0.0.1"
    port: int = PORT
    names: tuple[str, ...] = ()
    certificate: Path | None = None
    key: Path | None = None
    body_limit: int = 4_000_000  # a campaign with all files that it refers to
    rigs: tuple[Rig, ...] = (Rig(ANY_RIG),)
    roots: tuple[Path, ...] = ()
    simulators: int = 0
    ray: RaySettings | None = None
    in_process: bool = False
    keep_recordings: int | None = None
    keep_free: int = 500_000_000
    events: int = 50_000  # stored for clients that reconnect
    live: tuple[str, int | None] | None = None
    notify: NotifySettings | None = None
    madsci: MadsciSettings | None = None
    quick_start: bool = field(default=True, compare=False)
    """Whether simulators start at once instead of with the first campaign."""

    arm_interval: float = field(default=5.0, compare=False)
    """Interval at which the state of an idle arm is read [s]."""

    @property
    def runs(self) -> Path:
        """Folder of the runs' folders."""
        return self.state / "runs"

    @property
    def snapshots(self) -> Path:
        """Folder of the submitted campaigns, as they were at submission."""
        return self.state / "campaigns"

    @property
    def tokens(self) -> Path:
        """Path of the token file."""
        return self.state / "tokens"

    @property
    def address(self) -> Path:
        """Path of the file with the running daemon's URL."""
        return self.state / "url"

    @property
    def laboratories(self) -> dict[str, str]:
        """Names of the laboratories, by their rigs."""
        return {rig.name: rig.spec.name for rig in self.rigs if rig.spec is not None}

    def rig(self, name: str) -> Rig:
        """Return a rig by its name. Raises KeyError."""
        return next(rig for rig in (*self.rigs, Rig(NO_RIG)) if rig.name == name)


def networks(allow: Sequence[str]) -> list[ipaddress.IPv4Network | ipaddress.IPv6Network]:
    """Return the networks of addresses. Raises ValueError."""
    return [ipaddress.ip_network(text, strict=False) for text in allow]


def load_settings(path: Path | None, **options: Any) -> DaemonSettings:
    """Load the settings from a file; options of the command line override them.

    Args:
        path: settings file; None: defaults.
        options: fields of `DaemonSettings`; None for options that are not given.

    Raises:
        ConfigError: the file or a rig's file is invalid.
    """
    options = {name: value for name, value in options.items() if value is not None}
    if path is None:
        return replace(DaemonSettings(resolved(options.pop("state", state_directory()))), **options)
    report = Report()
    place = Place(Document.read(resolved(path)))
    file = validate(DaemonFile, place, report)
    settings = None if file is None else _resolve(file, place, report)
    report.raise_if_any()
    assert settings is not None, "settings without problems"
    if "state" in options:
        options["state"] = resolved(options["state"])
    return replace(settings, **options)


def _rig(name: str, source: Path, at: Place, report: Report) -> list[Rig]:
    try:
        spec = load_laboratory(source)
    except ConfigError as error:
        report.problems.extend(error.problems)
        return []
    if not spec.pours:
        report.add(at, "has no bench; campaigns that pour nothing need no rig")
    if spec.ray is not None:
        report.add(at, "names a Ray cluster; all rigs share the daemon's simulators: move 'ray' to the daemon's file")
    return [Rig(name, source, spec)]


def _check_tls(certificate: Path | None, key: Path | None, at: Place, report: Report) -> None:
    assert certificate is not None
    try:
        ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER).load_cert_chain(certificate, key)
    except OSError as error:  # includes SSLError
        reason = error.reason or "they can't be read" if isinstance(error, ssl.SSLError) else error.strerror
        report.add(at, f"{certificate.name} and {key and key.name} are not a certificate and its key in PEM ({reason})")


def _check_receivers(section: NotifySettings, at: Place, report: Report) -> None:
    for i, receiver in enumerate(section.to or ()):
        if (problem := problem_of(receiver)) is not None:
            report.add(at.at("to", i), problem)


def _rigs(file: DaemonFile, place: Place, report: Report) -> list[Rig]:
    """The rigs of a daemon's file; problems with their laboratories are added to the report."""
    rigs: list[Rig] = []
    for name, text in (file.rigs or {}).items():
        at, source = place.at("rigs", name), resolved(place.directory / text)
        if name == NO_RIG:
            report.add(at, f"'{NO_RIG}' stands for campaigns that pour nothing; give the rig another name", key=True)
        elif (missing := missing_file(source)) is not None:
            report.add(at, missing)
        else:
            rigs += _rig(name, source, at, report)
    return rigs


def _check_listening(
    file: DaemonFile, certificate: Path | None, key: Path | None, listen: Place, report: Report
) -> None:
    """Check the files of TLS, and that no token crosses a network in plain text."""
    tls = file.listen.tls
    for name, pem in (("certificate", certificate), ("key", key)):
        if pem is not None and (missing := missing_file(pem)) is not None:
            report.add(listen.at("tls", name), missing)
    broken = any(report.is_broken(listen.at("tls", name)) for name in ("certificate", "key"))
    if certificate is not None and key is not None and not broken:
        _check_tls(certificate, key, listen.at("tls"), report)
    if file.listen.host not in LOOPBACK and tls is None and not file.listen.plain:
        report.add(
            listen.at("host"),
            "other machines reach this address, and tokens would cross the network in plain text; add 'tls', or "
            "'plain: true' where something in front of it encrypts",
        )


def _resolve(file: DaemonFile, place: Place, report: Report) -> DaemonSettings:
    def path(text: str | None, at: Place) -> Path | None:
        return None if text is None else resolved(at.directory / text)

    rigs = _rigs(file, place, report)
    roots = tuple(resolved(place.directory / text) for text in file.roots or ())
    for index, root in enumerate(roots):
        if not root.is_dir():
            report.add(place.at("roots", index), f"{root} is not a folder")
    listen, tls = place.at("listen"), file.listen.tls
    certificate, key = (None, None) if tls is None else (path(tls.certificate, listen), path(tls.key, listen))
    _check_listening(file, certificate, key, listen, report)
    if file.madsci is not None:
        try:
            networks(file.madsci.allow or ())
        except ValueError as error:
            report.add(place.at("madsci", "allow"), f"{error}; write addresses such as 192.0.2.10 or 192.0.2.0/28")
    if file.notify is not None:
        _check_receivers(file.notify, place.at("notify"), report)
    if file.ray is not None and file.in_process:
        report.add(
            place.at("ray"), "a daemon without Ray ('in_process: true') uses no cluster; remove one of them", key=True
        )
    state = path(file.state, place)
    if state is not None and state.exists() and not state.is_dir():
        report.add(place.at("state"), f"{state} is not a folder")
    return DaemonSettings(
        state=state or state_directory(),
        host=file.listen.host,
        port=file.listen.port,
        names=tuple(file.listen.names or ()),
        certificate=certificate,
        key=key,
        rigs=tuple(rigs) or (Rig(ANY_RIG),),
        roots=roots,
        simulators=file.simulators,
        ray=None if file.ray is None or report.problems else RaySettings(address=file.ray.address),
        in_process=file.in_process,
        keep_recordings=file.recordings.keep,
        keep_free=round(file.keep_free * 1e6),
        live=None if file.live is None else (file.live.host, file.live.port),
        notify=file.notify,
        madsci=file.madsci,
    )
