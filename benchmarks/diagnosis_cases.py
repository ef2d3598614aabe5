"""Drawn cases for the benchmark of the diagnosis.

Sizes are drawn log-uniformly by what effects do to the predictions (`diagnosis_sizes.py`). What a
case counts as is what its effects do in its own training recording: a limit that is never reached
says nothing.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from diagnosis_plant import Planted, simulate
from diagnosis_rigs import RIGS, Log, load
from diagnosis_sizes import Sizes
from diagnosis_strange import strange_force

from bo_sysid.diagnosis.windows.candidate import Candidate, candidates
from bo_sysid.effects import CATALOGUE, survey
from bo_sysid.recording import Recording

_TRIES = 40  # draws until every effect of a case can be sized
_NEAR = 0.03  # [m] by fifths of which a load lies beside a body whose usual place is its frame
_BEYOND = 1.5  # times the largest size, that an effect may have in the training recording


@dataclass(frozen=True)
class Case:
    """A drawn case.

    Attributes:
        rig: name of the machine.
        truth: what the plant has beyond the model.
        train: recordings to diagnose.
        holdout: a recording set aside.
        sigma: noise of the positions.
    """

    rig: str
    truth: tuple[Planted, ...]
    train: tuple[Recording, ...]
    holdout: tuple[Recording, ...]
    sigma: float
    notes: dict[str, object] = field(default_factory=dict)


def draw(
    rng: np.random.Generator,
    rig: str,
    ids: Sequence[str],
    count: int,
    *,
    low: float = 1.0,
    high: float = 30.0,
    duration: float = 20.0,
    lugre: bool = False,
    log: Log | None = None,
    elsewhere: bool = False,
) -> Case:
    """Draw a case with `count` effects of the given ids, at sites where they apply.

    With `elsewhere` loads lie anywhere about their bodies.
    """
    model, sigma = load(rig), 10 ** rng.uniform(np.log10(3e-4), -3)
    setting, none = RIGS[rig], Case(rig, (), (), (), sigma)
    seed = int(rng.integers(2**31))
    nominal = simulate(model, setting, None, (), seed=seed, duration=10.0, sigma=sigma, log=log)
    machine = survey(model.compile(), [nominal])
    pool = [c for c in candidates([CATALOGUE[i] for i in ids], machine) if not c.secant]
    if elsewhere:
        pool = [c.with_shapes(_place(rng, c)) for c in pool if c.extent.place]
    drawn = _drawn(rng, pool, count, Sizes(model, machine, nominal, sigma), (low, high))
    if len(drawn) < count:
        return none
    truth = [
        Planted(c.effect.id, c.site.kind, c.site.name, tuple(c.full(x)), target)
        for c, x, target in drawn
    ]
    train, holdout = (
        simulate(
            model, setting, machine, truth, seed=seed + k, duration=d, sigma=sigma, lugre=lugre,
            log=log,
        )
        for k, d in ((1, duration), (2, 8.0))
    )  # fmt: skip
    if count and _runs_away(train, nominal):  # what is free drifts without any force as well
        return none
    acting = Sizes(model, machine, train, sigma)
    sizes = [acting.of(c, x) for c, x, _ in drawn]
    if any(size > _BEYOND * high for size in sizes):
        return none
    if count == 2 and acting.alike([(c, x) for c, x, _ in drawn]):
        return none
    shown = [
        replace(
            p,
            size=size,
            value=c.effect.reported(c.full(acting.seen(c, p.x)), machine, c.site),
        )
        for p, size, (c, x, _) in zip(truth, sizes, drawn, strict=True)
    ]
    return Case(rig, tuple(shown), (train,), (holdout,), sigma)


def measured(rng: np.random.Generator, case: Case) -> Case:
    """Return a case whose controls were measured with noise that the machine did not feel.

    Its σ is 2 to 10 % of how much each control varies in the training recording.
    """
    share = float(np.exp(rng.uniform(*np.log((0.02, 0.1)))))
    sizes = {n: np.std(c.values) for r in case.train for n, c in r.of_kind("ctrl").items()}

    def noisy(recording: Recording) -> Recording:
        channels = dict(recording.channels)
        for name, c in recording.of_kind("ctrl").items():
            noise = share * sizes[name] * rng.standard_normal(c.values.size)
            channels[f"ctrl.{name}"] = replace(c, values=c.values + noise)
        return replace(recording, channels=channels)

    train, holdout = (tuple(map(noisy, rs)) for rs in (case.train, case.holdout))
    return replace(case, train=train, holdout=holdout, notes={"noise of controls": share})


def _drawn(
    rng: np.random.Generator,
    pool: Sequence[Candidate],
    count: int,
    sizes: Sizes,
    bounds: tuple[float, float],
) -> list[tuple[Candidate, np.ndarray, float]]:
    """Return effects with magnitudes of a size in sigma, drawn log-uniformly, and that size.

    An effect is drawn once, and fewer are returned where too few can have the size.
    """
    ids = list(dict.fromkeys(c.effect.id for c in pool))
    drawn: list[tuple[Candidate, np.ndarray, float]] = []
    for _ in range(_TRIES if ids else 0):
        if len(drawn) == count:
            break
        effect = ids[int(rng.integers(len(ids)))]
        options = [c for c in pool if c.effect.id == effect]
        if any(c.effect.id == effect for c, *_ in drawn):
            continue
        c = options[int(rng.integers(len(options)))]
        target = float(np.exp(rng.uniform(*np.log(bounds))))
        share = float(rng.uniform()) if c.effect.hidden else 0.0
        x = sizes.scaled(c, target, share)
        if x is not None:
            drawn.append((c, x, target))
    return drawn


def _place(rng: np.random.Generator, load: Candidate) -> np.ndarray:
    """Return a place of a load: a fifth of the way to its usual one to beyond it, and beside."""
    usual = np.array(load.extent.probe[load.size :])
    beside = 0.2 * max(float(np.linalg.norm(usual)), _NEAR) * rng.normal(size=3)
    return usual * float(rng.uniform(0.2, 1.3)) + beside


def draw_strange(rng: np.random.Generator, rig: str, kind: str) -> Case:
    """Draw a case with physics that is not in the catalogue."""
    model, setting, sigma = load(rig), RIGS[rig], 10 ** rng.uniform(np.log10(3e-4), -3)
    seed = int(rng.integers(2**31))
    nominal = simulate(model, setting, None, (), seed=seed, duration=10.0, sigma=sigma)
    machine = survey(model.compile(), [nominal])
    joint = list(machine.joints)[int(rng.integers(len(machine.joints)))]
    size, at = float(np.exp(rng.uniform(np.log(0.05), np.log(0.3)))), float(rng.uniform(0.3, 0.7))
    plain = simulate(model, setting, None, (), seed=seed + 1, duration=20.0, sigma=sigma)
    for _ in range(_TRIES):
        law = strange_force(kind, machine, joint, size, at)
        train, holdout = (
            simulate(
                model, setting, machine, (), seed=seed + k, duration=20.0, sigma=sigma,
                strange=[law],
            )
            for k in (1, 2)
        )  # fmt: skip
        if not (_runs_away(train, plain) or _runs_away(holdout, plain)):
            break
        size = 0.6 * size
    else:  # it is the commands that do
        return Case(rig, (), (), (), sigma)
    return Case(rig, (), (train,), (holdout,), sigma, {"kind": kind, "site": joint, "size": size})


_GEARED = {
    "dry_friction": (4.0, 5.0, 3.0, 0.8, 0.6, 0.15),
    "viscous_damping": (1.0, 1.0, 0.6, 0.16, 0.12, 0.04),
    "armature": (0.5, 0.5, 0.3, 0.08, 0.06, 0.02),
}
"""What the joints of a geared arm have, within a factor of two, and its URDF has not."""


def draw_geared(rng: np.random.Generator, rig: str, *, masses: bool) -> Case:
    """Draw a case in which friction, damping and rotors are missing at every joint of an arm.

    With `masses` those of all links are off as well, and parameters of the study.
    """
    model, setting, sigma = load(rig), RIGS[rig], 1e-4
    seed, time = int(rng.integers(2**31)), np.arange(0.0, 2.0, 0.01)
    swing = {n: np.sin(time + k) for k, n in enumerate(model.joints)}
    machine = survey(model.compile(), [Recording.from_arrays(time, qpos=swing, ctrl=swing)])
    truth = []
    for effect, usual in _GEARED.items():
        for joint, x in zip(model.joints, usual * np.exp(rng.uniform(-0.7, 0.7, 6)), strict=True):
            truth.append(Planted(effect, "joint", joint, (x,), 0.0, x))
    train, holdout = (
        simulate(model, setting, machine, truth, seed=seed + k, duration=d, sigma=sigma)
        for k, d in ((1, 30.0), (2, 8.0))
    )
    notes: dict[str, object] = {}
    if masses:
        own = {g.name: g.mass for g in model.spec().geoms if g.mass > 0}
        notes["masses"] = {g: m * float(np.exp(rng.uniform(-0.2, 0.2))) for g, m in own.items()}
    return Case(rig, tuple(truth), (train,), (holdout,), sigma, notes)


def _runs_away(recording: Recording, nominal: Recording) -> bool:
    """Whether a force drives the machine far out of where it moves without it."""
    spans = [
        [float(np.ptp(c.values)) for c in r.of_kind("qpos").values()] for r in (recording, nominal)
    ]
    return any(with_it > 4 * without for with_it, without in zip(*spans, strict=True))


def draw_group(rng: np.random.Generator, rig: str, effect: str) -> Case:
    """Draw a case in which an effect is missing at every joint."""
    model, setting, sigma = load(rig), RIGS[rig], 5e-4
    seed = int(rng.integers(2**31))
    nominal = simulate(model, setting, None, (), seed=seed, duration=10.0, sigma=sigma)
    machine = survey(model.compile(), [nominal])
    chosen = [c for c in candidates([CATALOGUE[effect]], machine) if not c.secant]
    drawn = [(c, tuple(2 * rng.uniform(0.7, 1.5) * c.probe)) for c in chosen]
    truth = tuple(Planted(effect, c.site.kind, c.site.name, x, 0.0, x[0]) for c, x in drawn)
    train, holdout = (
        simulate(model, setting, machine, truth, seed=seed + k, duration=d, sigma=sigma)
        for k, d in ((1, 20.0), (2, 8.0))
    )
    return Case(rig, truth, (train,), (holdout,), sigma)
