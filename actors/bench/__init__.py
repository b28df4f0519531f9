"""Benches: one pour from the first question to the last weight, with hardware, emulated devices or simulated ones."""
