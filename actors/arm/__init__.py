"""Arms that pour: the interface, the simulated arm, the UR driver, and planning."""
