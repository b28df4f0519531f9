"""Backup and restore of a daemon's state directory.

`back_up` writes one zip archive, also while the daemon works: queue, questions, audit entries, orders and materials,
submitted campaigns, runs, and tokens. Recordings and recent events are left out. `restore` writes it into a new state
directory with a paused queue, because pours that were made after the backup are not in it.
"""

from __future__ import annotations

import json
import os
import time
import zipfile
from pathlib import Path, PurePosixPath

from orchestrator.daemon.state.daemon_store import CHECKING, ENDED, PAUSED, DesiredState, Store, StoreError
from orchestrator.materials.vessel_account import FILE_NAME as ACCOUNT
from orchestrator.records.journal import JOURNAL_NAME
from orchestrator.records.journal_check import LEDGER_NAME
from orchestrator.records.journal_file import JournalError, whole_copy
from orchestrator.records.run_registry import make_state_directory

STORE = "daemon.sqlite"
CONTENT = "backup.json"
FORMAT = 1

ATTEMPTS = 20
"""Attempts to copy a journal together with its ledger while a run writes both."""

LEFT_OUT = (".rrd", ".lock", "-wal", "-shm")


class BackupError(StoreError):
    """The backup can't be written or restored; the message gives the reason."""

    exit_code = 2


def back_up(state: Path, target: Path) -> dict[str, int]:
    """Write a backup.

    Args:
        state: state directory of a daemon, which may be running.
        target: archive; must not exist.

    Returns:
        Numbers of campaigns, runs and bytes.

    Raises:
        BackupError: there is no state, the target exists, or a journal changes too quickly.
        OSError: a file can't be read or written.
    """
    if not (state / STORE).is_file():
        raise BackupError(f"{state}: has no {STORE}; --state names the daemon's state directory")
    if target.exists():
        raise BackupError(f"{target}: exists already; name another file")
    unfinished = target.with_name(target.name + ".part")
    runs = sorted(path for path in (state / "runs").glob("*") if path.is_dir())
    campaigns = sorted(path for path in (state / "campaigns").glob("*") if path.is_dir())
    try:
        # The content includes tokens.
        with (
            os.fdopen(os.open(unfinished, os.O_CREAT | os.O_EXCL | os.O_WRONLY, 0o600), "wb") as file,
            zipfile.ZipFile(file, "w", zipfile.ZIP_DEFLATED) as archive,
        ):
            # The store is first: a run that is further than the store continues from its journal.
            archive.writestr(STORE, whole_copy(state / STORE))
            # The account is second: a pour whose result is in the store is in the account.
            if (state / ACCOUNT).is_file():
                archive.writestr(ACCOUNT, whole_copy(state / ACCOUNT))
            if (state / "tokens").is_file():
                archive.write(state / "tokens", "tokens")
            for folder in campaigns:
                _add_folder(archive, folder, state)
            for folder in runs:
                _add_run(archive, folder, state)
            about = {"format": FORMAT, "time": time.time(), "campaigns": len(campaigns), "runs": len(runs)}
            archive.writestr(CONTENT, json.dumps(about))
        unfinished.replace(target)
    finally:
        unfinished.unlink(missing_ok=True)
    return {"campaigns": len(campaigns), "runs": len(runs), "bytes": target.stat().st_size}


def _add_folder(archive: zipfile.ZipFile, folder: Path, state: Path, but: frozenset[str] = frozenset()) -> None:
    for path in sorted(folder.rglob("*")):
        if path.is_file() and path.name not in but and not path.name.endswith(LEFT_OUT):
            archive.write(path, str(path.relative_to(state)))


def _add_run(archive: zipfile.ZipFile, folder: Path, state: Path) -> None:
    journal, ledger = folder / JOURNAL_NAME, folder / LEDGER_NAME
    if not journal.is_file():
        _add_folder(archive, folder, state)
        return
    for _ in range(ATTEMPTS):
        before = ledger.read_bytes() if ledger.is_file() else b""
        copied = whole_copy(journal)
        if before == (ledger.read_bytes() if ledger.is_file() else b""):
            break
        time.sleep(0.1)
    else:
        raise BackupError(f"{folder.name}: its journal changes too quickly; back up between two pours")
    archive.writestr(str(journal.relative_to(state)), copied)
    archive.writestr(str(ledger.relative_to(state)), before)
    _add_folder(archive, folder, state, but=frozenset({JOURNAL_NAME, LEDGER_NAME}))


def restore(source: Path, state: Path) -> dict[str, float]:
    """Restore a backup into a new state directory. The queue is paused, and begun campaigns wait for an operator.

    Args:
        source: archive of `back_up`.
        state: must not exist, or be empty.

    Returns:
        Time of the backup (seconds since 1970) and numbers of campaigns and runs.

    Raises:
        BackupError: the archive is invalid, or the directory is not empty.
        OSError: a file can't be read or written.
    """
    if state.exists() and (not state.is_dir() or any(state.iterdir())):
        raise BackupError(f"{state}: is not empty; a backup is restored into a new state directory")
    try:
        with zipfile.ZipFile(source) as archive:
            about: dict[str, float] = json.loads(archive.read(CONTENT))
            if about.pop("format") != FORMAT:
                raise BackupError(f"{source}: is a backup of another version of Decant")
            if (bad := archive.testzip()) is not None:
                raise BackupError(f"{source}: is damaged ({bad})")
            make_state_directory(state)
            for name in archive.namelist():
                path = PurePosixPath(name)
                if path.is_absolute() or ".." in path.parts:
                    raise BackupError(f"{source}: is no backup ({name})")
                if name != CONTENT:
                    target = state / path
                    target.parent.mkdir(parents=True, exist_ok=True)
                    target.write_bytes(archive.read(name))
                    target.chmod(0o600)
    except (zipfile.BadZipFile, KeyError, ValueError, JournalError) as error:
        raise BackupError(f"{source}: is no backup of a daemon, or is damaged ({error})") from None
    store = Store(state / STORE)
    try:
        store.set_flag(PAUSED, {"by": "restore", "time": time.time()})
        resting = (*ENDED, CHECKING, "queued")
        store.write(
            f"update campaign set desired_state = ? where state not in ({', '.join('?' * len(resting))})",
            *(str(DesiredState.PAUSE), *resting),
        )
        store.note(
            "restore", "restore backup", detail=time.strftime("%Y-%m-%d %H:%M:%S %Z", time.localtime(about["time"]))
        )
    finally:
        store.close()
    return about
