"""Splits: robots and tasks to train and to test on, their files, and those that are shipped."""
