"""Marks of single answers, rates with their intervals, calibration, tables and the page."""

from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from chromium import ask, needs_chromium
from scipy.stats import binom

from bo_sysid.intervals import upper_bound
from bo_sysid.proof.marks import class_size, mark, mark_effects, named, offers
from bo_sysid.proof.page import page
from bo_sysid.proof.reveal import Revealed
from bo_sysid.proof.score import Scores, score
from bo_sysid.proof.statistics import clopper_pearson, reliability


def concealed(effect, site, *, kind="joint", size=5.0, value=0.1, known=True, depends_on=()):
    return {
        "effect": effect, "kind": kind, "site": site, "size": size, "value": value, "known": known,
        "unit": "N m", "details": {}, "depends_on": list(depends_on),
    }  # fmt: skip


def truth(*effects, tier=3, machine="two_link_arm", **changes):
    size = max((e["size"] for e in effects), default=0.0)
    plain = {
        "name": "case-1", "tier": tier, "machine": machine, "effects": list(effects), "size": size,
        "grouped": False, "parameters": {},
    }  # fmt: skip
    return {**plain, **changes}


def finding(effect, site, *, kind="joint", value=0.1, interval=(0.09, 0.11), p=0.99, others=()):
    return {
        "effect": effect, "kind": kind, "site": site, "value": value, "interval": list(interval),
        "probability": p, "equivalents": [list(o) for o in others],
    }  # fmt: skip


def entry(effect, site, kind="joint"):
    return {"effect": effect, "kind": kind, "site": site, "value": 1.0}


def answer(*findings, verdict=None, alternatives=(), unexplained=None, forecast=None):
    return {
        "verdict": verdict or ("missing-physics" if findings else "nothing-missing"),
        "findings": list(findings),
        "alternatives": [{"findings": list(a), "probability": p} for a, p in alternatives],
        "unexplained": unexplained or {"share": 0, "kind": None, "site": None, "depends_on": []},
        "holdout": {"forecast": forecast or {}},
    }


DRY = concealed("dry_friction", "elbow")


def test_the_right_name_at_the_right_site_is_right():
    marks = mark(truth(DRY), answer(finding("dry_friction", "elbow")))
    assert marks["top1"]
    assert marks["right"]
    assert not marks["wrong_name"]
    assert marks["probability"] == 0.99


@pytest.mark.parametrize(
    "told",
    [
        answer(finding("dry_friction", "shoulder")),
        answer(finding("viscous_damping", "elbow")),
        answer(finding("dry_friction", "elbow"), finding("armature", "elbow")),
    ],
)
def test_a_wrong_name_site_or_company_is_wrong_and_confident(told):
    marks = mark(truth(DRY), told)
    assert not marks["right"]
    assert marks["confident_wrong"]


def test_an_unsure_wrong_name_is_not_a_confident_one():
    marks = mark(truth(DRY), answer(finding("viscous_damping", "elbow", p=0.6)))
    assert marks["wrong_name"]
    assert not marks["confident_wrong"]


def test_the_first_alternative_counts_among_the_first_two():
    told = answer(
        finding("viscous_damping", "elbow", p=0.6),
        alternatives=[
            ([entry("viscous_damping", "elbow")], 0.6),
            ([{**entry("unknown", "world"), "kind": "world"}], 0.3),  # none of these is no set
            ([entry("dry_friction", "elbow")], 0.1),
        ],
    )
    marks = mark(truth(DRY), told)
    assert marks["top2"]
    assert not marks["top1"]


def test_a_class_counts_up_to_three_members():
    names = ("viscous_damping", "armature", "joint_spring")
    truly = [[entry("dry_friction", "elbow")]]
    others = [[entry(n, "elbow")] for n in names]
    small = answer(finding("constant_force", "elbow", others=[*truly, others[0]]))
    large = answer(finding("constant_force", "elbow", others=[*truly, *others]))
    assert class_size(small["findings"]) == 3
    assert mark(truth(DRY), small)["right"]
    assert not mark(truth(DRY), small)["wrong_name"]
    assert class_size(large["findings"]) == 5
    assert not mark(truth(DRY), large)["right"]
    assert mark(truth(DRY), large)["confident_wrong"]


