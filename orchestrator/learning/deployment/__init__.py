"""Deployment strategies D1 to D3: pour into a vessel, based on simulations, on real pours, or on both."""
