"""What the viewer draws in three dimensions."""