def test_an_equivalent_excuses_its_own_finding_alone():
    """A second wrong name beside one that offers what is concealed stays a wrong name."""
    both = truth(DRY, concealed("payload", "hand", kind="body"))
    offers = finding(
        "actuator_deadzone", "elbow", p=0.99, others=[[entry("dry_friction", "elbow")]]
    )
    assert not mark(both, answer(offers))["wrong_name"]
    assert mark(both, answer(offers, finding("cogging", "elbow")))["confident_wrong"]
    half = finding(
        "cogging", "elbow", others=[[entry("dry_friction", "elbow"), entry("armature", "elbow")]]
    )
    assert mark(both, answer(half))["confident_wrong"]


def test_an_equivalent_replaces_the_findings_that_list_it():
    instead = [entry("armature", "elbow")]
    payload = finding("payload", "hand", kind="body", others=[instead])
    spring = ("joint_spring", "joint", "elbow")
    armature = ("armature", "joint", "elbow")
    beside = [payload, finding("joint_spring", "elbow")]
    assert offers(beside, named(beside))
    assert offers(beside, frozenset({armature, spring}))
    assert not offers(beside, frozenset({armature}))
    assert not offers(beside, frozenset({spring}))
    assert offers(
        [payload, finding("joint_spring", "elbow", others=[instead])], frozenset({armature})
    )
    kept = [payload | {"equivalents": [[*instead, entry("joint_spring", "elbow")]]}, beside[1]]
    assert offers(kept, frozenset({armature, spring}))


def test_two_findings_may_be_exchanged_at_once():
    """Two findings with a class of two each: which of four sets it is stays open."""
    told = [
        finding("armature", "elbow", others=[[entry("link_inertia", "forearm", kind="body")]]),
        finding("viscous_damping", "elbow", others=[[entry("back_emf", "motor", kind="actuator")]]),
    ]
    both = truth(
        concealed("link_inertia", "forearm", kind="body"),
        concealed("back_emf", "motor", kind="actuator"),
    )
    assert class_size(told) == 2
    marks = mark(both, answer(*told))
    assert marks["right"]
    assert not marks["wrong_name"]
    inertia, damping = named(both["effects"][:1]), named([told[1]])
    assert offers(told, inertia | damping)
    assert not offers(told, inertia)
    assert not offers(told, inertia | named(both["effects"]) | damping)


def test_nothing_found_where_nothing_is_concealed_is_right():
    assert mark(truth(), answer())["right"]
    assert mark(truth(), answer(finding("timestep", "world", kind="world"), verdict="numerics"))[
        "right"
    ]
    alarm = mark(truth(), answer(finding("armature", "elbow")))
    assert alarm["detected"]
    assert alarm["confident_wrong"]
    assert mark(truth(), answer(verdict="unknown-physics"))["detected"]


def test_below_two_sigma_cannot_tell_is_accepted_and_a_wrong_name_is_not():
    small = truth(concealed("dry_friction", "elbow", size=1.5))
    assert mark(small, answer())["acceptable"]
    assert not mark(small, answer())["right"]
    assert not mark(small, answer(finding("armature", "elbow")))["acceptable"]
    assert not mark(truth(DRY), answer())["acceptable"]


def test_what_may_be_missed_is_small_together():
    large = concealed("payload", "hand", kind="body", size=25.0)
    small = concealed("dry_friction", "elbow", size=1.5)
    both = truth(large, small)
    assert not mark(both, answer())["acceptable"]
    assert mark(both, answer(finding("payload", "hand", kind="body")))["acceptable"]
    assert not mark(both, answer(finding("dry_friction", "elbow")))["acceptable"]
    group = truth(*(concealed("armature", f"joint {k}", size=1.9) for k in range(6)))
    assert not mark(group, answer())["acceptable"]


