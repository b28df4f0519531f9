"""Strategies: they decide which simulations, pours and suggestions to request next. Pure: no I/O, no clock, no Ray."""
