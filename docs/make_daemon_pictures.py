"""Draws docs/images/daemon: a real daemon on a virtual bench, seen through a real browser by somebody at the bench.

Nothing is staged: a campaign is submitted, questions are answered over the API as people would, the daemon is killed
in the middle of a pour and started again. Run from the project's root, with Chromium installed:
python docs/make_daemon_pictures.py
"""

from __future__ import annotations

import base64
import contextlib
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
from playwright.sync_api import Browser, Page, sync_playwright

from actors.runtime.child_process import child_environment

FOLDER = Path(__file__).parent / "images" / "daemon"
SIZES = {"tablet": (1024, 768), "desk": (1440, 1080)}
PAGE_TIMEOUT = 900.0

VESSEL = """\
name: {name}
profile: {{unit: mm, inner: [[0, 0], [{radius}, 0], [{radius}, {height}]], wall: 4 mm, floor: 4 mm}}
"""
VESSELS = {"beaker": (30, 70), "narrow": (20, 90)}

LABORATORY = """\
name: bench
simulators: 1
arm: {kind: simulated}
balance: {kind: simulated}
operator: {answers: person}
bench: {liquid: {particles: 400, cohesion: 0.05 N/m}, pose_error: {x: 1 mm}, time_scale: 2}
"""

CAMPAIGN = """\
name: narrow-glass
seed: 3
laboratory: bench.yaml
liquid: {name: water, mass: 100 g}
pourer: beaker.yaml
motion: {hold_time: 0.3 s, return_velocity: 180 deg/s}
simulator: {parameters: {particles: 300, cohesion: 0.05 N/m}}
deployment:
  strategy: D3
  receiver: narrow.yaml
  motion: {max_angle: 115 deg, height: 60 mm}
  actions: {angular_velocity: [60 deg/s, 180 deg/s], x_offset: [60 mm, 100 mm]}
  prior_simulations: 6
  pours: 6
  simulations_per_pour: 2
outputs: {recording: false}
"""


class Lab:
    """A daemon as a process, and somebody who answers.

    Args:
        folder: for its state and its files.
    """

    def __init__(self, folder: Path) -> None:
        self.folder, self.state = folder, folder / "state"
        for name, (radius, height) in VESSELS.items():
            (folder / f"{name}.yaml").write_text(VESSEL.format(name=name, radius=radius, height=height))
        (folder / "bench.yaml").write_text(LABORATORY)
        (folder / "campaign.yaml").write_text(CAMPAIGN)
        robot = Path(__file__).parent.parent / "configs" / "laboratories" / "ur10-kern.yaml"
        (folder / "one.yaml").write_text(
            "listen: {port: 0}\nrigs: {bench: bench.yaml}\nin_process: true\nkeep_free: 40 MB\n"
        )
        (folder / "two.yaml").write_text(
            f"listen: {{port: 0}}\nrigs: {{bench: bench.yaml, north: {robot}}}\nin_process: true\nkeep_free: 40 MB\n"
        )
        self.process: subprocess.Popen[bytes] | None = None
        self.url = self.token = ""

    def start(self, settings: str = "one.yaml") -> None:
        """`decant server start`."""
        command = [Path(sys.executable).with_name("decant"), "server", "start", settings, "--state", self.state]
        with (self.folder / "log").open("ab") as log:
            self.process = subprocess.Popen(
                command, cwd=self.folder, stdout=log, stderr=log, start_new_session=True, env=child_environment()
            )
        until((self.state / "url").is_file)
        self.url = (self.state / "url").read_text().strip()
        lines = (self.state / "tokens").read_text().splitlines()
        self.token = next(line.split()[2] for line in lines if line.startswith("admin "))

    def end(self, number: int = signal.SIGTERM) -> None:
        """End it, and what it started."""
        if self.process is not None:
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self.process.pid, number)
            try:
                self.process.wait(60)
            except subprocess.TimeoutExpired:
                os.killpg(self.process.pid, signal.SIGKILL)
                self.process.wait()
            self.process = None
            (self.state / "url").unlink(missing_ok=True)

    def call(self, path: str, body: Any = None, method: str = "GET") -> Any:
        """One call to the API."""
        headers = {"Authorization": f"Bearer {self.token}"}
        answer = httpx.request(method, f"{self.url}/api/v1/{path}", headers=headers, json=body, timeout=60)
        answer.raise_for_status()
        return answer.json()

    def submit(self, name: str) -> str:
        """Queue the campaign under a name."""
        text = CAMPAIGN.replace("narrow-glass", name)
        files = {f.name: f.read_bytes() for f in self.folder.glob("*.yaml") if f.name in text}
        body = {"text": text, "files": {k: base64.b64encode(v).decode() for k, v in files.items()}, "rig": "bench"}
        return str(self.call("campaigns", body, "POST")["id"])

    def answer_until(self, met: Callable[[dict[str, Any]], bool]) -> None:
        """Answer what is asked as a good operator would, until a question is met that fits: that one is left open."""
        deadline = time.monotonic() + PAGE_TIMEOUT
        while time.monotonic() < deadline:
            for question in self.call("questions"):
                if met(question):
                    return
                said = {"done": "done", "yes or no": "yes"}.get(question["wants"], "repeat")
                with contextlib.suppress(httpx.HTTPStatusError):
                    self.call(f"questions/{question['id']}/answer", {"answer": said}, "POST")
            time.sleep(0.1)
        raise TimeoutError

    def checkpoint(self) -> str:
        """Of the pour that is under way."""
        return str(next(rig for rig in self.call("rigs") if rig["name"] == "bench")["checkpoint"])


