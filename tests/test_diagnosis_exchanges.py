"""What may stand for a name, where the recordings do not tell."""

import pytest

from bo_sysid.diagnosis.answer.exchanges import exchanges, irreducible
from bo_sysid.report.diagnosis_text import undecided_sentences

A, B = ("armature", "elbow"), ("viscous_damping", "elbow")
a, b, c = ("link_inertia", "forearm"), ("back_emf", "motor"), ("payload", "forearm")


def names(*keys):
    return frozenset(keys)


def entries(*keys):
    return tuple({"effect": e, "kind": "joint", "site": s, "value": 1.0} for e, s in keys)


def told(*others, most=3):
    return exchanges(names(A, B), {names(*o): entries(*o) for o in others}, most)


def test_what_differs_in_one_name_is_told_of_that_name_alone() -> None:
    assert told((a, B), (A, b)) == {A: (entries(a),), B: (entries(b),)}


def test_a_product_of_exchanges_says_nothing_more() -> None:
    assert told((a, B), (a, b), (A, b)) == told((a, B), (A, b))
    assert irreducible(names(A, B), [names(a, b), names(a, B)]) == [names(a, b), names(a, B)]


def test_what_replaces_both_at_once_is_told_whole_at_both() -> None:
    assert told((c,)) == {A: (entries(c),), B: (entries(c),)}
    assert told((a, b)) == {A: (entries(a, b),), B: (entries(a, b),)}


def test_a_name_that_may_not_be_there_is_told_by_the_rest() -> None:
    assert told((B,)) == {A: (entries(B),), B: ()}


def test_no_more_than_a_few_are_told_of_each_name() -> None:
    many = [((f"effect {k}", "elbow"), B) for k in range(5)]
    found = told(*many, (A, b), most=3)
    assert (len(found[A]), len(found[B])) == (3, 1)


@pytest.mark.parametrize(
    ("others", "said"),
    [
        ([(a, B)], ["armature at elbow (1) from link_inertia at forearm (1)"]),
        (
            [(a, B), (A, b)],
            [
                "armature at elbow (1) from link_inertia at forearm (1)",
                "viscous_damping at elbow (1) from back_emf at motor (1)",
            ],
        ),
        (
            [(c,)],
            ["armature at elbow (1), viscous_damping at elbow (1) from payload at forearm (1)"],
        ),
        ([(B,)], ["whether there is armature at elbow (1)"]),
    ],
)
def test_a_report_says_which_names_a_set_replaces(others, said) -> None:
    found = told(*others)
    findings = [dict(entries(key)[0], equivalents=[list(e) for e in found[key]]) for key in (A, B)]
    assert undecided_sentences(findings) == [f"These recordings do not tell {s}." for s in said]
