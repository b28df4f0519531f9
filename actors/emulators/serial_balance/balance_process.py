"""The strings of a virtual balance on a serial line: it runs in a process of its own and dies with this one.

What stands in for a balance on a serial line on a virtual bench: one at the far end of a pseudo-terminal.
"""

from __future__ import annotations

import contextlib
import json
import os
import tempfile
import threading
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from actors.balance.balance_settings import AUTO, BalanceDevice, SerialBalanceSpec
from actors.balance.dialect_registry import voices
from actors.balance.simulated_balance import Load, ScaleSettings
from actors.interfaces import LaboratoryError
from actors.runtime.child_process import ChildProcess, python_module
from actors.runtime.ray_cleanup import MARK

PATIENCE = 40.0
"""How long its process may take to start, or to answer [s]."""

GRACE = 10.0
"""How long it has to end by itself [s]."""


class FarProcess:
    """A process at the far end of a pseudo-terminal.

    Args:
        settings: for `server.make_character`.
        baud: speed of the line; 0: any, and characters take no time.

    Raises:
        LaboratoryError: it did not start.
    """

    def __init__(self, settings: dict[str, Any], baud: int) -> None:
        # In a Ray of our own: in its folder, which is removed even behind a program that was killed.
        folder = Path(tempfile.mkdtemp(prefix="decant-balance-", dir=os.environ.get(MARK)))
        self.port = str(folder / "balance")
        """Path of the line, which keeps its name when the plug is pulled and put in again."""
        self._lock = threading.Lock()
        text = json.dumps({**settings, "link": self.port, "baud": baud})
        self._process = ChildProcess(python_module("actors.emulators.serial_balance.pty_server", text))
        try:
            self._answer()
        except BaseException:
            self.close()
            raise

    @property
    def pid(self) -> int:
        """Id of its process."""
        return self._process.pid

    def unplug(self) -> None:
        """Pull the plug: the port is gone."""
        self.order("unplug")

    def plug(self) -> None:
        """Put it in again: another device under the same name."""
        self.order("plug")

    def order(self, what: str, **values: Any) -> dict[str, Any]:
        """Have something done, and wait until it is.

        Raises:
            LaboratoryError: it can't, or its process is gone.
        """
        with self._lock:
            try:
                self._process.write(json.dumps({"do": what, **values}).encode("ascii") + b"\n")
            except (OSError, ValueError) as error:
                raise LaboratoryError(f"virtual balance at {self.port}: its process is gone{self._end()}") from error
            return self._answer()

    def close(self) -> None:
        """End it. May be called again."""
        self._process.close(GRACE)
        with contextlib.suppress(OSError):
            Path(self.port).unlink(missing_ok=True)
            Path(self.port).parent.rmdir()

    def _answer(self) -> dict[str, Any]:
        try:
            answer: dict[str, Any] = json.loads(self._process.read_line(PATIENCE))
        except TimeoutError:
            raise LaboratoryError(f"virtual balance at {self.port}: no answer within {PATIENCE:g} s") from None
        except (EOFError, OSError, ValueError):
            raise LaboratoryError(f"virtual balance at {self.port}: its process has ended{self._end()}") from None
        if "error" in answer:
            raise LaboratoryError(f"virtual balance at {self.port}: {answer['error']}")
        return answer

    def _end(self) -> str:
        """How its process ended, for an error message."""
        self._process.wait(1.0)
        said = f": {self._process.last_error}" if self._process.last_error else ""
        return f" (status {self._process.status}{said})"


class VirtualSerialBalance(FarProcess):
    """A virtual balance, started.

    Use `start`; its `port` is what a driver opens.
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
    ) -> VirtualSerialBalance:
        """Start one, empty.

        Args:
            dialect: one of `doors.voices`.
            baud: speed of the line; 0: any, and characters take no time.
            scale: what a data sheet says.
            time_scale: bench seconds per second of the clock; 0: bench time passes by `advance` only.
            latency: from question to answer [s of the clock].
            seed: of noise and of faults.

        Raises:
            LaboratoryError: it did not start.
        """
        if dialect not in voices():
            raise LaboratoryError(f"no virtual balance speaks '{dialect}'; there are {', '.join(voices())}")
        settings = {
            "dialect": dialect,
            "scale": asdict(scale or ScaleSettings()),
            "time_scale": time_scale,
            "latency": latency,
            "seed": list(seed),
        }
        return cls(settings, baud)

    def put(self, load: Load | float) -> None:
        """What is on it from now on.

        Args:
            load: a mass [kg], or masses over bench time.
        """
        load = load if isinstance(load, Load) else Load((0.0,), (load,))
        self.order("put", times=list(load.times), masses=list(load.masses))

    def prepare(self, seed: tuple[int, ...]) -> None:
        """Empty, bench time 0, no tare, noise of a new pour."""
        self.order("prepare", seed=list(seed))

    def faults(self, **changes: Any) -> None:
        """Change faults (see `faults.Faults`); others stay as they are."""
        self.order("faults", **changes)

    def advance(self, seconds: float) -> None:
        """Bench time passes, whatever the clock says [s]."""
        self.order("advance", seconds=seconds)

    def power_cycle(self) -> None:
        """Switch it off and on: tare gone, what is on it is its new zero. The port stays."""
        self.order("power cycle")

    def state(self) -> dict[str, Any]:
        """What is on it truly [kg], what it shows, bench time [s], commands heard."""
        return self.order("state")


class RecordedBalance(FarProcess):
    """Plays a recording to a client that asks."""

    @classmethod
    def start(cls, recording: Path, *, speed: float = 1.0) -> RecordedBalance:
        """Start playing; unasked bytes come at their times, answers after their questions.

        Args:
            recording: file made by `python -m actors.balance.record_line`.
            speed: so much faster than it was.

        Raises:
            LaboratoryError: it did not start.
        """
        return cls({"recording": str(recording), "speed": speed}, baud=0)


USUAL_DIALECT = "kcp"
"""Spoken unless another dialect is named."""


class SerialBalanceEmulator:
    """See `actors.balance.balance_settings.BalanceEmulator`.

    Args:
        spec: which dialect at which pace.
        scale: what its data sheet says.

    Raises:
        LaboratoryError: it did not start.
    """

    def __init__(self, spec: SerialBalanceSpec, scale: ScaleSettings) -> None:
        dialect = USUAL_DIALECT if spec.dialect == AUTO else spec.dialect
        # A line that takes no time: in scaled time its characters would be the slowest thing on the bench.
        self._balance = VirtualSerialBalance.start(
            dialect, baud=0, scale=scale, time_scale=spec.time_scale, latency=0.002
        )
        self._spec = replace(spec, port=self._balance.port, dialect=dialect)

    @property
    def device(self) -> BalanceDevice:
        """See `BalanceEmulator.device`."""
        return self._spec

    def prepare(self, seed: tuple[int, ...]) -> None:
        """See `BalanceEmulator.prepare`."""
        self._balance.prepare(seed)

    def put(self, mass: float) -> None:
        """See `BalanceEmulator.put`."""
        self._balance.put(mass)

    def order(self, what: str, values: dict[str, Any]) -> dict[str, Any]:
        """'unplug', 'plug', 'faults' …, see `VirtualSerialBalance`."""
        return self._balance.order(what, **values)

    def close(self) -> None:
        """See `BalanceEmulator.close`."""
        self._balance.close()
