"""Diagnosis of an installation: versions, optional packages, files, caches and a self-test."""