def until(met: Callable[[], object]) -> None:
    """Wait for something."""
    deadline = time.monotonic() + PAGE_TIMEOUT
    while not met():
        if time.monotonic() > deadline:
            raise TimeoutError
        time.sleep(0.05)


@contextlib.contextmanager
def seen(browser: Browser, lab: Lab, size: str) -> Iterator[Page]:
    """The page on a screen."""
    width, height = SIZES[size]
    page = browser.new_page(viewport={"width": width, "height": height}, locale="en-GB")
    page.goto(f"{lab.url}/#token={lab.token}")
    page.locator(".card").first.wait_for(timeout=1e3 * PAGE_TIMEOUT)
    yield page
    page.close()


def picture(
    browser: Browser, lab: Lab, name: str, size: str, act: Callable[[Page], object] = lambda page: None
) -> None:
    """One picture."""
    with seen(browser, lab, size) as page:
        act(page)
        page.wait_for_timeout(600)
        page.screenshot(path=FOLDER / f"{name}.png")
    print(FOLDER / f"{name}.png")


def main() -> None:
    """Draw them all."""
    FOLDER.mkdir(parents=True, exist_ok=True)
    chromium = os.environ.get("DECANT_CHROMIUM") or shutil.which("chromium")
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=chromium, args=["--no-sandbox"])
        lab = Lab(Path(folder))
        try:
            draw(browser, lab)
        except BaseException:
            print((lab.folder / "log").read_text()[-3000:])
            raise
        finally:
            lab.end(signal.SIGKILL)
            browser.close()


def draw(browser: Browser, lab: Lab) -> None:
    """From the first question to the emergency stop."""
    lab.start()
    first = lab.submit("narrow-glass")
    for name in ("wide-glass", "tall-glass"):
        lab.submit(name)
    pours = 0

    def third(question: dict[str, Any]) -> bool:
        nonlocal pours
        pours += question["about"] == "pourer_full"
        return pours == 3

    lab.answer_until(third)
    picture(browser, lab, "question-tablet", "tablet")
    lab.answer_until(lambda question: question["wants"] == "yes or no")
    with seen(browser, lab, "desk") as page:
        page.get_by_role("button", name="Yes").click()
        until(lambda: lab.checkpoint() == "tilt")
        page.locator(".step", has_text="tilting").wait_for(timeout=1e3 * PAGE_TIMEOUT)
        page.screenshot(path=FOLDER / "running-desk.png")
    lab.end(signal.SIGKILL)  # in the middle of the pour
    lab.start("two.yaml")
    lab.answer_until(lambda question: question["kind"] == "unknown")
    with seen(browser, lab, "tablet") as page:
        page.wait_for_timeout(600)
        page.screenshot(path=FOLDER / "unknown-tablet.png")
        page.get_by_label("Spilled").fill("3,2")
        page.get_by_label("Left in the pourer").fill("0,4")
        page.get_by_role("button", name="It was weighed").click()
        page.locator("#pours").get_by_text("3.2 g").first.wait_for(timeout=1e3 * PAGE_TIMEOUT)
    lab.answer_until(lambda question: lab.call(f"campaigns/{first}")["state"] == "finished")
    lab.answer_until(lambda question: question["wants"] == "yes or no")
    number = lab.call("questions")[0]["id"]
    lab.call(f"questions/{number}/answer", {"answer": "yes"}, "POST")
    until(lambda: lab.checkpoint() == "tilt")
    lab.call("emergency-stop?reason=the+tray+slipped", method="POST")
    picture(
        browser,
        lab,
        "emergency-tablet",
        "tablet",
        lambda page: page.get_by_role("button", name="Clear the stop").click(),
    )


if __name__ == "__main__":
    main()
