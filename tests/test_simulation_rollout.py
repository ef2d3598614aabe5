"""The simulation core against MuJoCo's own loop and against analytic solutions."""

import threading
from pathlib import Path

import mujoco
import numpy as np
import pytest

from bo_sysid.errors import StudyError
from bo_sysid.mjcf import Model, address_edit
from bo_sysid.simulation import (
    Controller,
    Engine,
    ForceLaw,
    LawInputs,
    State,
    tangent_difference,
)
from bo_sysid.simulation.of_study import study_laws
from bo_sysid.simulation.rollout import quietly
from bo_sysid.study import Study

PENDULUM = """<mujoco><option timestep="0.001" integrator="{integrator}"/><worldbody>
  <body name="rod"><joint name="hinge" axis="0 1 0" damping="{damping}"/>
    <geom name="bob" type="sphere" size="0.01" pos="0 0 -0.5" mass="1"/></body></worldbody>
  <actuator><motor name="motor" joint="hinge"/></actuator>
  <sensor><jointpos name="angle" joint="hinge"/></sensor></mujoco>"""


def pendulum(damping: float = 0.0, integrator: str = "RK4") -> mujoco.MjModel:
    return mujoco.MjModel.from_xml_string(PENDULUM.format(damping=damping, integrator=integrator))


def starts(count: int, seed: int = 0) -> State:
    rng = np.random.default_rng(seed)
    return State(
        rng.uniform(-1, 1, (count, 1)), rng.uniform(-1, 1, (count, 1)), np.zeros((count, 0))
    )


def loop(model: mujoco.MjModel, start: State, ctrl: np.ndarray) -> np.ndarray:
    """The independent implementation: one MjData at a time."""
    out = np.empty((len(start), ctrl.shape[1] + 1, model.nq))
    for w in range(len(start)):
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:] = start.qpos[w], start.qvel[w]
        out[w, 0] = data.qpos
        for k in range(ctrl.shape[1]):
            data.ctrl[:] = ctrl[w, k]
            mujoco.mj_step(model, data)
            out[w, k + 1] = data.qpos
    return out


def test_a_model_whose_bodies_may_fall_asleep_is_simulated() -> None:
    plain = Model.from_xml(PENDULUM.format(damping=0.1, integrator="Euler"))
    sleepy = '<option timestep="0.001"><flag sleep="enable"/></option>'
    text = PENDULUM.replace('<option timestep="0.001" integrator="{integrator}"/>', sleepy)
    model, start = Model.from_xml(text.format(damping=0.1)), starts(3)
    ctrl = np.random.default_rng(1).normal(size=(3, 40, 1))
    trajectory = Engine(threads=1).rollout(model.compile(), start, ctrl)
    np.testing.assert_array_equal(trajectory.qpos, loop(plain.compile(), start, ctrl))
    asleep = int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    assert model.spec().option.enableflags & asleep  # an export keeps it


def test_rollout_equals_the_bare_engine_to_the_last_bit() -> None:
    model, start = pendulum(0.1), starts(5)
    ctrl = np.random.default_rng(1).normal(size=(5, 40, 1))
    trajectory = Engine(threads=1).rollout(model, start, ctrl)
    np.testing.assert_array_equal(trajectory.qpos, loop(model, start, ctrl))
    assert not trajectory.diverged.any()


@pytest.mark.parametrize("threads", [1, 2, 3])
def test_results_do_not_depend_on_the_number_of_threads(threads: int) -> None:
    model, start = pendulum(0.1), starts(64)
    ctrl = np.random.default_rng(1).normal(size=(64, 20, 1))
    one = Engine(threads=1).rollout(model, start, ctrl)
    many = Engine(threads=threads).rollout(model, start, ctrl)
    np.testing.assert_array_equal(one.qpos, many.qpos)


def test_models_differ_by_window() -> None:
    models = [pendulum(d) for d in (0.0, 0.5, 1.0)]
    start, ctrl = starts(3), np.ones((3, 30, 1))
    trajectory = Engine().rollout(models, start, ctrl)
    for w, model in enumerate(models):
        alone = loop(model, start.rows(np.array([w])), ctrl[w : w + 1])
        np.testing.assert_array_equal(trajectory.qpos[w], alone[0])


