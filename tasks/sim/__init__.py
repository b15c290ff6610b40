"""Simulators behind one small protocol."""
