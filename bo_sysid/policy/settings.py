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

    Raises:
        StudyError: a number is out of its range.
    """

    kl: float = 0.02
    damping: float = 0.1
    average_kl: bool = True
    cg_steps: int = 15
    shrink: float = 0.8
    backtracks: int = 10

    def __post_init__(self) -> None:
        _require_within(kl=(self.kl, 1e-9, np.inf), damping=(self.damping, 0.0, np.inf))
        _require_within(cg_steps=(self.cg_steps, 1, np.inf), shrink=(self.shrink, 1e-3, 0.999))
        _require_within(backtracks=(self.backtracks, 1, np.inf))


@dataclass(frozen=True)
class CriticFit:
    """Settings of the fit.

    Attributes:
        epochs: passes over the batch.
        minibatch: rows a step.
        rate: learning rate of Adam.
        epsilon: of Adam's denominator.
        decays: of Adam's first and second moments.

    Raises:
        StudyError: a number is out of its range.
    """

    epochs: int = 10
    minibatch: int = 128
    rate: float = 1e-3
    epsilon: float = 1e-5
    decays: tuple[float, float] = (0.9, 0.999)

    def __post_init__(self) -> None:
        _require_within(epochs=(self.epochs, 1, np.inf), minibatch=(self.minibatch, 1, np.inf))
        _require_within(rate=(self.rate, 0.0, np.inf), epsilon=(self.epsilon, 0.0, np.inf))
        for decay in self.decays:
            _require_within(decays=(decay, 0.0, 1.0))


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
        _require_within(discount=(self.discount, 0.0, 1.0), decay=(self.decay, 0.0, 1.0))
        _require_within(log_std=(self.log_std, -20.0, 5.0), clip=(self.clip, 1e-3, np.inf))
        if self.batch < 2 or min(self.hidden, default=0) < 1:
            raise StudyError(
                f"policy: batch {self.batch} must be at least 2, hidden {self.hidden} not empty"
            )


def _require_within(**settings: tuple[float, float, float]) -> None:
    """Refuse a setting (value, low, high) that is not from low to high.

    Raises:
        StudyError: there is one.
    """
    for name, (value, low, high) in settings.items():
        if not low <= value <= high:
            raise StudyError(f"policy: {name} is {value}; it must be from {low:g} to {high:g}")