DRONE = """<mujoco><option timestep="0.002"/><worldbody><body name="drone"><freejoint name="root"/>
  <geom type="box" size=".1 .1 .02" mass="1"/><site name="rotor" pos=".1 0 0"/></body></worldbody>
  <actuator><motor name="thrust" site="rotor" gear="0 0 1 0 0 .02"/></actuator>
  <sensor><gyro name="gyro" site="rotor"/></sensor></mujoco>"""


@pytest.mark.parametrize("with_law", [False, True])
def test_a_free_body_whose_centre_of_mass_may_be_at_its_origin(with_law: bool) -> None:
    """MuJoCo keeps less of that one: no batch holds it beside others."""
    drone, offsets = Model.from_xml(DRONE), (-0.01, 0.0, 0.01, 0.0)
    models = [drone.compile([address_edit(drone, ["body[drone].ipos[0]"], x)]) for x in offsets]
    assert len({m.nC for m in models}) == 2
    rest = np.tile(models[0].qpos0, (4, 1))
    start = State(rest, 0.1 * np.ones((4, 6)), np.zeros((4, 0)))
    ctrl = np.random.default_rng(1).normal(size=(4, 30, 1))
    signals = {"aux.thrust": ctrl[..., 0]}
    laws = [Controller("thrust", lambda inputs: inputs.signals["aux.thrust"])] if with_law else []
    told = 0 * ctrl if with_law else ctrl
    run = Engine(1).rollout(models, start, told, laws=laws, signals=signals, sensors=True)
    end, diverged = Engine(1).final(models, start, ctrl[:, 0], steps=20)
    held = np.repeat(ctrl[:, :1], 20, axis=1)
    for w, model in enumerate(models):
        own = slice(w, w + 1)
        alone = Engine(1).rollout(model, start.rows(own), ctrl[own], sensors=True)
        np.testing.assert_array_equal(run.qpos[w], loop(model, start.rows(own), ctrl[own])[0])
        np.testing.assert_array_equal(run.sensordata[w], alone.sensordata[0])
        np.testing.assert_array_equal(end[w, :7], loop(model, start.rows(own), held[own])[0, -1])
    assert not (run.diverged | diverged).any()


def test_an_engine_forgets_the_previous_call() -> None:
    engine, start = Engine(), starts(4)
    first = engine.rollout(pendulum(), start, np.zeros((4, 10, 1)), force=np.ones((4, 10, 1)))
    engine.rollout(pendulum(2.0), starts(4, seed=9), np.ones((4, 10, 1)))
    engine.final(pendulum(), start, np.ones((4, 1)), steps=3)
    again = engine.rollout(pendulum(), start, np.zeros((4, 10, 1)), force=np.ones((4, 10, 1)))
    np.testing.assert_array_equal(first.qpos, again.qpos)


def test_another_structure_gets_another_batch() -> None:
    two = mujoco.MjModel.from_xml_string(
        "<mujoco><worldbody><body><joint/><geom size='.1'/><body pos='1 0 0'><joint/>"
        "<geom size='.1'/></body></body></worldbody></mujoco>"
    )
    engine = Engine()
    engine.rollout(pendulum(), starts(2), np.zeros((2, 3, 1)))
    start = State(np.zeros((2, 2)), np.zeros((2, 2)), np.zeros((2, 0)))
    assert engine.rollout(two, start, np.zeros((2, 3, 0))).qpos.shape == (2, 4, 2)


def test_small_swing_has_the_analytic_period() -> None:
    # point mass at 0.5 m (plus the bob's own inertia): omega^2 = m g l / (m l^2 + 2/5 m r^2)
    omega = np.sqrt(9.81 * 0.5 / (0.25 + 0.4 * 0.01**2))
    start = State(np.array([[1e-3]]), np.zeros((1, 1)), np.zeros((1, 0)))
    qpos = Engine().rollout(pendulum(), start, np.zeros((1, 2000, 1))).qpos[0, :, 0]
    time = np.arange(2001) * 1e-3
    np.testing.assert_allclose(qpos, 1e-3 * np.cos(omega * time), atol=2e-9)