def test_an_outsider_is_to_be_flagged_located_and_never_named():
    magnet = concealed("magnet", "elbow", known=False, depends_on=("position",))
    said = {"share": 0.4, "kind": "joint", "site": "elbow", "depends_on": ["position", "speed"]}
    marks = mark(truth(magnet, tier=4), answer(verdict="unknown-physics", unexplained=said))
    assert marks["right"]
    assert marks["located"]
    assert marks["dependence"]
    astray = {**said, "site": "shoulder", "depends_on": []}
    elsewhere = mark(truth(magnet, tier=4), answer(verdict="unknown-physics", unexplained=astray))
    assert elsewhere["flagged"]
    assert not elsewhere["located"]
    assert not elsewhere["dependence"]
    named_wrongly = mark(truth(magnet, tier=4), answer(finding("cogging", "elbow")))
    assert named_wrongly["confident_wrong"]
    assert not named_wrongly["right"]


def test_a_failed_diagnosis_is_wrong_and_no_false_alarm():
    marks = mark(truth(), None)
    assert not marks["right"]
    assert not marks["detected"]
    assert not marks["acceptable"]


def test_the_probability_of_nothing_is_what_the_alternatives_leave():
    told = answer(
        alternatives=[([entry("armature", "elbow")], 0.2), ([entry("payload", "x")], 0.1)]
    )
    assert mark(truth(), told)["probability"] == pytest.approx(0.7)


def test_the_probability_of_a_class_is_that_of_all_its_sets():
    """The class counts as right; two of its sets at .49 are no guess at .49."""
    other = [entry("link_inertia", "upper", "body")]
    told = answer(
        finding("dry_friction", "elbow", p=0.49, others=[other]),
        alternatives=[(other, 0.48), ([entry("payload", "x", "body")], 0.01)],
    )
    marks = mark(truth(DRY), told)
    assert marks["class_size"] == 2
    assert marks["probability"] == pytest.approx(0.97)


def test_magnitudes_and_intervals():
    pair = truth(DRY, concealed("armature", "shoulder", value=-0.2))
    told = answer(
        finding("dry_friction", "elbow", value=0.12),
        finding("armature", "shoulder", value=-0.19, interval=(-0.21, -0.17)),
    )
    dry, armature = mark_effects(pair, told)
    assert dry["error"] == pytest.approx(0.2)
    assert dry["covered"]
    assert armature["error"] == pytest.approx(0.05)
    assert armature["covered"]
    (missed,) = mark_effects(truth(DRY), answer(finding("dry_friction", "shoulder")))
    assert not missed["found"]
    assert missed["named"] == "dry_friction elsewhere"
    assert mark_effects(truth(DRY), answer())[0]["named"] == "(nothing)"


def test_clopper_pearson_covers_at_least_as_often_as_it_says():
    n, p = 20, 0.13
    inside = [low <= p <= high for low, high in (clopper_pearson(k, n) for k in range(n + 1))]
    assert 0.95 <= float(binom.pmf(np.arange(n + 1), n, p) @ np.array(inside)) < 1
    assert clopper_pearson(0, 150)[0] == 0.0
    assert clopper_pearson(150, 150)[1] == 1.0


def test_no_alarm_in_150_cases_bounds_the_rate_at_two_percent():
    """The bound p solves (1 - p)^150 = 0.05."""
    assert upper_bound(0, 150) == pytest.approx(1 - 0.05 ** (1 / 150))
    assert upper_bound(0, 0) == 1.0


def test_true_probabilities_have_the_error_that_is_expected_of_them():
    rng = np.random.default_rng(4)
    stated = rng.uniform(0.3, 1.0, 200)
    honest = [reliability(stated, rng.random(200) < stated) for _ in range(25)]
    assert abs(np.mean([h.excess for h in honest])) < 0.015
    assert honest[0].expected > 0.05
    assert len(honest[0].bins) == 10
    assert honest[0].bins.n.sum() == 200
    proud = reliability(np.full(400, 0.99), rng.random(400) < 0.8)
    assert proud.excess == pytest.approx(0.19, abs=0.05)


def test_certainty_that_is_always_right_has_no_error():
    sure = reliability(np.ones(30), np.ones(30, bool))
    assert sure.error == 0.0
    assert sure.expected == 0.0
    assert reliability(np.zeros(0), np.zeros(0, bool)).cases == 0


