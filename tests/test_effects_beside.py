"""What stands beside a repaired model: forces, filters and readings, kept as data."""

import importlib.util
import json
from pathlib import Path

import mujoco
import numpy as np
import pytest
import yaml
from diagnosis_helpers import ARM, SIGMA, arm, record
from effect_bench import SERVO, Bench, pendulum

from bo_sysid.diagnosis import diagnose
from bo_sysid.diagnosis.answer.repaired import BESIDE, MODEL, write_model
from bo_sysid.diagnosis.windows.candidate import Candidate
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis
from bo_sysid.effects import CATALOGUE, Filter, Force, Site, extent_at, survey
from bo_sysid.effects.beside import (
    Beside,
    LearnedLaw,
    Placed,
    as_commanded_and_measured,
    read_beside,
)
from bo_sysid.errors import ModelError
from bo_sysid.identify.problem import make_problem
from bo_sysid.mjcf import Model
from bo_sysid.recording import Channel, Recording, control_steps
from bo_sysid.runs import Run
from bo_sysid.simulation import Engine, ForceLaw, LawInputs, State
from bo_sysid.simulation.cutting import cut
from bo_sysid.simulation.lockstep import force_laws
from bo_sysid.simulation.of_study import study_laws
from bo_sysid.simulation.stepper import Stepper
from bo_sysid.study import Study
from bo_sysid.study.inputs import load_parts

ELBOW = Site("joint", "elbow")


@pytest.fixture(scope="module")
def machine():
    return survey(arm().compile(), [record(duration=2.0)])


def motion(n: int = 7) -> LawInputs:
    q = np.linspace(-0.5, 0.5, n)
    both = {"shoulder": q, "elbow": q[::-1]}
    return LawInputs(0 * q, both, both, both, {}, 0.002)


def beside(machine) -> Beside:
    return Beside(
        machine,
        (Placed("asymmetric_damping", ELBOW, (0.02,)),
         Placed("actuator_deadzone", Site("actuator", "elbow"), (0.05,))),
        (LearnedLaw("shoulder", {"position 3 of 48": 0.4, "speed 2": -0.1}, hold=0.001),),
    )  # fmt: skip


def test_what_is_read_back_acts_as_what_was_written(machine, tmp_path) -> None:
    model, made = arm(), beside(machine)
    made.write(tmp_path / "model.json")
    read = read_beside(tmp_path / "model.json", model.compile())
    before, after = made.parts(model), read.parts(model)
    assert [type(p) for p in after] == [Force, Filter, Force]
    for p, q in zip(before, after, strict=True):
        if isinstance(p, Force):
            np.testing.assert_array_equal(p.law(motion()), q.law(motion()))
            assert np.abs(q.law(motion())).max() > 1e-4
            assert p.hold == q.hold
    assert after[-1].hold == 0.001


def test_the_forces_are_those_of_the_catalogue(machine) -> None:
    effect = CATALOGUE["asymmetric_damping"]
    expected = effect.parts(arm().spec(), ELBOW, np.array([0.02]), machine)[0]
    first = beside(machine).parts(arm())[0]
    np.testing.assert_array_equal(first.law(motion()), expected.law(motion()))


@pytest.mark.parametrize("order", [(0, 1), (1, 0)])
def test_a_loop_beside_a_file_has_the_gains_that_are_in_the_file(order, tmp_path) -> None:
    """An encoder that scales is in the servo of the file: it is not scaled once more."""
    arm = pendulum(SERVO)
    told = {"encoder_scale": [0.2, 1.0, 0.0], "joint_compliance": [0.01, 0.01, 0.5, 1.0]}
    hinge = Site("joint", "hinge")
    members = []
    for effect, point in told.items():
        extent = extent_at(CATALOGUE[effect], hinge, arm.machine)
        members.append(Candidate(CATALOGUE[effect], hinge, extent, np.array(point)))
    members = [members[k] for k in order]
    h = Hypothesis(tuple(members), tuple(c.point[: c.size] for c in members))
    write_model(arm.model, arm.machine, h, tmp_path, timestep=0.001)
    model = Model.from_file(tmp_path / MODEL)
    parts = read_beside(tmp_path / BESIDE, model.compile()).parts(model)
    (law,) = (p.law for p in parts if isinstance(p, Force))
    q = {"hinge": np.array([0.3]), "hinge_flex": np.array([0.01])}
    v = {"hinge": np.array([0.1]), "hinge_flex": np.array([0.02])}
    made = law(LawInputs(np.zeros(1), q, v, {"servo": np.array([0.5])}, {}, 0.001))
    kp, kd = 10 * 1.2, 1 * 1.2
    assert made[0] == pytest.approx(-kp * 0.01 - kd * 0.02)


