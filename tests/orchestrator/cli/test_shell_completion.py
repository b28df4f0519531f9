"""`shell_completion`: shell completion, as bash, zsh and fish ask for it."""

from __future__ import annotations

import os
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from tests.orchestrator.catalogue.test_catalogue import made
from tests.support.cli_inputs import invoke
from tests.support.daemon_thread import Real
from tests.support.waiting import PATIENCE

ROOT = Path(__file__).parents[3]


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """A folder with the shipped files and a program called decant."""
    shutil.copytree(ROOT / "configs", tmp_path / "configs")
    program = tmp_path / "bin" / "decant"
    program.parent.mkdir()
    program.write_text(
        f"#!{sys.executable}\nimport sys\nsys.path.insert(0, {str(ROOT)!r})\n"
        "from orchestrator.cli.app import main\n\nmain()\n"
    )
    program.chmod(0o755)
    return tmp_path


def completed(place: Path, shell: str, line: str, **environment: str) -> set[str]:
    """The words that the shell offers at the end of a line."""
    words = line.split(" ")
    environment = {
        **os.environ,
        "PATH": f"{place / 'bin'}:{os.environ['PATH']}",
        "DECANT_STATE": str(place / "state"),
        **environment,
    }
    if shell == "bash":
        shown = 'eval "$(decant --show-completion bash)"'
        ask = f"COMP_WORDS=({shlex.join(words)}); COMP_CWORD={len(words) - 1}; _decant_completion decant"
        command = ["bash", "--norc", "-c", f"{shown}; {ask}; printf '%s\\n' \"${{COMPREPLY[@]}}\""]
    else:
        environment |= {"_DECANT_COMPLETE": f"complete_{shell}", "_TYPER_COMPLETE_ARGS": line}
        environment |= {"_TYPER_COMPLETE_FISH_ACTION": "get-args"}
        command = ["decant"]
    done = subprocess.run(
        command, cwd=place, env=environment, capture_output=True, text=True, timeout=PATIENCE, check=False
    )
    assert "Traceback" not in done.stderr
    if shell == "zsh":
        return {word.strip('"') for word in done.stdout.replace("_arguments '*: :((", "").split("\n") if word} - {"))'"}
    return {word for word in done.stdout.splitlines() if word}


@pytest.mark.slow
@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_a_campaign_is_completed_and_no_other_file(place: Path, shell: str) -> None:
    found = completed(place, shell, "decant run configs/campaigns/q")
    assert found, "nothing offered"
    assert all("configs/campaigns/quickstart.yaml" in word for word in found)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("line", "offered", "missing"),
    [
        ("decant run ", "configs/campaigns/paper.yaml", "configs/laboratories/virtual.yaml"),
        ("decant plan x.yaml --receiver c", "configs/vessels/bowl.yaml", "configs/campaigns/paper.yaml"),
        ("decant robot home configs/l", "configs/laboratories/virtual.yaml", "configs/vessels/bowl.yaml"),
        ("decant study run ", "configs/studies/quick.yaml", "configs/campaigns/paper.yaml"),
        ("decant server start ", "configs/daemon.yaml", "configs/laboratories/virtual.yaml"),
    ],
)
def test_bash_offers_the_files_of_the_kind_that_is_needed(place: Path, line: str, offered: str, missing: str) -> None:
    found = completed(place, "bash", line)
    assert offered in found
    assert missing not in found


@pytest.mark.slow
def test_bash_offers_runs_and_the_vessels_they_used(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DECANT_STATE", str(place / "state"))
    run = made(place)
    assert completed(place, "bash", f"decant runs show {run.name[:2]}") == {run.name}
    (receiver,) = completed(place, "bash", "decant runs pours --receiver ")
    assert completed(place, "bash", f"decant runs list --receiver {receiver[0]}") == {receiver}
    assert completed(place, "bash", "decant runs list --receiver zzz") == set()


@pytest.mark.slow
def test_bash_offers_campaigns_of_the_daemon_and_nothing_without_one(place: Path) -> None:
    assert completed(place, "bash", "decant queue list ") == set()
    real = Real(place / "state")
    try:
        reach = f"--url {real.url} --state {place / 'state'}"
        invoke(f"queue pause {reach}")
        queued = invoke(f"queue submit {place / 'configs/campaigns/quickstart.yaml'} {reach}").stdout.strip()
        environment = {"DECANT_URL": real.url, "DECANT_TOKEN": real.token()}
        assert completed(place, "bash", "decant queue list q", **environment) == {queued}
    finally:
        real.close()
