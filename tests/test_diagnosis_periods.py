"""Forces that repeat with a joint's position: their periods and shapes."""

from dataclasses import replace

import numpy as np
import pytest
from choice_machines import located
from diagnosis_helpers import arm, record

from bo_sysid.diagnosis.search import sharpen
from bo_sysid.diagnosis.search.search import Search
from bo_sysid.diagnosis.search.sharpen import repeated_anew, sharpened
from bo_sysid.diagnosis.search.variants import simplify
from bo_sysid.diagnosis.sets.refit import Effort
from bo_sysid.diagnosis.windows.evidence import make_evidence


def test_a_study_that_looks_for_no_effect_has_no_candidates() -> None:
    evidence = make_evidence(arm(), [record(duration=2.0)], effects=(), threads=1)
    assert evidence.candidates == ()


def test_a_period_between_those_of_the_grid_needs_no_second_name() -> None:
    missing = [("cogging", "joint", "elbow", [0.003, -0.068, 1.52])]
    found = located(
        record(missing, duration=6.0), effects=("cogging", "constant_force", "joint_spring")
    )
    (name,) = found.decision.best.members
    assert (name.effect.id, name.site.name) == ("cogging", "elbow")
    assert name.shapes[0] == pytest.approx(1.52, rel=0.02)
    np.testing.assert_allclose(found.decision.best.x[0], [0.003, -0.068], atol=0.003)


def test_a_period_is_sharpened_whatever_the_order_in_which_a_set_was_first_fitted(monkeypatch):
    missing = [("cogging", "joint", "elbow", [0.0, 0.05, 4.0])]
    found = located(
        record(missing, duration=6.0), effects=("cogging", "dry_friction", "viscous_damping")
    )
    (cogging,) = found.decision.best.members
    at = {c.effect.id: c for c in found.search.candidates if c.site.name == "elbow"}
    dry, damping = at["dry_friction"], at["viscous_damping"]
    first = found.decision.best.x[0]
    search, little = found.search, np.array([1e-3])
    before = search.fit((cogging, damping), (first, little)).members
    leader = search.fit((dry, damping, cogging), (little, little, first))
    assert before == (cogging, damping)
    assert leader.members[1:] == (damping, cogging)
    monkeypatch.setattr(Search, "best", leader)
    sharpened(search)
    rest = {k: f for k, f in search.fits.items() if k != leader.key}
    assert min(f.rms for f in rest.values()) <= found.decision.best.rms * 1.001


@pytest.mark.parametrize("last", [48.0, 3.0], ids=["in the grid", "beyond it"])
def test_a_period_that_a_part_of_the_windows_left_is_looked_for_again(last: float) -> None:
    """From one far off, where no small change of it leads to the one that is there."""
    missing = [("cogging", "joint", "elbow", [0.0, 0.05, 7.0])]
    found = located(record(missing, duration=6.0), effects=("cogging", "constant_force"))
    (right,), search = found.decision.best.members, found.search
    grid = tuple(g for g in right.extent.grid if g[-1] <= last)
    off = replace(right.with_shapes(np.array([9.5])), extent=replace(right.extent, grid=grid))
    far = search.fit((search.known(off),), (right.probe,))
    assert far.rms > 1.5 * found.decision.best.rms
    search.fits = {f.key: f for f in (search.nominal, far)}
    repeated_anew(search)
    assert search.best.rms == pytest.approx(found.decision.best.rms, rel=1e-3)
    (c,) = search.best.members
    assert c.shapes[0] == pytest.approx(7.0, rel=0.02)


def test_a_period_is_looked_for_again_whatever_the_order_of_the_fit_that_is_there(monkeypatch):
    missing = [("cogging", "joint", "elbow", [0.0, 0.05, 7.0])]
    found = located(record(missing, duration=4.0), effects=("cogging", "constant_force"))
    (right,), search = found.decision.best.members, found.search
    force = next(c for c in search.candidates if c.key == ("constant_force", "elbow"))
    off, little = search.known(right.with_shapes(np.array([9.5]))), np.array([1e-3])
    far = search.fit((force, off), (little, right.probe))
    monkeypatch.setattr(Search, "best", far)
    begun = []
    with monkeypatch.context() as first:
        first.setattr(sharpen, "_sharpen", lambda search, fit, at, bounds: begun.append(fit))
        repeated_anew(search)
    (fit,) = begun
    assert [c.key for c in fit.members] == [force.key, right.key]
    hypothesis = replace(fit.hypothesis, members=fit.members[::-1], x=fit.x[::-1])
    columns = [1, 2, 0, *range(3, fit.jacobian.shape[-1])]  # sine and cosine, then the force
    turned = replace(fit, hypothesis=hypothesis, jacobian=fit.jacobian[..., columns])
    search.fits = {f.key: f for f in (search.nominal, far)}
    search.fits[turned.key] = replace(turned, cost=0.99 * turned.cost)
    repeated_anew(search)
    assert search.nearest.rms == pytest.approx(found.decision.best.rms, rel=0.01)


def test_friction_that_rises_by_nothing_is_tried_as_one_that_creeps() -> None:
    missing = [("dry_friction", "joint", "elbow", [0.05, 0.0, 0.0])]
    found = located(record(missing, duration=4.0), effects=("dry_friction", "stribeck_friction"))
    search = found.search
    rises = next(
        c
        for c in search.candidates
        if c.key == ("stribeck_friction", "elbow") and not c.preslides and not c.secant
    )
    search.fits = {search.nominal.key: search.nominal}
    fit = search.fit((rises,), (np.array([0.0, 0.05]),))
    simplify(search, fit, Effort())
    dry = [f for f in search.fits.values() if f.key and f.members[0].key[0] == "dry_friction"]
    shapes = {tuple(f.members[0].shapes): f.rms for f in dry}
    assert {s[0] for s in shapes} == {0.0, 1.0}
    assert min(shapes.values()) == shapes[0.0, 0.0]
