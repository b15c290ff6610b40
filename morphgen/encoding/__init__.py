"""Encodings of a robot: tokens for policies, features for similarity measures, and its hash."""
