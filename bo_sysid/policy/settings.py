"""Settings of TRPO; nothing here needs torch."""

from dataclasses import dataclass, field

import numpy as np

from bo_sysid.errors import StudyError


@dataclass(frozen=True)
class TrustRegion:
    """Settings of the update.

    Attributes:
        kl: bound of the mean KL divergence.
        damping: added to the diagonal of its Hessian.
        average_kl: average the KL divergence over action dimensions; else sum.
        cg_steps: most steps of conjugate gradients.
        shrink: factor of the step when the line search backtracks.
        backtracks: most trials of the line search.
    """

    kl: float = 0.02
    damping: float = 0.1
    average_kl: bool = True
    cg_steps: int = 15
    shrink: float = 0.8
    backtracks: int = 10


@dataclass(frozen=True)
class CriticFit:
    """Settings of the fit.

    Attributes:
        epochs: passes over the batch.
        minibatch: rows a step.
        rate: learning rate of Adam.
        epsilon: of Adam's denominator.
        decays: of Adam's first and second moments.
    """

    epochs: int = 10
    minibatch: int = 128
    rate: float = 1e-3
    epsilon: float = 1e-5
    decays: tuple[float, float] = (0.9, 0.999)


@dataclass(frozen=True)
class TrpoSettings:
    """Settings of a training run; the defaults learn dm-control's cheetah and swimmer.

    Attributes:
        batch: control steps an iteration, over all environments.
        discount: gamma.
        decay: lambda of the advantages.
        hidden: units of the hidden layers, of policy and critic alike.
        log_std: logarithm of the policy's initial standard deviation, in units of half the
            control range.
        clip: largest absolute normalised observation and scaled reward.
        region: settings of the policy's update.
        critic: settings of the critic's fit.

    Raises:
        StudyError: a number is out of its range.
    """

    batch: int = 20_000
    discount: float = 0.99
    decay: float = 0.95
    hidden: tuple[int, ...] = (64, 64)
    log_std: float = 0.0
    clip: float = 10.0
    region: TrustRegion = field(default_factory=TrustRegion)
    critic: CriticFit = field(default_factory=CriticFit)

    def __post_init__(self) -> None:
        for name, value, low, high in (
            ("discount", self.discount, 0.0, 1.0),
            ("decay", self.decay, 0.0, 1.0),
            ("kl", self.region.kl, 1e-9, np.inf),
            ("damping", self.region.damping, 0.0, np.inf),
            ("cg_steps", self.region.cg_steps, 1, np.inf),
            ("backtracks", self.region.backtracks, 1, np.inf),
            ("shrink", self.region.shrink, 1e-3, 0.999),
        ):
            if not low <= value <= high:
                raise StudyError(f"policy: {name} is {value}; it must be from {low:g} to {high:g}")
        if self.batch < 2 or min(self.hidden, default=0) < 1:
            raise StudyError(
                f"policy: batch {self.batch} must be at least 2, hidden {self.hidden} not empty"
            )
