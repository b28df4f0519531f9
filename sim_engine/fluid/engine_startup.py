"""Removes work of Taichi 1.7 and Quadrants 1.3 at start-up that is not needed here, without a change to results.

Each replacement first checks that its target exists in the package; otherwise the package works as usual.
`DECANT_KERNEL_PLACES=1` switches all replacements off. Use it to get the positions of errors while you change a kernel.
"""

from __future__ import annotations

import contextlib
import functools
import gc
import importlib
import inspect
import linecache
import os
import sys
import textwrap
from collections.abc import Callable, Iterator
from types import CodeType, FrameType, ModuleType
from typing import Any

import numpy as np

ENVIRONMENT_VARIABLE = "DECANT_KERNEL_PLACES"


def as_it_is() -> bool:
    """Whether the package must be left unchanged."""
    return bool(os.environ.get(ENVIRONMENT_VARIABLE))


@contextlib.contextmanager
def uncollected() -> Iterator[None]:
    """Context without the garbage collector, which would search a growing heap repeatedly and find nothing."""
    collecting = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collecting:
            gc.enable()


@contextlib.contextmanager
def imports(package: str) -> Iterator[None]:
    """Context in which a package, and modules with kernels, are imported quickly.

    For every function it checks whether it is written inside a class. To find that line it searches all modules.

    Args:
        package: 'taichi' or 'quadrants'.
    """
    if as_it_is():
        yield
        return
    # Empty modules replace the one for source typed at a prompt and the one that checks for a newer version.
    prompt, version = ModuleType("dill"), ModuleType(f"{package}._version_check")
    version.start_version_check_thread = _nothing  # type: ignore[attr-defined]
    for module in prompt, version:
        sys.modules.setdefault(module.__name__, module)
    try:
        with uncollected(), _lines_read():
            yield
    finally:
        _replace(sys.modules.get(f"{package}.lang.kernel_impl"), "_inside_class", _quick_look)
        if sys.modules.get("dill") is prompt:  # remove the replacement, so that a later import gets the real module
            del sys.modules["dill"]


@contextlib.contextmanager
def _lines_read() -> Iterator[None]:
    """Context in which the line of a frame is read from the frame's own file."""
    search = inspect.getframeinfo
    inspect.getframeinfo = _line_of  # type: ignore[assignment]
    try:
        yield
    finally:
        inspect.getframeinfo = search


def _quick_look(look: Callable[[int], bool]) -> Callable[[int], bool]:
    def quick(level_of_class_stackframe: int) -> bool:
        with _lines_read():
            return look(level_of_class_stackframe + 1)

    return quick


def _line_of(frame: FrameType, context: int = 1) -> inspect.Traceback:
    """Like `inspect.getframeinfo` with one line of context."""
    code = frame.f_code
    line = linecache.getline(code.co_filename, frame.f_lineno, frame.f_globals)
    return inspect.Traceback(code.co_filename, frame.f_lineno, code.co_name, [line], 0)


def look_up_quickly(package: str) -> None:
    """Remove the work that takes most of the time when compiled kernels are looked up in the package's cache.

    Args:
        package: 'taichi' or 'quadrants'.
    """
    if as_it_is():
        return
    look_up_part = functools.partial(_part, package)
    with imports(package):
        look_up_part("matrix_ops")  # the first kernel would import it, more slowly
    expr, impl, builder = (look_up_part(name) for name in ("expr", "impl", "ast.ast_transformer_utils"))
    # For each of a kernel's thousands of nodes Taichi finds the method by name, stores the position, …
    # (Quadrants' builder has more to do for a node, so it stays.)
    context = getattr(builder, "ASTTransformerContext", None)
    runtime = impl.get_runtime() if context is not None and hasattr(impl, "get_runtime") else None
    if isinstance(getattr(runtime, "src_info_stack", None), list):
        _replace(getattr(builder, "Builder", None), "__call__", functools.partial(_quick_builder, impl.get_runtime))
    # … formats the line and carets of an error message, …
    _replace(context, "get_pos_info", lambda _: _nothing)
    _replace(getattr(builder, "ASTTransformerFuncContext", None), "memoized_get_pos_info", lambda _: _nothing)
    # … stores the stack for each field, for the case that it is not placed, …
    for module in impl, look_up_part("snode"):
        _replace(module, "get_traceback", lambda _: _nothing)
    # … searches a function's source again for every call, and wraps each of its lines at 9,999 characters.
    for module in look_up_part("kernel_impl"), look_up_part("_wrap_inspect"):
        # Taichi calls the names that its first module has imported; its second one must keep its own.
        if module is not None and (hasattr(module, "textwrap") or hasattr(module, "get_source_info_and_src")):
            _replace(module, "getsourcefile", functools.cache)
            _replace(module, "getsourcelines", lambda search: functools.cache(functools.partial(_source, search)))
    for module in look_up_part("kernel_impl"), look_up_part("_func_base"):
        _replace(module, "textwrap", lambda _: _Text)
    # For each integer it queries the range of its type from numpy, …
    _replace(expr, "_check_in_range", lambda _: _in_range)
    # … and its objects for a kernel form cycles, none of which ends before the kernel is built.
    for module in look_up_part("kernel_impl"), look_up_part("kernel"):
        _replace(getattr(module, "Kernel", None), "materialize", _uncollected_call)