def revealed():
    errors = {"nominal": 4.0, "refitted": 3.0, "repaired": 1.1, "noise_floor": 1.0}
    magnet = concealed("magnet", "elbow", known=False, depends_on=("position",))
    said = {"share": 0.4, "kind": "joint", "site": "elbow", "depends_on": ["position"]}
    cases = [
        (truth(DRY, tier=2), answer(finding("dry_friction", "elbow"), forecast=errors)),
        (truth(DRY), answer(finding("armature", "elbow"), forecast={**errors, "repaired": 2.0})),
        (truth(concealed("dry_friction", "elbow", size=1.2)), answer(forecast=errors)),
        (truth(magnet, tier=4), answer(verdict="unknown-physics", unexplained=said)),
        (truth(), answer(forecast=errors)),
        (truth(tier=2), answer(finding("payload", "<script>alert(1)</script>", kind="body"))),
        (truth(), None),
    ]
    return [
        Revealed(f"case-{k}", t, a, "no answer" if a is None else None, 1.0, {})
        for k, (t, a) in enumerate(cases)
    ]


def test_scores_of_a_run():
    scores = score(revealed())
    assert scores.rate("names_right") == 0.5
    assert scores.rate("names_right_tier_2") == 1.0
    assert scores.rate("false_alarms") == 0.5  # one of three failed
    assert scores.rate("unknown_located") == 1.0
    assert scores.rate("confident_wrong") == pytest.approx(2 / 6)
    assert scores.rate("small_acceptable") == 1.0
    assert scores.rate("failed") == pytest.approx(1 / 7)
    assert scores.rate("forecast_repaired") == 0.5
    assert scores.confusion.loc["dry_friction", "armature"] == 1
    assert scores.confusion.loc["magnet", "(unknown)"] == 1
    assert scores.confusion.loc["(nothing)"].to_dict() == {
        "(failed)": 1, "(nothing)": 1, "(unknown)": 0, "armature": 0, "dry_friction": 0,
        "payload": 1,
    }  # fmt: skip
    assert scores.by_decade.index.tolist() == ["below 2", "2 to 10"]
    assert scores.by_decade.loc["below 2", "detected"] == 0.0
    assert scores.by_machine.loc["two_link_arm", "n"] == 4
    assert scores.nothing.loc[(2, "two_link_arm"), "detected"] == 1.0
    assert scores.nothing.loc[(3, "two_link_arm"), "upper_bound"] == pytest.approx(0.95)
    assert scores.by_effect.loc["dry_friction", "right"] == 0.5
    assert scores.magnitudes.loc["dry_friction", "n"] == 1
    assert scores.forecasts.loc["tier 2", "repaired"] == 1.1
    assert scores.calibration.cases == 5


def test_the_notebook_counts_a_run_as_its_scores_do(tmp_path):
    """One answer gives unknown physics a confident name, one diagnosis failed."""
    pytest.importorskip("matplotlib").use("agg")
    magnet = concealed("magnet", "elbow", known=False)
    named = Revealed("x", truth(magnet, tier=4), answer(finding("armature", "elbow")), None, 1, {})
    scores = score([*revealed(), named])
    scores.cases.to_parquet(tmp_path / "cases.parquet")
    scores.effects.to_parquet(tmp_path / "effects.parquet")
    text = (Path(__file__).parents[1] / "notebooks" / "concealed_proof.py").read_text()
    shown = {}
    exec(text.replace("RUN = None", f"RUN = {str(tmp_path)!r}", 1), shown)  # noqa: S102 - ours
    assert shown["told"].cases == scores.calibration.cases == 6
    assert shown["told"].error == scores.calibration.error
    rates = shown["rates"].set_index("cases")["right"]
    assert rates["tier 3, nothing"] == 0.5  # one of two failed
    assert set(shown["nameable"]["effect"]) == {"dry_friction"}


def test_a_rate_has_a_key_of_its_own_and_its_words_are_for_the_page():
    scores = score(revealed())
    assert scores.summary["key"].is_unique
    assert scores.summary["what"].is_unique
    with pytest.raises(KeyError, match="unknown physics flagged"):
        scores.rate("unknown physics flagged")
    rates, _ = page(scores, {}).split("<h2>By tier</h2>")
    for key, what in scores.summary[["key", "what"]].to_numpy():
        assert f">{what}</td>" in rates
        assert f">{key}</td>" not in rates


