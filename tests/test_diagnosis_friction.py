"""Dry friction that bends before it slips, and friction that holds a joint all the time."""

from functools import partial
from pathlib import Path

import mujoco
import numpy as np
import pytest
import yaml
from diagnosis_helpers import ARM, NAMES, SIGMA, arm, candidate, posed, record

from bo_sysid.diagnosis import diagnose
from bo_sysid.diagnosis.answer.findings import findings
from bo_sysid.diagnosis.answer.hints import stuck_joints
from bo_sysid.diagnosis.search.held_friction import prefer_static_friction
from bo_sysid.diagnosis.search.locate import locate
from bo_sysid.diagnosis.search.moves import explore
from bo_sysid.diagnosis.search.search import Search
from bo_sysid.diagnosis.search.sharpen import sharpened
from bo_sysid.diagnosis.sets.fit import Fit
from bo_sysid.diagnosis.sets.rules import admissible, clean, ranked
from bo_sysid.diagnosis.sets.shapes import ranges, with_shapes_unsure
from bo_sysid.diagnosis.windows.candidate import candidates, free_parameters, parameter_candidates
from bo_sysid.diagnosis.windows.evidence import Evidence, make_evidence
from bo_sysid.diagnosis.windows.windowing import prepare
from bo_sysid.effects import CATALOGUE, Site, survey
from bo_sysid.mjcf import Model
from bo_sysid.parameters import Parameter
from bo_sysid.recording import Recording
from bo_sysid.recording.writers import write_recording
from bo_sysid.runs import Run
from bo_sysid.study import Study
from bo_sysid.study.overview import overview

LEVEL, BEND, MASS = 2.0, 1e-3, 0.5
SLIDE = f"""<mujoco><option timestep="0.0005" gravity="0 0 0" integrator="implicitfast"/><worldbody>
<body><joint name="j" type="slide" axis="1 0 0"/><geom size=".1" mass="{MASS}"/></body></worldbody>
</mujoco>"""


def rubbing(bend: float, level: float = LEVEL) -> mujoco.MjModel:
    """A mass that slides with dry friction; where its level is less than nothing, without any."""
    spec, time = mujoco.MjSpec.from_string(SLIDE), np.arange(0, 3, 0.01)
    moving = Recording.from_arrays(time, qpos={"j": np.sin(time)})
    machine = survey(spec.copy().compile(), [moving])
    CATALOGUE["dry_friction"].apply(spec, Site("joint", "j"), np.array([level, 1.0, bend]), machine)
    return spec.compile()


@pytest.mark.parametrize("share", [0.3, -0.8])
def test_bristles_bend_below_the_level(share: float) -> None:
    """LuGre, slowly: ż = v - |v| z/bend, so that |x| = -bend·ln(1 - |force|/level)."""
    model, steps = rubbing(BEND), 2000
    data = mujoco.MjData(model)
    for k in range(steps):
        data.qfrc_applied[0] = share * LEVEL * k / steps
        mujoco.mj_step(model, data)
    expected = -BEND * np.log(1 - abs(share)) * np.sign(share)
    assert data.qpos[0] == pytest.approx(expected, rel=0.03)


@pytest.mark.parametrize("bend", [0.0, BEND])
def test_above_it_the_friction_has_its_level_whether_it_bends_or_not(bend: float) -> None:
    model = rubbing(bend)
    data = mujoco.MjData(model)
    data.qvel[0] = 1.0
    for _ in range(200):
        mujoco.mj_step(model, data)
    slowed = (1.0 - data.qvel[0]) / data.time
    assert slowed == pytest.approx(LEVEL / MASS, rel=0.02)


def test_bristles_that_hold_nothing_are_none() -> None:
    """What takes all of a model's friction away leaves nothing that could bend."""
    assert rubbing(BEND, -LEVEL).nu == 0


def found(*missing: tuple[str, str, str, list[float]], finer: int = 4) -> Fit:
    """The best set whose members are needed, on recordings of an arm with effects concealed."""
    return needed(searched(*missing, finer=finer))


def needed(search: Search) -> Fit:
    fits = list(search.fits.values())
    order = ranked(fits, search.prior)
    return next(f for f in order if admissible(f, search.nominal, fits))


def searched(*missing: tuple[str, str, str, list[float]], finer: int = 4) -> Search:
    problem, machine = posed(record(missing, duration=5.0, finer=finer), horizon=150)
    known = candidates([CATALOGUE[n] for n in (*NAMES, "stribeck_friction")], machine)
    search = Search.on(prepare(problem), list(known), 2, None)
    explore(search)
    sharpened(search)
    return search


