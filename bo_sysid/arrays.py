"""One vocabulary of array shapes.

N candidates, d parameters, n evaluated candidates, W windows, H horizon (recorded instants after a
start), S simulation steps, T samples of a recording, c channels, S_mc Monte Carlo samples.
The annotations are documentation at run time and are enforced in the tests (jaxtyping, beartype).
"""

from collections.abc import Mapping
from typing import TypeAlias

import numpy as np
from jaxtyping import Float, Int

# recordings
Times: TypeAlias = Float[np.ndarray, " T"]
Samples: TypeAlias = Float[np.ndarray, " T"]

# the discrete set B
Points: TypeAlias = Float[np.ndarray, "N d"]
Point: TypeAlias = Float[np.ndarray, " d"]
Rows: TypeAlias = Int[np.ndarray, " n"]
Categories: TypeAlias = Mapping[int, Float[np.ndarray, " _"]]  # by column, where there is no order
Deviations: TypeAlias = Float[np.ndarray, " n"]
Probabilities: TypeAlias = Float[np.ndarray, " N"]

# simulation
Qpos: TypeAlias = Float[np.ndarray, "W nq"]
Qvel: TypeAlias = Float[np.ndarray, "W nv"]
Act: TypeAlias = Float[np.ndarray, "W na"]
Ctrl: TypeAlias = Float[np.ndarray, "W S nu"]
