"""Simulators as a pool: in processes of their own, or in this one."""
