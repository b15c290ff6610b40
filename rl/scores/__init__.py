"""Scores of policies: evaluations, studies, tables and submissions."""
