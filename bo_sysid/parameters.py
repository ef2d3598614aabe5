"""Parameters of a model and the discrete set B of candidates."""

from collections.abc import Sequence
from dataclasses import dataclass
from math import prod
from typing import Literal

import numpy as np
import pandas as pd
from scipy.stats import qmc

from bo_sysid.arrays import Categories, Point, Points
from bo_sysid.errors import StudyError

Apply = Literal["set", "scale", "add"]

MOST_CANDIDATES = 200_000
"""Points of a grid at most."""

COLUMNS = (
    "level", "row", "deviation", "diverged", "entropy", "contributions", "P", "P_boot", "mean",
)  # fmt: skip
"""What tables of evaluations and beliefs say beside the parameters; names that none may have."""


@dataclass(frozen=True)
class Parameter:
    """A physical quantity of the model that is uncertain.

    Attributes:
        name: name in tables and figures.
        addresses: the MJCF addresses that take the value (several: tied).
        low: lower bound, in `unit`.
        high: upper bound, in `unit`.
        steps: number of grid values from `low` to `high`, both included.
        apply: "set" writes the value, "scale" multiplies the model's own, "add" adds to it.
        unit: unit of the value.
        ordered: False where the grid values are categories: any two of them are equally far apart,
            and none lies between others or beyond them.
    """

    name: str
    addresses: tuple[str, ...]
    low: float
    high: float
    steps: int = 11
    apply: Apply = "set"
    unit: str = ""
    ordered: bool = True

    def __post_init__(self) -> None:
        if not self.addresses:
            raise StudyError(f"parameter {self.name!r}: needs at least one address")
        if not (np.isfinite(self.low) and np.isfinite(self.high) and self.low < self.high):
            raise StudyError(
                f"parameter {self.name!r}: low {self.low:g} must be below high {self.high:g}, "
                "both finite"
            )
        if self.steps < 2:
            raise StudyError(f"parameter {self.name!r}: steps is {self.steps}; at least 2")

    @property
    def grid(self) -> Point:
        """The `steps` grid values, ascending."""
        return np.linspace(self.low, self.high, self.steps)


@dataclass(frozen=True)
class CandidateSet:
    """The discrete set B of parameter vectors; a candidate's identity is its row.

    Attributes:
        parameters: the d parameters, in the order of the columns.
        points: `N x d` parameter values; never changed after construction.
        spacing: `d` steps of the grid that the points lie on; None where they lie on none.
    """

    parameters: tuple[Parameter, ...]
    points: Points
    spacing: Point | None = None

    def __post_init__(self) -> None:
        points = np.array(self.points, dtype=float)
        if points.ndim != 2 or points.shape[1] != len(self.parameters) or not len(points):
            raise StudyError(
                f"candidates {points.shape} must be N x {len(self.parameters)} with N at least 1"
            )
        points.flags.writeable = False
        object.__setattr__(self, "points", points)

    @classmethod
    def from_grid(cls, parameters: Sequence[Parameter]) -> "CandidateSet":
        """Return the full grid, last parameter fastest.

        Raises:
            StudyError: the grid has more than 200 000 points.
        """
        size = prod(p.steps for p in parameters)
        if size > MOST_CANDIDATES:
            raise StudyError(
                f"a grid over {len(parameters)} parameters has {size} candidates, more than "
                f"{MOST_CANDIDATES}; use candidates: {{sobol: 20000}} or fewer steps"
            )
        axes = np.meshgrid(*[p.grid for p in parameters], indexing="ij")
        spacing = np.array([(p.high - p.low) / (p.steps - 1) for p in parameters])
        return cls(tuple(parameters), np.stack([a.ravel() for a in axes], axis=1), spacing)

    @classmethod
    def from_sobol(
        cls, parameters: Sequence[Parameter], size: int, seed: int = 0
    ) -> "CandidateSet":
        """Return the first `size` points of a scrambled Sobol sequence within the bounds.

        A parameter without an order takes its grid values, in equal shares. Where all have none,
        combinations recur, and the set is smaller: no candidate is in it twice.
        """
        sampler = qmc.Sobol(len(parameters), rng=np.random.default_rng(seed))
        unit = sampler.random_base2(int(np.ceil(np.log2(max(size, 2)))))[:size]
        low = np.array([p.low for p in parameters])
        high = np.array([p.high for p in parameters])
        points = low + unit * (high - low)
        for k, p in enumerate(parameters):
            if not p.ordered:
                points[:, k] = p.grid[np.minimum((unit[:, k] * p.steps).astype(int), p.steps - 1)]
        first = np.sort(np.unique(points, axis=0, return_index=True)[1])
        return cls(tuple(parameters), points[first])

    @property
    def bounds(self) -> Points:
        """`2 x d` lower and upper bounds."""
        return np.array([[p.low for p in self.parameters], [p.high for p in self.parameters]])

    @property
    def cell(self) -> Point:
        """`d` sides of the box that a candidate stands for.

        On a grid its spacing; in a design of N points the sides of N equal boxes. A category stands
        for itself alone: there the side is 0, and each combination of categories has its share of
        the N boxes.
        """
        whole, (low, high) = list(self.categories), self.bounds
        if self.spacing is not None:
            side = self.spacing.copy()
        else:
            boxes = len(self) / np.prod([len(values) for values in self.categories.values()])
            ordered = max(len(low) - len(whole), 1)
            side = (high - low) * max(boxes, 1.0) ** (-1 / ordered)
        side[whole] = 0.0
        return np.asarray(side)

    @property
    def categories(self) -> Categories:
        """The values of each parameter without an order, by its column."""
        return {k: p.grid for k, p in enumerate(self.parameters) if not p.ordered}

    def __len__(self) -> int:
        return len(self.points)

    def frame(self) -> pd.DataFrame:
        """Return the candidates as a DataFrame, one column a parameter, one row a candidate.

        Tables add columns to it: `COLUMNS`.
        """
        return pd.DataFrame(self.points, columns=[p.name for p in self.parameters])
