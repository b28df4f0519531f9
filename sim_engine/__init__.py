"""The definition of a pour, and the simulation of its liquid.

The lowest layer: it does not import actors or orchestrator.
"""
