"""Catalogue of the runs on this machine: an index of runs and pours, built from the runs' own journals."""
