"""Friction, transmission and inertia against what physics says of them."""

from dataclasses import replace

import mujoco
import numpy as np
import pytest
from effect_bench import MOTOR, PENDULUM, SERVO, SLIDE, Bench, G, pendulum, period
from effect_machines import case

from bo_sysid.effects import CATALOGUE, Hidden, Site, applicable
from bo_sysid.effects.bristles import bristled
from bo_sysid.simulation.lockstep import LawInputs

HINGE = Site("joint", "hinge")


@pytest.fixture(scope="module")
def slide() -> Bench:
    return Bench(SLIDE)


class TestFriction:
    def test_dry_friction_decelerates_by_f_over_m(self, slide) -> None:
        t, _, v = slide.effect("dry_friction", "joint", "x", [0.8], 0.5, v=1.0)
        np.testing.assert_allclose(v[:, 0], 1.0 - 0.8 / 2 * t, atol=1e-5)
        t, _, v = slide.effect("dry_friction", "joint", "x", [0.8], 4.0, v=1.0)
        assert np.abs(v[t > 2.6]).max() < 1e-6  # it stops after 2.5 s and stays

    @pytest.mark.parametrize(
        ("id", "x"),
        [("dry_friction", [0.8, 1.0, 1e-4]), ("stribeck_friction", [0.0, 0.8, 0.1, 1e-4])],
    )
    def test_bent_friction_adds_to_what_a_parameter_of_the_study_wrote(self, slide, id, x) -> None:
        """1.3 N on 2 kg: .5 that was written into the spec before, .8 of the effect."""

        def both(spec: mujoco.MjSpec) -> None:
            spec.joint("x").frictionloss = 0.5
            CATALOGUE[id].parts(spec, Site("joint", "x"), np.array(x), slide.machine)

        t, _, v = slide.run(slide.model.compile([both]), (), 0.5, v=1.0)
        assert v[-1, 0] == pytest.approx(1.0 - 1.3 / 2 * t[-1], rel=0.01)

    def test_what_the_model_has_is_counted(self) -> None:
        """Drag and a payload that are there already can be found smaller, and are told."""
        arm = pendulum(MOTOR, damping="0.1 0.5")
        drag, hinge = CATALOGUE["quadratic_damping"], Site("joint", "hinge")
        assert drag.nominal(hinge, arm.machine) == pytest.approx(0.5)
        assert drag.extent(hinge, arm.machine).low[0] == pytest.approx(-0.5)
        loaded, _ = arm.edited("payload", "body", "rod", [0.2])
        machine = replace(arm.machine, model=loaded)
        assert CATALOGUE["payload"].nominal(Site("body", "rod"), machine) == pytest.approx(0.2)

    def test_viscous_damping_decays_exponentially(self, slide) -> None:
        t, _, v = slide.effect("viscous_damping", "joint", "x", [1.5], 2.0, v=1.0)
        np.testing.assert_allclose(v[:, 0], np.exp(-1.5 * t / 2), rtol=1e-3)

    def test_quadratic_damping_decays_as_one_over_t(self, slide) -> None:
        t, _, v = slide.effect("quadratic_damping", "joint", "x", [3.0], 2.0, v=1.0)
        np.testing.assert_allclose(v[:, 0], 1 / (1 + 3.0 * t / 2), rtol=2e-3)

    @pytest.mark.parametrize("speed", [0.02, 0.1, 0.2, 1.0, -0.1])
    def test_both_forms_of_stribeck_have_its_steady_state(self, slide, speed) -> None:
        excess, coulomb, vs = 0.5, 1.0, 0.1
        wanted = -np.sign(speed) * (coulomb + excess * np.exp(-((speed / vs) ** 2)))
        law = CATALOGUE["stribeck_friction"].force(
            Site("joint", "x"), np.array([excess, coulomb, vs]), slide.machine
        )
        motion = LawInputs(np.zeros(1), {}, {"x": np.array([speed])}, {}, {}, 0.001)
        assert law(motion)[0] == pytest.approx(wanted)
        model, parts = slide.edited(
            "stribeck_friction", "joint", "x", [excess, coulomb, vs], written=True
        )
        assert parts == ()
        assert model.nu == 1
        data = mujoco.MjData(model)
        for _ in range(500):
            data.qvel[0] = speed
            mujoco.mj_step(model, data)
        data.qvel[0] = speed
        mujoco.mj_forward(model, data)
        friction = data.qfrc_actuator[0] + data.qfrc_constraint[0]
        assert friction == pytest.approx(wanted, rel=1e-3)

    def test_the_written_stribeck_friction_moves_as_the_law_does(self, slide) -> None:
        x = [0.5, 1.0, 0.1]
        law = slide.edited("stribeck_friction", "joint", "x", x)
        bristles = slide.edited("stribeck_friction", "joint", "x", x, written=True)
        for push, v in ((0.0, 2.0), (-1.2, 1.0), (2.0, -0.5)):
            one, two = (slide.run(*form, 1.5, ctrl=push, v=v) for form in (law, bristles))
            travel = np.ptp(one[1])
            np.testing.assert_allclose(one[1], two[1], atol=0.03 * travel)
        held = slide.run(*bristles, 1.0, ctrl=0.4)
        assert np.abs(held[1]).max() < 3e-3  # 1.2 N of 1.5 N does not break it away
        assert np.ptp(held[1][-300:]) < 2e-4

    def test_stribeck_friction_breaks_away_as_computed(self, slide) -> None:
        _, q, _ = slide.effect("stribeck_friction", "joint", "x", [0.5, 1.0, 0.1], 1.0, ctrl=0.7)
        dt, v, travel = 1e-5, 0.0, 0.0
        for _ in range(100_000):
            v += dt * (3 * 0.7 - 1.0 - 0.5 * np.exp(-((v / 0.1) ** 2))) / 2
            travel += dt * v
        assert q[-1, 0] == pytest.approx(travel, rel=2e-3)

    def test_asymmetric_friction_differs_between_the_directions(self, slide) -> None:
        for sign, friction in ((1, 0.8 + 0.1), (-1, 0.8 - 0.1)):
            model, parts = slide.edited("asymmetric_friction", "joint", "x", [0.2])
            model.dof_frictionloss[0] = 0.8
            t, _, v = slide.run(model, parts, 0.5, v=sign)
            np.testing.assert_allclose(v[:, 0], sign * (1 - friction / 2 * t), atol=1e-3)

    def test_asymmetric_damping_differs_between_the_directions(self, slide) -> None:
        for sign, damping in ((1, 1.0 + 0.2), (-1, 1.0 - 0.2)):
            model, parts = slide.edited("asymmetric_damping", "joint", "x", [0.4])
            model.dof_damping[0] = 1.0
            t, _, v = slide.run(model, parts, 1.0, v=sign)
            np.testing.assert_allclose(v[:, 0], sign * np.exp(-damping * t / 2), atol=1e-3)

    def test_load_dependent_friction_takes_a_share_of_the_torque(self, slide) -> None:
        t, _, v = slide.effect("load_dependent_friction", "joint", "x", [0.3], 0.5, ctrl=0.5, v=0.1)
        push = 3 * 0.5
        np.testing.assert_allclose(v[:, 0], 0.1 + push * (1 - 0.3) / 2 * t, atol=1e-6)
        t, _, v = slide.effect(
            "load_dependent_friction", "joint", "x", [0.3], 0.2, ctrl=0.5, v=-1.0
        )
        np.testing.assert_allclose(v[:, 0], -1.0 + push * (1 + 0.3) / 2 * t, atol=1e-6)

    def test_load_dependent_friction_holds_what_it_can(self) -> None:
        rod = pendulum(MOTOR)
        weight = 0.5 * G * 0.2 * np.sin(0.5)  # at half a radian
        law = rod.effect(
            "load_dependent_friction", "joint", "hinge", [0.5], 0.3, ctrl=0.8 * weight, q=0.5
        )
        free = rod.run(rod.model.compile(), (), 0.3, ctrl=0.8 * weight, q=0.5)
        moved, would = (abs(run[1][-1, 0] - 0.5) for run in (law, free))
        assert moved < 0.05 * would

    @pytest.mark.parametrize("sign", [1, -1])
    def test_bristles_bend_as_their_equation_says(self, slide, sign) -> None:
        """At a constant slow speed, from bent by the drive: F·(1 - (1 ∓ 1)·exp(-x/b))."""
        joint, level, bend, h = slide.machine.joints["x"], 2.0, 1e-3, 1e-4
        v, drive = sign * 1e-3 * joint.speed, 2 * level
        memory: dict[str, object] = {}
        felt, steps = [], int(5 * bend / abs(v) / h)
        for _ in range(steps):
            motion = LawInputs(np.zeros(1), {}, {"x": np.array([v])}, {}, {}, h, memory)
            felt.append(bristled(np.array([drive]), 0.5, bend, joint, motion)[0])
        travelled = abs(v) * h * np.arange(1, steps + 1)
        turned = 1 - np.sign(drive) * sign
        expected = -sign * level * (1 - turned * np.exp(-travelled / bend))
        np.testing.assert_allclose(felt, expected, atol=0.01 * level)

    @pytest.mark.parametrize("push", [0.5, -0.5])
    def test_friction_of_a_load_slides_alike_whether_it_bends_or_not(self, slide, push) -> None:
        still, bent = (
            slide.effect("load_dependent_friction", "joint", "x", [0.3, b], 0.5, ctrl=push, v=1.0)
            for b in (0.0, 1e-4)
        )
        np.testing.assert_allclose(bent[2], still[2], atol=5e-3)

    def test_stribeck_friction_that_bends_is_plain_mjcf(self, slide) -> None:
        """Slowly, ż = v - |v| z/b at the level of standstill: x = -b·ln(1 - force/level)."""
        bend, level, share, steps = 1e-3, 0.5 + 1.0, 0.6, 4000
        model, parts = slide.edited("stribeck_friction", "joint", "x", [0.5, 1.0, 0.1, bend])
        assert parts == ()
        data = mujoco.MjData(model)
        for k in range(steps):
            data.qfrc_applied[0] = share * level * k / steps
            mujoco.mj_step(model, data)
        assert data.qpos[0] == pytest.approx(-bend * np.log(1 - share), rel=0.03)


