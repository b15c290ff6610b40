"""What a policy sees of a robot, how robots compare, and the hash of a robot."""
