"""Physical test cases of the solver."""
