"""Running statistics of observations and returns."""

from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Bool, Float


@dataclass
class RunningMoments:
    """Mean and variance of all samples so far.

    Attributes:
        mean: of each component.
        variance: of each component.
        count: of samples; starts just above zero, so that the first samples decide.
    """

    mean: Float[np.ndarray, "*shape"]
    variance: Float[np.ndarray, "*shape"]
    count: float = 1e-4

    @classmethod
    def of_size(cls, *shape: int) -> "RunningMoments":
        """Return statistics of nothing yet: mean 0, variance 1."""
        return cls(np.zeros(shape), np.ones(shape))

    def add(self, samples: Float[np.ndarray, "n *shape"]) -> None:
        """Take in samples, `n x ...`.

        Chan, Golub & LeVeque (1979): moments of a union from the moments of its parts.
        """
        n = len(samples)
        mean, variance = samples.mean(axis=0), samples.var(axis=0)
        total = self.count + n
        delta = mean - self.mean
        spread = self.variance * self.count + variance * n + delta**2 * (self.count * n / total)
        self.mean = self.mean + delta * (n / total)
        self.variance = spread / total
        self.count = total

    def get_state(self) -> dict[str, np.ndarray]:
        """Return copies of the statistics."""
        return {
            "mean": np.array(self.mean),
            "variance": np.array(self.variance),
            "count": np.array(self.count),
        }

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Restore the state that `get_state` returned."""
        self.mean, self.variance = np.array(state["mean"]), np.array(state["variance"])
        self.count = float(state["count"])


@dataclass(frozen=True)
class Normaliser:
    """Frozen statistics, applied: (x - mean) / std, clipped.

    Attributes:
        mean: `o`.
        std: `o`, positive.
        clip: largest absolute value.
    """

    mean: Float[np.ndarray, " o"]
    std: Float[np.ndarray, " o"]
    clip: float = 10.0

    @classmethod
    def of(cls, moments: RunningMoments, clip: float = 10.0, epsilon: float = 1e-8) -> "Normaliser":
        """Return the statistics as they are now."""
        return cls(moments.mean.copy(), np.sqrt(moments.variance + epsilon), clip)

    def __call__(self, x: Float[np.ndarray, "n o"]) -> Float[np.ndarray, "n o"]:
        """Return `n x o` normalised observations, float32."""
        z = (x - self.mean) / self.std
        return np.asarray(np.clip(z, -self.clip, self.clip, out=z), np.float32)


@dataclass
class ReturnScale:
    """Scales rewards by the spread of the discounted returns.

    Attributes:
        discount: of the running return of each episode.
        running: `n` discounted sums of rewards of the running episodes.
        clip: largest absolute scaled reward.
        moments: of these sums, over all steps.
    """

    discount: float
    running: Float[np.ndarray, " n"]
    clip: float = 10.0
    moments: RunningMoments = field(default_factory=RunningMoments.of_size)

    def __call__(
        self, rewards: Float[np.ndarray, "T n"], ended: Bool[np.ndarray, "T n"]
    ) -> Float[np.ndarray, "T n"]:
        """Take in `T x n` rewards, and return them scaled by the spread of returns, float32."""
        sums = np.empty_like(rewards)
        for t, reward in enumerate(rewards):
            self.running = self.running * self.discount + reward
            sums[t] = self.running
            self.running = np.where(ended[t], 0.0, self.running)
        self.moments.add(sums.ravel())
        scaled = rewards / np.sqrt(self.moments.variance + 1e-8)
        return np.clip(scaled, -self.clip, self.clip).astype(np.float32)

    def get_state(self) -> dict[str, np.ndarray]:
        """Return copies of the running sums and statistics."""
        return {"running": self.running.copy(), **self.moments.get_state()}

    def set_state(self, state: dict[str, np.ndarray]) -> None:
        """Restore the state that `get_state` returned."""
        self.running = np.array(state["running"])
        self.moments.set_state(state)
