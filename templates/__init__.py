"""Procedural parts: a xacro beside its YAML, by kind."""
