"""Calibration strategies C1 to C4: they fit the simulator's parameters θ to the weighed spills."""
