"""Submissions: a campaign with all files that it refers to becomes a queued campaign.

- A bundle is one self-contained unit. `pack` makes it from a loaded campaign; `unpack` writes it to a folder;
  `load_confined` loads a campaign that may read only given folders. Later changes of the original files do not affect
  a bundle.
- `receive` loads a submission, selects the rig and stores a snapshot; `check` checks the snapshot as `decant run` does,
  which may take minutes. Neither starts anything. `run_request` makes the run of a snapshot.
"""

from __future__ import annotations

import base64
import binascii
import hashlib
import json
import os
import re
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from actors.interfaces import LaboratoryError
from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.campaigns.file_references import YAML_SUFFIXES
from orchestrator.campaigns.yaml.file_access import confined, out_of_bounds, resolved
from orchestrator.campaigns.yaml.yaml_errors import ConfigError, Problem
from orchestrator.campaigns.yaml.yaml_source import Document
from orchestrator.catalogue.catalogue import posterior_source
from orchestrator.daemon.rigs.pour_orders import PlannedOrder, PourOrder
from orchestrator.daemon.state.daemon_settings import ANY_RIG, NO_RIG, DaemonSettings, Rig
from orchestrator.daemon.state.daemon_store import QueueItem
from orchestrator.learning.campaign_plan import CampaignPlan
from orchestrator.learning.run_errors import RunError
from orchestrator.records.journal import JOURNAL_NAME
from orchestrator.records.journal_file import whole_copy
from orchestrator.runs.run_service import RunRequest, RunResources, RunService, RunTaskError
from orchestrator.runs.run_tasks import TASKS, plan_task, read_theta
from orchestrator.runs.stages import POUR

CAMPAIGN, THETA, INCOMING = "campaign.yaml", "theta.yaml", "incoming"
"""Names of the campaign's file, of the file with the θ for planning (`orchestrator.runs.run_tasks.read_theta`), and of
the folder of a submission before it is stored as one self-contained file with its files."""

_NAME = re.compile(r"(\.\./){0,3}[A-Za-z0-9][A-Za-z0-9._-]{0,79}(/[A-Za-z0-9][A-Za-z0-9._-]{0,79}){0,3}")
_FILES = 100

Files = dict[str, str]
"""Name → content in base64. Names are paths relative to the campaign's file, as the campaign has them, such as
'../vessels/beaker.yaml': words of letters, digits, '.', '_' and '-'."""


class SubmissionBundleError(ValueError):
    """The bundle can't be unpacked; the message gives the reason."""


def pack(plan: CampaignPlan, theta: Path | None = None) -> tuple[str, Files]:
    """Convert a loaded campaign to text and files.

    Args:
        plan: campaign as loaded from its files.
        theta: file with the θ for planning, such as a calibration's `theta.json`; None: the campaign's θ.

    Returns:
        The campaign's text (JSON, which is YAML) with paths of the returned files, and these files.

    Raises:
        OSError: a file can't be read.
        ConfigError: a file is outside the folders that this campaign may read.
    """
    files: Files = {}
    resolved = dict(plan.resolved)
    resolved["outputs"] = {k: v for k, v in resolved.get("outputs", {}).items() if k != "directory"}
    table = _packed(resolved, files)
    if theta is not None:
        files[THETA] = _coded(theta.read_bytes())
    return json.dumps(table, indent=1, ensure_ascii=False) + "\n", files


def pack_unresolved(campaign: Path) -> tuple[str, Files]:
    """A campaign as it is written, with the files that it and its files name.

    Raises:
        OSError: a file can't be read.
        ConfigError: the campaign is not YAML.
    """
    document = Document.read(resolved(campaign))
    home, files = document.path.parent, dict[str, str]()
    waiting: list[tuple[Any, Path]] = [(document.data, home)]
    while waiting:
        value, folder = waiting.pop()
        if isinstance(value, dict | list):
            waiting += [(entry, folder) for entry in (value.values() if isinstance(value, dict) else value)]
        elif isinstance(value, str) and 0 < len(value) < 500 and (path := folder / value).is_file():
            name = Path(os.path.relpath(path, home)).as_posix()
            if name not in files:
                files[name] = _coded(path.read_bytes())
                if path.suffix.lower() in YAML_SUFFIXES:
                    waiting.append((Document.read(path).data, path.parent))
    return document.path.read_text(encoding="utf-8"), files


