"""Recorded pours: their files, replay and fit, the diagnosis of a rig, and their commands. The core runs without it."""
