"""Demonstrations: recorded episodes with the robots that they show, as a LeRobotDataset v3.

``recording`` runs the episodes, ``lerobot`` writes and describes the files, ``reader`` returns what
a policy observes in every step, and ``replay`` verifies episodes in the simulator.
"""
