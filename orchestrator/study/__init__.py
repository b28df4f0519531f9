"""Comparisons of strategies over many runs."""
