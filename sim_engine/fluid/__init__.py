"""The position-based solver. Taichi lives here and nowhere else."""
