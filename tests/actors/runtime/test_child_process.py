"""`child_process`: child processes: they start while the environment changes, end with their parent, and say how
they ended.
"""

from __future__ import annotations

import ast
import os
import platform
import re
import signal
import sys
import threading
from collections.abc import Iterator, MutableMapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest

from actors.emulators.serial_balance.balance_process import VirtualSerialBalance
from actors.interfaces import LaboratoryError
from actors.runtime.child_process import (
    ChildProcess,
    ConnectedProcess,
    child_environment,
    own_environment,
    run,
)
from tests.support.waiting import PATIENCE, alive, wait_for

ROOT = Path(__file__).parents[3]
PRODUCT = ("decant", "orchestrator", "actors", "sim_engine")
SCRIPTS = ("tests", "benchmarks", "docs")

STARTS = 120
"""By each of two threads. Without a copy of the environment about one start in seventy fails."""


def python(program: str) -> list[str]:
    return [sys.executable, "-c", program]


# ---- environment


def test_children_start_while_another_thread_changes_the_environment() -> None:
    done = threading.Event()

    def change() -> None:
        number = 0
        while not done.is_set():
            number += 1
            os.environ[f"DECANT_TEST_{number % 50}"] = "x" * (number % 997)
            os.environ.pop(f"DECANT_TEST_{(number + 25) % 50}", None)

    def start() -> None:
        for _ in range(STARTS):
            assert run(["/bin/true"], timeout=PATIENCE).returncode == 0

    changing = threading.Thread(target=change)
    changing.start()
    try:
        with ThreadPoolExecutor(2) as pool:
            for future in [pool.submit(start) for _ in range(2)]:
                future.result()
    finally:
        done.set()
        changing.join()
        for number in range(50):
            os.environ.pop(f"DECANT_TEST_{number}", None)


class Vanishing(MutableMapping[str, str]):
    """An environment of which another thread removes a variable between the list of names and the values."""

    def __init__(self) -> None:
        self.values_by_name = {"KEPT": "1", "REMOVED": "2"}

    def __iter__(self) -> Iterator[str]:
        yield from list(self.values_by_name)
        self.values_by_name.pop("REMOVED", None)

    def __getitem__(self, name: str) -> str:
        if name == "REMOVED":
            self.values_by_name.pop("REMOVED", None)
        return self.values_by_name[name]

    def __setitem__(self, name: str, value: str) -> None:
        raise AssertionError("a copy changes nothing")

    def __delitem__(self, name: str) -> None:
        raise AssertionError("a copy changes nothing")

    def __len__(self) -> int:
        return len(self.values_by_name)


def test_a_variable_that_vanishes_during_the_copy_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    with monkeypatch.context() as patch:  # pytest itself changes the environment after the test
        patch.setattr(os, "environ", Vanishing())
        copied = child_environment({"ADDED": "3"})
    assert copied == {"KEPT": "1", "ADDED": "3"}


def test_a_child_gets_the_environment_with_its_changes() -> None:
    child = ChildProcess(
        python("import os; print(os.environ['ADDED'], 'PATH' in os.environ)"), environment={"ADDED": "yes"}
    )
    assert child.read_line(PATIENCE) == b"yes True\n"
    child.close()
    assert child.status == 0


# ---- lines, errors, the end


def test_lines_are_whole_whatever_pieces_they_come_in() -> None:
    child = ChildProcess(
        python(
            "import os, sys\n"
            "os.write(1, b'one\\ntw')\n"
            "sys.stdin.buffer.read(1)\n"
            "os.write(1, b'o\\nthree\\nend')\n"
            "sys.stdin.buffer.read()"
        )
    )
    assert child.read_line(PATIENCE) == b"one\n"
    with pytest.raises(TimeoutError, match="no line"):
        child.read_line(0.0)
    child.write(b"x")
    assert child.read_line(PATIENCE) == b"two\n"
    assert child.read_line(PATIENCE) == b"three\n"
    child.close_input()
    with pytest.raises(EOFError):
        child.read_line(PATIENCE)
    child.close()


def test_what_a_child_wrote_last_to_its_errors_is_kept() -> None:
    child = ChildProcess(python("raise SystemExit('no such port')"))
    assert child.wait(PATIENCE)
    assert (child.status, child.last_error) == (1, "no such port")
    child.close()
    assert child.errors_kept == ""


def test_a_child_that_does_not_end_with_its_input_is_killed() -> None:
    child = ChildProcess(python("import signal, time\nprint('up', flush=True)\nwhile True: time.sleep(60)"))
    assert child.read_line(PATIENCE) == b"up\n"
    child.close(grace=0.0)
    child.close()
    assert child.status == -signal.SIGKILL


