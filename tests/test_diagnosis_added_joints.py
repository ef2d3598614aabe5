"""Joints that an effect adds: where they begin, and a diagnosis that names one of them."""

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import yaml
from diagnosis_helpers import arm
from diagnosis_helpers import record as record_arm

from bo_sysid.diagnosis import diagnose
from bo_sysid.diagnosis.search.locate import Located, by_added_joints, locate, with_backlash_tried
from bo_sysid.diagnosis.search.search import Search
from bo_sysid.diagnosis.search.window_lengths import windows_of
from bo_sysid.diagnosis.sets.decide import decide
from bo_sysid.diagnosis.windows.coordinates import Coordinates, transmitted
from bo_sysid.diagnosis.windows.evidence import make_evidence
from bo_sysid.diagnosis.windows.windowing import prepare
from bo_sysid.effects import CATALOGUE, Hidden, Site, survey
from bo_sysid.errors import ModelError
from bo_sysid.identify import identify
from bo_sysid.mjcf import Model
from bo_sysid.recording import Recording
from bo_sysid.runs import Run
from bo_sysid.simulation import Engine, MujocoSimulator, State, cut
from bo_sysid.simulation.windows import Layout, predicted
from bo_sysid.study import Study

JOINT = """
<mujoco model="geared joint">
  <option timestep="0.002" integrator="implicitfast"/>
  <worldbody>
    <body name="link">
      <joint name="hinge" axis="0 1 0" damping="0.05" armature="0.02"/>
      <geom name="link" type="capsule" fromto="0 0 0 0 0 -0.4" size="0.02" mass="1"/>
    </body>
  </worldbody>
  <actuator><motor name="hinge" joint="hinge" ctrlrange="-4 4"/></actuator>
</mujoco>
"""
SIGMA, COMPLIANCE, LOSS = 3e-4, 0.01, 0.004
RIVALS = (
    "joint_compliance",
    "backlash",
    "dry_friction",
    "armature",
    "link_inertia",
    "actuator_lag",
)


def tones(seed: int, time: np.ndarray) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return sum(
        rng.uniform(0.3, 0.6) * np.sin(2 * np.pi * f * time + rng.uniform(0, 6))
        for f in rng.uniform(0.2, 3.0, 6)
    )


def moving() -> Recording:
    time = np.arange(0, 4, 0.002)
    return Recording.from_arrays(
        time, qpos={"hinge": np.sin(3 * time)}, ctrl={"hinge": tones(0, time)}
    )


def plant(
    effect: str, x: list[float], finer: int, rotor: float = 0.02
) -> tuple[mujoco.MjModel, Hidden | None]:
    model = Model.from_xml(JOINT.replace('armature="0.02"', f'armature="{rotor}"'))
    machine, parts = survey(model.compile(), [moving()]), []
    site = Site("joint", "hinge")
    edit = lambda spec: parts.extend(  # noqa: E731
        CATALOGUE[effect].parts(spec, site, np.array(x), machine)
    )
    return model.compile([edit], timestep=0.002 / finer), next(iter(parts), None)


def record(effect: str, x: list[float], seed: int, duration: float) -> Recording:
    """Return noisy positions on the motor's side of a joint that gives way."""
    finer = 8
    compiled, _ = plant(effect, x, finer)
    data, time = mujoco.MjData(compiled), np.arange(0, duration, 0.002)
    ctrl, shown = tones(seed, time), np.empty(len(time))
    for k, u in enumerate(ctrl):
        shown[k], data.ctrl[0] = data.joint("hinge").qpos[0], u
        mujoco.mj_step(compiled, data, finer)
    shown += SIGMA * np.random.default_rng(seed).normal(size=len(time))
    return Recording.from_arrays(time, qpos={"hinge": shown}, ctrl={"hinge": ctrl})


