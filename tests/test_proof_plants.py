"""The plants of the proof: equations on paper against MuJoCo, and plants against each other."""

from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from bo_sysid.errors import ModelError
from bo_sysid.proof.adaptive import AdaptivePlant
from bo_sysid.proof.bodies import add_mass, scale_body, tilt
from bo_sysid.proof.equations import EQUATIONS
from bo_sysid.proof.machine import load_machine
from bo_sysid.proof.physics import Bristle, Encoder, Law, Transmission, nominal_physics
from bo_sysid.proof.rolled import hermite
from bo_sysid.proof.stepped import SteppedPlant, Stepping

MACHINES = Path(__file__).parent.parent / "studies" / "concealed" / "machines"
SMALL = (
    "two_link_arm", "two_link_arm_servos", "cart_pole", "cart_pole_servo", "rotary_pendulum",
    "rotary_pendulum_servo",
)  # fmt: skip
DT = 0.002


@pytest.fixture(scope="module")
def machines():
    return {name: load_machine(MACHINES / f"{name}.yaml") for name in SMALL}


def equations(machine, model):
    return EQUATIONS[machine.file.equations](model)


def sines(nu, steps):
    t = np.arange(steps) * DT
    return np.stack([0.4 * np.sin(2 * np.pi * (1 + a) * t + a) for a in range(nu)], axis=1)


def changed(machine):
    """The nominal model with everything that the equations must know changed."""
    model = machine.model.compile()
    model.dof_armature[:] += (0.03, 0.002)
    body = model.body(model.nbody - 1).name
    add_mass(model, body, 0.07, model.site_pos[0])
    scale_body(model, model.body(1).name, 1.3)
    tilt(model, 0.11, -0.2)
    return model


