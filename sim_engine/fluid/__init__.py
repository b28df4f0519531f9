"""The position-based solver. Taichi is used in this package only."""

import os

# Taichi prints a header on stdout at import, but stdout is reserved for results.
os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "False")
os.environ.setdefault("TI_LOG_LEVEL", "error")
# Taichi would contact its maker's site once a day from a thread.
os.environ.setdefault("TI_SKIP_VERSION_CHECK", "ON")
