"""`submissions`: campaigns that a fuzzer writes: each is queued or refused in words, and a refused one leaves
nothing behind.
"""

from __future__ import annotations

import copy
import json
import random
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.daemon.rigs.submissions import Files, Submission, SubmissionError, pack, prepare
from orchestrator.daemon.state.daemon_settings import DaemonSettings
from tests.support.hypothesis_examples import examples
from tests.support.small_campaign import write_campaign

pytestmark = [pytest.mark.slow, pytest.mark.hypothesis]

QUIET: dict[str, Any] = {"deadline": None, "suppress_health_check": list(HealthCheck)}

SCALARS = st.one_of(
    st.none(),
    st.booleans(),
    st.integers(),
    st.floats(),
    st.text(max_size=20),
    st.sampled_from(
        ["1 mm", "-1 deg", "1e400 g", "nan", "../../etc/passwd", "/etc/passwd", "!!python/object", "*a", "D9"]
    ),
)
VALUES = st.recursive(
    SCALARS,
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=10), inner, max_size=4),
    max_leaves=12,
)
PIECES = st.lists(
    st.one_of(
        st.sampled_from(
            [*list("{}[]:,-&*!|>'\"#%@?\n\t "), "<<: *a", "&a [*a]", "!!python/name:os.system", "? ", "---\n"]
        ),
        st.text(max_size=8),
    ),
    max_size=40,
).map("".join)


class Desk:
    """A daemon's door, and what may be submitted at it."""

    def __init__(self, folder: Path) -> None:
        self.settings = DaemonSettings(folder / "state", in_process=True)
        self.settings.snapshots.mkdir(parents=True)
        self.text, self.files = pack(load_campaign(write_campaign(folder)))
        self.before = self.everything(folder)
        self.folder, self.number = folder, 0

    def submit(self, text: str, files: Files) -> None:
        """Queued, or refused in words."""
        self.number += 1
        try:
            item = prepare(self.settings, Submission(text=text, files=files), f"{self.number:06x}", "somebody")
        except SubmissionError as error:
            refused: SubmissionError | None = error
        else:
            refused = None
        if refused is not None:
            assert str(refused).strip()
            assert "Traceback" not in str(refused)
            assert self.everything(self.folder) == self.before
        else:
            snapshot = self.settings.snapshots / item.id
            assert snapshot.is_dir()
            for path in sorted(snapshot.rglob("*"), reverse=True):
                path.rmdir() if path.is_dir() else path.unlink()
            snapshot.rmdir()

    @staticmethod
    def everything(folder: Path) -> set[Path]:
        return set(folder.rglob("*"))


@pytest.fixture(scope="module")
def desk(tmp_path_factory: pytest.TempPathFactory) -> Desk:
    return Desk(tmp_path_factory.mktemp("fuzzed"))


@settings(max_examples=examples(2000), **QUIET)
@given(text=PIECES)
def test_any_text_is_refused_in_words(desk: Desk, text: str) -> None:
    desk.submit(text, {})


@settings(max_examples=examples(600), **QUIET)
@given(where=st.randoms(use_true_random=False), value=VALUES, what=st.sampled_from(["change", "drop", "add", "cut"]))
def test_a_campaign_with_a_piece_changed_is_queued_or_refused(
    desk: Desk, where: random.Random, value: Any, what: str
) -> None:
    table = json.loads(desk.text)
    if what == "cut":
        desk.submit(desk.text[: where.randrange(len(desk.text))], desk.files)
        return
    changed = copy.deepcopy(table)
    at = changed
    while True:
        keys = list(at) if isinstance(at, dict) else list(range(len(at)))
        key = where.choice(keys)
        if not isinstance(at[key], dict | list) or not at[key] or where.random() < 0.3:
            break
        at = at[key]
    if what == "drop":
        del at[key]
    elif what == "add" and isinstance(at, dict):
        at[str(value)[:20]] = value
    else:
        at[key] = value
    desk.submit(json.dumps(changed), desk.files)
