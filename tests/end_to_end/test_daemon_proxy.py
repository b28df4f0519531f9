"""The recipe for nginx of docs/laboratory/security.md, as it is written there, on loopback."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
from collections.abc import Iterator
from pathlib import Path

import httpx
import pytest

from actors.runtime.child_process import child_environment
from orchestrator.daemon.state.access_tokens import Role
from tests.support.daemon_thread import Real
from tests.support.loopback import free_address
from tests.support.waiting import wait_for

pytestmark = pytest.mark.slow

PAGE = Path(__file__).parents[2] / "docs" / "laboratory" / "security.md"


def recipe(address: str, daemon: str) -> str:
    """The server block of the page, without TLS and at other addresses."""
    (block,) = re.findall(r"^```nginx\n(.*?)^```", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    block = re.sub(r"^\s*ssl_.*\n", "", block, flags=re.MULTILINE)
    return block.replace("listen 443 ssl", f"listen {address}:8080").replace("http://127.0.0.1:8377", daemon)


@pytest.fixture
def proxied(tmp_path: Path) -> Iterator[tuple[Real, str]]:
    nginx = shutil.which("nginx") or shutil.which("/usr/sbin/nginx")
    if nginx is None:
        pytest.skip("the recipe for nginx was not tested: it is not installed (apt-get install nginx)")
    real, address = Real(tmp_path / "state", names=("lab.example.org",)), free_address()
    paths = "".join(
        f"{name}_temp_path {tmp_path}/{name};\n" for name in ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
    )
    user = "user root;\n" if os.geteuid() == 0 else ""
    (tmp_path / "nginx.conf").write_text(
        f"{user}pid {tmp_path}/pid;\nerror_log {tmp_path}/errors;\nevents {{}}\n"
        f"http {{\naccess_log off;\n{paths}{recipe(address, real.url)}}}\n"
    )
    command = [nginx, "-p", str(tmp_path), "-c", str(tmp_path / "nginx.conf"), "-g", "daemon off;"]
    process = subprocess.Popen(command, env=child_environment())
    try:
        wait_for((tmp_path / "pid").exists)
        yield real, f"http://{address}:8080"
    finally:
        process.terminate()
        process.wait()
        real.close()


def test_the_recipe_passes_requests_events_and_the_stop_on(proxied: tuple[Real, str]) -> None:
    real, url = proxied
    headers = {"Host": "lab.example.org", "Authorization": f"Bearer {real.token(Role.ADMIN)}"}
    with httpx.Client(base_url=url, headers=headers, timeout=30.0) as client:
        assert client.get("/").status_code == 200
        assert client.get("/api/v1/status").json()["person"]["role"] == "admin"
        with client.stream("GET", "/api/v1/events", params={"after": 0}) as stream:
            lines = stream.iter_lines()
            assert next(lines).startswith(":")
            real.tell(1)
            assert any("LogLine" in line for line in lines)
        assert client.post("/api/v1/emergency-stop", params={"reason": "a test"}).json()["emergency"] is not None
        large = client.post("/api/v1/campaigns", json={"text": "x: 1", "files": {"a": "A" * 2_000_000}})
        assert large.status_code == 409  # of the emergency stop: the proxy has passed it on


def test_another_name_is_refused_with_the_key_that_allows_it(proxied: tuple[Real, str]) -> None:
    _, url = proxied
    answer = httpx.get(f"{url}/api/v1/status", headers={"Host": "other.example.org"})
    assert answer.status_code == 421
    assert "listen: {names: [lab.example.org]}" in answer.json()["detail"]