def test_the_transmitted_torque_is_the_weight_of_a_link_at_rest() -> None:
    model = Model.from_xml(JOINT).compile()
    angle = 0.5
    weight = 1 * 9.81 * 0.2 * np.sin(angle)  # the motor holds it: nothing moves
    start = State(np.array([[angle]]), np.zeros((1, 1)), np.zeros((1, 0)))
    torque = transmitted(model, start, np.array([[weight]]))
    assert torque[0, 0] == pytest.approx(weight, rel=1e-6)


def test_the_motor_keeps_what_its_own_inertia_needs() -> None:
    model = Model.from_xml(JOINT).compile()
    start = State(np.zeros((1, 1)), np.zeros((1, 1)), np.zeros((1, 0)))
    link = 0.02 + 1 / 12 * 0.4**2 + 0.2**2  # roughly a rod about its end, and the rotor
    share = float(transmitted(model, start, np.array([[2.0]]))[0, 0]) / 2.0
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    inertia = np.zeros((1, 1))
    mujoco.mj_fullM(model, data, inertia)
    assert share == pytest.approx(1 - 0.02 / inertia[0, 0], rel=1e-6)
    assert inertia[0, 0] == pytest.approx(link, rel=0.1)


def test_a_compliant_joint_begins_where_the_plant_rests() -> None:
    compiled, hidden = plant("joint_compliance", [COMPLIANCE, 0.0, 0.0, 0.0], 1)
    data = mujoco.MjData(compiled)
    data.ctrl[0] = 0.8
    compiled.dof_damping[:] = 0.3
    mujoco.mj_step(compiled, data, 20_000)  # at rest, bent by the weight that the motor holds
    nominal = Model.from_xml(JOINT).compile()
    angle = data.joint("hinge").qpos
    start = State(angle[None], np.zeros((1, 1)), np.zeros((1, 0)))
    coordinates = Coordinates.between(nominal, compiled, [hidden])
    expanded = coordinates.expand(start, transmitted(nominal, start, np.array([[0.8]])))
    np.testing.assert_allclose(expanded.qpos[0], data.qpos, rtol=0.03)


@pytest.mark.parametrize("rotor", [0.02, 0.0])
def test_a_joint_in_a_gap_begins_where_the_plant_rests(rotor) -> None:
    """Also without a rotor, where ends give way by .3 rad/(N m), which is all a step resolves."""
    compiled, hidden = plant("backlash", [0.04, 1e-6, 0.0, 0.25, 0.0], 8, rotor)
    data = mujoco.MjData(compiled)
    data.ctrl[0] = 0.5
    compiled.dof_damping[:], compiled.tendon_damping[:] = 0.3, 0.3
    mujoco.mj_step(compiled, data, 80_000)
    play = float(data.joint("hinge_play").qpos[0])
    np.testing.assert_allclose(hidden.under(np.array([0.5])), play, rtol=1e-3)
    assert abs(play) < hidden.most
    assert (abs(play) > 0.1) == (rotor == 0.0)


def test_the_encoder_of_a_link_shows_both_joints() -> None:
    compiled, hidden = plant("backlash", [0.04, 0.0, 0.0, 0.25, 1.0], 1)
    nominal = Model.from_xml(JOINT).compile()
    coordinates = Coordinates.between(nominal, compiled, [hidden])
    start = State(np.array([[0.3]]), np.zeros((1, 1)), np.zeros((1, 0)))
    expanded = coordinates.expand(start, np.array([[1.0]]))
    assert expanded.qpos[0].sum() == pytest.approx(0.3)  # motor and play together
    end = float(expanded.qpos[0, 1])  # pushed to the end that carries the link, which yields
    assert end == pytest.approx(-0.021, rel=0.01)
    offset = coordinates.elsewhere(np.array([[1.0]]), [0.0])
    places = sorted(float(end + o[0, 0]) for o in offset)
    np.testing.assert_allclose(places, [0.5 * end, 0.0, -0.5 * end, -end], atol=1e-12)


