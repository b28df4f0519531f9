"""Rerun recordings: what a campaign looks like while it runs and afterwards."""
