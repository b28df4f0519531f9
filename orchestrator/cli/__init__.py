"""The command line interface."""

import gc
import os

# Before numpy is imported: threads of its linear algebra do not make matrices this small faster, and starting them
# takes as much CPU time as the rest of the import. Children inherit it.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

# Pydantic would read the metadata of every installed package to find observers of its own.
os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "1")

# Imports and schemas are a million lasting objects, which the collector would search again after every 700 new ones.
gc.set_threshold(50_000, 10, 10)
