"""What a log does not say of the time before it, where a late drive is what the model lacks.

A lag, a delay or a slow command goes on from what was sent before. As far as anything tells, that
was the log's first command; a machine that was switched on at that moment had none, and for a few
time constants it moves as no drive makes it that goes on from that command.
"""

from collections.abc import Iterator, Sequence

import numpy as np
from jaxtyping import Bool, Float

from bo_sysid.diagnosis.search.search import Search
from bo_sysid.diagnosis.sets.fit import Fit
from bo_sysid.diagnosis.sets.groups import all_but, subset
from bo_sysid.diagnosis.sets.meshing import LATE
from bo_sysid.diagnosis.sets.rules import LOOSE, clean
from bo_sysid.diagnosis.windows.candidate import Candidate
from bo_sysid.diagnosis.windows.evidence import first_command
from bo_sysid.diagnosis.windows.projection import project
from bo_sysid.effects.memory import FORGOTTEN

_REMEMBERING = (*LATE, "command_rate")
_LEAST = 0.1  # [s] looked at, and left out, after a first command
_FEW = 0.25  # share of the windows, that may begin so early
_MORE = 2.0  # times what a set leaves of the other windows, that it leaves of those
_EXPLAINED = 1.1  # [sigma] in the other windows, which may be few
_TRIED = 3  # sets, those that leave least of the other windows


def unexplained_start(search: Search) -> tuple[float, Fit] | None:
    """Return for how long in [s] after first commands logs are not explained, and what then does.

    That is where a set with a late drive explains all windows but those, and does not without it;
    None where there is none.
    """
    problem = search.prepared.problem
    if clean(search.best) or problem.machine.impacts:
        return None
    first = np.array([first_command(r) for r in problem.recordings])
    since = problem.windows.time - first[problem.windows.recording]
    tried: list[tuple[float, Fit]] = []
    for f in search.fits.values():
        early = since < _forgotten(f) - 1e-9
        if _late(f) and 0 < early.sum() <= _FEW * len(early):
            left = problem.mean_square(project(search.frame.Q, f.residual))
            begin, rest = np.sqrt(left[early].mean()), np.sqrt(left[~early].mean())
            if begin > _MORE * rest:
                tried.append((float(rest), f))
    for _, f in sorted(tried, key=lambda pair: pair[0])[:_TRIED]:
        made = _fitted(search, f, since >= _forgotten(f) - 1e-9)
        if made is not None:
            return _forgotten(made), made
    return None


def _late(fit: Fit) -> list[int]:
    """Return which members of a set go on from what was sent before."""
    return [k for k, c in enumerate(fit.members) if c.effect.id in _REMEMBERING]


def _forgotten(fit: Fit) -> float:
    """Return for how long in [s] the late drives of a set go on from what was sent before."""
    times = [_LEAST]
    for c, x in zip(fit.members, fit.x, strict=True):
        if c.effect.id == "actuator_lag":
            times.append(FORGOTTEN * float(x[0]))
        elif c.effect.id == "actuator_delay":
            times.append(float(x[0]))
    return max(times)


def _fitted(search: Search, fit: Fit, rest: Bool[np.ndarray, " W"]) -> Fit | None:
    """Return a set that explains some of the windows, and without its late drives does not."""
    alone = Search.on(search.prepared.rows(rest), search.candidates, search.most, fit.hypothesis)
    for members, x in _with_lags_for_late_drives(search, fit):
        made = alone.fit(members, x, guess=fit.hypothesis)
        if made.rms < _EXPLAINED:
            prompt = all_but(made, _late(made))
            needed = alone.fit(*subset(made, prompt), guess=fit.hypothesis).rms > LOOSE
            return made if needed else None
    return None


def _with_lags_for_late_drives(
    search: Search, fit: Fit
) -> Iterator[tuple[Sequence[Candidate], Sequence[Float[np.ndarray, " _"]]]]:
    """Yield a set, the lags of its late drives, and these beside its other members.

    Where windows count that nothing explains, delays and what makes up for them stand for lags.
    """
    yield fit.members, fit.x
    sites = {fit.members[k].site.name for k in _late(fit)}
    usual = (c for c in search.candidates if c.key[0] == "actuator_lag" and not c.secant)
    lags = tuple({c.site.name: c for c in usual if c.site.name in sites}.values())
    begin = tuple(c.probe for c in lags)
    yield lags, begin
    others, x = subset(fit, all_but(fit, _late(fit)))
    yield (*others, *lags), (*x, *begin)
