"""Tests that every driver of an arm or a balance has to pass: derive a class in your own test module."""
