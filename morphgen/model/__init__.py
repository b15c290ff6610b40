"""``Robot`` and what follows from it alone: the ground floor."""
