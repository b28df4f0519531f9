"""The `decant` command: the application and the table of its commands, with examples for their help texts.

Each command is a function of its module, with its options as parameters. It imports what it needs when it is called, so
that `--help` starts fast.
"""

from __future__ import annotations

import contextlib
import copy
import errno
import functools
import io
import os
import sys
from typing import Annotated

import typer

from orchestrator.cli import (
    balance_commands,
    campaign_commands,
    dose_command,
    file_commands,
    materials_commands,
    pour_command,
    queue_commands,
    report_command,
    robot_commands,
    run_commands,
    simulate_command,
    station_commands,
    token_commands,
    view_command,
)
from orchestrator.cli.command_options import add_command, add_group
from sim_engine.settings.plugin_registry import own_extras

app = typer.Typer(
    name="decant",
    no_args_is_help=True,
    rich_markup_mode="markdown",
    pretty_exceptions_enable=False,
    help="""Teach a robot arm to pour without spilling.

A campaign file (YAML) defines the liquid, the vessels, the allowed actions, how the simulator is calibrated (C1 to C4)
and how pours are optimised: D1 in simulation, D2 on the bench, D3 with both. Start with:

    decant run configs/campaigns/quickstart.yaml

Exit codes: 0 success, 1 failed, 2 bad input (nothing was started), 3 an operator must answer,
4 the run did not reach all that was wanted, 130 interrupted.
""",
)


def _version(wanted: bool) -> None:
    if wanted:
        from importlib.metadata import version

        from sim_engine.settings.plugin_registry import DISTRIBUTION

        print(f"decant {version(DISTRIBUTION)}")
        raise typer.Exit


@app.callback()
def decant(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version and exit.")
    ] = False,
) -> None:
    """Options that precede the command."""


_add, _group = functools.partial(add_command, app), functools.partial(add_group, app)

_add(
    campaign_commands.run,
    "decant run configs/campaigns/quickstart.yaml",
    "decant run configs/campaigns/quickstart.yaml --live   # open the printed address in a browser",
    "decant run my.yaml --resume   # after a stop, a crash or a power failure; finished work is not repeated",
    quiet=True,
)
_add(
    campaign_commands.calibrate,
    "decant calibrate configs/campaigns/recorded.yaml --json",
    "decant calibrate my.yaml && decant plan my.yaml --parameters runs/my-20300131-1/theta.json",
    quiet=True,
)
_add(
    campaign_commands.plan,
    "decant plan my.yaml --parameters theta.json",
    "decant plan my.yaml --parameters theta.json --receiver vase.yaml --json",
    quiet=True,
)
_add(
    simulate_command.simulate,
    "decant simulate my.yaml --set angular_velocity=40 --set x_offset=90   # deg/s and mm",
    "decant simulate my.yaml --set 'angular_velocity=0.7 rad/s' --set 'x_offset=9 cm' --png pour.png",
    quiet=True,
)
_add(
    file_commands.validate, "decant validate my.yaml vase.yaml", "decant validate configs/campaigns/*.yaml", quiet=True
)
_add(file_commands.init, "decant init lab", "decant run lab/campaigns/quickstart.yaml")
_add(file_commands.schema, "decant schema > campaign.json", "decant schema result > result.json")
_add(
    pour_command.pour,
    "decant pour my.yaml --set angular_velocity=20 --set x_offset=100 --dry-run --png path.png",
    "decant pour my.yaml --set angular_velocity=20 --set x_offset=100 --empty --slow 0.2 --enable-motion",
    "decant pour my.yaml --set angular_velocity=20 --set x_offset=100 --enable-motion",
    quiet=True,
)
_add(
    dose_command.dose,
    "decant dose my.yaml --laboratory configs/laboratories/twin.yaml --amount '50 g' --dry-run",
    "decant dose my.yaml --laboratory configs/laboratories/twin.yaml --amount '50 g' --amount '25 g' --tolerance '1 g'",
    quiet=True,
)
_add(
    report_command.report,
    "decant report quickstart-20300131-1              # a run in the folder runs/",
    "decant report runs/quickstart-20300131-1 --pdf -o for-the-lab-meeting.html",
    quiet=True,
)
_add(
    view_command.view,
    "decant view quickstart-20300131-1                    # a run of the folder runs/",
    "decant view runs/first runs/second                   # side by side",
    "decant view runs/first --pour 7 --particles 5000     # simulate pour 7 again with 5000 particles",
    quiet=True,
)
_add(file_commands.plugins, "decant plugins", "decant plugins --json")

