"""Figures and tables of a campaign."""