def names_laboratory(campaign: Path) -> bool:
    """Whether a campaign's file has a laboratory. Raises ConfigError."""
    table = Document.read(resolved(campaign)).data
    return not isinstance(table, dict) or "laboratory" in table


def _packed(value: Any, files: Files) -> Any:
    if isinstance(value, Mapping):
        return {key: _packed(entry, files) for key, entry in value.items()}
    if isinstance(value, list):
        return [_packed(entry, files) for entry in value]
    if isinstance(value, str) and value.startswith("/"):  # only absolute paths begin with '/' in a record
        return _taken(Path(value), files)
    return value


def _taken(path: Path, files: Files) -> str:
    is_run = (path / JOURNAL_NAME).is_file()
    if not is_run and not path.is_file():  # nothing is read, as of the port of a device
        return str(path)
    if (outside := out_of_bounds(path)) is not None:
        raise ConfigError([Problem(path, 0, 0, "", outside)])
    stem = re.sub(r"[^A-Za-z0-9._-]", "_", re.sub(r"^\d+-", "", path.name)).lstrip("._-")[-60:] or "file"
    name = f"files/{len(files) + 1}-{stem}"
    if is_run:  # only the journal of a previous run is read
        files[f"{name}/{JOURNAL_NAME}"] = _coded(whole_copy(path / JOURNAL_NAME))
    else:
        files[name] = _coded(path.read_bytes())
    return name


def _coded(content: bytes) -> str:
    return base64.b64encode(content).decode("ascii")


def unpack(text: str, files: Mapping[str, str], folder: Path) -> Path:
    """Write a bundle to a new folder.

    Args:
        text: text of the campaign.
        files: files that it refers to.
        folder: is created; must not exist.

    Returns:
        Path of the campaign's file.

    Raises:
        SubmissionBundleError: a name is not allowed, or a file is not in base64.
    """
    if len(files) > _FILES:
        raise SubmissionBundleError(f"{len(files)} files; a campaign refers to some, and {_FILES} are taken at most")
    home = folder.joinpath(*["campaign"] * max((name.count("../") for name in files), default=0))
    contents: dict[Path, bytes] = {}
    for name, coded in files.items():
        place = Path(os.path.normpath(home / name))
        if not _NAME.fullmatch(name) or place == home / CAMPAIGN:
            raise SubmissionBundleError(
                f"files: {name[:80]!r} is not a name for one; names are paths from the campaign's file, of words of "
                "letters, digits, '.', '_' and '-', such as '../vessels/beaker.yaml'"
            )
        try:
            contents[place] = base64.b64decode(coded, validate=True)
        except (binascii.Error, ValueError):
            raise SubmissionBundleError(f"files: {name}: is not in base64") from None
    folder.mkdir(parents=True, mode=0o700)
    home.mkdir(parents=True, exist_ok=True)
    for path, content in contents.items():
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
        except (FileExistsError, NotADirectoryError, IsADirectoryError):
            name = os.path.relpath(path, home)
            raise SubmissionBundleError(f"files: {name}: is a file and a folder at once") from None
    campaign = home / CAMPAIGN
    campaign.write_text(text, encoding="utf-8")
    return campaign


def load_confined(campaign: Path, roots: Sequence[Path], laboratory: Path | None = None) -> CampaignPlan:
    """Load a campaign that may read only given folders.

    Args:
        campaign: its file.
        roots: folders that it may read.
        laboratory: laboratory file instead of its own.

    Raises:
        ConfigError: the campaign is invalid, or it refers to a file elsewhere.
    """
    with confined([*roots, *([] if laboratory is None else [laboratory])]):
        return load_campaign(campaign, laboratory, posteriors=posterior_source)


def run_request(
    settings: DaemonSettings, item: QueueItem, rig: Rig, vessels: Mapping[str, str] | None = None
) -> RunRequest:
    """Make the run of a submitted campaign or an order from its snapshot. Reads files; don't call it in an event loop.

    Args:
        settings: of the daemon.
        item: the campaign.
        rig: that it leases.
        vessels: ids of the station's vessels at the rig, by the names that a series may give its sources.

    Raises:
        ConfigError, RunTaskError, OrderError: it can't be used.
    """
    folder = settings.snapshots / item.id
    if item.task == POUR:
        request = planned_order(settings, item, rig).request()
    else:
        plan = load_confined(folder / CAMPAIGN, [folder.resolve()], rig.source)
        theta = read_theta(folder / THETA, plan) if (folder / THETA).is_file() else None
        if plan.dispense is not None and vessels:
            named = {name: vessels[name] for name in plan.dispense.sources if name in vessels}
            plan = replace(plan, dispense=replace(plan.dispense, vessels=named))
        plan = _of_daemon(plan, settings)
        request = plan_task(plan, theta) if item.task == "plan" else TASKS[item.task](plan)  # type: ignore[index]
    if item.run is None:
        return request
    return replace(request, folder=settings.runs / item.run)


