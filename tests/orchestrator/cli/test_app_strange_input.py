"""`app`: bad input of every kind that a person, a spreadsheet or a camera may make: one clear error, exit code 2."""

from __future__ import annotations

import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from actors.runtime.child_process import child_environment
from tests.support.cli_inputs import ROOT, invoke
from tests.support.waiting import PATIENCE

QUICKSTART, STUDY, VIRTUAL = "campaigns/quickstart.yaml", "studies/quick.yaml", "laboratories/virtual.yaml"

ACTION = "--set angular_velocity=100 --set x_offset=100"

# file to write: the file that it is made of, what is replaced, by what
SPOILT: dict[str, tuple[str, str, str]] = {
    "campaigns/tolerance.yaml": (
        QUICKSTART,
        "receiver_x: [-25 mm, 25 mm]",
        "receiver_x: {measured: 0 mm, tolerance: 3000 km}",
    ),
    "campaigns/measured.yaml": (
        QUICKSTART,
        "receiver_x: [-25 mm, 25 mm]",
        "receiver_x: {measured: .nan mm, tolerance: 3 mm}",
    ),
    "campaigns/many.yaml": (QUICKSTART, "simulations: auto", "simulations: 1000000000000"),
    "campaigns/long.yaml": (QUICKSTART, "name: quickstart", f"name: {'x' * 300}"),
    "campaigns/name.yaml": (QUICKSTART, "name: quickstart", "name: 注ぐ"),
    "campaigns/two.yaml": (QUICKSTART, "name: quickstart", "name: a\n---\nname: quickstart"),
    "campaigns/tag.yaml": (QUICKSTART, "strategy: C4", "strategy: !!python/object:os.system C4"),
    "studies/ever.yaml": (STUDY, "repetitions: 2, points_per_axis: 2", "repetitions: 1000000000, points_per_axis: 2"),
    "studies/twice.yaml": (STUDY, "search: [particles, cohesion]", "search: [particles, particles]"),
    "studies/levels.yaml": (STUDY, "- name: large", "- name: small"),
    "laboratories/many.yaml": (VIRTUAL, "simulators: 0", "simulators: 100000"),
    "laboratories/scale.yaml": (VIRTUAL, "time_scale: 30", "time_scale: .inf"),
    "laboratories/home.yaml": (VIRTUAL, "wrist3: 0 deg", "wrist3: .nan deg"),
}

HEADER = "angular_velocity_deg_s,max_angle_deg,lip_to_receiver_axis_mm,poured_g,spilled_g,retained_g,split\n"
POUR = "15.1,95.0,44.0,200.0,0.4,0.0,train\n"

WRITTEN: dict[str, str | bytes] = {
    "nan.yaml": "name: x\nprofile: {unit: mm, inner: [[0, 0], [.nan, 0], [30, 70]], wall: 4 mm, floor: 4 mm}\n",
    "open.yaml": "listen: {host: 0.0.0.0}\n",
    "port.yaml": "listen: {port: 99999999999999999999}\n",
    "tls.yaml": "listen: {tls: {certificate: README.md, key: README.md}}\n",
    "state.yaml": "state: README.md\n",
    "word.yaml": "notify: {to: ['nonsense://somebody:secret@x']}\n",
    "rigs.yaml": "rigs: {a: laboratories/virtual.yaml, a: laboratories/twin.yaml}\n",
    "twice.json": '{"theta": {"friction": 0.1, "friction": 0.2}}',
    "weight.json": '{"theta": {"friction": 0.1}, "posterior": [{"theta": {"friction": 0.1}, "weight": -1}]}',
    "deep.json": "[" * 100_000,
}


