"""What the search does and leaves out where names are far from the recordings."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from diagnosis_helpers import SIGMA, arm, candidate, record

from bo_sysid.diagnosis.search.blocks import simulate_blocks
from bo_sysid.diagnosis.search.final import refit_from_nearer
from bo_sysid.diagnosis.search.locate import locate
from bo_sysid.diagnosis.search.moves import explore, extend_first, without_weakest
from bo_sysid.diagnosis.search.search import Search
from bo_sysid.diagnosis.search.variants import turn_about
from bo_sysid.diagnosis.search.window_lengths import windows_of
from bo_sysid.diagnosis.sets.fit import Fit, set_key
from bo_sysid.diagnosis.sets.rules import LOOSE, MARGIN, explains_little
from bo_sysid.diagnosis.windows.evidence import Evidence, make_evidence
from bo_sysid.diagnosis.windows.forecast import fitted
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis
from bo_sysid.diagnosis.windows.linear import linearise
from bo_sysid.diagnosis.windows.problem import ROUGH
from bo_sysid.diagnosis.windows.windowing import prepare
from bo_sysid.effects import CATALOGUE
from bo_sysid.mjcf import Model
from bo_sysid.recording import Recording


def evidence(effect: str, **plant: object) -> Evidence:
    recordings = (record(duration=4.0, **plant),)  # type: ignore[arg-type]
    noise = {"qpos": SIGMA}
    return make_evidence(arm(), recordings, effects=[CATALOGUE[effect]], noise=noise, threads=1)


DAMPED = [("viscous_damping", "joint", "elbow", [0.02])]


@pytest.fixture(scope="module")
def waves() -> Evidence:
    """Damping beside a force that nothing known explains."""
    force = ("elbow", lambda q: 0.04 * np.sin(9 * q))
    return evidence("viscous_damping", missing=DAMPED, force=force)


@pytest.fixture
def compared(monkeypatch: pytest.MonkeyPatch) -> list[Fit]:
    """The sets whose members others were tried in the place of."""
    seen: list[Fit] = []
    monkeypatch.setattr(
        "bo_sysid.diagnosis.search.final.substitute", lambda search, fit: seen.append(fit)
    )
    return seen


def test_sets_that_explain_little_are_not_compared_with_others(waves, compared) -> None:
    located = locate(waves)
    assert located.decision.best.members
    assert explains_little(located.decision.best, located.decision.nominal)
    assert not compared


def test_far_off_blocks_that_were_left_out_are_simulated(waves) -> None:
    assert locate(waves).decision.best.simulated
    search = Search.on(prepare(windows_of(waves, 100, 0.002)), [], 1, None)
    near, far = (candidate(waves.machine, "viscous_damping", s) for s in ("elbow", "shoulder"))
    first, second = (search.fit([c], [np.zeros(1)]) for c in (near, far))
    assert ROUGH < first.rms < second.rms
    simulate_blocks(search)
    made = search.fits[first.key]
    assert made.simulated
    assert made.rss == first.rss < made.cv.sum()
    # what leaves more of all blocks than that of those left out cannot lead
    assert search.fits[second.key].simulated == (second.rss < made.cv.sum())


def test_no_far_set_is_fitted_without_blocks_beside_one_that_explains(monkeypatch) -> None:
    damped = evidence("viscous_damping", missing=DAMPED)
    search = Search.on(prepare(windows_of(damped, 100, 0.002)), [], 1, None)
    near = search.fit([candidate(damped.machine, "viscous_damping", "elbow")], [np.zeros(1)])
    far = search.nominal
    assert near.rms < ROUGH < far.rms
    assert near.cv.sum() < far.rss  # and so less than the far one can leave of other blocks
    tried: list[Fit] = []
    monkeypatch.setattr(
        "bo_sysid.diagnosis.search.blocks.cross_validated", lambda _, fit: tried.append(fit) or fit
    )
    simulate_blocks(search)
    assert not tried
    del search.fits[near.key]
    simulate_blocks(search)
    assert [fit.key for fit in tried] == [far.key]


def test_a_set_that_explains_is_compared(compared) -> None:
    located = locate(evidence("viscous_damping", missing=DAMPED))
    assert not located.decision.best.simulated
    (finding,) = located.decision.best.members
    assert finding.key == ("viscous_damping", "elbow")
    assert [fit.key for fit in compared] == [located.decision.best.key]


def test_a_set_is_fitted_without_all_its_trifles_at_once() -> None:
    damped = evidence("viscous_damping", missing=DAMPED)
    search = Search.on(prepare(windows_of(damped, 100, 0.002)), [], 6, None)
    damping = candidate(damped.machine, "viscous_damping", "elbow")
    trifles = [
        candidate(damped.machine, effect, site)
        for effect, site in (
            ("constant_force", "shoulder"), ("constant_force", "elbow"),
            ("quadratic_damping", "shoulder"), ("quadratic_damping", "elbow"),
            ("joint_spring", "shoulder"),
        )
    ]  # fmt: skip
    members = [damping, *trifles]
    together = search.fit(members, [np.zeros(c.size) for c in members])
    assert max(together.unique[1:]) < MARGIN < together.unique[0]
    without_weakest(search)
    alone = search.fits[set_key([damping])]
    assert alone.x[0] == pytest.approx(DAMPED[0][3], rel=0.02)
    assert alone.rms == pytest.approx(1.0, abs=0.05)


@pytest.mark.parametrize(("force", "rounds"), [(0.0, 1), (0.03, 2)])
def test_a_search_goes_on_from_what_is_needed_and_not_from_a_trifle(
    monkeypatch: pytest.MonkeyPatch, force: float, rounds: int
) -> None:
    pushed = [*DAMPED, ("constant_force", "joint", "shoulder", [force])]
    missing = evidence("viscous_damping", missing=pushed)
    search = Search.on(prepare(windows_of(missing, 100, 0.002)), [], 6, None)
    names = ("viscous_damping", "elbow"), ("constant_force", "shoulder")
    members = [candidate(missing.machine, effect, site) for effect, site in names]
    found = [search.fit(members[: k + 1], [np.zeros(1)] * (k + 1)) for k in range(2)]
    assert (found[1].unique[1] > MARGIN) == (force > 0)
    leaders, begun = [*found, found[1]], []  # before any round, after the first, after the second
    monkeypatch.setattr(Search, "best", property(lambda _: leaders[len(begun)]))
    monkeypatch.setattr(
        "bo_sysid.diagnosis.search.moves.round_at", lambda _, base: begun.append(base)
    )
    monkeypatch.setattr("bo_sysid.diagnosis.search.moves.clean", lambda _: True)
    monkeypatch.setattr("bo_sysid.diagnosis.search.moves.LOOSE", np.inf)
    assert explore(search) is found[1]
    assert begun == found[:rounds]


@pytest.mark.parametrize(("share", "times"), [(1.05, 0), (2.0, 1)])
def test_a_set_is_fitted_again_where_the_model_was_linearised_at_another_distance(
    waves, monkeypatch: pytest.MonkeyPatch, share: float, times: int
) -> None:
    search = Search.on(prepare(windows_of(waves, 100, 0.002)), [], 1, None)
    damping = candidate(waves.machine, "viscous_damping", "elbow")
    first = search.fit([damping], [np.zeros(1)])
    assert first.rms > ROUGH
    taken: list[object] = []
    monkeypatch.setattr(
        "bo_sysid.diagnosis.search.search.linearise",
        lambda *at: taken.append(at) or linearise(*at),
    )
    monkeypatch.setattr(search, "_framed", share * first.rms)
    search.refit([damping], first.x, start=first.start)
    assert min(len(taken), 1) == times


def test_what_only_windows_outside_the_search_show_is_found() -> None:
    """A torque limit that is reached once, where the search has no window."""
    limit, noise = 0.147, {"qpos": SIGMA}
    lost_of_one = [("actuator_saturation", "actuator", "elbow", [1.0 - limit])]
    recorded = record(lost_of_one, seed=3, duration=12.0, finer=1)
    chosen = [CATALOGUE["actuator_saturation"], CATALOGUE["dry_friction"]]
    rare = make_evidence(arm(), [recorded], effects=chosen, noise=noise, threads=1)
    horizon = round(rare.window / rare.machine.sampling)
    searched, whole = (windows_of(rare, horizon, 0.002, everything) for everything in (False, True))
    assert fitted(searched, Hypothesis()).ahead < 1.1
    assert fitted(whole, Hypothesis()).ahead > 1.5
    best = locate(rare).decision.best
    assert [c.key for c in best.members] == [("actuator_saturation", "elbow")]
    kept = rare.machine.actuators["elbow"].force_max - best.hypothesis.x[0][0]
    assert kept == pytest.approx(limit, rel=0.02)
    assert best.rms < 1.05


def test_the_best_effect_that_a_leader_lacks_is_extended_to_the_truth() -> None:
    missing = [*DAMPED, ("joint_spring", "joint", "shoulder", [0.4, 0.0])]
    recordings = (record(duration=4.0, missing=missing),)
    effects = [CATALOGUE[e] for e in ("viscous_damping", "joint_spring", "payload", "armature")]
    made = make_evidence(arm(), recordings, effects=effects, noise={"qpos": SIGMA}, threads=1)
    search = Search.on(prepare(windows_of(made, 100, 0.002)), list(made.candidates), 2, None)
    own = {c.key: c for c in search.candidates}
    wrong = [own["payload", "forearm"], own["armature", "elbow"]]
    for c in (wrong[0], own["viscous_damping", "elbow"]):
        search.fit([c], [np.zeros(c.size)])
    leader = search.fit(wrong, [np.zeros(c.size) for c in wrong])
    assert leader.rms > ROUGH
    extend_first(search, leader)
    assert search.best.key == {("viscous_damping", "elbow"), ("joint_spring", "shoulder")}
    assert search.best.rms == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("left", [1.1, 0.9])
def test_a_leader_far_off_is_fitted_from_what_does_the_same_and_came_nearer(left: float) -> None:
    """A drag and the back-EMF of a motor without a gear are one force."""
    force = ("elbow", lambda q: 0.04 * np.sin(9 * q))
    recordings = (record(duration=4.0, missing=DAMPED, force=force),)
    effects = [CATALOGUE["viscous_damping"], CATALOGUE["back_emf"]]
    made = make_evidence(arm(), recordings, effects=effects, noise={"qpos": SIGMA}, threads=1)
    search = Search.on(prepare(windows_of(made, 100, 0.002)), list(made.candidates), 1, None)
    own = {c.key: c for c in search.candidates}
    drag = search.fit([own["viscous_damping", "elbow"]], [np.zeros(1)])
    emf = search.fit([own["back_emf", "elbow"]], [np.zeros(1)])
    assert emf.rms == pytest.approx(drag.rms, rel=1e-3)
    known = replace(emf, cost=left**2 * emf.cost, rms=left * emf.rms)
    search.fits[emf.key] = known
    assert known.rms > LOOSE
    refit_from_nearer(search, known)
    assert search.fits[emf.key].rms < 1.001 * min(left, 1.0) * drag.rms


RAIL = """
<mujoco>
  <option timestep="0.004" gravity="0 0 0"/>
  <worldbody>
    <body>
      <joint name="rail" type="slide" axis="1 0 0"/>
      <geom size="0.1" mass="1"/>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="rail" ctrlrange="-5 5"/></actuator>
