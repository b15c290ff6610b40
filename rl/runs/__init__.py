"""Runs of training: their agents, robots, checkpoints and records."""
