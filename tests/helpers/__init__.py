"""What tests share: robots, scenes, runs and clients, built in code."""