@pytest.fixture(scope="module")
def diagnosed(tmp_path_factory):
    folder = tmp_path_factory.mktemp("compliance")
    for name, seed, duration in (("train", 1, 6.0), ("holdout", 2, 4.0)):
        recording = record("joint_compliance", [COMPLIANCE, LOSS, 0.0, 0.0], seed, duration)
        recording.to_frame().to_parquet(folder / f"{name}.parquet")
    (folder / "joint.xml").write_text(JOINT)
    content = {
        "version": 1,
        "name": "geared joint",
        "model": "joint.xml",
        "recordings": {"train": ["train.parquet"], "holdout": ["holdout.parquet"]},
        "diagnosis": {"effects": list(RIVALS)},
    }
    (folder / "joint.yaml").write_text(yaml.safe_dump(content))
    study = Study.load(folder / "joint.yaml")
    with Run.open(folder / "run", study.resolved(folder / "run"), "diagnose") as run:
        return diagnose(study, run), folder / "run"


def test_compliance_is_named_with_its_side_and_size(diagnosed) -> None:
    result, _ = diagnosed
    (finding,) = result.answer.findings
    assert (finding.effect, finding.site) == ("joint_compliance", "hinge")
    assert finding.quantity.value == pytest.approx(COMPLIANCE, rel=0.05)
    lost = finding.details["damping over stiffness"].value  # a step adds some of its own
    assert lost == pytest.approx(LOSS + 0.002 / 8, rel=0.3)
    floor = result.holdout.error("forecast", 0.08, "noise_floor")
    assert result.holdout.error("forecast", 0.08, "repaired") < 1.15 * floor


def test_play_in_a_springy_gear_is_named_with_its_gap() -> None:
    gap, soft, on_link, ringing = 0.06, 0.004, 0.3, 0.4
    recording = record("backlash", [gap, soft, on_link, ringing, 0.0], 2, 4.0)
    effects = [CATALOGUE[e] for e in ("backlash", "viscous_damping")]
    model, noise = Model.from_xml(JOINT), {"qpos": SIGMA}
    found = locate(make_evidence(model, [recording], effects=effects, noise=noise, threads=1))
    best = found.decision.best
    assert [c.key for c in best.members] == [("backlash", "hinge")]
    np.testing.assert_allclose(best.x[0], [gap, soft, on_link, ringing], rtol=0.2)
    assert best.rms < 2.0  # 10 at the model's own step, or from starts that no search found


def seen_behind(effect: str, x: list[float]) -> Recording:
    """Return noisy positions of a link, behind a gap or a motor that lags."""
    late = x[0] if effect == "actuator_lag" else 0.0
    compiled, _ = plant("backlash", x if effect == "backlash" else [0.0] * 5, 8)
    data, time = mujoco.MjData(compiled), np.arange(0, 4.0, 0.002)
    ctrl, shown = tones(2, time), np.empty(len(time))
    acts = 0.0
    for k, u in enumerate(ctrl):
        shown[k] = data.qpos.sum()
        for _ in range(8):
            acts = acts + (u - acts) * (1 - np.exp(-0.002 / 8 / late)) if late else u
            data.ctrl[0] = acts
            mujoco.mj_step(compiled, data)
    shown += SIGMA * np.random.default_rng(2).normal(size=len(time))
    return Recording.from_arrays(time, qpos={"hinge": shown}, ctrl={"hinge": ctrl})


@pytest.mark.parametrize(
    ("truth", "x", "leads"),
    [
        ("backlash", [0.01, 0.002, 0.5, 0.4, 1.0], {("backlash", "hinge")}),
        ("actuator_lag", [0.01], {("actuator_lag", "hinge"), ("actuator_gain", "hinge")}),
    ],
)
def test_a_gap_is_tried_where_a_late_motor_and_little_else_lead(truth, x, leads) -> None:
    late = ("actuator_lag", "actuator_gain")
    effects = [CATALOGUE[e] for e in ("backlash", *late)]
    recording, noise = seen_behind(truth, x), {"qpos": SIGMA}
    evidence = make_evidence(
        Model.from_xml(JOINT), [recording], effects=effects, noise=noise, threads=1
    )
    search = Search.on(
        prepare(windows_of(evidence, 150, 0.002)), list(evidence.candidates), 3, None
    )
    pair = [next(c for c in evidence.candidates if c.effect.id == e) for e in late]
    fit = search.refit(pair, (np.array([0.005]), np.array([-0.01])))
    search.fits = {fit.key: replace(fit, unique=(5.0, 0.3)), search.nominal.key: search.nominal}
    best = with_backlash_tried(evidence, search, 150).best
    assert {c.key for c in best.members} == leads
    assert best.x[0][0] == pytest.approx(x[0], rel=0.1)


