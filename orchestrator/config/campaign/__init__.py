"""Campaigns as written in files, and the plans that are made of them."""
