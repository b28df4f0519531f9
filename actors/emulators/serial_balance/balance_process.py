"""Starts an emulated serial balance in a child process, which ends with this process.

`VirtualSerialBalance` starts an emulated balance and controls it; `SerialBalanceEmulator` is the balance of a virtual
bench. The emulation itself is in `emulated_balance`, the process in `line_server`.
"""

from __future__ import annotations

import contextlib
import json
import os
import tempfile
import threading
from pathlib import Path
from typing import Any

from actors.balance.balance_settings import AUTO, BalanceSettings, SerialBalanceSettings
from actors.balance.dialect_registry import encoders
from actors.balance.scale_model import Load, ScaleSettings
from actors.interfaces import LaboratoryError
from actors.runtime.child_process import START_DEADLINE, ChildProcess, python_module
from actors.runtime.ray_cleanup import MARK

REPLY_TIMEOUT = 120.0
"""Longest wait for the process to reply [s]."""

GRACE = 10.0
"""Longest wait for the process to end by itself [s]."""


class FarProcess:
    """A child process that serves a pseudo-terminal, or a TCP connection as a serial server does.

    Args:
        settings: for the process.
        baud: speed of the line; 0: any speed, and characters take no time.
        tcp: serve a TCP connection.

    Attributes:
        module: that the process runs; it calls `line_server.serve`.

    Raises:
        LaboratoryError: the process did not start.
    """

    module = "actors.emulators.serial_balance.line_server"

    def __init__(self, settings: dict[str, Any], baud: int, tcp: bool = False) -> None:
        # With a Ray cluster of its own, in that cluster's folder, which is removed even after the program was killed.
        folder = Path(tempfile.mkdtemp(prefix="decant-balance-", dir=os.environ.get(MARK)))
        self.port = self._link = str(folder / "balance")
        """Address of the line; it stays the same when the line is unplugged and plugged in again."""
        self._lock = threading.Lock()
        text = json.dumps({**settings, "link": self._link, "baud": baud, "tcp": tcp})
        self._process = ChildProcess(python_module(self.module, text), prompt=True)
        try:
            self.port = self._answer(START_DEADLINE)["port"]
        except BaseException:
            self.close()
            raise

    @property
    def pid(self) -> int:
        """Process id."""
        return self._process.pid

    def unplug(self) -> None:
        """Unplug the line: the port vanishes."""
        self.order("unplug")

    def plug(self) -> None:
        """Plug the line in again: another device under the same path."""
        self.order("plug")

    def order(self, kind: str, **values: Any) -> dict[str, Any]:
        """Send a command and wait until it is executed.

        Raises:
            LaboratoryError: the command failed, or the process has ended.
        """
        with self._lock:
            try:
                self._process.write(json.dumps({"do": kind, **values}).encode("ascii") + b"\n")
            except (OSError, ValueError) as error:
                raise LaboratoryError(f"virtual balance at {self.port}: its process is gone{self._end()}") from error
            return self._answer()

    def close(self) -> None:
        """End the process. May be called again."""
        self._process.close(GRACE)
        with contextlib.suppress(OSError):
            Path(self._link).unlink(missing_ok=True)
            Path(self._link).parent.rmdir()

    def _answer(self, within: float = REPLY_TIMEOUT) -> dict[str, Any]:
        try:
            answer: dict[str, Any] = json.loads(self._process.read_line(within))
        except TimeoutError:
            raise LaboratoryError(f"virtual balance at {self.port}: no answer within {within:g} s") from None
        except (EOFError, OSError, ValueError):
            raise LaboratoryError(f"virtual balance at {self.port}: its process has ended{self._end()}") from None
        if "error" in answer:
            raise LaboratoryError(f"virtual balance at {self.port}: {answer['error']}")
        return answer

    def _end(self) -> str:
        """Describe how the process ended, for an error message."""
        self._process.wait(1.0)
        reason = f": {self._process.last_error}" if self._process.last_error else ""
        return f" (status {self._process.status}{reason})"


