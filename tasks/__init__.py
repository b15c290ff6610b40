"""Reach and push over a batch of bodies, on interchangeable simulators."""
