"""Which column tells an actuator what to do, by the motion of its joint, where no name says it."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial

import mujoco
import numpy as np
from scipy.optimize import linear_sum_assignment

from bo_sysid.checks.comparable import comparable
from bo_sysid.checks.evidence import WiringEvidence
from bo_sysid.checks.wraps import find_wraps, unwrapped
from bo_sysid.errors import RecordingError
from bo_sysid.mjcf import Model
from bo_sysid.recording import RawTable, Recording
from bo_sysid.recording.value import KINDS, kind_of
from bo_sysid.starter.columns import describe
from bo_sysid.starter.controls import fits_control
from bo_sysid.starter.guess import Rules, read
from bo_sysid.starter.matching import Fits, Guess
from bo_sysid.starter.naming import Column
from bo_sysid.starter.reading import column_rule

_MOST = 800  # instants
_TELLS = 0.8  # share of what moves a joint, that a column must tell
_CLEAR = 0.5  # of what the next best column leaves, that it leaves at most
_CONFIDENCE = 0.65
_DELAYS = tuple(0.008 * np.arange(-2, 8))


def evidence_of(model: mujoco.MjModel, recordings: Sequence[Recording]) -> WiringEvidence | str:
    """Return what recordings say about the channels of a model; why, where they say nothing."""
    made = comparable(model, recordings, _MOST)
    return made if isinstance(made, str) else WiringEvidence(*made, _MOST)


def with_movers(model: Model, tables: Sequence[RawTable], rules: Rules) -> Rules:
    """Return the rules with columns for actuators that have none, as far as the motion tells.

    A servo's goal goes with the position of its joint, a motor's control with the force that the
    motion needs beside friction.
    """
    left = [c for c in describe(tables[0]) if c.name in rules.unused and c.kind != "foreign"]
    columns = {c.name: c for c in left if kind_of(c.name) not in KINDS}
    channels = {n: f"aux.{k}" for k, n in enumerate(columns) if _moves(tables, n)}
    if not rules.unmatched or not channels:
        return rules
    compiled = model.compile()
    also = {c: {"from": n} for n, c in channels.items()}
    recordings = [read(t, replace(rules, columns={**rules.columns, **also})) for t in tables]
    evidence = evidence_of(compiled, unwrapped(recordings, find_wraps(recordings)))
    if isinstance(evidence, str):
        return rules
    fits = partial(fits_control, compiled)
    guesses = _movers_and_fits(
        evidence, rules.unmatched, [columns[n] for n in channels], channels, fits
    )
    ruled = {g.channel: column_rule(tables[0], compiled, g) for g in guesses}
    used = {g.column for g in guesses}
    return replace(
        rules,
        columns={**rules.columns, **{n: rule for n, (rule, _) in ruled.items()}},
        guesses={**rules.guesses, **{n: guess for n, (_, guess) in ruled.items()}},
        unmatched=tuple(a for a in rules.unmatched if f"ctrl.{a}" not in ruled),
        unused=tuple(c for c in rules.unused if c not in used),
    )


def _moves(tables: Sequence[RawTable], name: str) -> bool:
    """Whether a column is complete and changes in each table."""
    try:
        values = [t.column(name) for t in tables]
    except RecordingError:
        return False
    return all(bool(np.isfinite(v).all()) and np.ptp(v) > 0 for v in values)


def _movers_and_fits(
    evidence: WiringEvidence,
    actuators: Sequence[str],
    columns: Sequence[Column],
    channels: Mapping[str, str],
    fits: Fits,
) -> list[Guess]:
    """Return the columns that tell what some actuators did."""
    known = [a for a in actuators if evidence.driven(f"ctrl.{a}") in _recorded(evidence)]
    if not known:
        return []
    share = np.array(
        [[fits(a, c) * _share(evidence, a, channels[c.name]) for c in columns] for a in known]
    )
    found = []
    rows, picked = linear_sum_assignment(-share)
    for r, p in zip(rows.tolist(), picked.tolist(), strict=True):
        others = np.delete(share[r], p)
        next_best = float(others.max()) if len(others) else 0.0
        if share[r, p] < _TELLS or 1 - share[r, p] > _CLEAR * (1 - next_best):
            continue
        name, column, joint = known[r], columns[p], evidence.driven(f"ctrl.{known[r]}")
        what = f"the force at {joint}"
        if evidence.servo(f"ctrl.{name}"):
            what = f"the position of {joint}"
        reason = f"the motion: {100 * share[r, p]:.0f} % of {what} go with it"
        found.append(Guess(f"ctrl.{name}", column.name, column.unit, reason, _CONFIDENCE))
    return found


def _recorded(evidence: WiringEvidence) -> set[str]:
    return {n.removeprefix("qpos.") for n in evidence.recorded if n.startswith("qpos.")}


def _share(evidence: WiringEvidence, actuator: str, column: str) -> float:
    """Return how much of what moves an actuator's joint a column tells, 0 to 1."""
    h, name = evidence.identity(), f"ctrl.{actuator}"
    joint = evidence.driven(name)
    if evidence.servo(name):
        target, physics = evidence.value(h, f"qpos.{joint}"), []
    else:
        terms, j = evidence.terms(h), evidence.dof(name)
        target = terms.required_force[:, j]
        physics = [terms.velocity[:, j], terms.dry[:, j]]
    beside = np.column_stack([np.ones_like(target), *physics])
    spare = _left(beside, target)
    total = float(spare @ spare)
    best = 0.0
    for delay in _DELAYS:
        own = _left(beside, evidence.value(h, column, held=True, delay=delay))
        size = float(np.sqrt(own @ own * total))
        best = max(best, float(own @ spare) ** 2 / size**2 if size > 0 else 0.0)
    return best


def _left(columns: np.ndarray, target: np.ndarray) -> np.ndarray:
    """Return what a regression leaves."""
    return np.asarray(target - columns @ np.linalg.lstsq(columns, target)[0])