class TestTransmission:
    def test_a_spring_has_its_frequency(self, slide) -> None:
        t, q, _ = slide.effect("joint_spring", "joint", "x", [50.0, 0.0], 4.0, v=0.1)
        assert period(t, q[:, 0]) == pytest.approx(2 * np.pi * np.sqrt(2 / 50), rel=1e-3)
        _, q, _ = slide.effect("joint_spring", "joint", "x", [50.0, 5.0], 1.2, v=0.0)
        assert 0.5 * q.max() == pytest.approx(5.0 / 50, rel=1e-2)  # swings about its rest

    @pytest.mark.parametrize("side", [0.0, 1.0])
    @pytest.mark.parametrize("soft", [0.0, 0.004])
    def test_backlash_has_a_dead_travel_of_its_gap(self, slide, side, soft) -> None:
        gap, force = 0.02, 0.3
        model, (hidden,) = slide.edited("backlash", "joint", "x", [gap, soft, 0.0, 0.25, side])
        assert isinstance(hidden, Hidden)
        assert (hidden.of, hidden.shown) == ("x", side)
        ends, pushed = [], force * model.actuator_gear[0, 0]
        for push in (1, -1):  # the motor pushes, the link meets a wall: damping on the link
            data = mujoco.MjData(model)
            model.dof_damping[1] = 0.0
            for _ in range(1500):
                data.ctrl[0] = force * push
                data.qfrc_applied[1] = -1000 * (data.qpos[0] + data.qpos[1]) - 50 * data.qvel[1]
                data.qfrc_applied[0] = -50 * data.qvel[0] + data.qfrc_applied[1]
                mujoco.mj_step(model, data)
            ends.append(data.qpos.copy())
        assert abs(ends[0][1] - ends[1][1]) == pytest.approx(gap + 2 * soft * pushed, rel=0.01)

    @pytest.mark.parametrize(
        ("effect", "shapes"), [("backlash", [0.25, 0.0]), ("joint_compliance", [0.0])]
    )
    @pytest.mark.parametrize("own", ['damping="0.4"', 'springdamper=".5 .7"'])
    def test_the_damping_of_a_joint_is_shared_by_motor_and_link(self, effect, shapes, own) -> None:
        rod = Bench(PENDULUM.format(actuator=MOTOR, damping=0.4).replace('damping="0.4"', own))
        damping = rod.machine.model.dof_damping[0]
        model, _ = rod.edited(effect, "joint", "hinge", [0.1, 0.01, 0.25, *shapes])
        data = mujoco.MjData(model)
        for motor, link in ((1.0, 0.0), (0.0, 1.0), (0.7, -0.2)):
            data.qvel[:] = motor, link - motor
            mujoco.mj_forward(model, data)
            lost = -data.qvel @ data.qfrc_damper
            between = model.dof_damping[1] * data.qvel[1] ** 2  # of the spring itself
            assert lost - between == pytest.approx(damping * (0.75 * motor**2 + 0.25 * link**2))

    @pytest.mark.parametrize("compliance", [5e-5, 5e-4, 5e-3, 0.05, 0.2, 0.4])
    @pytest.mark.parametrize("push", [0.5, -2.0])
    def test_compliance_deflects_by_torque_times_compliance(
        self, compliance: float, push: float
    ) -> None:
        rod = pendulum(MOTOR, damping=0.0)
        model, (hidden,) = rod.edited(
            "joint_compliance", "joint", "hinge", [compliance, 0.0, 0.0, 1.0]
        )
        assert hidden.shown == 1.0
        model.opt.gravity[:] = 0
        data = mujoco.MjData(model)
        for _ in range(6000):  # the link is held by a stiff spring, the motor pushes
            link = data.qpos[0] + data.qpos[1]
            rate = data.qvel[0] + data.qvel[1]
            data.qfrc_applied[:] = -40.0 * link - 2.0 * rate
            data.ctrl[0] = push
            mujoco.mj_step(model, data)
        assert not data.warning.number.any()
        assert np.abs(data.qvel).max() < 1e-4
        expected = pytest.approx(-push * compliance, rel=0.02, abs=2e-7)
        assert data.qpos[1] == expected

    def test_a_stiff_joint_moves_as_without_compliance(self) -> None:
        rod = pendulum(MOTOR)
        model, _ = rod.edited("joint_compliance", "joint", "hinge", [1e-5, 0.0, 0.0, 0.0])
        _, q, _ = rod.run(model, (), 1.0, ctrl=0.3)
        _, rigid, _ = rod.run(rod.model.compile(), (), 1.0, ctrl=0.3)
        np.testing.assert_allclose(q.sum(axis=1), rigid[:, 0], atol=3e-3)

    def test_compliance_gives_the_resonance_of_link_and_spring(self) -> None:
        rod = pendulum(SERVO.replace("10", "1e4").replace('kv="1"', 'kv="100"'))
        k = 20.0
        model, _ = rod.edited("joint_compliance", "joint", "hinge", [1 / k, 0.0, 0.0, 0.0])
        model.opt.gravity[:] = 0
        t, q, _ = rod.run(model, (), 1.5, q=[0.0, 0.05])
        inertia = rod.machine.model.dof_M0[0]
        assert period(t, q[:, 1]) == pytest.approx(2 * np.pi * np.sqrt(inertia / k), rel=0.02)