def test_force_equals_a_motor_of_the_same_torque() -> None:
    start, torque = starts(3), np.random.default_rng(2).normal(size=(3, 25, 1))
    by_motor = Engine().rollout(pendulum(), start, torque)
    by_force = Engine().rollout(pendulum(), start, np.zeros((3, 25, 1)), force=torque)
    np.testing.assert_allclose(by_force.qpos, by_motor.qpos, atol=1e-14)


def test_laws_step_with_the_simulation() -> None:
    """A proportional controller and a damper as laws equal the same physics in MJCF."""
    start, ctrl = starts(6), np.zeros((6, 200, 1))
    goal = np.full((6, 200), 0.3)

    def servo(inputs: LawInputs) -> np.ndarray:
        return 4.0 * (inputs.signals["goal.motor"] - inputs.qpos["hinge"])

    def spring(inputs: LawInputs) -> np.ndarray:
        return -2.0 * inputs.qpos["hinge"]

    laws = (Controller("motor", servo), ForceLaw("hinge", spring))
    by_law = Engine().rollout(
        pendulum(integrator="Euler"), start, ctrl, laws=laws, signals={"goal.motor": goal}
    )
    xml = PENDULUM.format(damping=0, integrator="Euler").replace(
        'axis="0 1 0"', 'axis="0 1 0" stiffness="2"'
    )
    xml = xml.replace(
        '<motor name="motor" joint="hinge"/>', '<position name="motor" joint="hinge" kp="4"/>'
    )
    in_mjcf = Engine().rollout(
        mujoco.MjModel.from_xml_string(xml), start, np.full((6, 200, 1), 0.3)
    )
    np.testing.assert_allclose(by_law.qpos, in_mjcf.qpos, atol=1e-12)


@pytest.mark.parametrize(
    ("body", "told"),
    [
        ("x.signals['aux.voltage']", r"reads 'aux.voltage'.*uses"),
        ("x.qpos['hing']", r"reads 'hing', .*did you mean 'hinge'"),
        ("1 / 0", "fails: ZeroDivisionError"),
        ("[0.1, 0.2]", r"returned an array \(2,\); it must be one number for each .* \(3,\)"),
    ],
)
def test_what_is_wrong_in_the_law_of_an_actuator_names_it(
    body: str, told: str, tmp_path: Path
) -> None:
    (tmp_path / "servo.py").write_text(
        "def right(x):\n    return 4 * x.signals['goal.motor']\n\n"
        f"def duty(x):\n    return {body}\n"
    )
    (tmp_path / "rod.xml").write_text(PENDULUM.format(damping=0, integrator="Euler"))
    data = {"model": "rod.xml", "recordings": {"train": "later.csv"}}
    signals = {"goal.motor": np.full((3, 5), 0.3)}

    def run(name: str) -> np.ndarray:
        law = {"law": f"servo.py:{name}", "uses": ["goal.motor"]}
        study = Study.from_dict({**data, "actuators": {"motor": law}}, tmp_path, trust_code=True)
        laws = study_laws(study, Model.from_file(tmp_path / "rod.xml"))
        ctrl = np.zeros((3, 5, 1))
        return Engine().rollout(pendulum(), starts(3), ctrl, laws=laws, signals=signals).ctrl

    np.testing.assert_allclose(run("right"), 1.2)
    with pytest.raises(StudyError, match=rf"actuators.motor: servo.py:duty {told}"):
        run("duty")


def test_a_held_force_is_evaluated_once_every_few_steps() -> None:
    """The same as stepping the engine by hand, damped by a force that is held."""
    model, start = pendulum(), starts(4)
    ctrl = np.random.default_rng(3).normal(size=(4, 11, 1))
    damper = ForceLaw("hinge", lambda inputs: -0.5 * inputs.qvel["hinge"], hold=0.003)
    held = Engine().rollout(model, start, ctrl, laws=(damper,))
    data = mujoco.MjData(model)
    for w in range(4):
        mujoco.mj_resetData(model, data)
        data.qpos[:], data.qvel[:] = start.qpos[w], start.qvel[w]
        for k in range(11):
            if k % 3 == 0:
                data.qfrc_applied[:] = -0.5 * data.qvel
            data.ctrl[:] = ctrl[w, k]
            mujoco.mj_step(model, data)
            np.testing.assert_allclose(held.qpos[w, k + 1], data.qpos, atol=1e-14)


