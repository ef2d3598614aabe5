r"""A load that the model lacks, where another zero of an encoder would explain less.

The weight of a tool at the end of an arm changes with the pose as another zero of its last joints
would. A load of point masses m_k at points r_k of a body needs, with the point's acceleration a_k
(gravity's taken off) and its Jacobian J_k,

    Σ_k m_k J_kᵀ a_k,  m_k ≥ 0,

which is fitted to what the balance of forces leaves. A zero that is wrong moves mass within a body,
which no masses of one sign do.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import product

import mujoco
import numpy as np
from scipy.optimize import nnls

from bo_sysid.checks.balance import unexplained
from bo_sysid.checks.evidence import FLOOR, WiringEvidence
from bo_sysid.checks.flags import Flag
from bo_sysid.checks.hypothesis import WiringHypothesis
from bo_sysid.checks.score import MARGIN

_GRID = 0.25 * np.array(list(product((-1.0, 0.0, 1.0), repeat=3)))  # of the model's extent
_ROUNDS = 4  # of fits, each weighted by what the one before leaves
_LEAST = 0.02  # [rad] or [m] of zeros that a load may stand behind


@dataclass(frozen=True)
class Load:
    """A mass that the model lacks.

    Attributes:
        body: on which it is.
        mass: in [kg].
        score: as `WiringEvidence.scores`, with it.
    """

    body: str
    mass: float
    score: float


def without_loads(
    evidence: WiringEvidence, found: WiringHypothesis, first: WiringHypothesis
) -> tuple[WiringHypothesis, list[Flag]]:
    """Return a hypothesis without the zeros that a load, or a constant force, explains, and why.

    A load must explain more, a constant force as much.

    Args:
        evidence: the recordings.
        found: what is believed of them.
        first: what was supposed before.
    """
    zeros = {
        n: replace(w, offset=first.wires[n].offset)
        for n, w in found.wires.items()
        if n.startswith("qpos.") and abs(w.offset - first.wires[n].offset) > _LEAST
    }
    if not zeros or evidence.dynamics.loops:
        return found, []
    instead = replace(found, wires={**found.wires, **zeros})
    load = _best_load(evidence, instead, [n.removeprefix("qpos.") for n in zeros])
    score = float(evidence.scores(found, [found.delay])[0])
    if load is None or load.score > score - MARGIN:
        if _by_constant_forces(evidence, instead, list(zeros)) > score:
            return found, []
        return instead, [_constant_flag(found, zeros)]
    names = " and ".join(zeros)
    sentence = (
        f"A load of about {load.mass:.2g} kg on body {load.body} that the model lacks explains the "
        f"forces better than another zero of {names} would. Give the model what the machine "
        "carries, or let diagnose look for it."
    )
    return instead, [Flag("look", "load", tuple(zeros), sentence, {"mass": load.mass})]


def _by_constant_forces(
    evidence: WiringEvidence, h: WiringHypothesis, positions: Sequence[str]
) -> float:
    """Return the score of a hypothesis with constant forces at the joints of some positions."""
    given = evidence.terms(h).actuated(evidence.controls(h, h.delay))[None]
    without, beside = (unexplained(evidence.terms(h), given, varying=v)[0] for v in (False, True))
    free = np.isin(evidence.joints, [n.removeprefix("qpos.") for n in positions])
    return float(np.log(np.where(free, beside, without) + FLOOR) @ evidence.weights)


def _constant_flag(found: WiringHypothesis, zeros: Iterable[str]) -> Flag:
    """Return in words that other zeros may be constant forces."""
    names = tuple(zeros)
    offsets = " and ".join(f"{n} by {found.wires[n].offset:.3g}" for n in names)
    sentence = (
        f"Another zero of {offsets} would explain the forces, and a constant force at "
        f"{' and '.join(n.removeprefix('qpos.') for n in names)} as well: these recordings do not "
        "tell. Look at the machine where it rests."
    )
    return Flag("look", "zero", names, sentence)


def _best_load(evidence: WiringEvidence, h: WiringHypothesis, joints: list[str]) -> Load | None:
    """Return the load that explains most, on a body that one of some joints moves."""
    model = evidence.dynamics.model
    moved = {int(model.jnt_bodyid[evidence.joints.index(j)]) for j in joints}
    bodies = [b for b in range(1, model.nbody) if moved & set(_ancestors(model, b))]
    return min((_fitted(evidence, h, b) for b in bodies), key=lambda x: x.score, default=None)


def _ancestors(model: mujoco.MjModel, body: int) -> list[int]:
    """Return a body and all that carry it, but for the world."""
    out = []
    while body:
        out.append(body)
        body = int(model.body_parentid[body])
    return out


def _fitted(evidence: WiringEvidence, h: WiringHypothesis, body: int) -> Load:
    terms = evidence.terms(h)
    given = terms.actuated(evidence.controls(h, h.delay))
    missing = given - terms.required_force
    needs = evidence.of_points(h, body, _GRID * evidence.dynamics.model.stat.extent)
    used = evidence.weights > 0
    total = (terms.inertial**2 + terms.rest**2 + given**2).sum(axis=0) + 1e-300
    shares, masses = np.ones_like(total), np.zeros(len(_GRID))
    for _ in range(_ROUNDS):
        scale = np.where(used, 1.0 / np.sqrt(total * (shares + FLOOR)), 0.0)
        columns = (needs * scale[:, None]).reshape(-1, len(_GRID))
        masses, _ = nnls(columns, (missing * scale).ravel())
        with_load = replace(terms, rest=terms.rest + needs @ masses)
        shares = unexplained(with_load, given[None])[0]
    score = float(np.log(shares + FLOOR) @ evidence.weights)
    return Load(evidence.dynamics.model.body(body).name, float(masses.sum()), score)
