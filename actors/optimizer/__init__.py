"""The Bayesian optimiser: numerical code, and the actor that runs it."""