def test_a_held_force_that_remembers_is_told_how_long_it_is_held() -> None:
    """The sum of what it is told is the time; it was a third of it, the steps not counted."""
    ctrl = np.ones((4, 12, 1))
    told = []

    def law(inputs: LawInputs) -> np.ndarray:
        past = inputs.memory.get("time", np.zeros_like(inputs.time))
        np.testing.assert_allclose(inputs.time, past, atol=1e-12)
        inputs.memory["time"] = past + inputs.timestep
        told.append(inputs.timestep)
        return np.zeros_like(inputs.time)

    Engine().rollout(pendulum(), starts(4), ctrl, laws=(ForceLaw("hinge", law, hold=0.003),))
    assert told == pytest.approx([0.003] * 4)
    told.clear()  # beside given forces laws follow every step
    force = np.zeros((4, 12, 1))
    held = ForceLaw("hinge", law, hold=0.003)
    Engine().rollout(pendulum(), starts(4), ctrl, force=force, laws=(held,))
    assert told == pytest.approx([0.001] * 12)


def test_a_law_sees_the_names_and_the_time_step_of_the_model_that_is_given() -> None:
    """Also where the batch was made for another model of the same sizes."""
    engine, start, ctrl = Engine(), starts(2), np.zeros((2, 3, 1))
    seen: list[tuple[set[str], float]] = []

    def law(inputs: LawInputs) -> np.ndarray:
        seen.append((set(inputs.qpos), inputs.timestep))
        return np.zeros_like(inputs.time)

    for name, step in (("hinge", 0.001), ("elbow", 0.002)):
        xml = PENDULUM.format(damping=0, integrator="Euler").replace('"hinge"', f'"{name}"')
        model = mujoco.MjModel.from_xml_string(xml)
        model.opt.timestep = step
        engine.rollout(model, start, ctrl, laws=(ForceLaw(name, law),))
        assert seen[-1] == ({name}, step)


def test_a_law_keeps_its_memory_within_one_rollout_only() -> None:
    seen: list[int] = []

    def count(inputs: LawInputs) -> np.ndarray:
        inputs.memory["calls"] = inputs.memory.get("calls", 0) + 1
        seen.append(inputs.memory["calls"])
        return np.zeros_like(inputs.time)

    for _ in range(2):
        Engine().rollout(
            pendulum(), starts(2), np.zeros((2, 3, 1)), laws=(ForceLaw("hinge", count),)
        )
    assert seen == [1, 2, 3, 1, 2, 3]