def test_a_child_that_does_not_end_with_its_input_may_be_asked_to() -> None:
    child = ChildProcess(python("import time\nprint('up', flush=True)\nwhile True: time.sleep(60)"))
    assert child.read_line(PATIENCE) == b"up\n"
    child.close(PATIENCE, terminate=True)
    assert child.status == -signal.SIGTERM


def test_writing_to_a_child_that_has_ended_is_an_os_error() -> None:
    child = ChildProcess(python(""))
    assert child.wait(PATIENCE)
    with pytest.raises(OSError, match="Broken pipe"):
        child.write(b"x" * 100_000)
    child.close()


def test_a_program_that_takes_too_long_is_killed() -> None:
    with pytest.raises(TimeoutError):
        run(python("import time; time.sleep(600)"), timeout=0.1)


@pytest.mark.parametrize(
    ("waits", "options"),
    [
        ("import sys; sys.stdin.read()", ""),
        pytest.param(
            "import time; time.sleep(600)",
            "input=False, dies_with_parent=True, ",
            marks=pytest.mark.skipif(sys.platform != "linux", reason="only Linux has the call"),
        ),
    ],
    ids=["by its input", "by the kernel"],
)
def test_children_end_with_a_parent_that_is_killed(waits: str, options: str) -> None:
    parent = ChildProcess(
        python(
            "import sys\nfrom actors.runtime.child_process import ChildProcess\n"
            f"child = ChildProcess([sys.executable, '-c', {waits!r}], {options}output=False)\n"
            "print(child.pid, flush=True)\nsys.stdin.read()"
        ),
        environment={"PYTHONPATH": str(ROOT)},
    )
    pid = int(parent.read_line(PATIENCE))
    parent.kill()
    wait_for(lambda: not alive(pid), "end of the child")
    parent.release()


def test_a_connected_process_ends_with_its_connection() -> None:
    child = ConnectedProcess("actors.simulators.local_worker")
    assert child.alive
    child.connection.close()
    child.close(PATIENCE)
    assert child.status is not None


def test_a_balance_whose_process_was_killed_says_so() -> None:
    balance = VirtualSerialBalance.start(baud=0, time_scale=0.0)
    os.kill(balance.pid, signal.SIGKILL)
    try:
        with pytest.raises(LaboratoryError, match=r"its process (has ended|is gone) \(status -9\)"):
            balance.state()
    finally:
        balance.close()


def test_what_is_set_for_a_library_in_this_process_does_not_reach_other_children(monkeypatch) -> None:
    monkeypatch.setenv("DECANT_TEST_OLD", "before")
    names = ("DECANT_TEST_OLD", "DECANT_TEST_NEW")
    with own_environment(DECANT_TEST_OLD="changed", DECANT_TEST_NEW="added"):
        assert [os.environ[name] for name in names] == ["changed", "added"]
        assert [child_environment().get(name) for name in names] == ["before", None]
    assert [os.environ.get(name) for name in names] == ["before", None]


# ---- one place


STARTING = {
    "os": {"system", "popen", "fork", "forkpty", "posix_spawn", "posix_spawnp", "execv", "execl", "execlp", "execvp"},
    "asyncio": {"create_subprocess_exec", "create_subprocess_shell"},
    "multiprocessing": {"Process", "Pool", "get_context"},
}


def trees(*folders: str, about: str) -> Iterator[tuple[Path, ast.Module]]:
    """The Python files in some folders whose text has a pattern, parsed."""
    for path in sorted(path for folder in folders for path in (ROOT / folder).rglob("*.py")):
        text = path.read_text("utf-8")
        if re.search(about, text):
            yield path, ast.parse(text)


def name_of(node: ast.expr) -> str:
    """'os.environ.update' of an expression made of names; '' of others."""
    if isinstance(node, ast.Attribute):
        return f"{before}.{node.attr}" if (before := name_of(node.value)) else ""
    return node.id if isinstance(node, ast.Name) else ""


def test_one_module_of_the_product_starts_programs() -> None:
    found = []
    for path, tree in trees(*PRODUCT, about=r"subprocess|multiprocessing|os\.(system|popen|fork|posix_spawn|exec)"):
        if path == ROOT / "actors" / "runtime" / "child_process.py":
            continue
        for node in ast.walk(tree):
            at = f"{path.relative_to(ROOT)}:{getattr(node, 'lineno', 0)}"
            if isinstance(node, ast.Import) and any(alias.name == "subprocess" for alias in node.names):
                found.append(f"{at}: import subprocess")
            elif isinstance(node, ast.ImportFrom) and node.module == "subprocess":
                found.append(f"{at}: from subprocess import")
            elif isinstance(node, ast.Attribute) and node.attr in STARTING.get(name_of(node.value), ()):
                found.append(f"{at}: {name_of(node)}")
    assert not found, "\n".join(["start programs with actors.runtime.child_process:", *found])


