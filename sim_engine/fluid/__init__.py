"""The position-based solver. Its kernels are compiled by Taichi or Quadrants, which only this package imports."""
