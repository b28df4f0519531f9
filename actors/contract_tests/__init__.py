"""Tests that every driver of an arm or a balance has to pass: derive a class in a test module of your own."""
