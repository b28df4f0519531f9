"""`urscript`: the language: what programs mean, and that no program, however mad, gets out of its box or hangs the
controller.
"""

from __future__ import annotations

import contextlib
from typing import Any

import psutil
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from actors.emulators.ur_controller.urscript.lexer import KEYWORDS, ScriptError, Splitter
from actors.emulators.ur_controller.urscript.program import Command, Program, Steps, waiting
from actors.emulators.ur_controller.urscript.script_values import FUNCTIONS
from actors.emulators.ur_controller.urscript.translator import translate
from tests.actors.emulators.ur_controller.conftest import Bench
from tests.support.counted_calls import counted_calls
from tests.support.hypothesis_examples import examples


class Run:
    """A program with an `out` for what it finds and a `sync` to wait with."""

    def __init__(self, text: str, *, wrap: bool = True) -> None:
        self.found: list[Any] = []

        def sync() -> Steps:
            yield

        commands = {
            **{name: Command(function) for name, function in FUNCTIONS.items()},
            "out": Command(self.found.append),
            "sync": Command(sync, waits=True),
        }
        if wrap:
            text = "def test():\n" + text + "\nend\n"
        self.program = Program(translate(text, waiting(commands)), commands)
        self.cycles = 0

    def all(self, limit: int = 1000) -> list[Any]:
        while self.program.tick():
            self.cycles += 1
            assert self.cycles < limit
        return self.found


def result(text: str) -> list[Any]:
    return Run(text).all()


@pytest.mark.parametrize(
    ("expression", "value"),
    [
        ("1 + 2 * 3", 7),
        ("(1 + 2) * 3", 9),
        ("7 / 2", 3.5),
        ("7 % 3", 1),
        ("-7 % 3", -1),
        ("2 - -3", 5),
        ("1 < 2 and not 3 < 2", True),
        ("False or True", True),
        ("not 1 == 2", True),
        ("[1, 2, 3][1]", 2),
        ("[[1, 2], [3, 4]][1, 0]", 3),
        ("p[1, 2, 3, 0, 0, 0][2]", 3.0),
        ("0x10", 16),
        ("1.5e2", 150.0),
        ("2147483647 + 1", -2147483648),
        ("norm([3, 4])", 5.0),
        ("length([1, 2])", 2),
    ],
)
def test_expressions_mean_what_they_mean(expression: str, value: Any) -> None:
    assert result(f"out({expression})") == [value]


def test_branches_and_loops() -> None:
    text = """
i = 0
while i < 10:
  i = i + 1
  if i == 2:
    continue
  elif i == 5:
    break
  else:
    out(i)
  end
end
"""
    assert result(text) == [1, 3, 4]


def test_a_name_that_is_global_somewhere_is_global_unless_declared_local() -> None:
    text = """
global count = 0
def more():
  count = count + 1
  other = count * 10
  return other
end
def apart():
  local count = 100
  count = count + 1
  return count
end
out(more())
out(more())
out(apart())
out(count)
"""
    assert result(text) == [10, 20, 101, 2]


def test_lists_are_values_not_references() -> None:
    text = """
global kept = [1, 2, 3]
def change(list):
  list[0] = 99
  return list
end
a = kept
a[0] = 7
out(kept[0])
out(change(kept)[0])
out(kept[0])
"""
    assert result(text) == [1, 99, 1]


decimals = st.floats(-1e6, 1e6).map(lambda x: f"{x:.6f}") | st.integers(-(10**9), 10**9).map(str)


@settings(max_examples=examples(50))
@given(numbers=st.lists(decimals, min_size=2, max_size=7))
def test_a_list_of_plain_numbers_is_the_list_that_is_written_otherwise(numbers: list[str]) -> None:
    plain, otherwise = result(f"x = [{', '.join(numbers)}]\nout(x)\nout([ {' , '.join(numbers)} ])")
    assert plain == otherwise == [float(n) if "." in n else int(n) for n in numbers]
    assert list(map(type, plain)) == list(map(type, otherwise))


def test_plain_numbers_after_a_value_are_an_index() -> None:
    assert result("x = [[1, 2], [3, 4.5]]\nout(x[1, 1])\nout([[5, 6], [7, 8]][1, 0])\nx[0, 1] = 9\nout(x)") == [
        4.5,
        7,
        [[1, 9], [3, 4.5]],
    ]
    assert result("x = [1, 2]\ny = x\ny[0] = 3\nout(x)\nout(p[1, 2, 3, 4, 5, 6])")[0] == [1, 2]


def test_functions_have_defaults_and_named_arguments() -> None:
    assert result("def f(a, b=2, c=3):\n  return a * 100 + b * 10 + c\nend\nout(f(1))\nout(f(1, c=5))") == [123, 125]


def test_functions_may_be_called_before_they_are_written() -> None:
    assert result("def f():\n  return g() + 1\nend\ndef g():\n  return 1\nend\nout(f())") == [2]


def test_a_variable_called_p_is_no_pose() -> None:
    assert result("def scale(p, k):\n  p[0] = p[0] * k\n  return p\nend\nout(scale(p[1, 2, 3, 4, 5, 6], 2)[0])") == [
        2.0
    ]