def test_stepping_in_plain_mujoco_is_the_lock_step_simulation(machine, tmp_path) -> None:
    made = Beside(machine, beside(machine).effects[:1], beside(machine).laws)
    made.write(tmp_path / "arm.json")
    stepper = Stepper(ARM, tmp_path / "arm.json")
    stepper.data.qpos[:] = start = np.array([0.3, -0.4])
    for _ in range(200):
        stepper.data.ctrl[:] = (0.2, -0.05)
        stepper.step()
    laws = [ForceLaw(p.joint, p.law) for p in made.parts(arm())]
    ctrl = np.tile([0.2, -0.05], (1, 200, 1))
    state = State(start[None], np.zeros((1, 2)), np.zeros((1, 0)))
    compiled = arm().compile()
    with_laws = Engine(1).rollout(compiled, state, ctrl, laws=laws)
    np.testing.assert_allclose(stepper.data.qpos, with_laws.qpos[0, -1], atol=1e-9)
    without = Engine(1).rollout(compiled, state, ctrl)
    assert np.abs(without.qpos[0, -1] - stepper.data.qpos).max() > 1e-3


def test_a_force_of_a_recorded_channel_cannot_be_stepped_on(tmp_path) -> None:
    drive = '<mujoco><worldbody><body><joint name="x" type="slide"/><geom size=".1"/></body>'
    drive += '</worldbody><actuator><motor name="drive" joint="x"/></actuator></mujoco>'
    bench = Bench(drive, {"voltage": np.linspace(24.0, 18.0, 2000)})
    (tmp_path / "drive.xml").write_text(drive)
    sag = Placed("voltage_sag", Site("actuator", "drive"), (1.5,))
    Beside(bench.machine, (sag,)).write(tmp_path / "drive.json")
    with pytest.raises(ModelError, match=r"'aux.voltage', which is recorded: it cannot be stepped"):
        Stepper(tmp_path / "drive.xml", tmp_path / "drive.json").step()


def test_a_dead_zone_is_stepped_on_the_command(machine, tmp_path) -> None:
    Beside(machine, beside(machine).effects[1:]).write(tmp_path / "arm.json")
    stepper = Stepper(ARM, tmp_path / "arm.json")
    plain = Stepper(ARM, tmp_path / "arm.json")
    for _ in range(50):
        stepper.data.ctrl[1] = 0.04  # within the dead zone
        stepper.step()
        plain.step()
        assert stepper.data.ctrl[1] == 0.04
    np.testing.assert_allclose(stepper.data.qpos, plain.data.qpos, atol=1e-12)


@pytest.mark.parametrize("delay", [0.0007, 0.001, 0.0127])
def test_a_delay_between_two_steps_is_stepped_as_it_was_searched(machine, tmp_path, delay) -> None:
    late = Placed("actuator_delay", Site("actuator", "elbow"), (delay,))
    made = Beside(machine, (late, *beside(machine).effects[:1]))  # a law that holds it back
    made.write(tmp_path / "arm.json")
    stepper, dt = Stepper(ARM, tmp_path / "arm.json"), arm().compile().opt.timestep
    time = np.arange(300) * dt
    sent = 0.2 * np.sin(9 * time) + 0.1 * np.sign(np.sin(31 * time))
    for u in sent:
        stepper.data.ctrl[1] = u
        stepper.step()
    (act,) = (p for p in made.parts(arm()) if isinstance(p, Filter))
    arrives = act.change(Channel(time, sent, "", "", "zero"), dt)
    ctrl = np.zeros((1, 300, 2))
    ctrl[..., 1] = control_steps(arrives, np.zeros(1), 300, dt)
    laws = force_laws(made.parts(arm()))
    state = State(np.zeros((1, 2)), np.zeros((1, 2)), np.zeros((1, 0)))
    searched = Engine(1).rollout(arm().compile(), state, ctrl, laws=laws)
    np.testing.assert_allclose(stepper.data.qpos, searched.qpos[0, -1], atol=1e-9)


