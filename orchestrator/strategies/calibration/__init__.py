"""Calibration (C1 to C4): which parameters θ of the simulator reproduce the weighed spills."""