def test_how_far_friction_bends_is_found() -> None:
    fit = found(("dry_friction", "joint", "shoulder", [0.1, 1.0, 8e-4]), finer=16)
    (friction,) = fit.members
    assert (friction.key, clean(fit)) == (("dry_friction", "shoulder"), True)
    assert fit.x[0][0] == pytest.approx(0.1, rel=0.02)
    assert friction.shapes[-1] == pytest.approx(8e-4, rel=0.25)


@pytest.mark.parametrize("times", [0.1, 1.0, 1.9, 10.0])
def test_bounds_of_a_bend_hold_it_however_large(times: float) -> None:
    machine = survey(arm().compile(), [record([], duration=1.0)])
    (friction,) = (
        c for c in candidates([CATALOGUE["dry_friction"]], machine)
        if c.site.name == "shoulder" and not c.secant
    )  # fmt: skip
    bend = times * friction.extent.high[-1]
    ((low, high),) = ranges(friction.with_shapes(np.array([1.0, bend])), machine).values()
    assert low < bend <= high


def test_a_period_stays_within_the_bounds_of_its_effect() -> None:
    machine = survey(arm().compile(), [record([], duration=1.0)])
    coggings = [
        c for c in candidates([CATALOGUE["cogging"]], machine) if c.site.name == "shoulder"
    ]  # fmt: skip
    extent = coggings[0].extent
    for period in (extent.low[-1], *(c.shapes[0] for c in coggings), extent.high[-1]):
        ((low, high),) = ranges(coggings[0].with_shapes(np.array([period])), machine).values()
        assert extent.low[-1] <= low <= period <= high <= extent.high[-1]
        assert low < high


def test_the_interval_of_a_bend_says_how_little_the_recordings_tell_of_it() -> None:
    search = searched(("dry_friction", "joint", "shoulder", [0.1, 1.0, 8e-4]), finer=16)
    problem, Q = search.prepared.problem, search.frame.Q
    best = needed(search)
    fit = with_shapes_unsure(problem, Q, best)
    (friction,) = findings(fit, problem.machine, 1.0)
    bend = friction.details["bend"]
    assert bend.interval[0] < 8e-4 < bend.interval[1]
    deviation = float(fit.spread[0][-1])
    # beside it the level is fitted anew: twice the variance of the squares at two deviations
    levels = {}
    for moved in (-2 * deviation, 0.0, 2 * deviation):
        c = fit.members[0].with_shapes(fit.members[0].shapes + np.array([0.0, moved]))
        made = search.refit([c], fit.x, start=fit.start, guess=fit.hypothesis)
        levels[moved] = (made.rss, made.x[0][0])
    white = [levels[m][0] - levels[0.0][0] for m in levels if m]
    assert np.mean(white) / 4 >= 0.5  # no narrower than the noise allows
    change = [abs(levels[m][1] - levels[0.0][1]) / 2 for m in levels if m]
    grown = np.sqrt(fit.covariance[0, 0] - best.covariance[0, 0])
    assert grown == pytest.approx(np.mean(change), rel=0.5, abs=1e-5)


def test_a_speed_of_friction_that_the_recordings_do_not_tell_stays_where_it_is() -> None:
    missing = [("dry_friction", "joint", "shoulder", [0.1])]
    problem, machine = posed(record(missing, duration=5.0), horizon=150)
    known = candidates([CATALOGUE["stribeck_friction"]], machine)
    search = Search.on(prepare(problem), list(known), 1, None)
    explore(search)
    speeds = [f.members[0].shapes[0] for f in search.fits.values() if f.members]
    sharpened(search)
    (friction,) = search.best.members
    assert friction.effect.id == "stribeck_friction"
    points = np.concatenate([speeds, [c.shapes[0] for c in known]])
    assert np.isclose(friction.shapes[0], points, rtol=1e-9).any()


def test_stribeck_friction_that_bends_is_no_dry_friction() -> None:
    """Bent dry friction comes nearer than Stribeck friction that does not bend."""
    missing = [("stribeck_friction", "joint", "shoulder", [0.2, 0.1, 0.15, 8e-4])]
    chosen = [CATALOGUE[n] for n in ("dry_friction", "viscous_damping", "stribeck_friction")]
    recording = record(missing, seed=2, duration=3.0, finer=16)
    made = make_evidence(arm(), [recording], effects=chosen, noise={"qpos": SIGMA}, threads=1)
    best = locate(made).decision.best
    (friction,) = best.members
    assert friction.key == ("stribeck_friction", "shoulder")
    assert friction.shapes[-1] > 0
    assert best.x[0][1] == pytest.approx(0.1, rel=0.03)  # the level of sliding


