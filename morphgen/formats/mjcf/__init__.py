"""MJCF: documents of strangers, reading and writing."""