def test_text_injected_into_a_line_does_not_need_lines() -> None:
    assert result("global a = # offset\n24    global b = # offset\n0   out(a + b)") == [24]


def test_functions_that_wait_deep_inside_take_a_cycle_each() -> None:
    run = Run("def f():\n  sync()\n  return 5\nend\ndef g():\n  return f() + f()\nend\nout(g())")
    assert run.all() == [10]
    assert run.cycles == 2


def test_threads_run_beside_each_other_until_killed() -> None:
    text = """
global n = 0
thread counter():
  while True:
    n = n + 1
    sync()
  end
end
t = run counter()
sync()
sync()
sync()
kill t
seen = n
sync()
sync()
out(seen)
out(n)
"""
    seen, later = result(text)
    assert seen in (2, 3)
    assert later == seen


def test_a_critical_section_holds_the_other_threads() -> None:
    text = """
global n = 0
thread counter():
  while True:
    n = n + 1
    sync()
  end
end
t = run counter()
sync()
sync()
enter_critical
before = n
sync()
sync()
sync()
out(n - before)
exit_critical
"""
    assert result(text) == [0]


def test_killing_nothing_does_nothing() -> None:
    assert result("t = 0\nkill t\nout(1)") == [1]


@pytest.mark.parametrize(
    ("text", "line", "says"),
    [
        ("x = 1\ny = )", 3, "')' closes nothing"),
        ("x = 1\ny = 1 +", 3, "syntax error: invalid syntax"),
        ("out(1)\n\nnosuch(2)", 4, "'nosuch' is not defined"),
        ("if 1 == 1\n out(1)\nend", 3, "expected ':'"),
        ("x = [1, 2\n", 4, "expected ')' or ']', found 'end'"),
        ("x = 1\nx ? 2", 3, "means nothing"),
        ("1 = x", 2, "cannot assign"),
        ("f(1) = x", 2, "cannot assign"),
        ("x = y = 1", 2, "can be assigned"),
        ("out(1)\nif 1 < 2 < 3:\nend", 3, "chain"),
        ("end\ndef f():", 3, "nothing after"),
        ("join 1", 2, "join is not supported"),
        ("out(True xor False)", 2, "xor is not supported"),
        ("out(str_cat('a', 'b'))", 2, "'str_cat' is not defined in this virtual controller"),
        ("run out()", 2, "not a thread"),
        ("thread t():\n sync()\nend\nt()", 5, "start it with run"),
        ("x = p[1, 2, 3]", 2, "six entries"),
    ],
)
def test_what_can_not_be_read_is_told_with_its_line(text: str, line: int, says: str) -> None:
    with pytest.raises(ScriptError, match=r".+") as caught:
        Run(text)
    assert says in str(caught.value)
    assert caught.value.line == line


@pytest.mark.parametrize(
    ("text", "line", "says"),
    [
        ("x = 1\ny = x / 0", 3, "division by zero"),
        ("out(x)", 2, "'x' has no value yet"),
        ("x = [1, 2]\nout(x[5])", 3, "no such entry"),
        ("x = [1, 2]\ni = 0 - 1\nout(x[i])", 4, "is not an index"),
        ("x = [1] + [2]", 2, "can't compute"),
        ("x = sqrt(0 - 1)", 2, "computed"),
        ("out(1, 2, 3)", 2, "wrong use"),
        ("def f():\n  f()\nend\nf()", 3, "without end"),
        ('out("a" + 1)', 2, "can't compute"),
    ],
)
def test_what_goes_wrong_while_it_runs_is_told_with_its_line(text: str, line: int, says: str) -> None:
    with pytest.raises(ScriptError) as caught:
        result(text)
    assert says in str(caught.value)
    assert caught.value.line == line


@pytest.mark.slow
@pytest.mark.parametrize(
    "text",
    [
        "while True:\nend",
        "x = 2\nwhile True:\n  x = x * x\nend",
        "def f(n):\n  return f(n + 1) + f(n + 1)\nend\nf(0)",
        "thread t():\n  while True:\n    sync()\n  end\nend\nwhile True:\n  x = run t()\nend",
        "x = " + "(" * 5000 + "1" + ")" * 5000,
        "x = " + "[" * 5000,
        "x = " + "-" * 5000 + "1",
        "x = " + "not " * 5000 + "1",
        "x = " + "1 + " * 20000 + "1",
        "if True:\n" * 500 + "end\n" * 500,
        "while True:\n" * 50 + "sync()\n" + "end\n" * 50,
        "x = " + "9" * 100000,
        "x = 1e300 * 1e300",
        "a = [0]\nwhile True:\n  a = [a, a]\nend",
        "a = [0]\nwhile True:\n  a = [a, a]\n  sync()\nend",
        "a = [0, 0]\nwhile True:\n  a[0] = a\n  a[1] = a\n  sync()\nend",
        "a = [0]\nwhile True:\n  a = [a]\n  sync()\nend",
        "def f(n):\n  if n == 0:\n    return 1\n  end\n  return f(n - 1) + f(n - 1)\nend\nout(f(60))",
        "while True:\n" + "x = 1\n" * 3000 + "end",
        "a = [" + "1, " * 5000 + "1]\nwhile True:\n  x = norm(a)\nend",
        "def f0():\n  sync()\nend\n" + "".join(f"def f{i}():\n  f{i - 1}()\nend\n" for i in range(1, 2000)) + "f1()",
        "def f(" + ", ".join(f"p{i}" for i in range(4000)) + "):\n" + "x = 1\n" * 4000 + "end",
    ],
    ids=range(22),
)
def test_a_program_that_would_hang_or_fill_the_controller_is_ended(text: str) -> None:
    before = psutil.Process().memory_info().rss
    with contextlib.suppress(ScriptError), counted_calls() as calls:
        result(text)
    assert calls.count < 2_000_000
    assert psutil.Process().memory_info().rss - before < 4e8