</mujoco>
"""


def rubbing_one_way(difference: float) -> Evidence:
    """A slider that rubs forwards and is helped backwards, which rests for half of the time."""
    model, rng = Model.from_xml(RAIL), np.random.default_rng(0)
    compiled = model.compile(timestep=0.001)
    data, time = mujoco.MjData(compiled), np.arange(0, 8, 0.004)
    ctrl = 1.5 * np.sin(2 * np.pi * 0.8 * time) * (np.sin(2 * np.pi * 0.2 * time) > -0.2)
    place = np.empty(len(time))
    for k, u in enumerate(ctrl):
        place[k], data.ctrl[0] = data.qpos[0], u
        for _ in range(4):
            data.qfrc_applied[0] = -0.5 * difference * (abs(data.qvel[0]) > 0.01)
            mujoco.mj_step(compiled, data)
    place += SIGMA * rng.normal(size=len(time))
    recordings = (Recording.from_arrays(time, qpos={"rail": place}, ctrl={"push": ctrl}),)
    effects = [CATALOGUE[e] for e in ("constant_force", "dry_friction", "asymmetric_friction")]
    return make_evidence(model, recordings, effects=effects, noise={"qpos": SIGMA}, threads=1)


def test_a_force_that_friction_holds_leads_to_friction_that_differs_between_directions() -> None:
    """The two do the same while a joint moves; what each does alone is far from that."""
    made = rubbing_one_way(0.6)
    prepared = prepare(windows_of(made, 100, 0.004))
    search = Search.on(prepared, list(made.candidates), 3, None)
    own = {c.key: c for c in search.candidates if not c.secant}
    pair = [own["constant_force", "rail"], own["dry_friction", "rail"]]
    held = search.fit(pair, [np.array([-0.3]), np.array([0.3])])
    turn_about(search, held)
    found = search.fits[set_key([own["asymmetric_friction", "rail"]])]
    assert found.x[0] == pytest.approx(0.6, rel=0.05)
    assert found.rms == pytest.approx(1.0, abs=0.05)
    single = Search.on(prepared, search.candidates, 1, None)  # one name for another, though rarer
    turn_about(single, single.fit(pair[:1], [np.array([-0.3])]))
    assert set_key([own["asymmetric_friction", "rail"]]) in single.fits


def test_such_friction_is_tried_where_all_joints_rub() -> None:
    """Friction at both joints is one effect of the two that a set may have."""
    effects = [CATALOGUE[e] for e in ("constant_force", "dry_friction", "asymmetric_friction")]
    recordings = [record([("dry_friction", "joint", "elbow", [0.05])], duration=1.0)]
    made = make_evidence(arm(), recordings, effects=effects, noise={"qpos": SIGMA}, threads=1)
    search = Search.on(prepare(windows_of(made, 100, 0.002)), list(made.candidates), 2, None)
    own = {c.key: c for c in search.candidates if not c.secant}
    rubbing = [own["dry_friction", joint] for joint in ("shoulder", "elbow")]
    force, difference = own["constant_force", "elbow"], own["asymmetric_friction", "elbow"]
    held = search.fit([*rubbing, force], [np.array([0.05])] * 3)
    assert held.size == 2
    turn_about(search, held)
    assert set_key([*rubbing, difference]) in search.fits


def test_a_tilt_out_of_the_plane_of_a_planar_arm_is_found_from_one_inside_it() -> None:
    """Gravity loses 1 - cos 0.12 in the plane: of tilt beside none that has no slope."""
    tilted = evidence("gravity_tilt", missing=[("gravity_tilt", "world", "world", [0.12, 0.07])])
    prepared = prepare(windows_of(tilted, 150, 0.002))
    search = Search.on(prepared, list(tilted.candidates), 1, None)
    (tilt,) = tilted.candidates
    (x,) = search.refit((tilt,), (np.array([0.006, 0.07]),)).x
    assert abs(x[0]) == pytest.approx(0.12, rel=0.05)
    assert x[1] == pytest.approx(0.07, rel=0.01)