def geared_servo(gap: float, stiffness: float, seed: int, duration: float) -> Recording:
    """Return a servo's log by the equations of motion of rotor r and link l; it reads the link.

    J r'' = k(u - l) - d l' - τ,  I l'' = τ - b l' - w sin l,  τ of a gap with springy ends.
    """
    inertia, weight = 1 / 12 * 0.4**2 + 0.2**2, 9.81 * 0.2  # a rod, about its end
    rotor, damping, kp, kd, loss = 0.02, 0.05, 8.0, 0.4, 0.1
    h, time = 1e-4, np.arange(0, duration, 0.002)
    goal, shown = 0.5 * tones(seed, time), np.empty(len(time))
    r = l = dr = dl = 0.0
    for k, u in enumerate(goal):
        shown[k] = l
        for _ in range(20):
            turn = r - l
            beyond = turn - np.clip(turn, -gap / 2, gap / 2)
            torque = stiffness * beyond + loss * (dr - dl) * (beyond != 0)
            dr += h * (kp * (u - l) - kd * dl - torque) / rotor
            dl += h * (torque - damping * dl - weight * np.sin(l)) / inertia
            r, l = r + h * dr, l + h * dl
    shown += SIGMA * np.random.default_rng(seed).normal(size=len(time))
    return Recording.from_arrays(time, qpos={"hinge": shown}, ctrl={"hinge": goal})


def servo_joint(mass: float) -> Model:
    """Return the model of `geared_servo` without its gear; its thin rod has 1 kg."""
    motor = '<motor name="hinge" joint="hinge" ctrlrange="-4 4"/>'
    rod = 'type="capsule" fromto="0 0 0 0 0 -0.4" size="0.02" mass="1"'
    thin = f'type="capsule" fromto="0 0 0 0 0 -0.4" size="0.002" mass="{mass}"'
    servo = '<position name="hinge" joint="hinge" kp="8" kv="0.4"/>'
    return Model.from_xml(JOINT.replace(motor, servo).replace(rod, thin))


def test_play_in_a_loop_that_is_closed_at_the_link_is_named() -> None:
    model = servo_joint(1.0)
    recording, noise = geared_servo(0.008, 60.0, 3, 3.0), {"qpos": SIGMA}
    effects = [CATALOGUE[e] for e in ("backlash", "viscous_damping")]
    found = locate(make_evidence(model, [recording], effects=effects, noise=noise, threads=1))
    best = found.decision.best
    assert [c.key for c in best.members] == [("backlash", "hinge")]
    assert best.members[0].shapes == [1.0]  # the encoder is on the link
    np.testing.assert_allclose(best.x[0][:2], [0.008, 1 / 60], rtol=0.1)
    assert best.rms < 2.0 < 15.0 < found.decision.nominal.rms


def test_a_set_with_a_soft_gear_is_fitted_to_its_end() -> None:
    """Linearised without the gear, of which a start knows nothing, it ended far from the noise."""
    model = servo_joint(0.9)
    recording, noise = geared_servo(0.0, 60.0, 3, 4.0), {"qpos": SIGMA}
    effects = [CATALOGUE[e] for e in ("joint_compliance", "link_mass")]
    evidence = make_evidence(model, [recording], effects=effects, noise=noise, threads=1)
    prepared = prepare(windows_of(evidence, 100, 0.001))
    search = Search.on(prepared, list(evidence.candidates), 3, None)
    gears = [c for c in evidence.candidates if list(c.shapes) == [1.0]]  # with a link's encoder
    (mass,) = [c for c in evidence.candidates if c.effect.id == "link_mass"]
    search.fit((gears[0],), (0.0 * gears[0].probe,))
    fit = search.fit((gears[0], mass), (0.0 * gears[0].probe, 0.0 * mass.probe))
    assert fit.rms < 1.05  # 2.95 before
    assert fit.x[0][0] == pytest.approx(1 / 60, rel=0.05)


