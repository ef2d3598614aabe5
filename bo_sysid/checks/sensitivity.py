r"""What recordings can say about parameters, through the simulator.

Windows are predicted at the nominal point and at points beside it. With S the whitened change of
all predictions with the parameters and J₀ that with the start of each window, the start is a
nuisance: S is projected on what J₀ cannot do, window by window, and F = Sᵀ S is the Fisher
information of white sensor noise. F⁻¹ bounds the variance of any unbiased estimate (Cramér, Rao).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float

from bo_sysid.arrays import Point
from bo_sysid.checks.flags import Flag
from bo_sysid.parameters import Parameter
from bo_sysid.simulation import Simulator, State, Windows

_STEP = 1e-3  # of a parameter's range
_MOVE = (1e-6, 1e-4)  # of positions in [rad] or [m], of velocities
_PRIOR = 1 / np.sqrt(12)  # of the range: standard deviation of what is uniform within it
_WEAK = 0.1  # of the range: a standard deviation that is weak
_SAYS_NOTHING = 0.9  # of the prior: so little do the recordings narrow it
_PART = 0.25  # of a combination of length 1, that a parameter has in it; less where all have little
_DEAD = 1e-9
_SHOWN = 4  # parameters that a sentence lists


@dataclass(frozen=True)
class Information:
    """Fisher information about d parameters, in units of their ranges.

    Attributes:
        parameters: the parameters.
        fisher: `d x d`, for parameters scaled so that low to high is 1.
    """

    parameters: tuple[Parameter, ...]
    fisher: Float[np.ndarray, "d d"]

    @property
    def sigma(self) -> Float[np.ndarray, " d"]:
        """Least standard deviation of each parameter, in units of its range; at most 1/√12."""
        # the range itself is known: a uniform prior has a variance of 1/12
        return np.asarray(
            np.sqrt(np.diag(np.linalg.inv(self.fisher + 12 * np.eye(len(self.fisher)))))
        )

    def table(self) -> pd.DataFrame:
        """Return one row a parameter: name, unit, sigma, share of the range, verdict."""
        share = self.sigma
        width = np.array([p.high - p.low for p in self.parameters])
        verdict = np.where(
            share < _WEAK, "yes", np.where(share < _SAYS_NOTHING * _PRIOR, "weakly", "not")
        )
        return pd.DataFrame(
            {
                "name": [p.name for p in self.parameters],
                "unit": [p.unit for p in self.parameters],
                "sigma": share * width,
                "of_range": share,
                "determined": verdict,
            }
        )

    def weakest(self) -> list[tuple[float, dict[str, float]]]:
        """Return combinations that the recordings hardly determine.

        Each is its standard deviation in units of the range, and the share of each parameter in
        it; combinations better than a tenth of the range are left out.
        """
        values, vectors = np.linalg.eigh(self.fisher + 12 * np.eye(len(self.fisher)))
        out = []
        for value, vector in zip(values, vectors.T, strict=True):
            sigma = float(value**-0.5)
            if sigma < _WEAK:
                break
            vector = vector * np.sign(vector[np.argmax(np.abs(vector))])
            least = min(_PART, 0.5 * float(vector.max()))
            names = {
                p.name: float(x)
                for p, x in zip(self.parameters, vector, strict=True)
                if abs(x) > least
            }
            out.append((sigma, names))
        return out


def information(
    simulator: Simulator, point: Point, windows: Windows, noise: Mapping[str, float]
) -> Information:
    """Return what windows say about the simulator's parameters at a point.

    Args:
        simulator: predicts.
        point: the parameter values, within their bounds.
        windows: W windows.
        noise: standard deviation of each observed channel, in its unit.
    """
    projected = sensitivities(simulator, point, windows, noise)
    flat = projected.reshape(-1, projected.shape[-1])
    return Information(simulator.parameters, flat.T @ flat)


def sensitivities(
    simulator: Simulator, point: Point, windows: Windows, noise: Mapping[str, float]
) -> Float[np.ndarray, "W m d"]:
    """Return the whitened change of predictions per range of each parameter, starts projected.

    It is 0 in windows in which a simulation diverges, which says nothing of parameters.
    """
    return _linearised(simulator, point, windows, noise)[0]


def with_fitted_starts(
    simulator: Simulator, point: Point, windows: Windows, noise: Mapping[str, float]
) -> tuple[Float[np.ndarray, " d"], Float[np.ndarray, " d"]]:
    """Return the parameters that fit best where the start of each window is fitted as well.

    One Gauss-Newton step from a point, in parameters and starts at once, within the bounds.

    Args:
        simulator: predicts.
        point: `d` parameter values to step from, within their bounds.
        windows: W windows.
        noise: standard deviation of each observed channel, in its unit.

    Returns:
        `d` values, and `d` standard deviations of theirs, by what the step leaves of the residual
        where that is more than noise.
    """
    point = _inside(simulator.parameters, point)  # where the residual is that of the step
    S, r, starts = _linearised(simulator, point, windows, noise)
    flat, left = S.reshape(-1, S.shape[-1]), r.ravel()
    inverse = np.linalg.inv(flat.T @ flat + 12 * np.eye(flat.shape[1]))  # a uniform prior's, see σ
    step = inverse @ (flat.T @ left)
    numbers = int(np.count_nonzero(left)) - starts
    variance = float(((left - flat @ step) ** 2).sum()) / max(numbers - len(step), 1)
    low, high = np.array([(p.low, p.high) for p in simulator.parameters]).T
    sigma = np.sqrt(np.diag(inverse) * max(variance, 1.0))
    return np.clip(point + step * (high - low), low, high), sigma * (high - low)


def _linearised(
    simulator: Simulator, point: Point, windows: Windows, noise: Mapping[str, float]
) -> tuple[Float[np.ndarray, "W m d"], Float[np.ndarray, "W m"], int]:
    """Return sensitivities and the whitened residual, both projected on what starts cannot do.

    Beside them, how many numbers of starts were fitted for that: none in windows that diverge, nor
    of joints that follow others.
    """
    weight = np.array([1.0 / noise[n] if noise.get(n) else 0.0 for n in windows.channels])
    inside = _inside(simulator.parameters, point)
    points = [inside]
    for row in np.diag([_STEP * (p.high - p.low) for p in simulator.parameters]):
        points += [inside + row, inside - row]
    made = list(simulator.predictions(np.array(points), windows))
    base, *beside = [_whitened(p.values, windows, weight) for p in made]
    effect = np.stack(
        [(a - b) / (2 * _STEP) for a, b in zip(beside[::2], beside[1::2], strict=True)], axis=-1
    )
    start, lost = _start_effect(simulator, inside, windows, weight, base)
    residual = np.nan_to_num(windows.residual(made[0].values) * weight).reshape(len(windows), -1)
    columns = np.concatenate([effect, residual[..., None]], axis=-1)
    lost |= np.any([p.diverged for p in made], axis=0)
    columns[lost] = 0.0
    found = np.stack([_without(e, s) for e, s in zip(columns, start, strict=True)])
    return found[..., :-1], found[..., -1], int(start.shape[-1] * np.count_nonzero(~lost))


def _inside(parameters: Sequence[Parameter], point: Point) -> Point:
    """Return the values next to a point that are a difference away from all bounds."""
    low, high = np.array([(p.low, p.high) for p in parameters]).T
    margin = _STEP * (high - low)
    return np.asarray(np.clip(point, low + margin, high - margin))


def _start_effect(
    simulator: Simulator, point: Point, windows: Windows, weight: np.ndarray, base: np.ndarray
) -> tuple[Float[np.ndarray, "W m k"], Bool[np.ndarray, " W"]]:
    """Return the change with the k numbers of each start, and the windows that diverge then.

    Joints that follow through closed chains have no start of their own.
    """
    dof = windows.start.qvel.shape[1]
    own = np.setdiff1d(np.arange(dof), simulator.following)
    size, free = np.repeat(_MOVE, dof), np.concatenate([own, dof + own])
    starts: list[State] = [
        simulator.moved(windows.start, np.tile(row, (len(windows), 1)))
        for row in np.diag(size)[free]
    ]
    points = np.repeat(point[None], len(starts), axis=0)
    moved = list(simulator.predictions(points, windows, starts))
    columns = [
        (_whitened(p.values, windows, weight) - base) / h
        for p, h in zip(moved, size[free], strict=True)
    ]
    return np.stack(columns, axis=-1), np.any([p.diverged for p in moved], axis=0)


def _whitened(values: np.ndarray, windows: Windows, weight: np.ndarray) -> np.ndarray:
    seen = np.isfinite(windows.observed)
    return np.asarray(np.where(seen, values * weight, 0.0).reshape(len(windows), -1))


def _without(effect: np.ndarray, nuisance: np.ndarray) -> np.ndarray:
    """Return `m x d` columns projected on what `m x k` nuisances cannot do."""
    scale = np.linalg.norm(nuisance, axis=0)
    alive = nuisance[:, scale > _DEAD * max(float(scale.max()), 1e-300)]
    q, _ = np.linalg.qr(alive / np.linalg.norm(alive, axis=0))
    return np.asarray(effect - q @ (q.T @ effect))


def bounds_flags(parameters: Sequence[Parameter], point: Point) -> list[Flag]:
    """Return the parameters whose bounds leave out the model as it is.

    Args:
        parameters: d parameters.
        point: d values that stand for the model as it is.
    """
    outside = {
        p.name: f"{p.name} ({value:.4g}, and not {p.low:.4g} to {p.high:.4g})"
        for p, value in zip(parameters, point.tolist(), strict=True)
        if abs(value - 0.5 * (p.low + p.high)) > (0.5 + _DEAD) * (p.high - p.low)
    }
    if not outside:
        return []
    more = f", and {len(outside) - _SHOWN} more" if len(outside) > _SHOWN else ""
    sentence = (
        f"The model as it is lies outside the bounds of {listed(list(outside.values())[:_SHOWN])}"
        f"{more}: it is none of the candidates, as is right only where it is known to be wrong."
    )
    return [Flag("look", "bounds", tuple(outside), sentence)]


def in_words(combination: Mapping[str, float]) -> str:
    """Return a combination of parameters as a sentence's subject."""
    names = list(combination)
    if len(names) == 1:
        return names[0]
    up = [n for n in names if combination[n] > 0]
    down = [n for n in names if combination[n] < 0]
    if not down:
        return f"{listed(up)} rising together"
    if not up:
        return f"{listed(down)} falling together"
    return f"{listed(up)} rising while {listed(down)} fall{'s' * (len(down) == 1)}"


def listed(names: Sequence[str]) -> str:
    """Return "a, b and c"."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"
