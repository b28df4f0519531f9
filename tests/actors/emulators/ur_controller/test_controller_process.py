"""`controller_process`: the process: how it starts, that it never outlives its parent, and that no bytes on any
port bring it down.
"""

from __future__ import annotations

import contextlib
import os
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import psutil
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from actors.emulators.ur_controller import VirtualController, VirtualControllerError
from actors.runtime.bench_clock import SharedClock
from actors.runtime.child_process import child_environment
from tests.support.hypothesis_examples import examples
from tests.support.loopback import free_address
from tests.support.waiting import PATIENCE

PORTS = (30001, 30002, 30003, 30004, 30011, 30012, 29999)


def alive(pid: int) -> bool:
    try:
        return bool(psutil.Process(pid).status() != psutil.STATUS_ZOMBIE)
    except psutil.NoSuchProcess:
        return False


def gone(pid: int, seconds: float = 60.0) -> bool:
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        if not alive(pid):
            return True
        time.sleep(0.02)
    return False


def greeting(address: str) -> bytes:
    with socket.create_connection((address, 29999), timeout=5) as connection:
        return connection.recv(100)


@pytest.mark.realtime
def test_it_is_ready_when_it_says_so_and_gone_when_it_is_closed() -> None:
    controller = VirtualController.start(address=free_address())
    assert greeting(controller.address).startswith(b"Connected: Universal Robots Dashboard Server")
    assert controller.alive
    controller.close()
    assert not controller.alive
    with pytest.raises(OSError, match="refused"):
        greeting(controller.address)
    controller.close()  # once more does no harm


@pytest.mark.realtime
def test_the_arm_begins_where_it_is_told_to() -> None:
    joints = [0.1, -1.2, 1.3, -1.4, -1.5, 1.6]
    with VirtualController.start(address=free_address(), joints=joints, state="idle") as controller:
        state = controller.fault("state")
    assert state["joints"] == pytest.approx(joints)
    assert state["robot_mode"] == "IDLE"


@pytest.mark.realtime
def test_an_address_that_is_taken_is_told(shared: VirtualController) -> None:
    with pytest.raises(VirtualControllerError, match=f"{shared.address}.*is another one running there"):
        VirtualController.start(address=shared.address)


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.parametrize(
    ("options", "says"),
    [
        ({"address": "0.0.0.0"}, "only loopback"),
        ({"address": "192.168.0.1"}, "only loopback"),
        ({"time_scale": 0.0}, "scale"),
        ({"time_scale": float("nan")}, "scale"),
        ({"frequency": 1.0}, "Hz"),
        ({"model": "ur6"}, "ur10"),
        ({"joints": [0.0, 1.0]}, "six numbers"),
        ({"joints": [0.0, 0.0, 0.0, 0.0, 0.0, 9.0]}, "joint 6 \\(wrist 3\\)"),
    ],
)
def test_settings_that_make_no_sense_are_told(options: dict[str, object], says: str) -> None:
    with pytest.raises(VirtualControllerError, match=says):
        VirtualController.start(**{"address": free_address(), **options})  # type: ignore[arg-type]


PARENT = """
import os, sys, time
from actors.emulators.ur_controller import VirtualController
controller = VirtualController.start(address=sys.argv[1], clock=sys.argv[3])
if sys.argv[2] == "fork":
    if os.fork() == 0:  # holds the controller's standard input open
        time.sleep(20)
        os._exit(0)
print(controller.pid, flush=True)
time.sleep(60)
"""


@pytest.mark.realtime
@pytest.mark.parametrize("how", ["plain", "fork"])
def test_it_dies_with_a_parent_that_is_killed_and_leaves_no_file(how: str, tmp_path: Path) -> None:
    address, clock = free_address(), tmp_path / "bench" / "clock"
    clock.parent.mkdir()
    SharedClock.create(clock)
    parent = subprocess.Popen(
        [sys.executable, "-c", PARENT, address, how, str(clock)],
        stdout=subprocess.PIPE,
        text=True,
        start_new_session=True,
        env=child_environment(),
    )
    try:
        assert parent.stdout is not None
        pid = int(parent.stdout.readline())
        assert alive(pid)
        parent.kill()
        parent.wait()
        assert gone(pid)
        assert list(tmp_path.iterdir()) == []
    finally:
        parent.kill()
        with contextlib.suppress(ProcessLookupError):
            os.killpg(parent.pid, signal.SIGKILL)
        parent.stdout.close()


HANGING = """
import asyncio, os, re, sys
from actors.emulators.ur_controller.control_clock import until_orphaned

async def main():
    asyncio.get_running_loop().call_later(1.0, lambda: re.match("(a+)+$", "a" * 60 + "b"))  # holds the interpreter
    print(os.getpid(), flush=True)
    await until_orphaned(os.getppid(), interval=0.1, hung=2.0)

asyncio.run(main())
"""


@pytest.mark.realtime
def test_an_interpreter_that_hangs_ends_all_the_same() -> None:
    with tempfile.TemporaryFile() as complaints:
        process = subprocess.Popen(
            [sys.executable, "-c", HANGING],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=complaints,
            env=child_environment(),
        )
        try:
            assert process.stdout is not None
            assert int(process.stdout.readline()) == process.pid
            assert process.wait(60) == -signal.SIGALRM
        finally:
            process.kill()
            process.communicate()
        complaints.seek(0)
        assert b"most recent call first" in complaints.read()


