"""What a diagnosis leaves for pictures: held-out traces, sets, a pose."""

from collections.abc import Mapping, Sequence

import numpy as np
import pandas as pd
from jaxtyping import Float

from bo_sysid.diagnosis.answer.answer import Answer
from bo_sysid.diagnosis.answer.argmin import ArgminSets
from bo_sysid.diagnosis.answer.sentences import set_words
from bo_sysid.diagnosis.sets.decide import Decision
from bo_sysid.diagnosis.windows.problem import Problem
from bo_sysid.recording import Recording

_SETS = 12
_POSES = 2_000  # instants among which the pose is chosen


def traces(
    problem: Problem, past: int, residuals: Mapping[str, Float[np.ndarray, "W F c"]]
) -> pd.DataFrame:
    """Return what was recorded and what each model predicts from the past alone.

    Args:
        problem: windows of past and future.
        past: instants of the past in each window.
        residuals: by model, recorded minus predicted after the past, in sigma.

    Returns:
        Columns recording, time [s], begin (the recording's first stamp), window, channel,
        recorded and one for each model, in the channels' own units; one row an instant after the
        past and a channel.
    """
    windows = problem.windows
    observed, weight = windows.observed[:, past:], problem.weight[:, past:]
    instants = (windows.step + windows.fraction)[:, past:] * windows.timestep
    time = windows.time[:, None] + instants
    names = np.array([r.name for r in problem.recordings], dtype=object)[windows.recording]
    begin = np.array([r.span[0] for r in problem.recordings])[windows.recording]
    shape = observed.shape
    with np.errstate(divide="ignore", invalid="ignore"):
        models = {m: np.where(weight > 0, observed - r / weight, np.nan).ravel()
                  for m, r in residuals.items()}  # fmt: skip
    return pd.DataFrame(
        {
            "recording": np.broadcast_to(names[:, None, None], shape).ravel(),
            "time": np.broadcast_to(time[..., None], shape).ravel(),
            "begin": np.broadcast_to(begin[:, None, None], shape).ravel(),
            "window": np.broadcast_to(np.arange(shape[0])[:, None, None], shape).ravel(),
            "channel": np.broadcast_to(np.array(windows.channels, object), shape).ravel(),
            "recorded": observed.ravel(),
            **models,
        }
    )


def sets(decision: Decision, answer: Answer, searched: ArgminSets) -> pd.DataFrame:
    """Return the sets between which was decided, most probable first, "nothing" among them.

    The last row is "none of these": its probability is what the answer keeps for effects that no
    one has thought of, and the probabilities of the sets share the rest.

    Returns:
        Columns set (in words), effects (their number), probability, p_boot (how often the arg-min
        lies in it on other recordings; missing where it was not searched), rms [sensor sigma;
        missing for "none of these"], best and equivalent.
    """
    order = list(zip(decision.fits, decision.probability, strict=True))
    shown = order[:_SETS]
    shown += [(f, p) for f, p in order[_SETS:] if not f.members]
    equivalents = {e.key for e in decision.equivalents}
    outside_catalogue = _probability_outside_catalogue(answer)
    stranger = answer.unexplained.flagged and not answer.findings
    rows = [
        {
            "set": set_words(fit),
            "effects": fit.size,
            "probability": (1.0 - outside_catalogue) * float(probability),
            "p_boot": searched.of(fit),
            "rms": fit.rms,
            "best": fit is decision.best and not stranger,
            "equivalent": fit.key in equivalents,
        }
        for fit, probability in shown
    ]
    rows.append(
        {
            "set": "none of these", "effects": 1, "probability": outside_catalogue, "p_boot": None,
            "rms": np.nan, "best": stranger, "equivalent": False,
        }
    )  # fmt: skip
    return pd.DataFrame(rows).astype({"p_boot": float})


def _probability_outside_catalogue(answer: Answer) -> float:
    """Return the probability of an effect outside the catalogue."""
    unknown = (
        float(a["probability"])
        for a in answer.alternatives
        if any(f["effect"] == "unknown" for f in a["findings"])
    )
    return next(unknown, 0.0)


def bent_pose(recordings: Sequence[Recording]) -> dict[str, float]:
    """Return a recorded pose in which the machine is far from straight, by position channel.

    In four of five instants the joints' squared angles, each by its recorded range, sum to less.
    """
    first = recordings[0]
    channels = {n: c for n, c in first.channels.items() if n.startswith("qpos.")}
    time = np.linspace(*first.span, _POSES)
    values = {n: np.interp(time, c.time, c.values) for n, c in channels.items()}
    bent = np.sum([(v / max(float(np.ptp(v)), 1e-9)) ** 2 for v in values.values()], axis=0)
    at = int(np.argsort(bent)[4 * _POSES // 5])
    return {n: float(v[at]) for n, v in values.items()}
