"""`rtde_worker`: its messages to a driver that does not read them."""

from __future__ import annotations

import socket
import threading
from multiprocessing.connection import Connection

from actors.arm.ur.rtde_worker import Worker
from actors.arm.ur.worker_messages import MotionProgress

REPORTS = 5000
"""More than the connection holds: of a motion of four minutes."""


def test_a_driver_that_reads_nothing_delays_no_motion() -> None:
    ours, theirs = socket.socketpair()
    worker = Worker(Connection(theirs.detach()))
    sent = threading.Event()

    def report() -> None:
        for count in range(REPORTS):
            worker._report(MotionProgress(float(count), (0.1,) * 6, True))
        sent.set()

    driver = Connection(ours.detach())  # left open: a worker whose driver is gone ends its process
    threading.Thread(target=report, daemon=True).start()
    in_time = sent.wait(30.0)
    assert driver.recv().clock == 0.0
    while driver.poll(0.0 if sent.is_set() else 1.0):
        latest = driver.recv()
    assert in_time
    worker._report(MotionProgress(1e6, (0.1,) * 6, True))
    assert driver.recv().clock == 1e6 > latest.clock