FRICTION = (  # as a diagnosis writes it: an actuator without a control
    '<general name="stuck" joint="shoulder" dyntype="dcmotor" dynprm="0 0 0 0 0 20 .1" input="none"'
    ' gaintype="dcmotor" biastype="dcmotor" gainprm="1 1e-6" biasprm="0 0 0 .1 .15 .1" actdim="1" '
    'actearly="true"/>'
)


def test_filters_keep_to_their_controls_behind_an_actuator_without_one(machine, tmp_path) -> None:
    text = ARM.read_text().replace("<actuator>", f"<actuator>{FRICTION}")
    (tmp_path / "arm.xml").write_text(text)
    Beside(machine, beside(machine).effects[1:]).write(tmp_path / "arm.json")
    stepper = Stepper(tmp_path / "arm.xml", tmp_path / "arm.json")
    plain = mujoco.MjData(stepper.model)
    for _ in range(50):
        stepper.data.ctrl[:] = (0.2, 0.04)  # within the dead zone of the elbow alone
        plain.ctrl[:] = (0.2, 0.0)
        stepper.step()
        mujoco.mj_step(stepper.model, plain)
    np.testing.assert_allclose(stepper.data.qpos, plain.qpos, atol=1e-12)


RATED = """<mujoco><option timestep="0.002" gravity="0 0 0"/><worldbody><body>
  <joint name="j" axis="0 1 0" damping=".1"/><geom type="capsule" fromto="0 0 0 .3 0 0" size=".02"
  mass="1"/></body></worldbody><actuator>
  <intvelocity name="a" joint="j" gear="2" kp="40" kv="3" actrange="-9 9"/></actuator></mujoco>"""


@pytest.mark.parametrize("recut", [False, True])
def test_the_goal_of_a_servo_that_integrates_is_in_what_its_encoder_reads(recut, tmp_path) -> None:
    """It holds where it is switched on, whatever its encoder reads there.

    Windows are cut once, from what was recorded, or again where the reading is undone.
    """
    model, offset = Model.from_xml(RATED), 0.1
    data, rows = mujoco.MjData(plant := model.compile()), []
    data.qpos[0] = 0.2
    data.act[0] = 2 * 0.2
    for k in range(1500):
        data.ctrl[0] = np.sin(0.01 * k)
        rows.append([data.time, data.qpos[0], data.qvel[0], data.ctrl[0]])
        mujoco.mj_step(plant, data)
    time, q, v, u = np.transpose(rows)
    log = Recording.from_arrays(time, qpos={"j": q + offset}, qvel={"j": v}, ctrl={"a": u})
    effect, parts = CATALOGUE["encoder_offset"], []
    site, machine = Site("joint", "j"), survey(plant, [log])
    edit = [lambda spec: parts.extend(effect.parts(spec, site, np.array([offset]), machine))]
    model.export(tmp_path / "edited.xml", edit)
    edited = Model.from_file(tmp_path / "edited.xml")
    seen = as_commanded_and_measured(log, parts, 0.002)
    again = cut(edited, [seen], horizon=250)
    act = again.start.act if recut else cut(model, [log], horizon=250).start.act
    start = State(again.start.qpos, again.start.qvel, act)
    found = Engine(1).rollout(edited.compile(), start, again.ctrl)
    np.testing.assert_allclose(
        found.qpos[:, 1:, 0], again.observed[..., 0], atol=1e-5
    )  # its beginning is balanced


def test_a_force_is_held_as_in_the_search(machine, tmp_path) -> None:
    law = LearnedLaw("shoulder", {"position 3 of 48": 0.4, "speed 2": -0.1}, hold=0.01)
    made = Beside(machine, (), (law,))
    made.write(tmp_path / "arm.json")
    stepper = Stepper(ARM, tmp_path / "arm.json")
    stepper.data.qpos[:] = start = np.array([0.3, -0.4])
    for _ in range(203):
        stepper.data.ctrl[:] = (0.2, -0.05)
        stepper.step()
    ctrl = np.tile([0.2, -0.05], (1, 203, 1))
    state = State(start[None], np.zeros((1, 2)), np.zeros((1, 0)))
    found = Engine(1).rollout(arm().compile(), state, ctrl, laws=force_laws(made.parts(arm())))
    np.testing.assert_allclose(stepper.data.qpos, found.qpos[0, -1], atol=1e-12)