class TestInertia:
    def test_a_payload_slows_a_pendulum_as_computed(self) -> None:
        rod = pendulum()
        m, inertia = 0.3, rod.machine.model.dof_M0[0]
        t, q, _ = rod.effect("payload", "body", "rod", [m], 6.0, q=0.02)
        torque = G * (0.5 * 0.2 + m * 0.4)
        exact = 2 * np.pi * np.sqrt((inertia + m * 0.4**2) / torque)
        assert period(t, q[:, 0]) == pytest.approx(exact, rel=1e-4)

    def test_a_payload_hangs_where_it_is_put(self) -> None:
        rod, m = pendulum(damping=0.5), 0.3
        _, q, _ = rod.effect("payload", "body", "rod", [m, 0.1, 0.0, -0.3], 20.0)
        lean = m * 0.1 / (0.5 * 0.2 + m * 0.3)
        assert abs(q[-1, 0]) == pytest.approx(np.arctan(lean), rel=1e-3)
        model, _ = rod.edited("payload", "body", "rod", [m, 0.1, 0.0, -0.3])
        inertia = rod.machine.model.dof_M0[0]
        assert model.dof_M0[0] == pytest.approx(inertia + m * (0.1**2 + 0.3**2))

    def test_armature_and_inertia_slow_a_pendulum_as_computed(self) -> None:
        rod = pendulum()
        inertia = rod.machine.model.dof_M0[0]
        own = inertia - 0.5 * 0.2**2
        for id, kind, site, x, added in (
            ("armature", "joint", "hinge", 0.02, 0.02),
            ("link_inertia", "body", "rod", 0.5, 0.5 * own),
        ):
            t, q, _ = rod.effect(id, kind, site, [x], 6.0, q=0.02)
            exact = 2 * np.pi * np.sqrt((inertia + added) / (G * 0.5 * 0.2))
            assert period(t, q[:, 0]) == pytest.approx(exact, rel=2e-4), id

    def test_a_shifted_centre_hangs_to_the_side(self) -> None:
        rod = pendulum(damping=0.5)
        _, q, _ = rod.effect("com_shift", "body", "rod", [0.05, 0.0, 0.0], 20.0)
        assert abs(q[-1, 0]) == pytest.approx(np.arctan(0.05 / 0.2), rel=1e-3)
        model, _ = rod.edited("com_shift", "body", "rod", [0.05, 0.0, 0.0])
        np.testing.assert_allclose(model.body("rod").ipos, [0.05, 0, -0.2])
        np.testing.assert_array_equal(
            model.body("rod").inertia, rod.machine.model.body("rod").inertia
        )

    @pytest.mark.parametrize("id", ["com_shift", "link_inertia"])
    def test_how_a_mass_is_spread_is_felt_only_where_it_turns(self, id) -> None:
        cart = case("cart-pole").machine
        assert [s.name for s in applicable(CATALOGUE[id], cart)] == ["pole"]
        assert len(applicable(CATALOGUE["payload"], cart)) == 2


