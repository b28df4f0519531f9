"""Recorded pours: their files, replay with simulator and estimator, fits of unknown quantities, export from runs."""