def test_laws_are_told_how_long_the_simulation_runs(machine, tmp_path) -> None:
    beside(machine).write(tmp_path / "arm.json")
    stepper, told = Stepper(ARM, tmp_path / "arm.json"), []

    def law(m: LawInputs) -> np.ndarray:
        told.append(float(m.time[0]))
        return 0 * m.time

    stepper._laws = (ForceLaw("elbow", law),)
    for steps in (3, 2):
        mujoco.mj_resetData(stepper.model, stepper.data)
        for _ in range(steps):
            stepper.step()
    dt = stepper.model.opt.timestep
    np.testing.assert_allclose(told, [0, dt, 2 * dt, 0, dt])


def test_readings_are_undone(machine) -> None:
    site = Site("channel", "qpos.elbow")
    t = np.arange(0, 1, 0.01)
    true = np.sin(3 * t)
    made = Beside(
        machine,
        (Placed("sensor_scale", site, (0.1,)), Placed("sensor_delay", site, (0.02,))),
    )
    scale, delay = made.parts(arm())
    shown = Recording.from_arrays(t, qpos={"elbow": 1.1 * np.sin(3 * t)})
    own = as_commanded_and_measured(shown, [scale], 0.002).channels["qpos.elbow"]
    np.testing.assert_allclose(own.values, true)
    late = as_commanded_and_measured(shown, [delay], 0.002).channels["qpos.elbow"]
    np.testing.assert_allclose(late.time, t - 0.02)


def test_several_readings_of_a_channel_are_undone_together(machine) -> None:
    """A reading that is late, too large by a tenth, and .3 rad off, of the other joint."""
    site = Site("channel", "qpos.elbow")
    placed = [("sensor_scale", (0.1,)), ("sensor_offset", (0.3,)), ("sensor_delay", (0.02,))]
    other = float(machine.channels.index("qpos.shoulder"))
    made = Beside(
        machine,
        (*(Placed(e, site, x) for e, x in placed), Placed("channel_swap", site, (1.0, other))),
    )
    t = np.arange(0, 1, 0.01)
    shown = {"elbow": 1.1 * np.sin(3 * t) + 0.3, "shoulder": np.cos(t)}
    recording = Recording.from_arrays(t, qpos=shown)
    own = as_commanded_and_measured(recording, made.parts(arm()), 0.002).channels
    there = own["qpos.shoulder"].time
    np.testing.assert_array_equal(there, t[: len(there)])  # what is beyond the last sample is gone
    assert len(t) - len(there) in (2, 3)
    np.testing.assert_allclose(own["qpos.shoulder"].values, np.sin(3 * (there + 0.02)), atol=1e-5)
    np.testing.assert_allclose(own["qpos.elbow"].values, np.cos(t))
    np.testing.assert_array_equal(own["qpos.elbow"].time, t)


def test_one_late_encoder_of_several_shares_its_stamps_with_the_others(machine, tmp_path) -> None:
    """Windows begin where all positions were recorded; nothing is made up across a gap."""
    late, t = 0.0127, 0.002 * np.arange(2000)
    t = np.delete(t, np.arange(500, 600))
    made = Beside(machine, (Placed("sensor_delay", Site("channel", "qpos.elbow"), (late,)),))
    shown = {"shoulder": np.cos(t), "elbow": np.sin(5 * (t - late))}
    recording = Recording.from_arrays(t, qpos=shown, ctrl={"shoulder": t * 0, "elbow": t * 0})
    seen = as_commanded_and_measured(recording, made.parts(arm()), 0.002)
    elbow = seen.channels["qpos.elbow"]
    np.testing.assert_allclose(elbow.values, np.sin(5 * elbow.time), atol=1e-6)
    assert np.isin(elbow.time, t).all()
    assert len(t) - len(elbow.time) == 14  # at the end, and before the gap
    (note,) = (n for n in seen.notes if "late" in n)
    assert note.startswith("qpos.elbow reads 0.0127 s late")
    windows = cut(arm(), [seen], horizon=100)
    assert len(windows) == 17  # of 18, of which one spans the gap
    both = (Placed("sensor_delay", Site("channel", f"qpos.{n}"), (late,)) for n in shown)
    alike = as_commanded_and_measured(recording, Beside(machine, tuple(both)).parts(arm()), 0.002)
    np.testing.assert_allclose(alike.channels["qpos.elbow"].time, t - late)  # as exact as it was
    assert alike.notes == recording.notes