AT_THE_START = {
    "orchestrator/records/run_registry.py",  # `--state`, before anything is started
    "orchestrator/daemon/server_process.py",  # what the previous program left, before anything is started
    "actors/runtime/child_process.py",  # `own_environment`: read by Ray's library, which has no other way
}
"""Files that change this process's environment outside of an import."""


def test_the_environment_is_not_changed_while_a_program_runs() -> None:
    found = []
    for path, tree in trees(*PRODUCT, about=r"os\.environ|putenv|unsetenv"):
        if str(path.relative_to(ROOT)) in AT_THE_START:
            continue
        for function in ast.walk(tree):
            if isinstance(function, ast.FunctionDef | ast.AsyncFunctionDef):
                found += [f"{path.relative_to(ROOT)}:{line}" for line in changes_of_the_environment(function)]
    assert not found, "\n".join(["pass the variable to the child instead of changing os.environ:", *found])


CHANGING = {
    *(f"os.environ.{name}" for name in ("update", "pop", "popitem", "setdefault", "clear")),
    *("os.putenv", "os.unsetenv"),
}


def changes_of_the_environment(tree: ast.AST) -> list[int]:
    """Lines that change `os.environ`."""
    lines = []
    for node in ast.walk(tree):
        match node:
            case ast.Subscript(value=changed, ctx=ast.Store() | ast.Del()) | ast.AugAssign(target=changed):
                if name_of(changed) == "os.environ":
                    lines.append(node.lineno)
            case ast.Call(func=function) if name_of(function) in CHANGING:
                lines.append(node.lineno)
    return lines


def test_tests_and_scripts_give_every_child_an_environment() -> None:
    """pytest changes `os.environ` at every test, also while a thread of a fixture starts a child."""
    calls = {f"subprocess.{name}" for name in ("Popen", "run", "call", "check_call", "check_output")}
    found = []
    for path, tree in trees(*SCRIPTS, about=r"subprocess\."):
        for node in ast.walk(tree):
            if not isinstance(node, ast.Call) or name_of(node.func) not in calls:
                continue
            if not any(word.arg in ("env", None) for word in node.keywords):
                found.append(f"{path.relative_to(ROOT)}:{node.lineno}")
    assert not found, "\n".join(["add env=child_environment() (actors.runtime.child_process):", *found])


def test_rays_private_api_is_used_in_one_function_only() -> None:
    found = {
        (str(path.relative_to(ROOT)), node.name)
        for path, tree in trees(*PRODUCT, about=r"\bray\._")
        for node in ast.walk(tree)
        if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and re.search(r"\bray\._", ast.unparse(node))
    }
    assert found == {("actors/runtime/ray_runtime.py", "_ray_internals")}


SLICE = """
import ctypes, struct, threading
def shown():
    attributes = ctypes.create_string_buffer(48)
    assert ctypes.CDLL(None).syscall({number}, 0, attributes, 48, 0) == 0
    _, _, _, nice, _, runtime, _, _ = struct.unpack("=IIQiIQQQ", attributes.raw)
    print((nice, runtime), flush=True)
input()
thread = threading.Thread(target=shown)
thread.start()
thread.join()
"""


@pytest.mark.skipif(platform.machine() not in ("x86_64", "aarch64"), reason="the number of the system call")
def test_a_prompt_child_and_its_threads_get_short_slices_and_keep_their_priority() -> None:
    if tuple(int(n) for n in platform.release().split(".")[:2]) < (6, 12):
        pytest.skip("Linux before 6.12 has no slices")
    code = SLICE.format(number={"x86_64": 315, "aarch64": 275}[platform.machine()])
    shown = []
    for prompt in (False, True):
        child = ChildProcess([sys.executable, "-c", code], prompt=prompt)
        child.write(b"\n")
        shown.append(child.read_line(deadline=PATIENCE).decode().strip())
        child.close()
    nice = os.getpriority(os.PRIO_PROCESS, 0)
    assert shown[1] == f"({nice}, 100000)", shown
    assert shown[0].startswith(f"({nice}, ")
    assert shown[0] != shown[1]
