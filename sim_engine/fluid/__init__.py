"""The position-based solver. Taichi lives here and nowhere else."""

import os

# Taichi greets on stdout at import, which is for results alone.
os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "False")
os.environ.setdefault("TI_LOG_LEVEL", "error")
# Nor need it tell its maker's site that it is there: it would, from a thread, once a day.
os.environ.setdefault("TI_SKIP_VERSION_CHECK", "ON")