# command line: what stderr has to say
BAD: dict[str, str] = {
    "validate campaigns/tolerance.yaml": "receiver_x.tolerance: 3000 km is outside 0 … 60 mm",
    "validate campaigns/measured.yaml": "receiver_x.measured: '.nan mm' is not a quantity; should be a length",
    "validate campaigns/many.yaml": "calibration.simulations: 1000000000000 is too large; at most 200,000",
    "validate campaigns/long.yaml": "name: has 300 characters; at most 60",
    "validate campaigns/name.yaml": "name: '注ぐ' should consist of letters, digits",
    "validate campaigns/two.yaml": "a file holds one document; remove the '---' line",
    "validate campaigns/tag.yaml": "tag 'tag:yaml.org,2002:python/object:os.system' is not supported",
    "validate studies/ever.yaml": "calibration.C1.repetitions: 1000000000 is too large; at most 10,000",
    "validate studies/twice.yaml": "studies/twice.yaml:11:21: search[1]: 'particles' stands twice; keep one",
    "validate studies/levels.yaml": "mismatch[1]: a level 'small' stands above already",
    "validate laboratories/many.yaml": "simulators: 100000 is too large; at most 10,000",
    "validate laboratories/scale.yaml": "bench.time_scale: inf is not finite",
    "validate laboratories/home.yaml": "arm.home.wrist3: '.nan deg' is not a quantity",
    "validate nan.yaml": "nan.yaml:2:38: profile.inner[1][0]: should be a finite number, got nan",
    "server start open.yaml": "open.yaml:1:16: listen.host: other machines reach this address",
    "server start port.yaml": "listen.port: 99999999999999999999 is too large; at most 65,535",
    "server start tls.yaml": "tls.yaml:1:15: listen.tls: README.md and README.md are not a certificate",
    "server start state.yaml": "README.md is not a folder",
    "server start word.yaml": "word.yaml:1:15: notify.to[0]: is not a URL that apprise knows",
    "server start rigs.yaml": "rigs.a: duplicate key; it stands in line 1 already",
    "plan campaigns/quickstart.yaml --parameters twice.json": "twice.json:1:29: theta.friction: duplicate key",
    f"simulate campaigns/quickstart.yaml {ACTION} --parameters weight.json": "needs a 'theta' and a 'weight' above 0",
    "plan campaigns/quickstart.yaml --parameters deep.json": "is nested more than 30 deep",
}


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("strange") / "files"
    shutil.copytree(ROOT / "configs", folder)
    for name, (source, old, new) in SPOILT.items():
        text = (folder / source).read_text(encoding="utf-8")
        assert old in text
        (folder / name).write_text(text.replace(old, new, 1), encoding="utf-8")
    for name, content in WRITTEN.items():
        (folder / name).write_bytes(content.encode() if isinstance(content, str) else content)
    return folder


@pytest.fixture
def there(place: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Path]:
    """The working directory, which has to stay as it is."""
    monkeypatch.chdir(place)
    before = sorted(place.rglob("*"))
    yield place
    assert sorted(place.rglob("*")) == before


@pytest.mark.parametrize("command", BAD)
def test_strange_input_gets_one_clear_error(command: str, there: Path) -> None:
    result = invoke(command)
    assert isinstance(result.exception, SystemExit), result.exception
    assert result.exit_code == 2, result.stderr
    assert "Traceback" not in result.stderr
    assert BAD[command] in result.stderr
    assert "secret" not in result.stderr.partition(" | ")[0]
    said = [line for line in result.stderr.splitlines() if "|" not in line and "can't be used" not in line]
    assert len(said) == 1, result.stderr


def decant(*words: str | bytes, stdout: int | None = None, **environment: str) -> subprocess.CompletedProcess[bytes]:
    return subprocess.run(
        [sys.executable, "-c", "from orchestrator.cli.app import main; main()", *words],
        stdout=subprocess.PIPE if stdout is None else stdout, stderr=subprocess.PIPE, check=False, timeout=PATIENCE,
        env={**child_environment(), **environment},
    )  # fmt: skip


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
@pytest.mark.parametrize(
    "words", [["--version"], ["queue", "--help"], ["schema", "vessel"]], ids=lambda words: words[0]
)
def test_a_full_disk_below_the_output_is_one_line(words: list[str]) -> None:
    with Path("/dev/full").open("wb") as full:
        done = decant(*words, stdout=full.fileno())
    assert done.returncode == 1
    said = b"decant: the output can't be written completely: No space left on device\n"
    assert done.stderr == said


def test_a_name_is_kept_in_a_locale_without_its_letters(tmp_path: Path) -> None:
    path, sizes = tmp_path / "Gefäß.yaml", ["--height", "95 mm", "--diameters", "5 mm: 60 mm, 95 mm: 72 mm"]
    words = ["vessel", "profile", str(path).encode(), *sizes, "--wall", "3 mm", "--name", "Gefäß".encode()]
    done = decant(*words, LC_ALL="C", PYTHONUTF8="0", PYTHONCOERCECLOCALE="0")
    assert done.returncode == 0, done.stderr.decode()
    assert YAML(typ="safe").load(path)["name"] == "Gefäß"
    assert "Gefäß.png".encode() in done.stderr + done.stdout
    words[2], words[-1] = str(tmp_path / "other.yaml"), b"Gef\xe4\xdf"
    done = decant(*words)
    assert done.returncode == 2
    assert b"should be text in UTF-8" in done.stderr
    assert len(done.stderr.splitlines()) == 1