@pytest.mark.parametrize(
    ("id", "x", "added"),
    [
        ("viscous_damping", [0.3], lambda q, v: -0.3 * v),
        ("joint_spring", [2.0, 0.5], lambda q, v: 0.5 - 2.0 * q),
        ("constant_force", [1.0], lambda q, v: 1.0),
    ],
)
@pytest.mark.parametrize("own", ['springdamper=".5 .7"', ""])
def test_what_pulls_at_a_joint_is_added_to_what_mujoco_derives(own, id, x, added) -> None:
    """A joint with `springdamper` has a stiffness and a damping that no number says."""
    arm = Bench(PENDULUM.format(actuator=MOTOR, damping=0.0).replace('damping="0.0"', own))
    model, _ = arm.edited(id, "joint", "hinge", x)
    for q, v in ((0.4, -0.6), (-0.3, 0.5)):
        passive = []
        for m in (arm.machine.model, model):
            data = mujoco.MjData(m)
            data.qpos[0], data.qvel[0] = q, v
            mujoco.mj_forward(m, data)
            passive.append(data.qfrc_passive[0])
        assert passive[1] - passive[0] == pytest.approx(added(q, v), abs=2e-6)


@pytest.mark.parametrize(("id", "x"), [("joint_spring", [2.0, 0.5]), ("constant_force", [0.5])])
@pytest.mark.parametrize("own", ['stiffness="2 3 0" springref="10"', 'stiffness="0 3 4"'])
def test_a_spring_beside_one_with_higher_terms_adds_its_own_force(own, id, x) -> None:
    """The pendulum moves as plain MuJoCo has it, with the force applied at every step."""
    hinge = PENDULUM.format(actuator=MOTOR, damping=0.1).replace('damping="0.1"', own)
    arm = Bench(hinge)
    _, q, _ = arm.effect(id, "joint", "hinge", x, 1.0, q=0.3)
    data = mujoco.MjData(arm.machine.model)
    data.qpos[0] = 0.3
    for shown in q[:, 0]:
        assert shown == pytest.approx(data.qpos[0], abs=1e-9)
        data.qfrc_applied[0] = x[-1] - (x[0] * data.qpos[0] if len(x) > 1 else 0.0)
        mujoco.mj_step(arm.machine.model, data)
    details = CATALOGUE[id].details
    assert details is None or not details(np.array(x), arm.machine, HINGE)


