"""Shared test helpers: robots, scenes, runs and clients, built in code."""
