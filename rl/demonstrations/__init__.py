"""Demonstrations: recorded episodes with the robots that they show, as a LeRobotDataset v3.

``recording`` runs the episodes and verifies them in the simulator, ``lerobot`` writes and describes
the files, and ``reader`` returns what a policy observes in every step.
"""
