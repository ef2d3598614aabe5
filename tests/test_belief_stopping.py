"""The three inner stops on histories written by hand."""

import re

import numpy as np
import pytest

from bo_sysid.belief.argmin import ArgminBelief
from bo_sysid.belief.stopping import StopReason, StopRule, entropy_converged, has_converged
from bo_sysid.study.sections import Search, Stop

WIDE = ArgminBelief(np.array([0.5, 0.25, 0.25, 0.0]), "exact", 0.0)
FALLING = (3.0, 2.0, 1.0, 0.8)


@pytest.mark.parametrize(
    ("entropies", "settled"),
    [
        ((1.0, 0.99, 0.985), False),  # fewer than three picks since the start
        ((2.0, 1.0, 0.995, 0.992, 0.991), True),
        ((2.0, 1.0, 0.995, 0.992, 0.98), False),  # fell by 0.02
        ((2.0, 1.0, 0.995, 1.2, 0.999), False),  # a second valley came and went
        ((2.0, 1.0, 1.0, 1.0, 1.3), False),  # rising is not settled
    ],
)
def test_entropy_settled(entropies, settled):
    assert entropy_converged(entropies, threshold=0.01, last=3) is settled


def test_converged_is_all_mass_on_evaluated_rows():
    assert has_converged(WIDE, np.array([2, 0, 1]))
    assert not has_converged(WIDE, np.array([0, 1, 3]))
    assert not has_converged(WIDE, np.array([0, 1]))
    assert not has_converged(WIDE, np.array([], dtype=int))


@pytest.mark.parametrize(
    ("rule", "entropies", "evaluated", "reason"),
    [
        (StopRule(budget=9), FALLING, [0, 3], None),
        (StopRule(budget=2), FALLING, [0, 3], StopReason.BUDGET),
        (StopRule(budget=3), FALLING, [0, 1, 2], StopReason.CONVERGED),
        (StopRule(last=2, entropy=0.1), (3.0, 1.0, 1.05, 1.02), [0, 3], StopReason.ENTROPY),
        (StopRule(last=2, entropy=None), (3.0, 1.0, 1.0, 1.0), [0, 3], None),
    ],
)
def test_rule(rule, entropies, evaluated, reason):
    assert rule(entropies, WIDE, np.array(evaluated)) is reason


def test_every_reason_names_the_keys_of_a_study_that_go_further():
    settings = {*Search.model_fields, *Stop.model_fields}
    named = {r: re.findall(r"(?:search|stop)\.(\w+)", r.sentence) for r in StopReason}
    assert named[StopReason.BUDGET] == ["budget"]
    assert named[StopReason.ENTROPY] == ["entropy", "last"]
    assert all(key in settings for keys in named.values() for key in keys)
    assert "evaluated" in StopReason.CONVERGED.sentence


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"budget": 0}, "must be at least 1"),
        ({"last": 0}, "must be at least 1"),
        ({"entropy": -1.0}, "must not be negative"),
    ],
)
def test_settings_out_of_range(settings, message):
    with pytest.raises(ValueError, match=message):
        StopRule(**settings)