app.add_typer(run_commands.runs)

_robot = _group(
    "robot",
    "Check and move the arm of a laboratory.",
    "decant robot check configs/laboratories/ur10-kern.yaml                  # moves nothing",
    "decant robot jog configs/laboratories/ur10-kern.yaml --enable-motion    # small steps, typed",
)
_robot(
    robot_commands.check,
    "decant robot check configs/laboratories/virtual.yaml",
    "decant robot check configs/laboratories/ur10-kern.yaml --accept-safety   # after reading them on the pendant",
)
_robot(
    robot_commands.jog,
    "decant robot jog configs/laboratories/virtual.yaml         # practise without a robot",
    "decant robot jog configs/laboratories/ur10-kern.yaml --enable-motion",
)
_robot(
    robot_commands.home,
    "decant robot home configs/laboratories/virtual.yaml        # practise without a robot",
    "decant robot home configs/laboratories/ur10-kern.yaml --enable-motion",
)
_robot(
    robot_commands.teach,
    "decant robot teach my-lab.yaml pan --use balance     # after guiding the arm there by hand",
    "decant robot teach my-lab.yaml left --use source",
    "decant robot teach my-lab.yaml rack A1 --rack 'rows: 4, columns: 6, row_pitch: 120 mm, column_pitch: 100 mm'",
    "decant robot teach my-lab.yaml rack D1",
)
_robot(
    robot_commands.try_place,
    "decant robot try configs/laboratories/night.yaml left             # practise without a robot",
    "decant robot try my-lab.yaml left --enable-motion",
    name="try",
)

_balance = _group(
    "balance",
    "Check a balance before the first pour; record its raw traffic and explain it.",
    "decant balance check configs/laboratories/ur10-kern.yaml",
    "decant balance check /dev/serial/by-id/usb-FTDI_FT232R-if00-port0   # no laboratory file yet",
)
_balance(
    balance_commands.check,
    "decant balance check configs/laboratories/virtual.yaml       # practise without a balance",
    "decant balance check /dev/serial/by-id/usb-FTDI_FT232R-if00-port0 --record day-one.jsonl",
    "decant balance check 192.168.0.20:4001 --set dialect=a-and-d",
)
_balance(
    balance_commands.record,
    "decant balance record rig.yaml --to kern.jsonl --remarks 'Kern PCB 3500-2; 200 g put on after 10 s'",
    "decant balance record --from kern.jsonl      # explain a recording",
    "decant balance record --from terminal.log    # explain the lines as another program saved them",
)

_server = _group(
    "server",
    "Run a laboratory as a service.",
    "decant server start --state ./lab            # prints the address of its page; runs until Ctrl-C",
    "decant server backup lab.zip --state ./lab   # also while it runs",
)
_server(
    queue_commands.start,
    "decant server start",
    "decant server start lab.yaml --port 0",
    "decant server start --state ./trials --in-process",
)
_server(queue_commands.shutdown, "decant server stop   # finishes and weighs a pour that has begun", name="stop")
_server(station_commands.backup, "decant server backup decant-2030-03-01.zip")
_server(station_commands.restore, "decant server restore decant-2030-03-01.zip --state ./restored")

_token = add_group(
    _server.args[0],
    "token",
    "Access tokens of the server's users; a running server reads them again at once.",
    "decant server token add operator anna --days 365   # prints the token once",
    "decant server token revoke anna",
)
_token(token_commands.add, "decant server token add operator anna", "decant server token add viewer screen --days 90")
_token(token_commands.revoke, "decant server token revoke anna")
_token(token_commands.list_all, "decant server token list", name="list")

