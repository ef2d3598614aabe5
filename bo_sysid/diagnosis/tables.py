"""What a diagnosis leaves for pictures: held-out traces, the missing force, sets, a pose."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np
import pandas as pd
from jaxtyping import Float

from bo_sysid.diagnosis.answer import Answer
from bo_sysid.diagnosis.argmin import ArgminSets
from bo_sysid.diagnosis.decide import Decision
from bo_sysid.diagnosis.evidence import Evidence
from bo_sysid.diagnosis.fitted_starts import DIVERGING
from bo_sysid.diagnosis.hypothesis import Hypothesis
from bo_sysid.diagnosis.linear import Linear, linearise, project
from bo_sysid.diagnosis.problem import Problem, pose
from bo_sysid.diagnosis.sentences import set_words
from bo_sysid.diagnosis.settling import settle
from bo_sysid.diagnosis.signatures import response_to_forces
from bo_sysid.diagnosis.timestep import finer_step
from bo_sysid.effects.machine import JointScale
from bo_sysid.recording import Recording

_PIECE = 0.1  # [s] over which the missing force is taken as constant: above noise, below motion
_LEAST = 8  # instants in such a piece
_PIECES = 300  # most pieces
_ROUNDS = 3
_SHARES = (1.0, 0.3, 0.09)  # of a Gauss-Newton step on the starts
_PRIOR = 3.0  # deviation of the missing force, in units of the joint's typical force
_SETS = 12
_POSES = 2_000  # instants among which the pose is chosen
_FORCE_COLUMNS = (
    "recording", "time", "begin", "joint", "position", "speed", "unit", "nominal", "repaired",
    "sigma",
)  # fmt: skip


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


def missing_force(evidence: Evidence, repaired: Hypothesis, timestep: float) -> pd.DataFrame:
    """Return the force on each joint that a model lacks to follow the training recordings.

    The recordings are cut into pieces of a tenth of a second. In each the residual is explained by
    a start and one constant force a joint, by least squares on the linearised simulator with a
    wide prior: y = P r, f = (AᵀA + 1/s²)⁻¹ Aᵀ y with A the projected response to the forces.
    Both models step as finely as the recordings show: half a long step is a slope over speed that
    no force explains. In a closed chain the forces are those on the joints that are free.

    Args:
        evidence: what the diagnosis was made from.
        repaired: what the nominal model lacks, with the share of a finer step that is shown.
        timestep: at which it was fitted, in [s].

    Returns:
        Columns recording, time [s], begin (the recording's first stamp), joint, position, speed,
        unit, nominal, repaired, and sigma, the standard deviation of the force; one row a piece
        and a joint, forces in `unit`. No rows for a machine without hinges and slides.
    """
    machine = evidence.machine
    if not machine.joints:
        return pd.DataFrame(columns=list(_FORCE_COLUMNS))
    horizon = max(round(_PIECE / machine.sampling), _LEAST)
    whole = sum(r.span[1] - r.span[0] for r in evidence.recordings) / machine.sampling
    problem = pose(
        evidence.model,
        machine,
        evidence.recordings,
        evidence.sigma,
        (),
        horizon=horizon,
        stride=max(int(np.ceil(whole / horizon / _PIECES)), 1),
        timestep=timestep,
        engine=evidence.engine,
        laws=evidence.laws,
    )
    finer, plain = finer_step(repaired.numerics), replace(repaired, numerics=0.0)
    _, nominal, _ = _forces(problem, Hypothesis(), finer)
    linear, left, sigma = _forces(problem, plain, finer)
    windows = problem.windows
    middle = windows.time + 0.5 * windows.step[:, -1] * windows.timestep
    parts = [
        pd.DataFrame(
            {
                "recording": [problem.recordings[i].name for i in windows.recording],
                "time": middle,
                "begin": [problem.recordings[i].span[0] for i in windows.recording],
                "joint": name,
                "position": linear.along.qpos[name].mean(axis=1),
                "speed": linear.along.qvel[name].mean(axis=1),
                "unit": "N m" if joint.hinge else "N",
                "nominal": nominal[:, k],
                "repaired": left[:, k],
                "sigma": sigma[:, k],
            }
        )
        for k, (name, joint) in enumerate(_free(problem).items())
    ]
    return pd.concat(parts, ignore_index=True)


def _free(problem: Problem) -> dict[str, JointScale]:
    """Return the joints that do not follow from others."""
    joints = problem.machine.joints.items()
    return {name: joint for name, joint in joints if name not in problem.loops.joints}


def _forces(
    problem: Problem, hypothesis: Hypothesis, finer: int
) -> tuple[Linear, Float[np.ndarray, "W j"], Float[np.ndarray, "W j"]]:
    """Return the linearised model, and for every window the missing forces with their sigma.

    The residual is that of a time step `finer` times smaller.
    """
    start = problem.windows.start
    for _ in range(_ROUNDS):
        linear = linearise(problem, hypothesis, start)
        start, _ = settle(problem, linear, hypothesis, start, 1, _SHARES)
    linear = linearise(problem, hypothesis, start)
    y = project(linear.Q, problem.residual(hypothesis, start, finer))
    joints = _free(problem)
    one = np.ones((len(y), linear.macros, 1))
    A = np.concatenate(
        [response_to_forces(linear, n, j.force * one) for n, j in joints.items()], -1
    )
    scale = np.array([j.force for j in joints.values()])
    force, sigma = explained(A, y)
    return linear, force * scale, sigma * scale


def explained(
    A: Float[np.ndarray, "W R j"], y: Float[np.ndarray, "W R"]
) -> tuple[Float[np.ndarray, "W j"], Float[np.ndarray, "W j"]]:
    """Return the least-squares forces f of A f = y beside their prior, and their deviations.

    [A; 1/s] f = [y; 0] without normal equations, which impacts make singular. A window whose
    response diverges says nothing: there the prior is left.
    """
    A = np.where((np.abs(A) < DIVERGING).all(axis=(1, 2), keepdims=True), A, 0.0)
    count = A.shape[-1]
    prior = np.broadcast_to(np.eye(count) / _PRIOR, (len(A), count, count))
    inverse = np.linalg.pinv(np.concatenate([A, prior], axis=1), rcond=1e-12)
    force = (inverse[..., : A.shape[1]] @ y[..., None])[..., 0]
    return force, np.sqrt((inverse**2).sum(axis=2))


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
    unheard = _unheard_of(answer)
    stranger = answer.unexplained.flagged and not answer.findings
    rows = [
        {
            "set": set_words(fit),
            "effects": fit.size,
            "probability": (1.0 - unheard) * float(probability),
            "p_boot": searched.of(fit),
            "rms": fit.rms,
            "best": fit is decision.best and not stranger,
            "equivalent": fit.key in equivalents,
        }
        for fit, probability in shown
    ]
    rows.append(
        {
            "set": "none of these", "effects": 1, "probability": unheard, "p_boot": None,
            "rms": np.nan, "best": stranger, "equivalent": False,
        }
    )  # fmt: skip
    return pd.DataFrame(rows).astype({"p_boot": float})


def _unheard_of(answer: Answer) -> float:
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
