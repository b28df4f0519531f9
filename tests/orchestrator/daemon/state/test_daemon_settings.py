"""`daemon_settings`: the daemon's settings: strict, with places, and safe unless somebody says otherwise."""

from __future__ import annotations

import socket
from pathlib import Path

import pytest
from typer.testing import CliRunner

from orchestrator.campaigns.yaml.yaml_errors import ConfigError
from orchestrator.cli.app import app
from orchestrator.daemon.state.daemon_settings import DaemonSettings, load_settings

LABORATORY = "{name: numbers, bench: {liquid: {particles: 400}}}\n"


def load(folder: Path, text: str) -> DaemonSettings:
    (folder / "left.yaml").write_text(LABORATORY)
    (folder / "desk.yaml").write_text("{name: thinking}\n")
    (folder / "far.yaml").write_text(LABORATORY.replace("bench", "ray: {address: 10.0.0.1:6379}, bench"))
    path = folder / "decant.yaml"
    path.write_text(text)
    return load_settings(path)


def test_without_a_file_only_this_machine_is_served(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DECANT_STATE", str(tmp_path))
    found = load_settings(None)
    assert (found.state, found.host, found.certificate, found.roots) == (tmp_path, "127.0.0.1", None, ())
    assert [rig.name for rig in found.rigs] == ["virtual"]


def test_a_file_says_what_is_different(tmp_path: Path) -> None:
    found = load(
        tmp_path,
        "state: there\nrigs: {left: left.yaml}\nroots: [.]\nlisten: {port: 9}\n"
        "recordings: {keep: 3}\nkeep_free: 1 GB\n",
    )
    assert found.state == tmp_path / "there"
    assert [(rig.name, rig.mode) for rig in found.rigs] == [("left", "virtual")]
    assert (found.port, found.keep_free) == (9, 1_000_000_000)
    assert found.keep_recordings == 3


def test_a_cluster_where_nothing_answers_is_refused_before_anything_starts(
    tmp_path: Path,
) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.2", 0))
        address = f"127.0.0.2:{free.getsockname()[1]}"
    (tmp_path / "decant.yaml").write_text(f"state: there\nray: {{address: {address}}}\n")
    done = CliRunner().invoke(app, ["server", "start", str(tmp_path / "decant.yaml")])
    assert done.exit_code == 2
    assert f"Ray cluster at {address}: nothing answers there (Connection refused)" in done.output
    assert not (tmp_path / "there").exists()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("rigs: {far: far.yaml}\n", "move 'ray' to the daemon's file"),
        ("ray: {address: 10.0.0.1}\n", "decant.yaml:1:16: ray.address: '10.0.0.1' should be host:port"),
        ("in_process: true\nray: {address: 10.0.0.1:6379}\n", "decant.yaml:2:1: ray: a daemon without Ray"),
    ],
)
def test_what_is_wrong_is_said_with_its_place(tmp_path: Path, text: str, said: str) -> None:
    with pytest.raises(ConfigError) as refused:
        load(tmp_path, text)
    assert said in str(refused.value)
