"""morphgen: procedural robot morphologies with embedded tasks."""
