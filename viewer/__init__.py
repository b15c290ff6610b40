"""The page on which robots are looked at."""