def _part(package: str, name: str) -> Any:
    """A module of a package's language, if one of that name exists."""
    try:
        return importlib.import_module(f"{package}.lang.{name}")
    except ImportError:
        return None


def _replace(owner: object, name: str, by: Callable[[Any], object]) -> None:
    """Replace an attribute once; does nothing if it does not exist."""
    old = getattr(owner, name, None)
    if old is not None and (owner, name) not in _replaced:
        _replaced.add((owner, name))
        setattr(owner, name, by(old))


_replaced: set[tuple[object, str]] = set()


def _nothing(*_: object, **__: object) -> str:
    return ""


def _quick_builder(runtime: Callable[[], Any], build: Callable[..., object]) -> Callable[..., object]:
    """Like Taichi's builder, which is then called only for errors."""
    methods: dict[type, Any] = {}

    def quick(self: Any, context: object, node: object) -> object:
        kind = node.__class__
        if kind not in methods:
            methods[kind] = getattr(type(self), "build_" + kind.__name__, None)
        method = methods[kind]
        if method is None:
            return build(self, context, node)
        places = runtime().src_info_stack
        places.append("")
        try:
            return method(context, node)
        except Exception as problem:
            return build(_Raising(problem), context, node)
        finally:
            places.pop()

    return quick


class _Raising:
    """A builder that raises, whatever it builds."""

    def __init__(self, problem: Exception) -> None:
        self._problem = problem

    def __getattr__(self, name: str) -> Callable[..., object]:
        if not name.startswith("build_"):
            raise AttributeError(name)
        return self._raise

    def _raise(self, *_: object) -> object:
        raise self._problem


def _source(search: Callable[..., tuple[list[str], int]], function: Any) -> tuple[list[str], int]:
    """Lines of a function and the number of the first; `inspect` would read it token by token to find its end."""
    code = getattr(inspect.unwrap(function), "__code__", None)
    lines = linecache.getlines(code.co_filename) if isinstance(code, CodeType) else []
    if not isinstance(code, CodeType) or not lines:
        return search(function)
    first = code.co_firstlineno - 1
    margin = _margin(lines[first])
    end = _last_line(code)
    # After its last expression a function contains at most closing brackets.
    while end < len(lines) and lines[end].strip() and _margin(lines[end]) > margin:
        end += 1
    return lines[first:end], first + 1


def _margin(line: str) -> int:
    return len(line) - len(line.lstrip())


def _last_line(code: CodeType) -> int:
    """Number of the last line that has code."""
    inner = [_last_line(constant) for constant in code.co_consts if isinstance(constant, CodeType)]
    return max([end or 0 for _, end, _, _ in code.co_positions()] + inner)


class _Text:
    """The part of `textwrap` that the packages use."""

    dedent = staticmethod(textwrap.dedent)

    @staticmethod
    def fill(line: str, **options: Any) -> str:
        """Return a line of source unchanged."""
        if "\t" in line or len(line) > 200:
            return textwrap.fill(line, **options)
        return line.rstrip()


@functools.cache
def _range(kind: type) -> tuple[int, int]:
    info = np.iinfo(kind)
    return int(info.min), int(info.max)


def _in_range(kind: type, value: int) -> bool:
    least, most = _range(kind)
    return bool(least <= value <= most)


def _uncollected_call(call: Callable[..., object]) -> Callable[..., object]:
    @functools.wraps(call)
    def quiet(*args: object, **kwargs: object) -> object:
        with uncollected():
            return call(*args, **kwargs)

    return quiet
