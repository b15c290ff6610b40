"""Environments as Gymnasium and stable-baselines3 expect them."""
