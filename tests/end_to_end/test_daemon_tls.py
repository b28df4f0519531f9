"""The daemon behind a certificate that was made a moment ago, and the client that talks to it."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import httpx
import pytest

from actors.runtime.child_process import child_environment
from tests.end_to_end.test_daemon_killed import opened
from tests.support.waiting import PATIENCE

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl makes certificates"),
]


def certificate(folder: Path, name: str) -> Path:
    """One that signed itself, for 127.0.0.1; its key lies beside it."""
    subject = ["-subj", f"/CN={name}", "-addext", "subjectAltName=IP:127.0.0.1", "-days", "2", "-nodes"]
    files = ["-keyout", str(folder / f"{name}.key"), "-out", str(folder / f"{name}.crt")]
    command = ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1"]
    subprocess.run([*command, *subject, *files], check=True, capture_output=True, env=child_environment())
    return folder / f"{name}.crt"


def test_it_is_served_over_tls_and_believed_by_those_only_who_know_its_certificate(tmp_path: Path) -> None:
    ours, others = certificate(tmp_path, "ours"), certificate(tmp_path, "others")
    (tmp_path / "daemon.yaml").write_text(
        "listen: {port: 0, tls: {certificate: ours.crt, key: ours.key}}\nkeep_free: 40 MB\n", encoding="utf-8"
    )
    with opened(tmp_path) as laboratory:
        laboratory.settings, laboratory.environment = ["daemon.yaml"], {"DECANT_CA": str(ours)}
        laboratory.start()
        url = (laboratory.state / "url").read_text().strip()
        assert url.startswith("https://127.0.0.1:")
        assert laboratory.told("queue", "list")["status"]["rigs"][0]["name"] == "virtual"
        laboratory.until(lambda: "simulators" not in laboratory.decant("queue", "list", check=False).stderr)

        for authority, words in (("", "is not believed"), (str(others), "is not believed"), (url, "$DECANT_CA")):
            laboratory.environment = {"DECANT_CA": authority} if authority else {}
            refused = laboratory.decant("queue", "list", check=False)
            assert refused.returncode in (1, 2)
            assert words in refused.stderr
            assert "Traceback" not in refused.stderr
        with pytest.raises(httpx.HTTPError):
            httpx.get(url.replace("https", "http") + "/healthz", timeout=PATIENCE, trust_env=False)
        assert laboratory.end() == 0
