"""The Bayesian optimiser: linear algebra, and one actor around it."""