@pytest.mark.parametrize(
    ("of", "at", "scale"),
    [("sensor", Site("channel", "qpos.elbow"), (0.05,)),
     ("encoder", Site("joint", "elbow"), (0.05, 1.0, 0.0))],
)  # fmt: skip
def test_readings_of_two_diagnoses_are_undone_in_the_order_in_which_they_were_found(
    machine, tmp_path, of: str, at: Site, scale: tuple[float, ...]
) -> None:
    """The second was found in recordings of which the first was undone."""
    for name, effect, x in (("one", of + "_offset", (0.3,)), ("two", of + "_scale", scale)):
        Beside(machine, (Placed(effect, at, x),)).write(tmp_path / f"{name}.json")
    content = {
        "version": 1,
        "model": {"file": str(ARM), "beside": ["one.json", "two.json"]},
        "recordings": {"train": ["none.parquet"]},
    }
    parts = load_parts(Study.from_dict(content, tmp_path), arm())
    time = 0.01 * np.arange(200)
    p = np.sin(time)
    raw = Recording.from_arrays(time, qpos={"shoulder": p, "elbow": 1.05 * p + 0.3})
    seen = as_commanded_and_measured(raw, parts, 0.002).channels["qpos.elbow"]
    np.testing.assert_allclose(seen.values, p, atol=1e-12)


def test_a_file_that_is_none_of_these_is_refused(machine, tmp_path) -> None:
    (tmp_path / "other.json").write_text('{"version": 4}')
    with pytest.raises(ModelError, match=r"other.json: is no file of what stands beside a model"):
        read_beside(tmp_path / "other.json", arm().compile())
    wrong = Beside(machine, (Placed("dry_fricton", ELBOW, (0.1,)),))
    with pytest.raises(ModelError, match="dry_friction"):
        wrong.parts(arm())
    wrong = Beside(machine, (), (LearnedLaw("elbow", {"positon 3": 0.1}),))
    with pytest.raises(ModelError, match="position 3"):
        wrong.parts(arm())


@pytest.mark.parametrize(
    ("key", "wrong", "said"),
    [
        (("laws", 0, "joint"), "shuolder", r"unknown joint 'shuolder'; did you mean 'shoulder'"),
        (("effects", 0, "site"), "elbw", r"unknown joint 'elbw'; did you mean 'elbow'"),
        (("effects", 0, "kind"), "body", r"unknown kind of site 'body'"),
        (("effects", 0, "x"), [0.1, 0.2, 0.3], r"asymmetric_damping at elbow has 3 magnitudes"),
    ],
)
def test_what_was_edited_wrongly_is_named_with_its_file(
    machine, tmp_path, key, wrong, said
) -> None:
    file = tmp_path / "model.json"
    beside(machine).write(file)
    content = json.loads(file.read_text())
    content[key[0]][key[1]][key[2]] = wrong
    file.write_text(json.dumps(content))
    with pytest.raises(ModelError, match=rf"model\.json: ({said})"):
        read_beside(file, arm().compile()).parts(arm())


@pytest.mark.parametrize(
    ("placed", "laws", "said"),
    [
        ([("asymmetric_damping", ELBOW, (0.02,))], [], "no joint 'elbow'; did you mean 'ellbow'"),
        ([("actuator_deadzone", Site("actuator", "elbow"), (0.05,))], [], "no actuator 'elbow'"),
        ([("sensor_scale", Site("channel", "qpos.elbow"), (0.1,))], [], "no channel 'qpos.elbow'"),
        ([], [("elbow", {"position 3 of 48": 0.4})], "no joint 'elbow'"),
        ([], [("shoulder", {"elbow 3 of 12": 0.4})], "no joint 'elbow'"),
        ([], [("shoulder", {"shoulder^1": 0.4})], "no actuator 'shoulder'; did you mean 'sholder'"),
        ([], [("shoulder", {"elbow 3 of 12": 0.0, "force at time 2": 0.1})], None),
    ],
)
def test_what_another_model_has_is_named_with_the_nearest(machine, placed, laws, said) -> None:
    text = ARM.read_text()
    for old, new in (
        ('"elbow"', '"ellbow"'),
        ('motor name="shoulder"', 'motor name="sholder"'),
    ):
        assert old in text
        text = text.replace(old, new)
    other = Model.from_xml(text, name="other")
    made = Beside(
        machine, tuple(Placed(*p) for p in placed), tuple(LearnedLaw(*w) for w in laws), "m.json"
    )
    if said is None:
        made.parts(other)
    else:
        with pytest.raises(ModelError, match=rf"m\.json: the model other has {said}"):
            made.parts(other)


