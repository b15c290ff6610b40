"""xacro: expanding files of strangers, evaluating their expressions."""
