"""Deployment (D1 to D3): how to pour into a vessel, planned in simulation, learnt on real pours, or both."""
