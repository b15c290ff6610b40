"""Names of the observation channels, in a module that loads no torch."""

KINEMATIC_CHANNELS = ("lag", "joint", "poses", "jacobian", "dls", "ik")
"""Channels of ``kinematic_channels``, in the order in which networks concatenate them."""
CHANNELS = (
    *KINEMATIC_CHANNELS,
    *("velocity", "previous_action", "tree", "points", "no_state"),
)
"""Channels of observations that can be asked for by name; ``no_state`` hides what it names."""