def test_friction_that_holds_a_joint_all_the_time_is_no_viscous_damping() -> None:
    """Its level is at least what the motor did; more cannot be told, and the interval says so."""
    held = [("dry_friction", "joint", "elbow", [0.9])]
    chosen = [CATALOGUE[n] for n in NAMES]
    made = make_evidence(
        arm(), [record(held, duration=5.0)], effects=chosen, noise={"qpos": SIGMA}, threads=1
    )
    best = locate(made).decision.best
    assert stuck_joints(best) == ("elbow",)  # and any friction would do the same where it rests
    (finding,) = findings(best, made.machine, 1.0)
    assert (finding.effect, finding.site) == ("dry_friction", "elbow")
    low, high = finding.quantity.interval
    assert low < 0.9 < high < 1.5


def test_the_repaired_study_goes_on_with_friction_that_bends(tmp_path: Path) -> None:
    bent = [("dry_friction", "joint", "shoulder", [0.1, 1.0, 8e-4])]
    for part, seed in (("train", 0), ("holdout", 1)):
        write_recording(
            record(bent, duration=3.0, seed=seed, finer=16), tmp_path / f"{part}.parquet"
        )
    content = {
        "version": 1, "name": "bent", "model": str(ARM),
        "recordings": {"train": ["train.parquet"], "holdout": ["holdout.parquet"]},
        "diagnosis": {"effects": list(NAMES)},
    }  # fmt: skip
    (tmp_path / "study.yaml").write_text(yaml.safe_dump(content))
    study = Study.load(tmp_path / "study.yaml")
    with Run.open(
        tmp_path / "run", study.resolved(relative_to=tmp_path / "run"), "diagnose"
    ) as run:
        diagnose(study, run)
    repaired = Study.load(tmp_path / "run" / "study_repaired.yaml")
    (parameter,) = repaired.parameters
    assert parameter.low < 0.1 < parameter.high
    assert set(parameter.address) == {f"actuator[shoulder_friction].biasprm[{k}]" for k in (3, 4)}
    assert overview(repaired).parameters.nominal.iloc[0] == pytest.approx(0.1, rel=0.02)


def evidence_of(
    missing: list[float], parameters: list[Parameter], model: Model, finer: int = 16
) -> Evidence:
    recording = record([("dry_friction", "joint", "shoulder", missing)], duration=3.0, finer=finer)
    chosen = [CATALOGUE[n] for n in NAMES]
    return make_evidence(
        model, [recording], effects=chosen, parameters=parameters, noise={"qpos": SIGMA}, threads=1
    )


def fitted_beside(parameters: list[Parameter], missing: list[float], finer: int = 16) -> Fit:
    """The best set on recordings of an arm whose shoulder rubs, beside parameters of a study."""
    return locate(evidence_of(missing, parameters, arm(), finer)).decision.best


def frictions(*joints: str) -> list[Parameter]:
    return [Parameter(j, (f"joint[{j}].frictionloss",), 0.0, 1.0) for j in joints]


def test_friction_that_bends_is_found_where_the_study_fits_friction_that_does_not() -> None:
    best = fitted_beside(frictions("shoulder", "elbow"), [0.1, 1.0, 8e-4])
    assert [c.key for c in best.members] == [("dry_friction", "shoulder")]
    assert clean(best)
    assert best.x[0][0] == pytest.approx(0.1, rel=0.02)
    assert best.members[0].shapes[-1] == pytest.approx(8e-4, rel=0.3)
    (elbow,) = best.hypothesis.nuisances  # the shoulder's friction is all in the member
    assert elbow.site.name == "elbow"


def test_friction_that_does_not_bend_stays_a_parameter() -> None:
    best = fitted_beside(frictions("shoulder"), [0.1, 0.0, 0.0], finer=4)
    assert not best.members
    assert best.hypothesis.nuisance_x[0][0] == pytest.approx(0.1, rel=0.02)


def test_a_parameter_of_other_joints_too_stays_beside_friction() -> None:
    tied = Parameter("both", ("joint[*].frictionloss",), 0.0, 1.0)
    damping = Parameter("damping", ("joint[elbow].damping",), 0.0, 1.0)
    held = parameter_candidates(arm(), [tied, damping, *frictions("elbow")])
    machine = survey(arm().compile(), [record([], duration=1.0)])
    shoulder, elbow = (candidate(machine, "dry_friction", site) for site in ("shoulder", "elbow"))
    assert free_parameters(held, []) == held
    assert free_parameters(held, [shoulder]) == held
    assert free_parameters(held, [elbow]) == held[:2]
    assert free_parameters(held, [shoulder, elbow]) == held[1:2]


