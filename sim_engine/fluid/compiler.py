"""`ti`: the package that compiles this folder's kernels, Taichi or Quadrants (`sim_engine.engine_package`).

Every module with kernels imports `ti` from here. Quadrants has the same language under another name.
"""

from __future__ import annotations

import importlib
import os
from typing import Any

from sim_engine.engine_package import engine_name
from sim_engine.fluid.engine_startup import imports

NAME = engine_name()

for _variable, _value in {
    # At import they print a header on stdout, which is reserved for results.
    "ENABLE_TAICHI_HEADER_PRINT": "False",
    "ENABLE_QUADRANTS_HEADER_PRINT": "False",
    "TI_LOG_LEVEL": "error",
    "QD_LOG_LEVEL": "error",
    # Taichi would contact its maker's site once a day from a thread.
    "TI_SKIP_VERSION_CHECK": "ON",
}.items():
    os.environ.setdefault(_variable, _value)

with imports(NAME):
    ti: Any = importlib.import_module(NAME)

KERNELS = "kernels" if NAME == "taichi" else f"kernels-{NAME}"
"""Folder of compiled kernels in the cache directory: the packages do not share it."""
