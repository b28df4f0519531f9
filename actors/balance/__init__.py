"""Balances: the driver interface, drivers for serial and simulated balances, dialects, and the weighings of a pour."""