def test_the_page_is_whole_escaped_and_asks_for_nothing(tmp_path):
    text = page(score(revealed()), {"suite": "<b>bold</b>"})
    assert "<script" not in text
    assert "&lt;script&gt;alert(1)" in text
    assert "&lt;b&gt;bold" in text
    for outside in ("http://", "https://", "src=", "@import"):
        assert outside not in text
    assert "<svg" in text


def test_the_page_marks_what_is_not_acceptable_and_says_so_in_words():
    scores = score(revealed())
    wrong = int((~scores.cases["acceptable"].to_numpy(bool)).sum())
    assert wrong
    text = page(scores, {})
    assert text.count('<tr class="wrong">') == wrong
    cases = text.partition("<h2>Cases</h2>")[2]
    assert '<th scope="col">acceptable</th>' in cases
    assert '<th scope="col" class="text">found</th>' in cases  # above cells of its own side


@needs_chromium
@pytest.mark.slow
def test_the_page_fits_a_phone(tmp_path):
    path = tmp_path / "proof.html"
    path.write_text(page(score(revealed()), {"SHA-256 of the suite": "0123456789abcdef" * 4}))
    asked = """
      const wide = document.documentElement.scrollWidth - innerWidth;
      return [wide, Boolean(document.querySelector("meta[name=viewport]"))];
    """
    (wide, told), problems = ask(path, asked, 500)
    assert problems == []
    assert told  # a phone lays a page out for a desktop otherwise
    assert wide <= 0


def test_the_table_of_cases_goes_through_parquet(tmp_path):
    scores = score(revealed())
    scores.cases.to_parquet(tmp_path / "cases.parquet")
    scores.effects.to_parquet(tmp_path / "effects.parquet")
    pd.testing.assert_frame_equal(pd.read_parquet(tmp_path / "cases.parquet"), scores.cases)


def test_cases_of_several_runs_are_scored_together():
    runs = [score(revealed()[:2]), score(revealed()[2:])]
    both = Scores.of(pd.concat([r.cases for r in runs]), pd.concat([r.effects for r in runs]))
    whole = score(revealed())
    pd.testing.assert_frame_equal(both.summary, whole.summary)
    pd.testing.assert_frame_equal(both.confusion, whole.confusion)
    assert both.rate("confident_wrong") == pytest.approx(2 / 6)
    assert runs[0].rate("confident_wrong") == pytest.approx(1 / 2)


def test_diagnoses_that_fail_do_not_lower_the_rates_of_errors():
    """Two answers, one of them a false alarm; any number of failures beside them."""
    told = [answer(), answer(finding("armature", "elbow"))]
    for failed in (0, 8):
        cases = [*told, *[None] * failed]
        scores = score(
            [Revealed(f"case-{k}", truth(), a, None, 1.0, {}) for k, a in enumerate(cases)]
        )
        rates = scores.summary.set_index("key")
        for key in ("false_alarms", "confident_wrong"):
            assert rates.loc[key, ["count", "of"]].tolist() == [1, 2]
        assert scores.nothing.loc[(3, "two_link_arm"), "detected"] == 0.5
        assert rates.loc["failed", "count"] == failed


@pytest.mark.parametrize(
    ("told", "cases", "error"),
    [
        (answer(finding("cogging", "elbow", p=0.98)), 1, 0.98),
        (answer(), 1, 1.0),
        (answer(verdict="unknown-physics"), 0, float("nan")),
    ],
)
def test_probabilities_of_names_that_unknown_physics_is_given_are_calibrated(told, cases, error):
    magnet = truth(concealed("magnet", "elbow", known=False), tier=4)
    calibration = score([Revealed("a", magnet, told, None, 1.0, {})]).calibration
    assert calibration.cases == cases
    assert calibration.error == pytest.approx(error, nan_ok=True)


def test_a_run_without_physics_missing_has_scores():
    scores = score([Revealed("a", truth(), answer(), None, 1.0, {})])
    assert scores.rate("false_alarms") == 0.0
    assert np.isnan(scores.rate("unknown_flagged"))
    assert "Proof" in page(scores, {})
