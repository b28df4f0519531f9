"""`engine_startup`: Taichi without what it does in vain: the same kernels, the same complaints."""

from __future__ import annotations

import gc
import inspect
import sys
import textwrap

import pytest

from sim_engine.fluid import density, engine, kernels, neighbours, state, step, tension, viscosity, walls
from sim_engine.fluid import engine_startup as quick
from sim_engine.fluid import kernels as vectors
from sim_engine.fluid import neighbours as columns
from sim_engine.fluid import state as table
from sim_engine.fluid import viscosity as newtonian
from sim_engine.fluid import viscosity as packing
from sim_engine.fluid import walls as rims
from sim_engine.fluid.compiler import ti
from sim_engine.fluid.engine import FluidEngine
from sim_engine.simulator import PourSimulator

MODULES = columns, density, engine, kernels, neighbours, newtonian, packing, rims, state, step, table, tension, vectors
FUNCTIONS = [
    function.__wrapped__
    for module in (*MODULES, viscosity, walls)
    for owner in (module, *(part for part in vars(module).values() if inspect.isclass(part)))
    for function in vars(owner).values()
    if hasattr(function, "_is_taichi_function") or hasattr(function, "_is_wrapped_kernel")
]


def body(lines: list[str]) -> str:
    """Source without comments behind it."""
    while not lines[-1].strip() or lines[-1].lstrip().startswith("#"):
        lines = lines[:-1]
    return "".join(lines)


def test_a_function_s_source_is_what_inspect_finds() -> None:
    """Written over many lines, with brackets that close behind the last expression."""
    assert len(FUNCTIONS) > 50
    for function in FUNCTIONS:
        lines, first = quick._source(inspect.getsourcelines, function)
        expected, at = inspect.getsourcelines(function)
        assert (body(lines), first) == (body(expected), at), function.__qualname__


@pytest.mark.parametrize("line", ["    x = 1  \n", "\n", "y\n", "\tif a:\n", f"z = {'1 + ' * 60}1\n"])
def test_lines_are_those_that_textwrap_makes(line: str) -> None:
    assert quick._Text.fill(line, tabsize=4, width=9999) == textwrap.fill(line, tabsize=4, width=9999)


def test_an_error_in_a_kernel_is_still_told(simulator: PourSimulator) -> None:
    engine.engine()

    @ti.kernel
    def wrong():  # type: ignore[no-untyped-def]
        print(nowhere)  # type: ignore[name-defined]  # noqa: F821

    with pytest.raises(Exception, match='"nowhere" is not defined'):
        wrong()


def test_nothing_is_left_behind(simulator: PourSimulator) -> None:
    """The collector collects, and who wants a module that Taichi was spared gets it."""
    assert isinstance(engine.engine(), FluidEngine)
    assert gc.isenabled()
    assert getattr(sys.modules.get("dill", pytest), "__file__", None)
    assert inspect.getframeinfo.__module__ == "inspect"