def planned_order(settings: DaemonSettings, item: QueueItem, rig: Rig) -> PlannedOrder:
    """Plan an order from its snapshot; see `run_request`."""
    folder = settings.snapshots / item.id
    planned = PlannedOrder.of(PourOrder.read(folder), rig, folder)
    return replace(planned, plan=_of_daemon(planned.plan, settings))


def _of_daemon(plan: CampaignPlan, settings: DaemonSettings) -> CampaignPlan:
    """The plan as a daemon runs it."""
    return replace(
        plan,
        # A daemon never repeats a pour by itself: it asks the operator, whatever the campaign says.
        on_unknown="ask",
        outputs=plan.outputs.model_copy(update={"directory": str(settings.runs)}),
        # All campaigns use the daemon's simulators. A submission must not make the daemon connect to another machine.
        laboratory=plan.laboratory.with_values(ray=None),
    )


class SubmissionError(RunError):
    """The submission can't be queued; the message gives the problem and a remedy."""

    exit_code = 2


@dataclass(frozen=True)
class Submission:
    """A submission: a campaign's text with its files, or the path of a file on the daemon's machine.

    Attributes:
        rig: name of the rig; '' selects the matching one.
        order: an ordered pour instead of a campaign.
        not_before, after: see `QueueItem`.
    """

    text: str = ""
    files: Files | None = None
    path: str = ""
    task: str = "run"
    rig: str = ""
    priority: int = 0
    order: PourOrder | None = None
    not_before: float | None = None
    after: dict[str, str] | None = None


def receive(settings: DaemonSettings, submission: Submission, key: str, by: str) -> QueueItem:
    """Load a submission, select its rig and store its snapshot. Takes a moment; don't call it in an event loop.

    Args:
        settings: settings of the daemon.
        submission: the submission.
        key: letters at the end of the campaign's id.
        by: user who submits it.

    Returns:
        The campaign, to be checked; its `body_hash` is that of its content, whatever form it came in.

    Raises:
        SubmissionError: the submission can't be used; its files are removed.
    """
    folder = settings.snapshots / key
    try:
        with _refusing(settings, folder):
            return _received(settings, submission, key, by)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise


def check(settings: DaemonSettings, item: QueueItem) -> None:
    """Check a received campaign as `decant run` does: vessels, motions, devices. May take minutes; needs a thread.

    Raises:
        SubmissionError: it can't run.
    """
    with _refusing(settings, settings.snapshots / item.id):
        work = run_request(settings, item, settings.rig(item.rig))
        service = RunService()
        service.check(work).require()
        service.check_laboratory(work, RunResources())


def prepare(settings: DaemonSettings, submission: Submission, key: str, by: str) -> QueueItem:
    """Receive and check a submission at once; see `receive` and `check`."""
    item = receive(settings, submission, key, by)
    try:
        check(settings, item)
    except BaseException:
        shutil.rmtree(settings.snapshots / item.id, ignore_errors=True)
        raise
    return item.model_copy(update={"state": "queued"})


@contextmanager
def _refusing(settings: DaemonSettings, folder: Path) -> Iterator[None]:
    """Convert errors of a submission to SubmissionError."""
    try:
        yield
    except (ConfigError, SubmissionBundleError, RunTaskError, LaboratoryError, RunError, OSError) as error:
        raise SubmissionError(_without_places(str(error), settings, folder)) from None


_PATH = re.compile(r"(?<![\w./~])/(?:[^\s/'\":;,()\[\]]+/)+([^\s/'\":;,()\[\]]+)")
"""An absolute path with two or more parts; the group is its last part."""