class VirtualSerialBalance(FarProcess):
    """A running emulated balance.

    Create it with `start`; a driver opens its `port`.
    """

    @classmethod
    def start(
        cls,
        dialect: str = "kcp",
        *,
        baud: int = 9600,
        scale: ScaleSettings | None = None,
        time_scale: float = 1.0,
        latency: float = 0.01,
        seed: tuple[int, ...] = (0,),
        tcp: bool = False,
        clock: str = "",
    ) -> VirtualSerialBalance:
        """Start an emulated balance without a load.

        Args:
            dialect: one of `actors.balance.dialect_registry.encoders`.
            baud: speed of the line; 0: any speed, and characters take no time.
            scale: data sheet of the scale.
            time_scale: bench seconds per second of the clock; 0: bench time passes by `advance` only.
            latency: time between query and reply [s of the clock].
            seed: of noise and of faults.
            tcp: behind a serial server: its `port` is then `127.0.0.1:…`.
            clock: file of the bench's clock; '' for the wall clock.

        Raises:
            LaboratoryError: it did not start.
        """
        if dialect not in encoders():
            raise LaboratoryError(f"no virtual balance speaks '{dialect}'; there are {', '.join(encoders())}")
        settings = {
            "dialect": dialect,
            "scale": (scale or ScaleSettings()).model_dump(),
            "time_scale": time_scale,
            "latency": latency,
            "seed": list(seed),
            "clock": clock,
        }
        return cls(settings, baud, tcp)

    def put(self, load: Load | float) -> None:
        """Set the load from now on.

        Args:
            load: a mass [kg], or masses over bench time.
        """
        load = load if isinstance(load, Load) else Load((0.0,), (load,))
        self.order("put", times=list(load.times), masses=list(load.masses))

    def prepare(self, seed: tuple[int, ...]) -> None:
        """Empty the scale, set bench time to 0, clear the tare, and reseed the noise."""
        self.order("prepare", seed=list(seed))

    def faults(self, **changes: Any) -> None:
        """Change faults (see `emulated_balance.BalanceFaults`); others stay as they are."""
        self.order("faults", **changes)

    def advance(self, seconds: float) -> None:
        """Let bench time pass, independent of the clock [s]."""
        self.order("advance", seconds=seconds)

    def power_cycle(self) -> None:
        """Switch the balance off and on: the tare is cleared, and the current load becomes the zero. The port stays."""
        self.order("power cycle")

    def state(self) -> dict[str, Any]:
        """Return the true load [kg], the display, bench time [s] and the number of received commands."""
        return self.order("state")


USUAL_DIALECT = "kcp"
"""Dialect of the emulated balance if the settings name none."""


class SerialBalanceEmulator:
    """See `actors.balance.balance_settings.BalanceEmulator`.

    Args:
        spec: dialect and time scale.
        scale: data sheet of the scale.

    Raises:
        LaboratoryError: it did not start.
    """

    def __init__(self, spec: SerialBalanceSettings, scale: ScaleSettings) -> None:
        dialect = USUAL_DIALECT if spec.dialect == AUTO else spec.dialect
        # In scaled time, the transmission of characters would limit the speed of the bench.
        baud = spec.candidates()[0].baud if spec.time_scale == 1.0 and spec.dialect != AUTO else 0
        self._balance = VirtualSerialBalance.start(
            dialect, baud=baud, scale=scale, time_scale=spec.time_scale, latency=0.002, clock=spec.clock
        )
        self._spec = spec.with_values(port=self._balance.port, dialect=dialect)

    @property
    def balance(self) -> BalanceSettings:
        """See `BalanceEmulator.balance`."""
        return self._spec

    def prepare(self, seed: tuple[int, ...]) -> None:
        """See `BalanceEmulator.prepare`."""
        self._balance.prepare(seed)

    def put(self, mass: float) -> None:
        """See `BalanceEmulator.put`."""
        self._balance.put(mass)

    def order(self, kind: str, values: dict[str, Any]) -> dict[str, Any]:
        """Send a command: 'unplug', 'plug', 'faults' …; see `VirtualSerialBalance`."""
        return self._balance.order(kind, **values)

    def close(self) -> None:
        """See `BalanceEmulator.close`."""
        self._balance.close()
