"""Types that annotations of every package use."""

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]
"""A NumPy array of 64-bit floats. Docstrings give its shape and unit."""
