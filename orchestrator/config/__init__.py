"""Laboratories as written in files: simulators, arm, balance, operator, cluster."""