def _without_places(text: str, settings: DaemonSettings, folder: Path) -> str:
    """Remove this machine's paths from a message, since remote users must not learn its directory structure.

    The campaign's files keep the names that the campaign uses; other paths are reduced to their last part.
    """
    incoming = folder / INCOMING
    homes = [incoming.joinpath(*["campaign"] * depth) for depth in range(4)]
    named = {*homes, *(home.resolve() for home in homes), folder, folder.resolve(), *settings.roots}
    for place in sorted(map(str, named), key=len, reverse=True):
        text = text.replace(f"{place}/", "").replace(place, "the campaign")
    for state in {settings.state, settings.state.resolve()}:  # may contain spaces, which end a match of _PATH
        text = text.replace(f"{state}/", "/-/")
    return _PATH.sub(r"\1", text)


def _received(settings: DaemonSettings, submission: Submission, key: str, by: str) -> QueueItem:
    folder = settings.snapshots / key
    draft = QueueItem(
        id=key,
        name=POUR,
        task=submission.task,
        priority=submission.priority,
        by=by,
        not_before=submission.not_before,
        after=submission.after,
    )
    rig: Rig | None = None
    plan: CampaignPlan | None = None
    if submission.order is not None:
        folder.mkdir(parents=True, mode=0o700)
        submission.order.write(folder)
    else:
        plan, rig, body_hash = _stored(settings, submission, folder)
        draft = draft.model_copy(update={"name": plan.name, "body_hash": body_hash})
    work = run_request(settings, draft, Rig(ANY_RIG))
    if rig is None:
        rig = _rig(settings, submission.rig, work)
        if plan is not None and rig.source is not None:
            _require_laboratory_of(rig, plan, folder)
    elif not work.pours:
        rig = Rig(NO_RIG)
    if rig.source is not None:
        work = run_request(settings, draft, rig)
    mode = "none" if rig.name == NO_RIG else work.campaign.laboratory.mode
    item = draft.model_copy(update={"id": f"{draft.name[:40]}-{key}", "rig": rig.name, "mode": mode})
    folder.rename(settings.snapshots / item.id)
    return item


def _stored(settings: DaemonSettings, submission: Submission, folder: Path) -> tuple[CampaignPlan, Rig | None, str]:
    """Store the self-contained form of a campaign as its snapshot.

    Returns:
        The campaign as it came; the rig, if the campaign names no laboratory; and the digest of the request.
    """
    text, files = submission.text, submission.files or {}
    if submission.path:
        text, files = _from_path(settings, submission.path)
    incoming = folder / INCOMING
    campaign = unpack(text, files, incoming)
    rig = None if names_laboratory(campaign) else _rig_of_all(settings, submission.rig)
    plan = load_confined(campaign, [incoming.resolve()], None if rig is None else rig.source)
    theta = campaign.parent / THETA
    with confined([incoming.resolve(), *([] if rig is None or rig.source is None else [rig.source.parent])]):
        text, files = pack(plan, theta if theta.is_file() else None)
    shutil.rmtree(incoming)
    folder.rmdir()
    unpack(text, files, folder)
    return plan, rig, _digest(text, files, submission, own_laboratory=rig is None)


def _rig_of_all(settings: DaemonSettings, wanted: str) -> Rig | None:
    """The rig of a campaign that names no laboratory; None if there are none, and it has to name one."""
    rigs = [rig for rig in settings.rigs if rig.source is not None and wanted in ("", rig.name)]
    if len(rigs) == 1:
        return rigs[0]
    if not (names := ", ".join(rig.name for rig in settings.rigs if rig.source is not None)):
        return None
    raise SubmissionError(f"the campaign names no 'laboratory'; say on which rig it runs: {names}")


def _digest(text: str, files: Files, submission: Submission, *, own_laboratory: bool) -> str:
    """Digest of a request: of what it contains and how it is to run, whatever its files are called."""
    digests = {name: hashlib.sha256(content.encode()).hexdigest() for name, content in files.items()}
    for name in list(digests):
        if name.endswith(f"/{JOURNAL_NAME}"):
            digests[name.removesuffix(f"/{JOURNAL_NAME}")] = digests[name]

    def named(value: Any) -> Any:
        if isinstance(value, dict):
            return {key: named(entry) for key, entry in value.items()}
        if isinstance(value, list):
            return [named(entry) for entry in value]
        return digests.get(value, value) if isinstance(value, str) else value

    table = {key: named(value) for key, value in json.loads(text).items() if own_laboratory or key != "laboratory"}
    how = [submission.task, submission.rig, submission.priority, submission.not_before, submission.after]
    return hashlib.sha256(json.dumps([table, digests.get(THETA), how], sort_keys=True).encode()).hexdigest()