def test_a_soft_gear_that_leaves_more_than_none_is_fitted_on() -> None:
    """A fit that ended at 3.1 σ, where no gear leaves 1.8, was taken for what a gear can do."""
    soft = 0.029
    missing = ("joint_compliance", "joint", "elbow", (soft, 0.001, 0.965, 0.0))
    recording = record_arm([missing], seed=3, duration=5.0, finer=8)
    effects = [CATALOGUE["joint_compliance"]]
    evidence = make_evidence(arm(), [recording], effects=effects, threads=1)
    search = Search.on(
        prepare(windows_of(evidence, 150, 0.002)), list(evidence.candidates), 3, None
    )
    motor = [c for c in evidence.candidates if c.site.name == "elbow" and list(c.shapes) == [0.0]]
    for gear in motor:
        fit = search.fit((gear,), (gear.probe,))
        assert fit.rms < 1.05
        assert fit.x[0][0] == pytest.approx(soft, rel=0.05)
    assert search.nominal.rms > 1.7


@pytest.mark.parametrize("soft", [0.2, 0.3])
def test_a_gear_that_bends_by_much_of_what_its_joint_moves_is_named(soft: float) -> None:
    """A third and two thirds of it; half was the most that was looked for."""
    recording = record("joint_compliance", [soft, 0.01, 0.0, 0.0], 3, 4.0)
    effects = [CATALOGUE[e] for e in ("joint_compliance", "viscous_damping", "joint_spring")]
    model, noise = Model.from_xml(JOINT), {"qpos": SIGMA}
    found = locate(make_evidence(model, [recording], effects=effects, noise=noise, threads=1))
    best = found.decision.best
    assert [c.key for c in best.members] == [("joint_compliance", "hinge")]
    assert best.x[0][0] == pytest.approx(soft, rel=0.01)
    assert best.rms < 1.05


def test_a_joint_that_follows_what_it_does_not_explain_is_not_named() -> None:
    """Beside damping a soft gear left 3.6 of 19 sigma of friction that no effect in the list is."""
    recording = record("dry_friction", [0.3, 0.0], 2, 1.5)
    effects = [CATALOGUE[e] for e in ("joint_compliance", "viscous_damping")]
    model, noise = Model.from_xml(JOINT), {"qpos": SIGMA}
    found = locate(make_evidence(model, [recording], effects=effects, noise=noise, threads=1))
    best = found.decision.best
    assert [c.key for c in best.members] == [("viscous_damping", "hinge")]
    assert best.rms > 3.0


@pytest.mark.parametrize("added", [True, False])
def test_windows_prepared_for_a_joint_that_was_added_decide_nothing_far_off(added: bool) -> None:
    """Where that joint begins is free in all of them: what nothing leaves is less, and led."""
    recording = record("dry_friction", [0.9, 0.0], 2, 1.5)
    effects = [CATALOGUE[e] for e in ("joint_compliance", "viscous_damping")]
    model, noise = Model.from_xml(JOINT), {"qpos": SIGMA}
    evidence = make_evidence(model, [recording], effects=effects, noise=noise, threads=1)
    problem = windows_of(evidence, 100, 0.002)
    search = Search.on(prepare(problem), list(evidence.candidates), 1, None)
    gear = next(c for c in evidence.candidates if c.effect.hidden is added)
    soft = search.fit((gear,), (gear.probe,))
    alone = Search.on(prepare(problem, soft.hypothesis), list(evidence.candidates), 1, None)
    nothing = decide([alone.nominal], alone.nominal, alone.prior, alone.frame.Q, problem.dof)
    assert nothing.best.rms > 3.0
    assert (alone.nominal.rms < 0.9 * search.nominal.rms) is added
    assert by_added_joints(Located(nothing, alone.prepared, alone, evidence)) is added


