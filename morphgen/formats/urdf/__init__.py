"""URDF: what it may contain, reading and writing."""
