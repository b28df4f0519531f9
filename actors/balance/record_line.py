"""Record the lines of a balance, for replay in tests: `python -m actors.balance.record_line --port … --to file`."""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from actors.balance.balance_interface import BalanceError
from actors.balance.balance_settings import AUTO, SerialBalanceSettings, parse_format
from actors.balance.dialect_registry import dialects
from actors.balance.line_recording import Recorder
from actors.balance.serial_balance import SerialBalance


def main(arguments: Sequence[str] | None = None) -> int:
    """Record a line. Returns the exit code."""
    parser = _parser()
    asked = parser.parse_args(arguments)
    if asked.to.exists():
        parser.error(f"{asked.to} exists; name another file")
    spec = SerialBalanceSettings(
        port=asked.port,
        dialect=asked.dialect,
        baud=asked.baud,
        format=asked.format,
        handshake=asked.handshake,
        interval=asked.interval,
    )
    about = {"balance": asked.balance, "port": asked.port, "date": time.strftime("%Y-%m-%d"), "remarks": asked.remarks}
    with asked.to.open("x", encoding="utf-8") as file:
        recorder = Recorder(file, asked.source, about)
        balance = SerialBalance(spec, "recorded", recorder)
        try:
            print(balance.connect(), file=sys.stderr)
            end = time.monotonic() + asked.seconds
            while (left := end - time.monotonic()) > 0.0:
                if asked.listen:
                    balance.listen(min(left, 1.0))
                    continue
                weight = balance.read()
                print(f"\r{weight.shown or weight.status:<24} {weight.status:<12}", end="", file=sys.stderr, flush=True)
                time.sleep(min(asked.interval, left))
        except BalanceError as error:
            print(error, file=sys.stderr)
            return 1
        except KeyboardInterrupt:
            pass
        finally:
            balance.close()
            print(f"\n{recorder.count} bytes in {asked.to}; {balance.statistics()}", file=sys.stderr)
    return 0


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(prog="python -m actors.balance.record_line", description=__doc__)
    parser.add_argument("--port", required=True, help="e.g. a path under /dev/serial/by-id/")
    parser.add_argument("--to", required=True, type=Path, help="file to write; must not exist yet")
    parser.add_argument("--balance", default="", help="make and model, as on its plate")
    parser.add_argument("--remarks", default="", help="what was put on it, and when")
    parser.add_argument("--dialect", default=AUTO, choices=[AUTO, *dialects()])
    parser.add_argument("--baud", type=int, help="unless given, found out")
    parser.add_argument("--format", type=_format, help="e.g. 8N1; unless given, found out")
    parser.add_argument("--handshake", default="none", choices=["none", "software", "hardware"])
    parser.add_argument("--seconds", type=float, default=60.0, help="for how long")
    parser.add_argument("--interval", type=float, default=0.15, help="from question to question [s]")
    parser.add_argument("--listen", action="store_true", help="ask nothing, only listen (after connecting)")
    parser.add_argument(
        "--source",
        default="hardware",
        choices=["hardware", "virtual"],
        help="what is recorded; say 'virtual' for a virtual balance",
    )
    return parser


def _format(text: str) -> str:
    try:
        parse_format(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error
    return text


if __name__ == "__main__":
    sys.exit(main())
