"""Physical cases that the solver is held against: setup, measured quantities, reference, criterion; one a module."""
