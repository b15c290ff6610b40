"""Robot models: kinematic trees, geometry, mass properties, kinematics and dynamics."""
