"""Scores on splits: episodes, studies, tables, submissions and leaderboards."""
