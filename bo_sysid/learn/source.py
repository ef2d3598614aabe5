"""Where real trajectories come from: what a source of them offers to the outer loop."""

from collections.abc import Mapping
from typing import Any, NamedTuple, Protocol, runtime_checkable

import pandas as pd

from bo_sysid.learn.scene import Scene
from bo_sysid.learn.values import Estimate
from bo_sysid.policy.store import LearnedPolicy
from bo_sysid.recording import Recording
from bo_sysid.study import Study


class Waiting(NamedTuple):
    """A trajectory that a person has to record.

    Attributes:
        message: what to record, and where to put it.
    """

    message: str


@runtime_checkable
class Source(Protocol):
    """Where real trajectories come from."""

    def take(self, number: int, policy: LearnedPolicy | None, scene: Scene) -> Waiting | None:
        """Have the recordings of iteration `number`, under the policy of the one before.

        Args:
            number: of the iteration, from 1 on.
            policy: None in the first.
            scene: in which the policy was learned: after a repair its commands have another range.
        """
        ...

    def recordings(self, study: Study) -> tuple[Recording, ...]:
        """All recordings so far, as the model of a study is to see them."""
        ...

    @property
    def training(self) -> Mapping[str, Any]:
        """The study's key `recordings` for what is there, paths relative to the run folder."""
        ...

    @property
    def noise(self) -> Mapping[str, float]:
        """σ of the sensors by kind or channel, as far as it is known."""
        ...

    @property
    def trajectories(self) -> pd.DataFrame:
        """One row a counted trajectory: number, name, steps, seconds, reward, fault."""
        ...

    @property
    def given(self) -> tuple[Recording, ...]:
        """Recordings that were there before, and are no counted trajectories."""
        ...

    def evaluate(self, policy: LearnedPolicy) -> Estimate | None:
        """Return the policy's return on the machine, which is no trajectory; None if unknown."""
        ...