def magnet(q: np.ndarray) -> np.ndarray:
    z = (q - 0.2) / 0.15
    return -0.08 * z * np.exp(-(z**2))


@pytest.fixture(scope="module")
def repaired(tmp_path_factory) -> Path:
    """The run of a diagnosis of an arm with a magnet near its elbow."""
    folder = tmp_path_factory.mktemp("magnet")
    for name, seed, duration in (("train", 1, 6.0), ("holdout", 2, 3.0)):
        frame = record(seed=seed, duration=duration, force=("elbow", magnet)).to_frame()
        frame.to_parquet(folder / f"{name}.parquet")
    content = {
        "version": 1,
        "model": str(ARM),
        "recordings": {"train": ["train.parquet"], "holdout": ["holdout.parquet"]},
        "diagnosis": {"effects": ["viscous_damping", "armature"]},
        "parameters": [
            {"address": "joint[elbow].armature", "low": 0.0, "high": 0.02, "steps": 3},
        ],
        "deviation": {"horizon": 150, "starts": "fitted"},
    }
    (folder / "arm.yaml").write_text(yaml.safe_dump(content))
    study = Study.load(folder / "arm.yaml")
    with Run.open(folder / "run", study.resolved(folder / "run"), "diagnose") as run:
        assert diagnose(study, run).verdict == "unknown-physics"
    return folder / "run"


def test_a_learned_law_goes_on_with_the_repaired_study(repaired) -> None:
    study = Study.load(repaired / "study_repaired.yaml")
    (law,) = study_laws(study, arm())
    assert law.joint == "elbow"
    with_law, without = (
        make_problem(s, threads=1).deviation(np.array([[0.0]])).deviation[0]
        for s in (study, Study.load(repaired / "study_repaired.yaml", {"model.beside": []}))
    )
    assert with_law < 0.5 * without


def test_the_module_beside_the_model_steps_it(repaired) -> None:
    spec = importlib.util.spec_from_file_location("model_repaired", repaired / "model_repaired.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    simulation = module.load()
    data, own = simulation.data, 0.3
    data.qpos[:] = (0.0, 0.25)
    data.qfrc_applied[1] = own
    simulation.step()
    expected = magnet(np.array([0.25]))[0]
    inverse = mujoco.MjData(simulation.model)  # the force that the step's acceleration needs
    inverse.qpos[:], inverse.qacc[:] = (0.0, 0.25), data.qacc
    mujoco.mj_inverse(simulation.model, inverse)
    assert inverse.qfrc_inverse[1] == pytest.approx(expected + own, abs=0.015)
    assert abs(expected) > SIGMA
    assert data.qfrc_applied[1] == own


def test_effects_of_ones_own_are_stepped_from_their_file(tmp_path) -> None:
    file = tmp_path / "mine.py"
    file.write_text(
        "import numpy as np\n"
        "from bo_sysid.effects import Component, Extent, Force, effect\n\n\n"
        "@effect(\n"
        "    'wave', kind='joint', components=(Component('size', 'N m'),), noun='a wave',\n"
        "    extent=lambda site, machine: Extent((0.1,), (-5.0,), (5.0,)),\n"
        "    sentence='{site} has {value}.', evidence='-', separation='-',\n"
        ")\n"
        "def wave(spec, site, x, machine):\n"
        "    return Force(site.name, lambda m: x[0] * np.sin(3 * m.qpos[site.name]))\n"
    )
    placed = Placed("wave", Site("joint", "elbow"), (0.3,))
    Beside(survey(arm().compile(), [record(duration=1.0)]), (placed,)).write(tmp_path / "arm.json")
    with pytest.raises(ModelError, match="'wave'"):
        Stepper(ARM, tmp_path / "arm.json")
    stepper = Stepper(ARM, tmp_path / "arm.json", [file])
    plain = mujoco.MjData(stepper.model)
    plain.qpos[:] = stepper.data.qpos[:] = (0.1, 0.4)
    plain.qfrc_applied[1] = 0.3 * np.sin(3 * 0.4)
    stepper.step()
    mujoco.mj_step(stepper.model, plain)
    np.testing.assert_allclose(stepper.data.qvel, plain.qvel, rtol=1e-12)