DRIVEN = """<mujoco><option timestep="0.001" integrator="implicitfast"/>
<default>{defaults}</default><worldbody><body><joint name="hinge" axis="0 1 0" {joint}/>
 <geom type="capsule" fromto="0 0 0 0 0 -.4" size=".01" mass=".5"/></body></worldbody>
<tendon><fixed name="belt" {tendon}><joint joint="hinge" coef="1"/></fixed></tendon>
<equality><joint joint1="hinge" {equality}/></equality>
<actuator><motor name="motor" joint="hinge" {motor}/></actuator></mujoco>"""
OWN = {
    "joint": 'damping=".1" stiffness=".2" armature=".02" margin=".05" actuatorfrcrange="-3 3"',
    "tendon": 'stiffness=".1" frictionloss=".05" limited="true" range="-2 2"',
    "equality": 'solref=".5 1" active="false"',
    "motor": 'gear="5" ctrllimited="true" ctrlrange="-2 2" armature=".01" damping=".02"',
}


@pytest.mark.parametrize(
    ("id", "x"),
    [
        ("cogging", [0.3, 0.1, 6.0]),
        ("dry_friction", [0.2, 1, 1e-3]),
        ("backlash", [0.1, 0.01, 0.5, 0.25, 0.0]),
        ("joint_compliance", [0.05, 0.01, 0.5, 0.0]),
        ("joint_compliance", [1e-5, 0.0, 0.5, 0.0]),
    ],
)
def test_what_is_added_takes_nothing_from_the_defaults_of_a_model(id, x) -> None:
    """It moves as where the model states the same of each of its own elements."""
    ends = []
    for text in (
        DRIVEN.format(defaults="", **OWN),
        DRIVEN.format(
            defaults="".join(f"<{kind} {own}/>" for kind, own in OWN.items()),
            **dict.fromkeys(OWN, ""),
        ),
    ):
        data = mujoco.MjData(Bench(text).edited(id, "joint", "hinge", x)[0])
        data.qvel[0], data.ctrl[0] = 3.0, 0.1
        mujoco.mj_step(data.model, data, 300)
        ends.append((*data.qpos, *data.qvel))
    np.testing.assert_allclose(ends[1], ends[0], rtol=1e-9)
