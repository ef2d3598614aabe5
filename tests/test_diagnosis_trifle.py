"""A known effect that is too small for a name, where something is left that a law predicts."""

import pytest
from diagnosis_helpers import SIGMA, arm, record

from bo_sysid.diagnosis.answer.explain import explain
from bo_sysid.diagnosis.answer.trifle import trifle_sentence, with_trifle
from bo_sysid.diagnosis.search.locate import Located, locate
from bo_sysid.diagnosis.windows.evidence import make_evidence
from bo_sysid.effects import CATALOGUE


def located(damping: float) -> Located:
    """The decision on an arm whose elbow has damping in [N m s/rad] that the model lacks."""
    missing = [("viscous_damping", "joint", "elbow", [damping])]
    effects = [CATALOGUE[e] for e in ("viscous_damping", "armature")]
    recordings = [record(missing, duration=12.0)]
    return locate(make_evidence(arm(), recordings, effects=effects, noise={"qpos": SIGMA}))


def test_what_a_law_would_predict_has_the_name_that_explains_it() -> None:
    """At .18 sensor sigmas it is less than is named; what it leaves without is no noise."""
    found = located(1.5e-4)
    assert not found.decision.best.members
    assert explain(found).unexplained.flagged
    answered = with_trifle(found)
    best = answered.decision.best
    assert [c.key for c in best.members] == [("viscous_damping", "elbow")]
    assert best.x[0][0] == pytest.approx(1.5e-4, rel=0.15)
    assert answered.decision.probability[0] > 0.99
    assert not explain(answered).unexplained.flagged
    assert trifle_sentence(best).startswith("Viscous damping at the elbow does less than what is")


@pytest.mark.parametrize("damping", [0.0, 3e-4])
def test_noise_and_what_is_named_stay_as_they_were_found(damping: float) -> None:
    found = located(damping)
    assert bool(found.decision.best.members) == (damping > 0)
    assert with_trifle(found) is found
