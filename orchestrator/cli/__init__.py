"""The command line interface."""

import atexit
import gc
import os

# Before numpy is imported: threads of its linear algebra do not make matrices this small faster, and starting them
# takes as much CPU time as the rest of the import. Children inherit it.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Pydantic would read the metadata of every installed package to find observers of its own.
os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "1")

# Imports and schemas are a hundred thousand lasting objects. The collector would search them again after every 700 new
# ones, and at the end of the process.
gc.set_threshold(100_000, 10, 10)
atexit.register(gc.freeze)
