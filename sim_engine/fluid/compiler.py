"""`ti`: the package that compiles this folder's kernels, Taichi or Quadrants (`sim_engine.engine_package`).

Every module with kernels imports `ti` from here. Quadrants has the same language under another name.
"""

from __future__ import annotations

import importlib
import os
from typing import Any

from sim_engine.engine_package import ENGINES, VARIABLE, engine_name
from sim_engine.errors import EngineError
from sim_engine.fluid.engine_startup import imports
from sim_engine.resources import ENVIRONMENT_VARIABLE, cache_directory

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

if not os.environ.get("HOME"):
    # Taichi aborts the process if it finds neither variable, as in a service.
    os.environ[ENVIRONMENT_VARIABLE] = os.environ["XDG_CACHE_HOME"] = str(cache_directory())

try:
    with imports(NAME):
        ti: Any = importlib.import_module(NAME)
except ImportError as error:
    raise EngineError(f"{NAME} can't be loaded: {error}. {VARIABLE} chooses one of {', '.join(ENGINES)}") from error

KERNELS = "kernels" if NAME == "taichi" else f"kernels-{NAME}"
"""Folder of compiled kernels in the cache directory: the packages do not share it."""