_queue = _group(
    "queue",
    "Submit campaigns to the server, follow and control them, and answer their questions.",
    "decant queue submit configs/campaigns/quickstart.yaml   # prints the campaign's id",
    "decant queue logs quickstart-3f2a1c -f                  # follow it",
    "decant queue answer                                     # list what the laboratory asks",
)
_queue(
    queue_commands.submit,
    "decant queue submit configs/campaigns/quickstart.yaml",
    "decant queue submit my.yaml --rig left --priority 5",
    "decant queue submit my.yaml --task plan --parameters theta.json --receiver configs/vessels/bowl.yaml",
)
_queue(
    queue_commands.list_campaigns,
    "decant queue list",
    "decant queue list quick   # one campaign; the first letters of an id suffice",
    name="list",
)
_queue(queue_commands.logs, "decant queue logs -f", "decant queue logs quickstart-3f2a1c --json")
_queue(
    queue_commands.pause,
    "decant queue pause quickstart-3f2a1c",
    "decant queue pause quickstart-3f2a1c --now   # stops the motion",
    "decant queue pause   # the queue",
)
_queue(queue_commands.resume, "decant queue resume quickstart-3f2a1c", "decant queue resume   # the queue")
_queue(queue_commands.stop, "decant queue stop quickstart-3f2a1c   # its results so far are kept")
_queue(
    queue_commands.answer,
    "decant queue answer",
    "decant queue answer 7 done",
    "decant queue answer 8 weighed 3.2 0.4   # spilled and retained [g]",
)
_queue(queue_commands.enable, "decant queue enable narrow-1b2c3d")
_queue(
    station_commands.order,
    "decant queue pour plan-17:4 --from beaker-1 --into vial-7 --amount '30 g'",
    "decant queue pour plan-17:4 --from beaker-1 --into vial-7 --amount '30 g' --dry-run",
    name="pour",
)

_materials = _group(
    "materials",
    "See what is left in vessels, and enter weighings and pours made by hand.",
    "decant materials weigh virtual/beaker '412.3 g' --liquid water   # after filling it",
    "decant materials list                                            # what the pours since then left",
)
_materials(
    materials_commands.list_vessels,
    "decant materials list",
    "decant materials list virtual/beaker   # the entries of its account",
    name="list",
)
_materials(
    materials_commands.weigh,
    "decant materials weigh virtual/beaker '412.3 g' --liquid water   # the source of a campaign",
    "decant materials weigh beaker-1 '412.3 g' --note 'after lunch'     # a vessel of the daemon",
)
_materials(materials_commands.place, "decant materials place night/receiver right")
_materials(
    materials_commands.poured, "decant materials poured monday-1 --from beaker-1 --into vial-7 --weighed '30.2 g'"
)

_add(
    queue_commands.estop,
    "decant estop",
    "decant estop --rig left",
    "decant estop --reason 'glass on the table'",
    "decant estop --clear   # accept work again",
    unknown_options=True,
)

for _register in own_extras("decant.commands").values():
    _register(app)


def main() -> None:
    """Run the command line."""
    if (
        sys.getfilesystemencoding() == "ascii"
    ):  # arguments and files are UTF-8, also in a locale that has no such letters
        command = [sys.executable, *sys.orig_argv[1:]]
        os.execve(sys.executable, command, {**os.environ, "PYTHONUTF8": "1"})
    # Typer builds the parameters of all commands before it reads the first word
    word = sys.argv[1] if len(sys.argv) > 1 else ""
    commands = [c for c in app.registered_commands if c.name == word]
    groups = [g for g in app.registered_groups if g.typer_instance and g.typer_instance.info.name == word]
    named = copy.copy(app)
    if commands or groups:
        named.registered_commands, named.registered_groups = commands, groups
    for stream in (sys.stdout, sys.stderr):  # a name must not end a command that has done its work
        if isinstance(stream, io.TextIOWrapper):
            stream.reconfigure(errors="backslashreplace")
    try:
        try:
            named()
        finally:
            sys.stdout.flush()
    except OSError as error:
        if error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EPIPE):
            raise
        if error.errno != errno.EPIPE:
            where = error.filename or "the output can't be written completely"
            print(f"decant: {where}: {error.strerror}", file=sys.stderr)
        with contextlib.suppress(OSError):  # Python flushes it once more at its end
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        sys.exit(1)
