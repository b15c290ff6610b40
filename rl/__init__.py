"""Policies, training and evaluation over batches of bodies."""
