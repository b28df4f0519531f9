"""The command line interface."""

import os

# Before numpy is imported: threads of its linear algebra do not make matrices this small faster, and starting them
# takes as much CPU time as the rest of the import. Children inherit it.
os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