@pytest.mark.parametrize("hold", [None, 0.0, 0.002])
def test_divergence_is_a_status_per_window(
    hold: float | None,
    capfd: pytest.CaptureFixture[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    start = State(np.zeros((3, 1)), np.array([[0.0], [1e12], [1.0]]), np.zeros((3, 0)))
    nothing = lambda inputs: np.zeros_like(inputs.time)  # noqa: E731
    law = () if hold is None else (ForceLaw("hinge", nothing, hold),)
    trajectory = Engine().rollout(pendulum(), start, np.zeros((3, 5, 1)), laws=law)
    np.testing.assert_array_equal(trajectory.diverged, [False, True, False])
    assert np.isfinite(trajectory.qpos).all()
    assert capfd.readouterr() == ("", "")  # the status is enough
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("hold", [None, 0.0, 0.002])
def test_a_window_that_diverged_diverges_again_and_another_in_its_place_does_not(
    hold: float | None,
) -> None:
    """What MuJoCo counts is left from call to call, and begins anew in what it resets."""
    still = State(np.zeros((3, 1)), np.zeros((3, 1)), np.zeros((3, 0)))
    flung = still.moved(pendulum(), np.array([[0, 0], [0, 1e12], [0, 1e12]]))
    nothing = lambda inputs: np.zeros_like(inputs.time)  # noqa: E731
    law = () if hold is None else (ForceLaw("hinge", nothing, hold),)
    kept, ctrl = Engine(1), np.zeros((3, 5, 1))
    for start, lost in ((flung, True), (flung, True), (still, False), (flung, True)):
        found = kept.rollout(pendulum(), start, ctrl, laws=law)
        np.testing.assert_array_equal(found.diverged, [False, lost, lost])
        np.testing.assert_array_equal(
            found.qpos, Engine(1).rollout(pendulum(), start, ctrl, laws=law).qpos
        )
        state, diverged = kept.final(pendulum(), start, ctrl[:, 0], steps=5)
        np.testing.assert_array_equal(diverged, [False, lost, lost])
        assert np.isfinite(state).all()


@pytest.mark.parametrize("with_law", [False, True])
def test_sensordata_belongs_to_the_state_of_its_row(with_law: bool) -> None:
    law = (ForceLaw("hinge", lambda inputs: np.zeros_like(inputs.time)),) if with_law else ()
    trajectory = Engine().rollout(
        pendulum(), starts(3), np.zeros((3, 7, 1)), laws=law, sensors=True
    )
    assert trajectory.sensordata is not None
    np.testing.assert_array_equal(trajectory.sensordata, trajectory.qpos)


def test_final_equals_the_end_of_a_rollout() -> None:
    start, held = starts(5), np.random.default_rng(3).normal(size=(5, 1))
    engine = Engine()
    whole = engine.rollout(pendulum(0.2), start, np.repeat(held[:, None], 4, axis=1))
    state, diverged = engine.final(pendulum(0.2), start, held, steps=4)
    np.testing.assert_array_equal(state, np.hstack([whole.qpos[:, -1], whole.qvel[:, -1]]))
    assert not diverged.any()


def test_states_move_and_differ_as_mujoco_has_it() -> None:
    xml = """<mujoco><worldbody>
      <body><freejoint/><geom size=".1"/>
        <body><joint type="hinge"/><geom size=".1"/>
          <body><joint type="ball"/><geom size=".1"/></body></body></body>
      <body><joint type="slide"/><geom size=".1"/></body></worldbody></mujoco>"""
    model, rng = mujoco.MjModel.from_xml_string(xml), np.random.default_rng(0)
    qpos = rng.normal(size=(20, model.nq))
    for q in qpos:
        mujoco.mj_normalizeQuat(model, q)
    change = rng.normal(size=(20, model.nv))
    state = State(qpos, np.zeros((20, model.nv)), np.zeros((20, 0)))
    moved = state.moved(model, np.hstack([change, change]))
    np.testing.assert_allclose(moved.qvel, change)
    expected, difference = qpos.copy(), np.empty((20, model.nv))
    for k in range(20):
        mujoco.mj_integratePos(model, expected[k], change[k], 1.0)
        mujoco.mj_differentiatePos(model, difference[k], 1.0, qpos[k], expected[k])
    np.testing.assert_allclose(moved.qpos, expected, atol=1e-12)
    np.testing.assert_allclose(tangent_difference(model, moved.qpos, qpos), difference, atol=1e-9)


@pytest.mark.parametrize("hold", [0.0, 0.01])
def test_after_a_divergence_nothing_moves(hold: float) -> None:
    model = mujoco.MjModel.from_xml_string(
        '<mujoco><option timestep="0.002"/><worldbody><body>'
        '<joint name="x" type="slide"/><geom size=".1" mass="1"/></body></worldbody></mujoco>'
    )
    law = ForceLaw("x", lambda m: np.where((m.time > 0.05) & (m.qpos["x"] > 0.5), 1e14, 0.0), hold)
    start = State(np.array([[-1.0], [1.0]]), np.zeros((2, 1)), np.zeros((2, 0)))
    t = Engine(1).rollout(model, start, np.zeros((2, 200, 0)), laws=[law])
    assert t.diverged[1]
    np.testing.assert_array_equal(t.diverged, [False, True])
    assert len(np.unique(t.qpos[1, 40:])) == 1


def test_warnings_are_heard_again_once_the_last_thread_has_left() -> None:
    before, inside, leave = mujoco.get_mju_user_warning(), threading.Event(), threading.Event()

    def other() -> None:
        with quietly():
            inside.set()
            leave.wait(10)

    thread = threading.Thread(target=other)
    with quietly():
        thread.start()
        assert inside.wait(10)
    assert mujoco.get_mju_user_warning() != before  # the other is still inside
    leave.set()
    thread.join()
    assert mujoco.get_mju_user_warning() == before
