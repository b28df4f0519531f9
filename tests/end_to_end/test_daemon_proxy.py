"""The recipes for nginx and Caddy of docs/laboratory/security.md, as they are written there, on loopback."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
import socket
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


def recipe(proxy: str, address: str, daemon: str) -> str:
    """The block of the page, without TLS and at other addresses."""
    begins = {"nginx": "```nginx\n", "caddy": "```\n(?=lab.example.org {)"}[proxy]
    (block,) = re.findall(rf"^{begins}(.*?)^```", PAGE.read_text(encoding="utf-8"), re.MULTILINE | re.DOTALL)
    if proxy == "caddy":
        block = block.replace("lab.example.org {", f"http://lab.example.org:8080 {{\n    bind {address}")
        return block.replace("127.0.0.1:8377", daemon.removeprefix("http://"))
    block = re.sub(r"^\s*ssl_.*\n", "", block, flags=re.MULTILINE)
    return block.replace("listen 443 ssl", f"listen {address}:8080").replace("http://127.0.0.1:8377", daemon)


def served(proxy: str, folder: Path, text: str) -> list[str]:
    """Write the configuration of a proxy, and return the command that serves it."""
    program = shutil.which(proxy) or shutil.which(f"/usr/sbin/{proxy}")
    if program is None:
        pytest.skip(f"the recipe for {proxy} was not tested: it is not installed (apt-get install {proxy})")
    if proxy == "caddy":
        (folder / "Caddyfile").write_text(f"{{\n    admin off\n}}\n{text}")
        return [program, "run", "--config", str(folder / "Caddyfile")]
    paths = "".join(
        f"{name}_temp_path {folder}/{name};\n" for name in ("client_body", "proxy", "fastcgi", "uwsgi", "scgi")
    )
    user = "user root;\n" if os.geteuid() == 0 else ""
    (folder / "nginx.conf").write_text(
        f"{user}pid {folder}/pid;\nerror_log {folder}/errors;\nevents {{}}\nhttp {{\naccess_log off;\n{paths}{text}}}\n"
    )
    return [program, "-p", str(folder), "-c", str(folder / "nginx.conf"), "-g", "daemon off;"]


@pytest.fixture(params=["nginx", "caddy"])
def proxied(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[tuple[Real, str]]:
    address = free_address()
    with contextlib.closing(Real(tmp_path / "state", names=("lab.example.org",))) as real:
        command = served(request.param, tmp_path, recipe(request.param, address, real.url))
        process = subprocess.Popen(command, env=child_environment() | {"XDG_DATA_HOME": str(tmp_path)})
        try:
            wait_for(lambda: answers(address))
            yield real, f"http://{address}:8080"
        finally:
            process.terminate()
            process.wait()


def answers(address: str) -> bool:
    """Whether something listens there."""
    with socket.socket() as line:
        return line.connect_ex((address, 8080)) == 0


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


@pytest.mark.parametrize("proxied", ["nginx"], indirect=True)  # Caddy passes on no other name
def test_another_name_is_refused_with_the_key_that_allows_it(proxied: tuple[Real, str]) -> None:
    _, url = proxied
    answer = httpx.get(f"{url}/api/v1/status", headers={"Host": "other.example.org"})
    assert answer.status_code == 421
    assert "listen: {names: [lab.example.org]}" in answer.json()["detail"]