@pytest.mark.parametrize("name", SMALL)
def test_accelerations_are_those_of_mujoco(machines, name):
    model = changed(machines[name])
    model.dof_damping[:] = 0
    model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_ACTUATION
    accelerate = equations(machines[name], model)
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    for _ in range(40):
        data.qpos[:], data.qvel[:] = rng.normal(0, 2, 2), rng.normal(0, 4, 2)
        data.qfrc_applied[:] = rng.normal(0, 1, 2)
        mujoco.mj_forward(model, data)
        found = accelerate(*data.qpos, *data.qvel, *data.qfrc_applied)
        np.testing.assert_allclose(found, data.qacc, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("name", SMALL)
def test_nominal_trajectories_agree_with_rk4_at_a_small_step(machines, name):
    model = changed(machines[name])
    physics = nominal_physics(model)
    u = sines(model.nu, 500)
    plant = AdaptivePlant(physics, equations(machines[name], model))
    smooth = plant.roll(lambda k, y: u[k], 500, DT)
    stepped = SteppedPlant(physics, Stepping(16, "RK4")).roll(lambda k, y: u[k], 500, DT)
    assert np.ptp(smooth.qpos, axis=0).min() > 0.01
    np.testing.assert_allclose(smooth.qpos, stepped.qpos, atol=1e-6)
    np.testing.assert_allclose(smooth.qvel, stepped.qvel, atol=1e-5)


def concealed(physics):
    """Physics of every sort that both plants have."""
    return replace(
        physics,
        bristles=(
            Bristle(0, lambda t, q, v, load: 0.05 * (1 + np.exp(-(v[0] ** 2) / 0.01)), 3e-4, 1e-3),
            Bristle(1, lambda t, q, v, load: 0.01 + 0.1 * abs(load[0]) / 50, 3e-4),
        ),
        laws=(Law(1, lambda t, q, v, load: 0.02 * np.sin(7 * q[1]) - 0.003 * v[1]),),
        drives=tuple(
            replace(d, delay=0.0131, lag=0.01, deadzone=0.03, limit=0.35 * abs(d.gear * d.gain),
                    offset=0.02)
            for d in physics.drives
        ),
    )  # fmt: skip


@pytest.mark.parametrize("name", ["two_link_arm", "cart_pole", "two_link_arm_servos"])
def test_stepping_by_hand_converges_to_the_adaptive_solver(machines, name):
    physics = concealed(nominal_physics(machines[name].compiled))
    u = sines(len(physics.drives), 400)
    plant = AdaptivePlant(physics, equations(machines[name], physics.model))
    exact = plant.roll(lambda k, y: u[k], 400, DT).qpos
    errors = [
        np.abs(SteppedPlant(physics, Stepping(n, "RK4")).roll(lambda k, y: u[k], 400, DT).qpos
               - exact).max()
        for n in (8, 32)
    ]  # fmt: skip
    assert errors[0] < 1e-3
    assert errors[1] < 0.5 * errors[0]


def test_a_stiff_spring_between_rotor_and_link_is_no_spring(machines):
    """The limit of compliance is the rigid joint with the rotor's inertia as armature."""
    machine = machines["two_link_arm_servos"]
    rigid = nominal_physics(machine.model.compile())
    model = machine.model.compile()
    model.dof_armature[0] -= 0.02
    soft = replace(nominal_physics(model), transmission=Transmission(0, 0.02, 0.0, 4e4, 20.0))
    u = sines(2, 150)
    rolls = [
        AdaptivePlant(p, equations(machine, p.model)).roll(lambda k, y: u[k], 150, DT).qpos
        for p in (rigid, soft)
    ]
    np.testing.assert_allclose(*rolls, atol=2e-3)
    assert np.abs(rolls[0]).max() > 0.05


def test_within_its_gap_the_rotor_moves_alone():
    gap = Transmission(0, 0.02, 0.1, 100.0, 1.0)
    assert gap.force(0.04, 5.0) == 0.0
    assert gap.force(0.06, 0.0) == pytest.approx(1.0)
    assert gap.force(-0.07, 0.0) == pytest.approx(-2.0)


def test_dry_friction_stops_a_pendulum_below_its_level(machines):
    """A joint held by friction creeps by no more than the bristle gives."""
    machine = machines["two_link_arm"]
    physics = nominal_physics(machine.compiled)
    level = Bristle(0, lambda t, q, v, load: 0.5, 3e-4, 1e-3)
    plant = AdaptivePlant(replace(physics, bristles=(level,)), equations(machine, physics.model))
    moved = plant.roll(lambda k, y: (0.3, 0.0), 300, DT).qpos
    assert np.abs(moved[:, 0]).max() < 1e-3
    free = AdaptivePlant(physics, equations(machine, physics.model))
    assert np.abs(free.roll(lambda k, y: (0.3, 0.0), 300, DT).qpos).max() > 0.05


def test_encoders_tell_late_scaled_and_shifted(machines):
    machine = machines["rotary_pendulum"]
    physics = replace(
        nominal_physics(machine.compiled),
        encoders=(Encoder(delay=0.0037), Encoder(scale=0.1, offset=0.2)),
    )
    seen = []

    def command(k, measured):
        seen.append(measured)
        return (np.sin(3 * k * DT),)

    plant = AdaptivePlant(physics, equations(machine, physics.model))
    rolled = plant.roll(command, 200, DT)
    early = hermite(rolled.time, rolled.qpos[:, 0], rolled.qvel[:, 0], rolled.time - 0.0037)
    np.testing.assert_allclose(rolled.read[:, 0], early)
    np.testing.assert_allclose(rolled.read[:, 1], 1.1 * rolled.qpos[:, 1] + 0.2)
    np.testing.assert_allclose(np.array(seen), rolled.read, atol=1e-9)


def test_hermite_is_exact_for_cubics():
    t = np.linspace(0, 1, 6)
    cubic = np.polynomial.Polynomial([0.3, -1.0, 2.0, 0.7])
    at = np.linspace(0.01, 0.99, 17)
    np.testing.assert_allclose(hermite(t, cubic(t), cubic.deriv()(t), at), cubic(at), atol=1e-14)


def test_a_body_with_a_load_is_that_of_mujoco(machines):
    machine = machines["two_link_arm"]
    model = machine.model.compile()
    add_mass(model, "forearm", 0.2, np.array([0.01, 0.02, -0.25]))

    def load(spec):
        body = spec.body("forearm").add_body(pos=[0.01, 0.02, -0.25])
        body.mass, body.inertia, body.explicitinertial = 0.2, [1e-12] * 3, True
        body.ipos, body.iquat = [0, 0, 0], [1, 0, 0, 0]

    expected = machine.model.compile([load])
    masses = []
    for m in (model, expected):
        data, full = mujoco.MjData(m), np.zeros((2, 2))
        data.qpos[:] = (0.4, -0.9)
        mujoco.mj_forward(m, data)
        mujoco.mj_fullM(m, data, full)
        masses.append((full, data.qfrc_bias.copy()))
    np.testing.assert_allclose(masses[0][0], masses[1][0], rtol=1e-9)
    np.testing.assert_allclose(masses[0][1], masses[1][1], rtol=1e-9, atol=1e-12)


def test_equations_refuse_what_they_do_not_describe(machines):
    model = machines["cart_pole"].compiled
    with pytest.raises(ModelError, match="a hinge along or about"):
        EQUATIONS["two_link_arm"](model)
    rough = machines["cart_pole"].model.compile()
    rough.dof_frictionloss[:] = 0.1
    with pytest.raises(ModelError, match="dry friction, limits, contact"):
        AdaptivePlant(nominal_physics(rough), EQUATIONS["cart_pole"](rough))
