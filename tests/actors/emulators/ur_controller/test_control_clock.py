"""`control_clock`: a host that is late, or busy with a long program, stretches the controller's time and no more."""

from __future__ import annotations

import asyncio
import socket
import sys
import threading
from pathlib import Path
from typing import Any

import pytest

from actors.arm.ur import rtde
from actors.emulators.ur_controller import VirtualController
from actors.emulators.ur_controller.control_clock import Host
from actors.emulators.ur_controller.controller import Controller
from actors.emulators.ur_controller.program_uploads import LONG_PROGRAM
from actors.emulators.ur_controller.robot import MODELS
from actors.runtime.bench_clock import SharedClock
from tests.support.loopback import free_address
from tests.support.waiting import wait_for

PROGRAM = "def long():\n" + "  x = 1\n" * (LONG_PROGRAM // 8 + 1) + "  sleep(1000)\nend\n"

PACKAGES = 15
"""While the clock creeps they come five times a second, so that the unmodified ur-rtde would lose its connection, after
2.5 s, to a controller that sends none."""


class SlowTranslation:
    """A controller whose host needs for a translation as long as the test says."""

    def __init__(self) -> None:
        self.address = free_address()
        self.translate, self.translating = threading.Event(), threading.Event()
        self.controller = Controller(MODELS["ur10e"], frequency=125.0)
        translated = self.controller.translated

        def slowly(text: str) -> Any:
            self.translating.set()
            assert self.translate.wait(240.0)
            return translated(text)

        self.controller.translated = slowly  # type: ignore[method-assign]
        self._started, self._end = threading.Event(), asyncio.Event()
        self._thread = threading.Thread(target=lambda: asyncio.run(self._serve()), daemon=True)

    async def _serve(self) -> None:
        host = Host(self.controller, self.address)
        await host.open()
        host.start()
        self._loop = asyncio.get_running_loop()
        self._started.set()
        await self._end.wait()

    def __enter__(self) -> SlowTranslation:
        self._thread.start()
        assert self._started.wait(60.0)
        return self

    def __exit__(self, *_: object) -> None:
        self.translate.set()
        self._loop.call_soon_threadsafe(self._end.set)
        self._thread.join(60.0)

    def upload(self) -> None:
        with socket.create_connection((self.address, 30003), timeout=60.0) as port:
            port.sendall(PROGRAM.encode())
            assert self.translating.wait(60.0)


@pytest.mark.realtime
def test_clients_get_packages_with_new_times_while_a_program_is_translated() -> None:
    with SlowTranslation() as slow, socket.create_connection((slow.address, rtde.PORT), timeout=60.0) as connection:
        outputs = rtde.Outputs(rtde.Requests(connection), ("timestamp",), 125.0)
        slow.upload()
        begin, times = slow.controller.now, list[float]()
        while len(times) < PACKAGES:
            (moment,) = outputs.values(outputs.next())["timestamp"]
            times += [moment] if moment > begin else []
        assert times == sorted(set(times))
        assert slow.controller.program is None
        slow.translate.set()
        wait_for(lambda: slow.controller.program is not None, "the program runs")


CLIENT = """
import sys
from rtde_receive import RTDEReceiveInterface
client = RTDEReceiveInterface(sys.argv[1], 125.0, ["timestamp"])
print("connected", flush=True)
for line in sys.stdin:
    print(client.isConnected(), client.getTimestamp(), flush=True)
"""


@pytest.mark.realtime
def test_the_unmodified_ur_rtde_keeps_its_connection_meanwhile() -> None:
    pytest.importorskip("rtde_receive")
    from actors.runtime.child_process import ChildProcess

    with SlowTranslation() as slow:
        client = ChildProcess([sys.executable, "-c", CLIENT, slow.address])
        try:
            assert client.read_line(60.0) == b"connected\n"
            slow.upload()
            times: set[bytes] = set()

            def seen() -> bool:
                client.write(b"\n")
                connected, moment = client.read_line(60.0).split()
                assert connected == b"True"
                times.add(moment)
                return len(times) > PACKAGES + 3

            wait_for(seen, "new times", poll=0.05)
        finally:
            client.kill()
            client.release()


@pytest.mark.realtime
def test_the_controller_waits_for_a_program_that_is_late(tmp_path: Path) -> None:
    """So its watchdogs, and a cup that turns back without commands, do not see the host's lateness."""
    SharedClock.create(tmp_path / "clock")
    driver = SharedClock(tmp_path / "clock")
    with VirtualController.start(free_address(), time_scale=10.0, clock=str(tmp_path / "clock")) as controller:

        def time_now() -> float:
            return float(controller.fault("state", timeout=60.0)["time"])

        wait_for(lambda: time_now() > 0.0, "its clock runs")
        driver.promise("arm", 0.5)
        begin = driver.now
        wait_for(lambda: driver.now > begin + 0.45, "it uses the time that it has")
        for _ in range(30):
            standing = time_now()
            assert driver.now <= begin + 0.5
        driver.promise("arm", 0.5)
        wait_for(lambda: time_now() > standing + 1.0, "it goes on when the program acts")


@pytest.mark.realtime
def test_all_devices_of_a_bench_have_the_time_of_the_controller(tmp_path: Path) -> None:
    """The balance ages as the controller does, however late the host is."""
    from actors.emulators.serial_balance.balance_process import VirtualSerialBalance

    SharedClock.create(tmp_path / "clock")
    turned = SharedClock(tmp_path / "clock")  # no controller: the test turns the clock
    balance = VirtualSerialBalance.start("kcp", baud=0, time_scale=10.0, clock=str(tmp_path / "clock"))
    try:
        before = balance.state()["time"]
        assert balance.state()["time"] == before, "it stands with the clock"
        turned.advance(0.5)
        assert balance.state()["time"] == pytest.approx(before + 5.0)
    finally:
        balance.close()
