"""The decision on made-up fits, against what its rules say."""

from dataclasses import replace

import numpy as np
import pytest
from diagnosis_helpers import candidate, posed, record

from bo_sysid.diagnosis.search.final import finalists
from bo_sysid.diagnosis.sets.decide import decide
from bo_sysid.diagnosis.sets.fit import Fit
from bo_sysid.diagnosis.sets.rules import (
    SetPrior,
    admissible,
    explains_little,
    required_size,
    sizes,
)
from bo_sysid.diagnosis.windows.candidate import Candidate, candidates
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis
from bo_sysid.effects import CATALOGUE
from bo_sysid.simulation import State

BLOCKS, DOF = 20, 4000


@pytest.fixture(scope="module")
def machine():
    return posed(record(duration=2.0))[1]


def fit(members: tuple[Candidate, ...], rms: float, unique: float = 5.0, seed: int = 0) -> Fit:
    """A fit of given quality whose residual is made of noise of that size."""
    rng = np.random.default_rng(seed)
    cost = np.full(BLOCKS, rms**2 * DOF / BLOCKS) * (1 + 0.01 * rng.normal(size=BLOCKS))
    nothing = np.zeros((2, 2))
    return Fit(
        Hypothesis(members, tuple(c.probe for c in members)),
        (None,) * len(members),
        State(nothing, nothing, nothing[:, :0]),
        np.full((2, DOF // 2), rms) * (1 + 0.2 * rng.normal(size=(2, DOF // 2))),
        np.ones((2, DOF // 2, len(members))),
        rms,
        cost,
        cost,
        (unique,) * len(members),
        np.eye(len(members)),
    )


def decided(*fits: Fit):
    nominal = next(f for f in fits if not f.members)
    return decide(fits, nominal, SetPrior(40, 3), np.zeros((2, DOF // 2, 0)), DOF)


def test_the_set_that_explains_is_answered(machine) -> None:
    friction = fit((candidate(machine, "dry_friction", "elbow"),), 1.0)
    damping = fit((candidate(machine, "viscous_damping", "elbow"),), 2.0, seed=1)
    decision = decided(fit((), 5.0), friction, damping)
    assert decision.best is friction
    assert decision.probability[0] > 0.99
    assert decision.probability.sum() == pytest.approx(1.0)


def test_a_second_effect_below_the_margin_is_not_admitted(machine) -> None:
    one, two = (candidate(machine, e, "elbow") for e in ("dry_friction", "viscous_damping"))
    single = fit((one,), 1.001)
    pair = replace(fit((one, two), 0.99), unique=(5.0, 0.15))
    assert decided(fit((), 5.0), single, pair).best is single


def test_an_effect_must_be_as_large_as_what_stays_unexplained(machine) -> None:
    nominal = fit((), 3.5)
    weak = fit((candidate(machine, "dry_friction", "elbow"),), 3.0, unique=2.0)
    assert required_size(weak, nominal) == pytest.approx(np.sqrt(8.0))
    assert not admissible(weak, nominal)
    assert decided(nominal, weak).best is nominal


@pytest.mark.parametrize(
    ("rms", "nominal", "gone"), [(6.0, 9.0, True), (6.0, 60.0, False), (2.9, 3.1, False)]
)
def test_a_set_is_lost_where_it_is_far_off_and_explains_little(
    machine, rms: float, nominal: float, gone: bool
) -> None:
    damping = fit((candidate(machine, "viscous_damping", "elbow"),), rms)
    assert explains_little(damping, fit((), nominal)) == gone


@pytest.mark.parametrize(("alone", "needed"), [(12.0, True), (1.1, False)])
def test_a_small_part_of_the_whole_is_needed_where_nothing_comes_near_without_it(
    machine, alone: float, needed: bool
) -> None:
    # half a sigma by its slope, of fifty that the nominal model leaves
    late, mass = (
        candidate(machine, "dry_friction", "elbow"),
        candidate(machine, "payload", "forearm"),
    )
    both = replace(fit((late, mass), 1.0), unique=(5.0, 0.5))
    nominal, single = fit((), 50.0), fit((late,), alone)
    assert admissible(both, nominal, [nominal, single, both]) == needed
    assert not admissible(both, nominal, [nominal, both])  # not tried without it


def test_far_off_an_effect_is_as_large_as_the_best_fit_without_it_leaves(machine) -> None:
    nominal = fit((), 5.0)  # 4 sigma beyond the fit, where the linear model sees 2
    strong = fit((candidate(machine, "dry_friction", "elbow"),), 3.0, unique=2.0)
    assert decided(nominal, strong).best is strong


@pytest.mark.parametrize("alike", [True, False])
def test_a_group_that_does_what_one_effect_does_is_as_probable_and_comes_after_it(
    machine, alike: bool
) -> None:
    """By what it leaves alone the group leads, and a third set stands between the two."""
    one = fit((candidate(machine, "link_mass", "forearm"),), 1.003)
    both = tuple(candidate(machine, "viscous_damping", j) for j in ("shoulder", "elbow"))
    group = replace(fit(both, 1.0), groups=("viscous_damping",) * 2)
    group = replace(group, residual=one.residual + (0.01 if alike else 0.5))
    third = fit((candidate(machine, "payload", "upper"),), 1.0015, seed=4)
    decision = decided(fit((), 9.0, seed=3), one, group, third)
    shares = dict(zip((f.key for f in decision.fits), decision.probability, strict=True))
    if alike:
        assert decision.best is one
        assert shares[one.key] == pytest.approx(shares[group.key], rel=1e-6)
        assert decision.equivalents[0] is group
    else:
        assert decision.best is group
        assert shares[group.key] > 2 * shares[one.key]
    assert shares[third.key] < shares[group.key]


def test_sets_that_differ_by_less_than_both_leave_are_told_apart_by_nothing(machine) -> None:
    one = fit((candidate(machine, "payload", "forearm"),), 2.0)
    other = replace(
        fit((candidate(machine, "link_mass", "forearm"),), 1.99),
        residual=one.residual + 0.01,
    )
    decision = decided(fit((), 9.0, seed=3), one, other)
    assert decision.probability[:2] == pytest.approx([0.5, 0.5])


@pytest.mark.parametrize(("rms", "apart", "told"), [(1.02, 0.03, False), (1.02, 0.2, True),
                                                    (1.0, 0.03, True)])  # fmt: skip
def test_what_the_model_itself_leaves_decides_nothing_between_sets_that_are_close(
    machine, rms: float, apart: float, told: bool
) -> None:
    """Beside a leftover of .2 sigma a difference of .03 may be 40 nats for no good reason."""
    wrong = fit((candidate(machine, "payload", "forearm"),), rms)
    right = replace(
        fit((candidate(machine, "link_mass", "forearm"),), rms),
        residual=wrong.residual + apart,
        cv=wrong.cv + 80.0 / BLOCKS,
    )
    decision = decided(fit((), 9.0, seed=3), wrong, right)
    assert decision.best is wrong
    assert (decision.probability[0] > 0.99) == told


@pytest.mark.parametrize(("deviations", "stays"), [(8.0, True), (2.0, False)])
def test_a_small_member_of_a_group_stays_where_it_is_surely_there(
    machine, deviations: float, stays: bool
) -> None:
    # two joints that pass the margin, and a third below it
    members = (
        *(candidate(machine, "armature", j) for j in ("shoulder", "elbow")),
        candidate(machine, "dry_friction", "elbow"),
    )
    variance = [1e-9, 1e-9, (members[2].probe[0] / deviations) ** 2]
    three = replace(
        fit(members, 1.0), groups=("armature",) * 3, unique=(5.0, 5.0, 0.1),
        covariance=np.diag(variance),
    )  # fmt: skip
    assert admissible(three, fit((), 5.0)) == stays
    assert not admissible(replace(three, groups=(None,) * 3), fit((), 5.0))


def test_the_members_of_a_group_are_large_together(machine) -> None:
    # 1.5 leaves 1.118 sigma unexplained, which two of .9 are and one is not
    members = tuple(candidate(machine, "armature", j) for j in ("shoulder", "elbow"))
    pair = replace(fit(members, 1.5, unique=0.9), groups=("armature",) * 2)
    assert admissible(pair, fit((), 9.0))
    assert not admissible(replace(pair, groups=(None,) * 2), fit((), 9.0))
    assert not admissible(replace(pair, unique=(0.7, 0.7)), fit((), 9.0))


def test_what_many_effects_leave_together_hides_no_smaller_one(machine) -> None:
    small = fit((candidate(machine, "viscous_damping", "elbow"),), 1.0, unique=1.1)
    assert admissible(small, fit((), 2400.0))
    assert not admissible(replace(small, unique=(0.9,)), fit((), 2400.0))
    assert not admissible(replace(small, unique=(0.5,)), fit((), 30.0))


def test_what_another_set_explains_is_no_unknown(machine) -> None:
    one, two = (candidate(machine, "armature", j) for j in ("shoulder", "elbow"))
    some, all_of = fit((one,), 3.0, unique=1.0), fit((one, two), 1.02)
    assert not admissible(some, fit((), 9.0))
    assert admissible(some, fit((), 9.0), (some, all_of))
    # a joint that was added follows whatever is missing, and explains nothing of it
    soft = fit((candidate(machine, "joint_compliance", "elbow"),), 3.1)
    assert not admissible(replace(some, rms=8.0), fit((), 9.0), (replace(some, rms=8.0), soft))


def test_shapes_of_one_effect_are_no_rivals(machine) -> None:
    holds = candidate(machine, "dry_friction", "elbow")
    creeps = holds.with_shapes(np.array([0.0]))
    decision = decided(fit((), 5.0), fit((holds,), 1.0), fit((creeps,), 1.0002, seed=0))
    assert [f.members for f in decision.fits if f.members] == [(holds,)]
    assert decision.equivalents == ()


def test_nothing_is_preferred_where_nothing_is_gained(machine) -> None:
    nominal = fit((), 1.0)
    useless = fit((candidate(machine, "armature", "elbow"),), 0.9999, unique=0.3)
    assert decided(nominal, useless).best is nominal


def test_sets_with_the_same_predictions_are_equivalent(machine) -> None:
    one = fit((candidate(machine, "payload", "forearm"),), 1.0)
    other = replace(
        fit((candidate(machine, "link_mass", "forearm"),), 1.0), residual=one.residual, cv=one.cv
    )
    decision = decided(fit((), 5.0, seed=3), one, other)
    assert {decision.best, *decision.equivalents} == {one, other}


def test_a_set_with_one_member_exchanged_is_an_equivalent_though_a_hair_too_weak(machine) -> None:
    shared = candidate(machine, "dry_friction", "elbow")
    payload, mass = (candidate(machine, e, "forearm") for e in ("payload", "link_mass"))
    one = fit((shared, payload), 1.5, unique=1.2)
    other = replace(fit((shared, mass), 1.5, unique=1.1), cv=one.cv, residual=one.residual)
    assert not admissible(other, fit((), 9.0))
    decision = decided(fit((), 9.0, seed=3), one, other)
    assert {decision.best, *decision.equivalents} == {one, other}


def test_a_load_somewhere_has_no_more_than_one_number_that_does_the_same(machine) -> None:
    load = next(c for c in candidates([CATALOGUE["payload"]], machine) if c.site.name == "forearm")
    somewhere = replace(
        fit((load.free,), 1.0), jacobian=np.ones((2, DOF // 2, 4)), covariance=np.eye(4)
    )
    mass = fit((candidate(machine, "link_mass", "upper"),), 1.0)
    mass = replace(mass, residual=somewhere.residual, cv=somewhere.cv + 0.5)
    decision = decided(fit((), 5.0, seed=3), somewhere, mass)
    assert decision.best is mass
    assert decision.equivalents == (somewhere,)
    assert decision.probability[0] == pytest.approx(0.5, abs=1e-3)


def test_what_adds_nothing_to_a_simpler_effect_does_not_stand_for_it(machine) -> None:
    friction = fit((candidate(machine, "dry_friction", "elbow"),), 1.0)
    stribeck = fit((candidate(machine, "stribeck_friction", "elbow"),), 1.0, unique=0.01)
    stribeck = replace(
        stribeck,
        cv=friction.cv - 1.5,
        residual=friction.residual,
        jacobian=np.zeros((2, DOF // 2, 2)),
        covariance=np.eye(2),
    )
    assert decided(fit((), 5.0, seed=3), friction, stribeck).best is friction


@pytest.mark.parametrize(
    ("unique", "own", "named", "beside"),
    [(0.15, 0.5, True, True), (0.05, 0.5, False, True), (0.05, 0.05, False, False)],
)
def test_a_richer_effect_that_is_asked_for_but_too_small_stands_beside_the_plain_one(
    machine, unique: float, own: float, named: bool, beside: bool
) -> None:
    friction = fit((candidate(machine, "dry_friction", "elbow"),), 1.01)
    stribeck = fit((candidate(machine, "stribeck_friction", "elbow"),), 1.0, unique=unique)
    (magnitudes,) = stribeck.hypothesis.x
    stribeck = replace(
        stribeck,
        hypothesis=replace(stribeck.hypothesis, x=(magnitudes * np.array([own, 1.0]),)),
        jacobian=np.zeros((2, DOF // 2, 2)),
        covariance=np.eye(2),
    )
    decision = decided(fit((), 5.0, seed=3), friction, stribeck)  # alike but for little
    assert decision.best is (stribeck if named else friction)
    other = friction if named else stribeck
    assert decision.equivalents == ((other,) if beside else ())
    assert decision.probability[0] == pytest.approx(0.5 if beside else 1.0, abs=1e-3)


@pytest.mark.parametrize(
    ("left", "whole", "unique", "answered"),
    [
        (1.26, 1.002, 0.76, True),  # .76 of 40 sigma: less than a fiftieth
        (1.26, 1.05, 0.7, False),  # leaves more than noise itself
        (1.012, 1.002, 0.76, False),  # nothing is left to explain
        (1.26, 1.002, 0.15, False),  # smaller than any effect may be
    ],
)
def test_a_small_part_that_completes_the_answer_is_answered_as_a_hint(
    machine, left: float, whole: float, unique: float, answered: bool
) -> None:
    large, small, same = (
        candidate(machine, e, "elbow") for e in ("quadratic_damping", "viscous_damping", "back_emf")
    )
    single = fit((large,), left, unique=39.0)
    pair = replace(fit((large, small), whole), unique=(39.0, unique))
    alike = replace(fit((large, same), whole), unique=(39.0, unique), cv=pair.cv + 1e-3)
    decision = decided(fit((), 40.0, seed=3), single, pair, alike)
    assert decision.best is (pair if answered else single)
    assert {decision.best, *decision.equivalents} == (
        {single, pair, alike} if answered else {single}
    )
    assert decision.probability[0] == pytest.approx(1 / 3 if answered else 1.0, abs=1e-3)


def test_far_from_the_recordings_a_richer_effect_does_not_stand_beside_the_plain_one(
    machine,
) -> None:
    friction = fit((candidate(machine, "dry_friction", "elbow"),), 2.1, unique=5.0)
    stribeck = replace(
        fit((candidate(machine, "stribeck_friction", "elbow"),), 2.0, unique=1.0),
        jacobian=np.zeros((2, DOF // 2, 2)),
        covariance=np.eye(2),
    )
    decision = decided(fit((), 5.0, seed=3), friction, stribeck)
    assert decision.best is friction
    assert decision.equivalents == ()


def test_a_superset_of_the_answer_is_no_equivalent(machine) -> None:
    one, two = (candidate(machine, e, "elbow") for e in ("dry_friction", "viscous_damping"))
    single = fit((one,), 1.0)
    pair = replace(fit((one, two), 1.0), residual=single.residual, cv=single.cv)
    assert decided(fit((), 5.0), single, pair).equivalents == ()


def test_the_prior_halves_for_nothing_and_shares_an_eighth_by_size(machine) -> None:
    prior = SetPrior(40, 3)
    one = candidate(machine, "dry_friction", "elbow")
    two = candidate(machine, "payload", "forearm")
    assert prior.log(fit((), 1.0)) == pytest.approx(np.log(0.5))
    assert prior.log(fit((one,), 1.0)) == pytest.approx(np.log(0.125 / 40))
    assert prior.log(fit((one, two), 1.0)) == pytest.approx(np.log(0.125 / 780))


def test_close_to_the_recordings_a_size_is_at_most_what_leaving_out_costs(machine) -> None:
    payload = fit((candidate(machine, "payload", "forearm"),), 1.002, unique=4.2)
    nothing = fit((), 1.007)
    assert sizes(payload, [nothing, payload]) == pytest.approx([np.sqrt(1.007**2 - 1.002**2)])
    assert sizes(payload, [payload]) == (4.2,)  # nothing to compare with
    assert decided(nothing, payload).best is nothing


@pytest.mark.parametrize(("alone", "both", "named"), [(0.97, 0.9, False), (1.0, 0.82, True)])
def test_of_what_is_explained_below_the_noise_a_quarter_counts(
    machine, alone: float, both: float, named: bool
) -> None:
    one = fit((candidate(machine, "payload", "forearm"),), alone)
    two = fit((*one.members, candidate(machine, "viscous_damping", "elbow")), both, unique=0.6)
    above = max(alone**2 - 0.97, 0.0)
    below = min(alone**2, 0.97) - both**2
    assert sizes(two, [one, two])[1] == pytest.approx(np.sqrt(above + below / 4))
    assert decided(fit((), 5.0), one, two).best is (two if named else one)


def test_far_from_the_recordings_a_size_is_what_leaving_out_costs(machine) -> None:
    friction = fit((candidate(machine, "dry_friction", "elbow"),), 2.0, unique=0.5)
    assert sizes(friction, [fit((), 5.0), friction]) == pytest.approx([np.sqrt(21.0)])


def test_far_from_the_recordings_only_a_set_with_all_else_says_what_leaving_out_costs(machine):
    """That nothing at all leaves more says nothing of one of two members."""
    friction, payload = (
        candidate(machine, e, s) for e, s in (("dry_friction", "elbow"), ("payload", "forearm"))
    )
    both, nothing = fit((payload, friction), 2.0, unique=0.5), fit((), 9.0)
    assert sizes(both, [nothing, both]) == (0.5, 0.5)
    bent = friction.with_shapes(2.0 * friction.shapes)
    parts = [fit((payload,), 2.5), fit((bent,), 3.0)]
    assert sizes(both, [nothing, both, *parts]) == pytest.approx([np.sqrt(5.0), 1.5])


@pytest.mark.parametrize(("times", "held"), [(2.0, True), (0.0, False)])
def test_only_a_large_member_may_do_no_more_where_there_is_more_of_it(
    machine, times: float, held: bool
) -> None:
    """Friction that holds a joint has no slope; nor has one of nothing, which is not needed."""
    friction, payload = (
        candidate(machine, e, s) for e, s in (("dry_friction", "elbow"), ("payload", "forearm"))
    )
    both = fit((payload, friction), 1.0)
    both = replace(
        both,
        hypothesis=replace(both.hypothesis, x=(payload.probe, times * friction.probe)),
        jacobian=both.jacobian * np.array([1.0, 0.0]),
        unique=(5.0, 0.0),
    )
    assert (sizes(both, [fit((payload,), 3.0)])[1] > 1.0) == held


def test_a_member_of_no_magnitude_is_not_needed_however_far_off_the_fit_is(machine) -> None:
    friction, payload = (
        candidate(machine, e, s) for e, s in (("dry_friction", "elbow"), ("payload", "forearm"))
    )
    both = fit((payload, friction), 3.0)
    both = replace(
        both, hypothesis=replace(both.hypothesis, x=(payload.probe, -1e-12 * friction.probe)),
        unique=(5.0, 0.0),
    )  # fmt: skip
    assert sizes(both, [fit((payload,), 9.0)])[1] == 0.0


def test_a_part_that_leaves_clearly_more_than_the_leader_is_no_finalist(machine) -> None:
    one, two = (candidate(machine, e, "elbow") for e in ("dry_friction", "viscous_damping"))
    pair, nominal = fit((one, two), 1.0), fit((), 5.0)
    needed, nearly = fit((one,), 1.3), fit((one,), 1.05)
    assert needed not in finalists([pair, needed, nominal], nominal)
    assert nearly in finalists([pair, nearly, nominal], nominal)
    # far from the recordings no such size is known
    far, rest, nothing = fit((one, two), 4.0), fit((one,), 4.5), fit((), 50.0)
    assert rest in finalists([far, rest, nothing], nothing)
