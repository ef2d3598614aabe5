"""Loads at a place that the model does not say."""

import numpy as np
import pytest
from diagnosis_helpers import SIGMA, arm, record

from bo_sysid.diagnosis.answer.answer import Answer, make_answer
from bo_sysid.diagnosis.answer.explain import explain
from bo_sysid.diagnosis.search.final import compare
from bo_sysid.diagnosis.search.loads import place_loads
from bo_sysid.diagnosis.search.locate import locate
from bo_sysid.diagnosis.search.search import Search
from bo_sysid.diagnosis.search.window_lengths import windows_of
from bo_sysid.diagnosis.windows.evidence import Evidence, make_evidence
from bo_sysid.diagnosis.windows.windowing import prepare
from bo_sysid.effects import CATALOGUE

MASS, TIP = 0.15, (0.0, 0.0, -0.25)  # of the load; the site at the end of the forearm


def evidence_of(place: tuple[float, float, float], duration: float) -> Evidence:
    """Return recordings of an arm that carries a load, seen by what weighs."""
    recorded = record([("payload", "body", "forearm", [MASS, *place])], duration=duration)
    ids = ("payload", "link_mass", "com_shift", "link_inertia", "gravity_compensation")
    return make_evidence(
        arm(), [recorded], effects=[CATALOGUE[i] for i in ids], noise={"qpos": SIGMA}, threads=1
    )


def answered(place: tuple[float, float, float]) -> Answer:
    evidence = evidence_of(place, 8.0)
    located = locate(evidence)
    return make_answer(located.decision, explain(located), evidence.machine)


@pytest.fixture(scope="module")
def elsewhere() -> Answer:
    return answered((0.05, 0.02, -0.16))


def test_a_load_is_found_where_it_lies(elsewhere: Answer) -> None:
    (load,) = elsewhere.findings
    assert (load.effect, load.site) == ("payload", "forearm")
    assert load.quantity.value == pytest.approx(MASS, rel=0.02)
    assert load.details["x"].value == pytest.approx(0.05, rel=0.03)
    assert load.details["z"].value == pytest.approx(-0.16, rel=0.03)
    for name, truth in (("x", 0.05), ("y", 0.02), ("z", -0.16)):
        low, high = load.details[name].interval
        assert low < truth < high, name


def test_what_the_recordings_do_not_tell_of_its_place_is_said(elsewhere: Answer) -> None:
    (load,) = elsewhere.findings  # both joints turn about y
    assert "carries a load of 0.150" in load.sentence
    assert "It lies at x = 0.0" in load.sentence
    assert load.sentence.endswith("in the frame of the forearm; the recordings do not tell its y.")


def test_the_last_comparison_tries_a_load_elsewhere_in_the_place_of_a_mass() -> None:
    """Short windows ranked a mass with trifles first; without these it left 1.12 sigma."""
    evidence = evidence_of((0.005, 0.0, -0.15), 4.0)
    prepared = prepare(windows_of(evidence, 150, 0.002, everything=True))
    final = Search.on(prepared, list(evidence.candidates), 3, None)
    mass = next(c for c in evidence.candidates if c.key == ("link_mass", "forearm"))
    first = final.fit((mass,), (mass.probe,))
    assert first.rms > 1.5
    compare(final, first)
    (load,) = final.best.members
    assert load.moved
    assert final.best.rms < 1.05
    assert final.best.x[0][0] == pytest.approx(MASS, rel=0.03)


def test_a_mass_and_a_shifted_centre_are_tried_as_a_load_at_its_usual_place() -> None:
    """It was fitted on the way to a place, was not left for one, and was forgotten."""
    evidence = evidence_of(TIP, 4.0)
    search = Search.on(
        prepare(windows_of(evidence, 150, 0.002, everything=True)),
        list(evidence.candidates),
        3,
        None,
    )
    both = [
        next(c for c in evidence.candidates if c.key == (e, "forearm"))
        for e in ("link_mass", "com_shift")
    ]
    place_loads(search, search.fit(both, [c.probe for c in both]))
    (load,) = search.best.members
    assert load.key == ("payload", "forearm")
    assert not load.moved
    assert search.best.x[0] == pytest.approx([MASS], rel=0.03)


def test_a_place_is_looked_for_from_the_mass_in_whatever_order_that_was_fitted(monkeypatch) -> None:
    recorded = [record([("payload", "body", "forearm", [MASS, *TIP])], duration=2.0)]
    effects = [CATALOGUE[e] for e in ("payload", "link_mass", "dry_friction")]
    evidence = make_evidence(arm(), recorded, effects=effects, noise={"qpos": SIGMA}, threads=1)
    search = Search.on(prepare(windows_of(evidence, 60, 0.002)), list(evidence.candidates), 3, None)
    own = {c.key: c for c in reversed(search.candidates)}
    mass, load = own["link_mass", "forearm"], own["payload", "forearm"]
    friction, little = own["dry_friction", "elbow"], np.array([1e-3])
    usual = search.fit((load, friction), (load.probe, little))
    assert usual.x[0] > 2 * max(load.probe, usual.x[1])
    base = search.fit((friction, mass), (little, mass.probe))
    begun, refit = [], search.refit

    def seen(members, x, **kwargs):
        if any(c.moved for c in members):
            begun.append(np.concatenate(x))
        return refit(members, x, **kwargs)

    monkeypatch.setattr(search, "refit", seen)
    place_loads(search, base, base)
    assert begun[0][1] == pytest.approx(usual.x[0][0], rel=0.2)


def test_a_load_at_its_usual_place_stays_there() -> None:
    (load,) = answered(TIP).findings
    assert (load.effect, load.site) == ("payload", "forearm")
    assert load.quantity.value == pytest.approx(MASS, rel=0.02)
    assert not load.details
    assert "It is taken to lie at (0, 0, -0.25) m in the frame of the forearm." in load.sentence
    np.testing.assert_allclose(load.x[1:], TIP)
