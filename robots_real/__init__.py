"""Manifests of real parts: where a data package describes them, and their frames."""