@pytest.mark.realtime
def test_the_clock_never_waits_for_another_thread(fresh: Callable[..., VirtualController]) -> None:
    """One of usual priority would hold it up for as long as others keep the cores."""
    controller = fresh(time_scale=1.0)
    assert controller.fault("state")["timing"]["ticks"] > 0
    assert psutil.Process(controller.pid).num_threads() == 1


def send(controller: VirtualController, text: bytes, most: float = 60.0) -> float:
    """Send text as a program. Returns the latest wake-up of the clock so far [s]."""
    with (
        contextlib.suppress(ConnectionError),
        socket.create_connection((controller.address, 30003), timeout=most) as port,
    ):
        port.sendall(text)
    greeting(controller.address)
    return float(controller.fault("state", timeout=most)["timing"]["worst"])


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.parametrize(
    ("text", "says"),
    [
        (b"x=1\n" * 6_000 + b'textmsg("all of them")\n', "all of them"),
        (b"def f():\n" + b"  x = 1\n" * 20_000 + b"  sleep(100)\nend\n", "program f started"),
        (b"def f():\n" + b"  x = 1\n" * 400_000, "without an end"),
        (b"a = [0]\n" + b"def f():\n a = [0]\n while True:\n  a = [a, a]\n end\nend\n", "more than 10000 entries"),
    ],
    ids=["many", "long", "endless", "growing"],
)
def test_no_program_takes_the_clock_its_time(fresh: Callable[..., VirtualController], text: bytes, says: str) -> None:
    controller = fresh(time_scale=1.0, frequency=125.0)
    late = send(controller, text)
    end = time.monotonic() + PATIENCE
    while True:
        state = controller.fault("state", timeout=20.0)
        late = max(late, state["timing"]["worst"])
        if any(says in message for message in state["messages"]):
            break
        assert time.monotonic() < end, state["messages"]
        time.sleep(0.1)
    assert late < 1.0, f"the clock was {late:.2f} s late"


@pytest.mark.realtime
@pytest.mark.parametrize("port", [30001, 30002, 30003])
@pytest.mark.parametrize(
    ("text", "says"),
    [
        (b"def a(x):\n textmsg(1)\nend\n", "program 'a' must not have parameters"),
        (b"def a(\n textmsg(1)\nend\n", "compile error: expected"),
        (b"def a():\n def b(x):\n  return 1\n end\n b()\nend\n", "wrong use"),
        (b"\xff\xfe\x00def a(\x80):\nend\n", "compile error"),
        (b"def a(x):\n" + b"  y = 1\n" * 10_000 + b"end\n", "program 'a' must not have parameters"),
        (b"def a():\n" + b"  x = 1234567890\n" * 70_000, "without an end"),
    ],
    ids=["parameters", "malformed", "nested", "binary", "long", "endless"],
)
def test_a_program_that_can_not_be_run_is_refused_and_the_next_one_runs(
    shared: VirtualController, port: int, text: bytes, says: str
) -> None:
    def run(sent: bytes, wanted: str, mark: str = "") -> None:
        """Send a program and wait for a message that comes after the mark."""
        with socket.create_connection((shared.address, port), timeout=PATIENCE) as connection:
            with contextlib.suppress(ConnectionError):  # too much without an end is cut off
                connection.sendall(sent)
            end = time.monotonic() + PATIENCE
            while True:
                messages = shared.fault("state", timeout=PATIENCE)["messages"]
                after = messages.index(mark) + 1 if mark else 0
                if any(wanted in message for message in messages[after:]):
                    return
                assert time.monotonic() < end, messages
                time.sleep(0.02)

    first, last = f"first {os.urandom(8).hex()}", f"last {os.urandom(8).hex()}"
    run(f'sec first():\n textmsg("{first}")\nend\n'.encode(), first)
    run(text, says, f"text: {first}")
    run(f'def last():\n textmsg("{last}")\nend\n'.encode(), last, f"text: {first}")
    assert shared.alive


def test_the_clock_has_the_priority_of_other_work(fresh: Callable[..., VirtualController]) -> None:
    """A higher one takes processor time from the programs that it serves."""
    controller = fresh(time_scale=1.0)
    assert os.sched_getscheduler(controller.pid) & 0xFF == os.SCHED_OTHER
    assert os.getpriority(os.PRIO_PROCESS, controller.pid) >= os.getpriority(os.PRIO_PROCESS, 0)


sizes = st.integers(0, 70_000)


@pytest.mark.realtime
@settings(max_examples=examples(25), deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(port=st.sampled_from((*PORTS, 0)), data=st.one_of(st.binary(max_size=200), sizes.map(os.urandom)))
def test_no_bytes_on_any_port_bring_it_down(shared: VirtualController, port: int, data: bytes) -> None:
    try:
        with socket.create_connection((shared.address, port or shared.fault_port), timeout=5) as connection:
            connection.sendall(data)
            connection.shutdown(socket.SHUT_WR)
    except (ConnectionError, OSError):
        pass  # it may have been cut off
    assert shared.alive
    assert greeting(shared.address).startswith(b"Connected")


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.parametrize("port", PORTS)
def test_connections_that_come_and_go_or_never_read_do_no_harm(shared: VirtualController, port: int) -> None:
    connections = [socket.create_connection((shared.address, port), timeout=5) for _ in range(50)]
    for connection in connections[::2]:
        connection.close()
    assert greeting(shared.address).startswith(b"Connected")
    for connection in connections[1::2]:
        connection.close()
    assert shared.fault("state")["safety_mode"] == "NORMAL"