def _require_laboratory_of(rig: Rig, plan: CampaignPlan, folder: Path) -> None:
    """Refuse a campaign whose laboratory is another one than the rig's. Raises SubmissionError."""
    here = load_confined(folder / CAMPAIGN, [folder.resolve()], rig.source).resolved["laboratory"]
    stored = load_confined(folder / CAMPAIGN, [folder.resolve()]).resolved["laboratory"]
    if (difference := _difference(stored, here, "laboratory")) is not None:
        raise SubmissionError(
            f"{difference} at rig '{rig.name}': the campaign is for another laboratory. Leave out 'laboratory' to run "
            "it on the rig as it is, or name another rig"
        )


NOT_COMPARED = ("ray", "simulators")
"""Keys of a laboratory that a daemon replaces by its own."""


def _difference(sent: Any, here: Any, place: str) -> str | None:
    """The first difference between two laboratories, as '… is 1 here and 2'; None if they are the same."""
    if isinstance(sent, dict) and isinstance(here, dict):
        keys = [key for key in dict.fromkeys((*here, *sent)) if key not in NOT_COMPARED or place != "laboratory"]
        differences = (_difference(sent.get(key), here.get(key), f"{place}: {key}") for key in keys)
        return next(filter(None, differences), None)
    if isinstance(sent, list) and isinstance(here, list) and len(sent) == len(here):
        pairs = enumerate(zip(sent, here, strict=True))
        return next(filter(None, (_difference(*pair, f"{place}.{index}") for index, pair in pairs)), None)
    if sent == here or (_is_file(sent) and _is_file(here) and Path(sent).read_bytes() == Path(here).read_bytes()):
        return None
    shown = ["absent" if value is None else json.dumps(value, ensure_ascii=False)[:80] for value in (sent, here)]
    return f"{place} is {shown[0]} in the campaign and {shown[1]}"


def _is_file(value: Any) -> bool:
    return isinstance(value, str) and value.startswith("/") and Path(value).is_file()


def _from_path(settings: DaemonSettings, text: str) -> tuple[str, Files]:
    """Pack a campaign on this machine from one of the allowed folders."""
    if not settings.roots:
        raise SubmissionError("no campaign may be submitted by its path: the daemon's settings name no 'roots'")
    candidates = [resolved(root / text) for root in settings.roots]
    with confined(settings.roots):
        path = next((file for file in candidates if file.is_file() and _inside(file, settings)), None)
        if path is None:
            raise SubmissionError(f"{text}: there is no such campaign in the folders that may be read (roots)")
        return pack(load_confined(path, settings.roots))


def _inside(path: Path, settings: DaemonSettings) -> bool:
    return any(root in path.parents for root in settings.roots)


def _rig(settings: DaemonSettings, wanted: str, work: RunRequest) -> Rig:
    """Return the requested rig, or the one that matches the campaign's laboratory."""
    names = [rig.name for rig in settings.rigs]
    spec = work.campaign.laboratory
    if wanted:
        if wanted not in (*names, NO_RIG):
            raise SubmissionError(f"there is no rig '{wanted}'; there are {', '.join(names)}")
        if wanted == NO_RIG and work.pours:
            raise SubmissionError(f"'{NO_RIG}' is for campaigns that pour nothing; name one of {', '.join(names)}")
        return settings.rig(wanted)
    if not work.pours:
        return Rig(NO_RIG)
    if settings.rigs[0].source is None:
        if spec.mode != "virtual":
            raise SubmissionError(
                f"laboratory {spec.name} is {spec.mode}; the daemon runs campaigns on hardware only on a rig that its "
                f"settings name: 'rigs: {{{spec.name}: LABORATORY.yaml}}'"
            )
        if not spec.pours:
            raise SubmissionError(f"laboratory {spec.name} has no bench, but the campaign pours")
        return settings.rigs[0]
    fitting = [rig for rig in settings.rigs if rig.spec is not None and spec.name in (rig.name, rig.spec.name)]
    if len(fitting) != 1:
        raise SubmissionError(
            f"no rig is called '{spec.name}', as the campaign's laboratory is; say which it is for, with --rig: "
            f"{', '.join(names)}"
        )
    return fitting[0]