def test_one_cycle_of_the_maddest_program_is_no_pause_that_a_clock_would_drop() -> None:
    for text in ("while True:\nend", "p = p[.5, .2, .3, 0, 3, 0]\nwhile True:\n  x = norm(p)\nend"):
        run = Run(text)
        with pytest.raises(ScriptError, match="without sync"), counted_calls() as calls:
            run.program.tick()
        assert calls.count < 300_000


def test_lists_are_compared_by_their_entries() -> None:
    assert result("a = [1, 2]\nout(a == [1, 2])\nout(a != [1, 3])\nout(a == 1)") == [True, True, False]


@pytest.mark.parametrize(
    "text",
    [
        "x = __import__('os')",
        "x = out.__class__",
        "out((1).__class__)",
        "x = open('/etc/passwd')",
        "x = eval('1')",
        "import os",
        "x = c_out",
        "out(__builtins__)",
        "x = [y for y in [1]]",
        "x = lambda: 1",
        "x = \"'); import os; ('\"\nout(y)",
    ],
)
def test_a_program_reaches_nothing_but_its_commands(text: str) -> None:
    with pytest.raises(ScriptError):
        result(text)


words = st.one_of(
    st.sampled_from(sorted(KEYWORDS)),
    st.sampled_from(["(", ")", "[", "]", ",", ":", "=", "==", "+", "-", "*", "/", "%", "<", ".", "\n", "p[", ";", "#"]),
    st.sampled_from(["x", "y", "out", "sync", "norm", "f", "t", "test", '"s"', "'s'", "1", "2.5", "0x1F", "1e9"]),
)


@settings(max_examples=examples(300), deadline=None)
@given(text=st.lists(words, max_size=40).map(" ".join))
def test_any_words_are_a_program_or_an_error(text: str) -> None:
    with contextlib.suppress(ScriptError):
        run = Run(text, wrap=False)
        for _ in range(5):
            run.program.tick()


@settings(max_examples=examples(200), deadline=None)
@given(text=st.text(max_size=200))
def test_any_text_is_a_program_or_an_error(text: str) -> None:
    with contextlib.suppress(ScriptError):
        Run(text, wrap=False)


@given(cuts=st.lists(st.integers(0, 200), max_size=5))
def test_programs_arrive_whole_however_the_stream_is_cut(cuts: list[int]) -> None:
    text = 'set_x(1)\n\ndef a():\n  if x == 1: # end\n    textmsg("end")\n  end\nend\nsec b():\n  y()\nend\nstopj(2)\n'
    splitter, programs, place = Splitter(), [], 0
    for cut in [*sorted(cuts), len(text)]:
        programs += splitter.feed(text[place:cut])
        place = max(place, cut)
    assert [p.split("(")[0].strip() for p in programs] == ["set_x", "def a", "sec b", "stopj"]


def test_text_without_an_end_is_dropped_before_it_fills_memory() -> None:
    splitter = Splitter(limit=1000)
    assert splitter.feed("def f():\n") == []
    with pytest.raises(ScriptError, match="without an end"):
        splitter.feed("  x = 1234567890\n" * 100)
    assert splitter.feed("stopj(2)\n") == ["stopj(2)\n"]


def test_a_secondary_program_runs_beside_the_main_one_and_can_not_move(bench: Bench) -> None:
    bench.start("sleep(1.0)")
    bench.tick()
    bench.controller.upload("sec light():\n  set_standard_digital_out(3, True)\nend\n")
    bench.controller.upload("sec move():\n  movej([0, 0, 0, 0, 0, 0])\nend\n")
    bench.tick(ticks=3)
    assert bench.controller.signals.digital_out == 1 << 3
    assert bench.controller.playing
    assert bench.said("exception") == ["a secondary program can't move the robot"]


@pytest.mark.parametrize("command", ["force_mode", "freedrive_mode", "teach_mode", "movec"])
def test_what_is_not_supported_ends_the_program_with_a_word_why(bench: Bench, command: str) -> None:
    bench.run(f"{command}()")
    assert bench.said("exception") == [f"{command} is not supported by this virtual controller"]
