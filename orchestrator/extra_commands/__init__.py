"""Commands of packages that a laboratory can do without: validation of the solver, vessels from measurements.

Entry points of the group `decant.commands` name them, so that the core imports neither the commands nor the packages.
"""
