"""Orchestration of campaigns: strategies, scheduler, journal, results, daemon and command line."""
