"""Signatures: how each candidate would move the predictions, by the linear model along them.

The response to a candidate is one propagation of what it adds in a step: B times a force, E times a
change of control, or the one-step difference of the edited model. Where it adds a joint, no linear
model of the same state tells of it, and its grid point is simulated.
"""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace

import numpy as np
from jaxtyping import Float

from bo_sysid.diagnosis.windows.candidate import Candidate
from bo_sysid.diagnosis.windows.commanded import changed_activations
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis
from bo_sysid.diagnosis.windows.linear import Linear
from bo_sysid.diagnosis.windows.observation import observe
from bo_sysid.diagnosis.windows.projection import project
from bo_sysid.effects import Force
from bo_sysid.mjcf.commands import clamped
from bo_sysid.mjcf.compiling import differ

_BATCH = 24  # columns propagated at once
_FAR = 1e9  # [sigma] a response is cut off here, where the linear model diverges


def signatures(
    linear: Linear,
    candidates: Sequence[Candidate],
    *,
    left_out: Collection[Candidate] = (),
    out: Float[np.ndarray, "W R p"] | None = None,
) -> Float[np.ndarray, "W R p"]:
    """Return the projected response to each magnitude of each candidate, per unit, in sigma.

    Args:
        linear: the linear model.
        candidates: what is added to its hypothesis.
        left_out: candidates of which nothing is computed; theirs is zero.
        out: where the responses are written; those of many windows are large.
    """
    if out is None:
        count = sum(c.size for c in candidates)
        out = np.zeros((*linear.Q.shape[:2], count), np.float32)
    first = 0
    for batch in _batches(candidates):
        columns = _responses(linear, batch, left_out)
        last = first + columns.shape[-1]
        out[..., first:last] = columns
        first = last
    return out


def _batches(candidates: Sequence[Candidate]) -> Iterator[list[Candidate]]:
    """Split candidates into batches with columns enough for one propagation."""
    batch: list[Candidate] = []
    for candidate in candidates:
        batch.append(candidate)
        if sum(c.size for c in batch) >= _BATCH:
            yield batch
            batch = []
    if batch:
        yield batch


def _responses(
    linear: Linear, candidates: Sequence[Candidate], left_out: Collection[Candidate]
) -> Float[np.ndarray, "W R p"]:
    """Return the projected responses to some candidates, from one propagation."""
    forcing, shown = zip(
        *(_no_forcing(linear, c) if c in left_out else _forcing(linear, c) for c in candidates),
        strict=True,
    )
    response = linear.shown(linear.propagate(np.concatenate(forcing, axis=-1)))
    response += np.concatenate(shown, axis=-1)
    response = project(linear.Q, response)
    np.clip(response, -_FAR, _FAR, out=response)
    response[np.isnan(response)] = 0.0
    return response


def response_to_forces(
    linear: Linear, joint: str, forces: Float[np.ndarray, "W M k"]
) -> Float[np.ndarray, "W R k"]:
    """Return the projected response to forces on a joint, one in each macro step."""
    dof = linear.problem.machine.joints[joint].dof
    B = linear.held(linear.B[..., dof])[..., None]
    parts = [
        project(linear.Q, linear.shown(linear.propagate(B * forces[:, :, None, k : k + _BATCH])))
        for k in range(0, forces.shape[-1], _BATCH)
    ]
    return np.concatenate(parts, axis=-1)


def _no_forcing(linear: Linear, candidate: Candidate) -> tuple[np.ndarray, np.ndarray]:
    """Return the zeros of a candidate that is left out."""
    W, M, n = len(linear.start), linear.macros, linear.A.shape[-1]
    return (
        np.zeros((W, M, n, candidate.size)),
        np.zeros((W, linear.problem.count, candidate.size)),
    )


def _forcing(linear: Linear, candidate: Candidate) -> tuple[np.ndarray, np.ndarray]:
    """Return what each magnitude adds in a macro step, and directly to the observations."""
    w, shown = _no_forcing(linear, candidate)
    acting = min(candidate.size, candidate.effect.acting)  # a place of nothing is nothing
    for i in range(acting):
        x = np.zeros(candidate.size)
        x[acting:] = candidate.point[acting : candidate.size]
        x[i] = candidate.point[i]
        w[..., i], shown[..., i] = _difference(linear, candidate, x)
        w[..., i] /= x[i]
        shown[..., i] /= x[i]
    return w, shown


def _difference(
    linear: Linear, candidate: Candidate, x: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """Return what some magnitudes of a candidate add, and what they show directly."""
    law, directly = candidate.effect.force, np.zeros(linear.Q.shape[:2])
    if law is not None and not candidate.secant:
        joint = candidate.site.name
        force = law(candidate.site, candidate.full(x), linear.problem.machine)(linear.along.anew)
        return _by_force(linear, joint, force), directly
    h = linear.hypothesis
    added = replace(h, members=(*h.members, candidate), x=(*h.x, x))
    if candidate.effect.hidden and any(
        candidate.exclusive_keys & c.exclusive_keys for c in h.members
    ):
        return _nothing(linear), directly  # another joint is added there
    if candidate.effect.hidden or candidate.secant:
        return _nothing(linear), _simulated(linear, added)
    return _by_edits(linear, added)


def _by_edits(linear: Linear, added: Hypothesis) -> tuple[np.ndarray, np.ndarray]:
    """Return what the edits and parts of a hypothesis add to those of the linear model."""
    problem, shown = linear.problem, np.zeros(linear.Q.shape[:2])
    model, parts = problem.compiled(added)
    new = parts[len(linear.parts) :]
    w = _nothing(linear)
    if changed_activations(linear.points.model, model, new):
        return w, _simulated(linear, added)  # windows begin with other activations
    if differ(model, linear.points.model):
        step = linear.points.stepped(model) - linear.points.base
        w = w + linear.held(step.reshape(len(linear.start), -1, linear.A.shape[-1]))
    for part in new:
        if isinstance(part, Force):
            w = w + _by_force(linear, part.joint, part.law(linear.along.anew))
    if new:
        controls = problem.controls(parts, problem.windows)
        ctrl, old = (clamped(model, u) for u in (controls, linear.ctrl[:, : controls.shape[1]]))
        change = _per_macro(ctrl - old, linear.macro, linear.macros)
        if change.any():
            w = w + np.einsum("wmnu,wmu->wmn", linear.held(linear.E), change)
        before = observe(problem.layout, problem.windows, linear.trajectory, linear.parts)
        after = observe(problem.layout, problem.windows, linear.trajectory, parts)
        shown = problem.whitened(problem.weighted(after - before))
    return w, shown


def _nothing(linear: Linear) -> np.ndarray:
    return np.zeros((len(linear.start), linear.macros, linear.A.shape[-1]))


def _simulated(linear: Linear, hypothesis: Hypothesis) -> np.ndarray:
    """Return the change of the observations by simulation: the state has more coordinates."""
    return np.asarray(linear.residual - linear.problem.residual(hypothesis, linear.start))


def _by_force(linear: Linear, joint: str, force: np.ndarray) -> np.ndarray:
    dof = linear.problem.machine.joints[joint].dof
    return np.asarray(linear.held(linear.B[..., dof]) * force[..., None])


def _per_macro(values: np.ndarray, macro: int, macros: int) -> np.ndarray:
    """Return the mean of `W x S x nu` over each macro step."""
    spare = macros * macro - values.shape[1]
    padded = np.pad(values, ((0, 0), (0, spare), (0, 0)), mode="edge")
    return np.asarray(padded.reshape(len(values), macros, macro, -1).mean(axis=2))