def test_the_repaired_study_searches_with_the_joint_that_nothing_measures(diagnosed) -> None:
    _, run = diagnosed
    content = yaml.safe_load((run / "study_repaired.yaml").read_text())
    assert content["model"]["unrecorded"] == {"hinge_flex": None}
    change = {"search": {"budget": 6}}
    content["parameters"] = [
        {"name": "mass", "address": "geom[link].mass", "low": 0.8, "high": 1.2, "steps": 5}
    ]
    (run / "again.yaml").write_text(yaml.safe_dump({**content, **change}))
    found = identify(Study.load(run / "again.yaml"))
    assert found.best[0] == pytest.approx(1.0)


def test_an_unrecorded_base_stands_for_all_its_coordinates() -> None:
    floating = """<mujoco><worldbody><body><freejoint name="base"/><geom size=".1"/>
      <body><joint name="wheel"/><geom size=".1"/></body></body></worldbody></mujoco>"""
    spec = Model.from_xml(floating)
    model = Model(spec.name, spec.source, mujoco.MjSpec.from_string(floating), {"base": None})
    assert list(model.unrecorded) == [f"base.{k}" for k in range(7)]


def test_an_unrecorded_joint_must_be_one_of_the_model(tmp_path: Path) -> None:
    (tmp_path / "joint.xml").write_text(JOINT)
    with pytest.raises(ModelError, match=r"no joint 'hing'.*hinge"):
        Model.from_file(tmp_path / "joint.xml", unrecorded={"hing": None})


@pytest.mark.parametrize("fraction", [0.0, 0.5])
def test_a_channel_shows_the_joint_that_its_encoder_sees_as_well(
    tmp_path: Path, fraction: float
) -> None:
    text = JOINT.replace("<geom", '<joint name="play" axis="0 1 0"/><geom')
    (tmp_path / "joint.xml").write_text(text)
    seen = Model.from_file(tmp_path / "joint.xml", unrecorded={"play": "hinge"})
    time = np.arange(0, 0.5, 0.002) + 0.002 * fraction * (np.arange(250) % 2)
    recording = Recording.from_arrays(
        time, qpos={"hinge": np.sin(3 * time)}, ctrl={"hinge": tones(0, time)}
    )
    windows = cut(seen, [recording], horizon=10)
    whole = Engine(1).rollout(seen.compile(), windows.start, windows.ctrl)
    both = predicted(Layout.of(seen, seen.compile()), windows, whole)
    plain = Model.from_file(tmp_path / "joint.xml")
    each = replace(windows, channels=("qpos.hinge", "qpos.play"), observed=both.repeat(2, axis=2))
    apart = predicted(Layout.of(plain, plain.compile()), each, whole)
    assert np.abs(apart[..., 1]).max() > 1e-3
    np.testing.assert_allclose(both[..., 0], apart.sum(axis=-1), atol=1e-12)


def test_one_step_predictions_show_it_as_well(tmp_path: Path) -> None:
    text = JOINT.replace("<geom", '<joint name="play" axis="0 1 0" damping="0.1"/><geom')
    (tmp_path / "joint.xml").write_text(text)
    seen = Model.from_file(tmp_path / "joint.xml", unrecorded={"play": "hinge"})
    time = np.arange(0, 0.5, 0.002)
    recording = Recording.from_arrays(
        time, qpos={"hinge": np.sin(3 * time)}, ctrl={"hinge": tones(0, time)}
    )
    windows = cut(seen, [recording], horizon=1)
    windows.start.qpos[:, 1] = 0.2
    assert windows.aligned
    (once,) = MujocoSimulator(seen, (), Engine(1)).predictions(np.zeros((1, 0)), windows)
    whole = Engine(1).rollout(seen.compile(), windows.start, windows.ctrl)
    expected = predicted(Layout.of(seen, seen.compile()), windows, whole)
    np.testing.assert_allclose(once.values, expected, atol=1e-12)