@pytest.mark.parametrize("fitted", [False, True])
def test_friction_that_the_model_has_right_may_bend(fitted: bool) -> None:
    """Its level is no change, and what is missing is how far it gives way."""
    level, bend = 0.1, 8e-4
    xml = ARM.read_text().replace('name="shoulder"', f'name="shoulder" frictionloss="{level}"', 1)
    evidence = evidence_of(
        [level, 1.0, bend], frictions("shoulder") if fitted else [], Model.from_xml(xml)
    )
    best = locate(evidence).decision.best
    assert [c.key for c in best.members] == [("dry_friction", "shoulder")]
    assert best.x[0][0] == pytest.approx(0.0, abs=0.01 * level)
    assert best.members[0].shapes[-1] == pytest.approx(bend, rel=0.3)
    assert not stuck_joints(best)  # as slopes by what changes alone would say
    (finding,) = findings(best, evidence.machine, 1.0)
    assert finding.sentence.startswith("The dry friction at the shoulder, 0.1 N m in the model, ")
    assert finding.after == pytest.approx(level, rel=0.01)


def test_friction_that_bends_is_all_that_there_is_at_its_joint() -> None:
    xml = ARM.read_text().replace('name="shoulder"', 'name="shoulder" frictionloss=".3"', 1)
    machine = survey(Model.from_xml(xml).compile(), [record([], duration=1.0)])
    straight = candidate(machine, "dry_friction", "shoulder")
    bent = straight.with_shapes(np.array([1.0, 1e-3]))
    change = np.array([-0.1])
    assert straight.total(change) == pytest.approx(change)
    assert bent.total(change) == pytest.approx([0.2])


@pytest.mark.parametrize(("level", "told"), [(0.1, True), (0.004, False)])
def test_friction_holds_where_recordings_do_not_tell_that_it_creeps(
    level: float, told: bool
) -> None:
    """The plant's creeps as MuJoCo's own does; only where it is large is that more than noise."""
    joint = "shoulder"
    recording = record([("dry_friction", "joint", joint, [level, 0.0, 0.0])], duration=5.0)
    problem, machine = posed(recording, horizon=150)
    friction = candidate(machine, "dry_friction", joint)
    creeping = friction.with_shapes(np.array([0.0, 0.0]))
    assert creeping.regularised
    assert not friction.regularised
    assert not creeping.with_shapes(np.array([0.0, 1e-3])).regularised
    final = Search.on(prepare(problem), [friction, creeping], 1, None)
    final.fit([creeping], [np.array([level])])
    prefer_static_friction(final)
    assert final.best.members[0].regularised is told
    assert len(final.fits) == (3 if told else 2)


def test_a_parameter_at_its_bound_is_written_as_that_bound() -> None:
    """A fit may stop a trifle below none: a model file with negative friction is no model."""
    (rubs,) = parameter_candidates(arm(), frictions("elbow"))
    machine = survey(arm().compile(), [record([], duration=1.0)])
    least = np.array(rubs.extent.low)
    assert least[0] < 0
    apply = partial(rubs.effect.apply, site=rubs.site, x=least, machine=machine)
    assert arm().compile([apply]).dof_frictionloss.min() == 0.0


def test_friction_of_a_plant_at_the_step_of_the_model_creeps() -> None:
    """At half that step, where bends are told, no friction was as the plant's (1.17 σ)."""
    light = """<mujoco><option timestep="0.005"/><worldbody><body name="link">
<joint name="elbow" axis="0 1 0" damping="{}" frictionloss="{}"/>
<geom name="rod" type="capsule" fromto="0 0 0 0 0 -.4" size=".02" mass="{}"/></body></worldbody>
<actuator><motor name="elbow" joint="elbow" ctrlrange="-2 2"/></actuator></mujoco>"""
    plant = mujoco.MjModel.from_xml_string(light.format(0.05, 0.1, 0.62))
    data, rng = mujoco.MjData(plant), np.random.default_rng(0)
    phase, time, place = rng.uniform(0, 6, 3), 0.005 * np.arange(1600), []
    waves = np.sin(2 * np.pi * np.outer(time, (0.3, 0.7, 1.3)) + phase)
    torque = 0.6 * waves.sum(axis=1)
    for u in torque:
        place.append(data.qpos[0])
        data.ctrl[0] = u
        mujoco.mj_step(plant, data)
    seen = np.array(place) + rng.normal(0, 5e-4, len(time))
    recording = Recording.from_arrays(time, qpos={"elbow": seen}, ctrl={"elbow": torque})
    effects = [CATALOGUE[e] for e in ("dry_friction", "stribeck_friction", "cogging", "backlash")]
    parameters = (
        Parameter("mass", ("geom[rod].mass",), 0.4, 0.8),
        Parameter("damping", ("joint[elbow].damping",), 0.0, 0.1),
    )
    model = Model.from_xml(light.format(0.02, 0, 0.5))
    evidence = make_evidence(model, [recording], effects=effects, parameters=parameters, threads=1)
    best = locate(evidence).decision.best
    assert [c.key for c in best.members] == [("dry_friction", "elbow")]
    assert best.x[0][0] == pytest.approx(0.1, rel=0.01)
    assert best.rms < 1.01
    assert best.hypothesis.numerics == pytest.approx(0.0, abs=0.05)
