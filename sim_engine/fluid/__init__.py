"""The position-based solver. Taichi lives here and nowhere else."""

import os

# Taichi greets on stdout at import, which is for results alone.
os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "False")
os.environ.setdefault("TI_LOG_LEVEL", "error")
