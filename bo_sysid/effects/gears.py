"""What lies between a motor and its link: play and compliance, as a second joint on the axis."""

import mujoco
import numpy as np

from bo_sysid.effects.actuators import acting, as_edited
from bo_sysid.effects.contract import Component, Extent, Magnitudes, Site
from bo_sysid.effects.machine import ActuatorScale, Machine
from bo_sysid.effects.parts import Force, Hidden, Motion, Part, Signal
from bo_sysid.effects.registry import effect
from bo_sysid.mjcf.compiling import compile_spec
from bo_sysid.mjcf.plain import add_plain

_GAPS = (0.01, 0.1)  # of the spread of a joint's position, tried as play
_SOFT = (0.003, 0.02, 0.1, 0.3)  # of that spread, by which the typical force bends a joint
_MOST_SOFT = 1.0  # the same, at most: what gives way further is no gear, and follows any motion
_LAG, _LONGEST = 1e-3, 0.05  # [s] damping over stiffness: a probe, and the most
_ROTOR = 1e-3  # of a joint's inertia: the rotor's, where the model has none
_MOTOR_SIDE, _LINK_SIDE = 0.0, 1.0
_HARDEST = 0.9999  # largest impedance of MuJoCo's constraints
_TIGHT = 1e-3  # of that spread, by which the typical force bends a gear that plays
_YIELDING = (0.01, 0.05)  # the same for ends that give way, from which fits are begun as well
_MOST_YIELDING = 0.2  # the same, at most
_EVENLY = 0.5  # share of a joint's damping that acts on the link, to begin with
_MOST = 10.0  # of a joint's typical force: what bends the ends of a gap
_SOFTEST = 0.01  # impedance of the ends of a gap
_RATIO = 0.25  # damping ratio of a constraint that stands for a spring, or at first for an end
_RINGING = 0.02  # least damping ratio of an end
_NO_LIMITS = int(mujoco.mjtDisableBit.mjDSBL_LIMIT)  # the ends of a gap are none
_EXPLICIT = (mujoco.mjtIntegrator.mjINT_EULER, mujoco.mjtIntegrator.mjINT_RK4)


def _added(site: Site, what: str) -> str:
    """Return the name of the joint that is added to one."""
    return f"{site.name}_{what}"


def _sides(site: Site, machine: Machine, what: str) -> tuple[float, ...]:
    """Return where the encoder may be: (), where the joint has no drive that it could tell from.

    A servo closes its loop where the encoder is. Nor is anything added where a joint of the model
    bears the name already: it would be taken for the one between motor and link.
    """
    model, joint = machine.model, machine.joints[site.name]
    number = model.joint(site.name).id
    body = model.jnt_bodyid[number]
    last = number == model.body_jntadr[body] + model.body_jntnum[body] - 1
    taken = mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_JOINT, _added(site, what)) >= 0
    if not (joint.actuators and last) or taken:
        return ()
    return (_MOTOR_SIDE, _LINK_SIDE)


def _servos(site: Site, machine: Machine) -> tuple[str, ...]:
    """Return the actuators of a joint that close a loop around it."""
    names = machine.joints[site.name].actuators
    return tuple(n for n in names if any(machine.actuators[n].bias[1:3]))


def _loop(spec: mujoco.MjSpec, site: Site, machine: Machine) -> tuple[float, float]:
    """Return gain and damping of the servos of a joint, in [N m/rad] and [N m s/rad].

    They are those of the spec, in which other effects and parameters have changed them. What slows
    a motor that closes no loop acts at the motor.
    """
    servos = [as_edited(spec, machine.actuators[name]) for name in _servos(site, machine)]
    return -sum(a.bias[1] * a.gear**2 for a in servos), -sum(a.bias[2] * a.gear**2 for a in servos)


def _closed(
    spec: mujoco.MjSpec, hidden: Hidden, site: Site, machine: Machine
) -> Part | tuple[Part, ...]:
    """Return an added joint, with what a servo whose encoder sits on the link does more.

    In MJCF its loop is closed by the motor's position q; the encoder shows q + δ, so that the
    motor's torque differs by -kp δ - kd δ', or as far as its force is limited by
    F(u, q + δ, v + δ') - F(u, q, v).
    """
    if not (hidden.shown and _servos(site, machine)):
        return hidden
    kp, kd = _loop(spec, site, machine)
    limited = _limited(spec, site, machine)
    for a in limited:
        kp, kd = kp + a.bias[1] * a.gear**2, kd + a.bias[2] * a.gear**2

    def law(motion: Motion) -> Signal:
        q, v = motion.qpos[site.name], motion.qvel[site.name]
        more, faster = motion.qpos[hidden.joint], motion.qvel[hidden.joint]
        force = -kp * more - kd * faster
        for a in limited:
            u = acting(a, motion)
            force = force + a.force(u, q + more, v + faster) - a.force(u, q, v)
        return force

    return hidden, Force(site.name, law)


def _limited(spec: mujoco.MjSpec, site: Site, machine: Machine) -> list[ActuatorScale]:
    """Return the servos of a joint whose force is limited, as they are in the spec."""
    servos = [as_edited(spec, machine.actuators[name]) for name in _servos(site, machine)]
    return [a for a in servos if a.plain and a.follows and a.force_limits is not None]


def _second_joint(
    spec: mujoco.MjSpec, site: Site, machine: Machine, what: str, on_link: float
) -> mujoco.MjsJoint:
    """Add a joint on the axis of a driven one, and leave that one with the motor's inertia.

    The position of the first is then the motor's, the sum of both the link's. A rotor that the
    model does not have gets so much inertia as a step can resolve. The share `on_link` of the
    joint's damping acts on the link, as that of a fixed tendon along both.
    """
    joint, scale = spec.joint(site.name), machine.joints[site.name]
    kp, kd = _loop(spec, site, machine)
    dt = _step(machine)
    explicit = spec.option.integrator in _EXPLICIT
    floor = max(_ROTOR * scale.inertia, kp * dt**2, 2.0 * kd * dt if explicit else 0.0)
    joint.armature = max(joint.armature, floor)
    play: mujoco.MjsJoint = add_plain(
        joint.parent,
        "joint",
        name=_added(site, what),
        type=joint.type,
        axis=joint.axis,
        pos=joint.pos,
    )
    if joint.frame is not None:
        play.set_frame(joint.frame)
    if np.any(joint.damping):
        link = add_plain(spec, "tendon", name=f"{play.name}_link")
        for turned in (joint, play):
            link.wrap_joint(turned.name, 1.0)
        link.damping = on_link * np.array(joint.damping)
        joint.damping = (1.0 - on_link) * np.array(joint.damping)
    return play


def _step(machine: Machine) -> float:
    """Return the model's own step, by which joints are as stiff as it resolves, in [s].

    Not that of a finer simulation: its difference is to be what the step does, not the joint.
    """
    return float(machine.model.opt.timestep)


def _resolved(site: Site, machine: Machine) -> bool:
    """Whether a step of the model resolves a rotor in a gap, slowed as fast as its link is."""
    model = machine.model
    servos = [machine.actuators[n] for n in _servos(site, machine)]
    kd = -sum(s.bias[2] * s.gear**2 for s in servos)
    rotor = model.dof_armature[machine.joints[site.name].dof]
    return bool(2.0 * kd * model.opt.timestep <= rotor) if servos else True


def _backlash_extent(site: Site, machine: Machine) -> Extent | None:
    sides = _sides(site, machine, "play")
    if not sides or machine.model.opt.disableflags & _NO_LIMITS:
        return None
    if not _resolved(site, machine):
        sides = (_MOTOR_SIDE,)
    joint = machine.joints[site.name]
    most = joint.spread / joint.force
    tight, points = _TIGHT * most, [(gap, side) for side in sides for gap in _GAPS]
    return Extent(
        (_GAPS[0] * joint.spread, tight, _EVENLY, _RATIO, sides[0]),
        (0.0, 0.0, 0.0, 0.0, -1e-9),
        (joint.spread, _MOST_YIELDING * most, 1.0, 1.0, 1.0),
        tuple((gap * joint.spread, tight, _EVENLY, _RATIO, side) for gap, side in points),
        tuple(
            (gap * joint.spread, soft * most, _EVENLY, _RATIO, side)
            for gap, side in points
            for soft in _YIELDING
        ),
    )


@effect(
    "backlash",
    kind="joint",
    components=(
        Component("gap", "rad"),
        Component("compliance", "rad/(N m)"),
        Component("damping on the link", "–"),
        Component("damping ratio of the ends", "–"),
        Component("encoder on the link", "–"),
    ),
    shapes=1,
    extent=_backlash_extent,
    noun="backlash",
    sentence="{site} has a play of {value} between motor and link.",
    form="second coaxial joint with a range",
    evidence="a distance after each reversal over which motor and link move apart",
    separation="small reversals, slow and fast",
    hidden=True,
)
def backlash(
    spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine
) -> Part | tuple[Part, ...] | None:
    """A gap of x[0] in total, whose ends give way by x[1]·torque.

    x[2] is the share of the joint's damping that acts on the link; x[3] is the damping ratio of the
    joint against an end; x[4] is 0 with the encoder on the motor, 1 on the link. The ends are
    limits of the second joint: MuJoCo's constraint with impedance d and solref (-s, -b) acts at
    rest as a spring of stiffness s/((1 - d) w), w the joint's inverse inertia in the reference
    pose, with the damping ratio b/(2√s). A small d adds little inertia; √s·h is kept within what a
    step h resolves.
    """
    if not x[0]:
        return None
    name = _added(site, "play")
    play = spec.joint(name)
    there = play is not None  # in a repaired model: what stands beside it is wanted
    if not there:
        play = _second_joint(spec, site, machine, "play", float(x[2]))
    weight, stiffest = (1 - _SOFTEST) * _inverse_inertia(spec, play), 0.25 / _step(machine) ** 2
    stiff = min(weight / max(float(x[1]), 1e-30), stiffest)
    open_, soft = 0.5 * float(x[0]), weight / stiff  # no stiffer than a step resolves
    hidden = Hidden(
        name,
        site.name,
        float(x[4]),
        lambda torque: -open_ * np.sign(torque) - soft * torque,
        open_ + soft * _MOST * machine.joints[site.name].force,
    )
    if there:
        return _closed(spec, hidden, site, machine)
    hinge = play.type == mujoco.mjtJoint.mjJNT_HINGE
    half = open_ / (np.pi / 180 if play.compiler.degree and hinge else 1.0)
    play.range = [-half, half]
    play.limited = mujoco.mjtLimited.mjLIMITED_TRUE
    play.solimp_limit = [_SOFTEST, _SOFTEST, 0.001, 0.5, 2.0]
    play.solref_limit = [-stiff, -2.0 * max(float(x[3]), _RINGING) * np.sqrt(stiff)]
    return _closed(spec, hidden, site, machine)


def _inverse_inertia(spec: mujoco.MjSpec, joint: mujoco.MjsJoint) -> float:
    compiled = compile_spec(spec.copy(), f"joint {joint.name!r}", " with play")
    return float(compiled.dof_invweight0[compiled.joint(joint.name).dofadr[0]])


def _compliance_extent(site: Site, machine: Machine) -> Extent | None:
    sides = _sides(site, machine, "flex")
    if not sides:
        return None
    joint = machine.joints[site.name]
    most = joint.spread / joint.force
    return Extent(
        (_SOFT[0] * most, _LAG, _EVENLY, sides[0]),
        (0.0, 0.0, 0.0, -1e-9),
        (_MOST_SOFT * most, _LONGEST, 1.0, 1.0),
        tuple((soft * most, _LAG, _EVENLY, side) for side in sides for soft in _SOFT),
    )


@effect(
    "joint_compliance",
    kind="joint",
    components=(
        Component("compliance", "rad/(N m)"),
        Component("damping over stiffness", "s"),
        Component("damping on the link", "–"),
        Component("encoder on the link", "–"),
    ),
    shapes=1,
    extent=_compliance_extent,
    noun="compliance",
    sentence="Between motor and link {site} gives way by {value}.",
    form="second coaxial joint with a soft equality",
    evidence="a deflection in proportion to torque, and a resonance",
    separation="fast commands; several loads at rest",
    threshold=True,
    hidden=True,
)
def joint_compliance(
    spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine
) -> Part | tuple[Part, ...] | None:
    """Deflection x[0]·torque between motor and link; x[2] and x[3] as of backlash.

    A spring that the time step h resolves is the stiffness k = 1/x[0] of the second joint, with
    the damping k·(x[1] + h). A stiffer one is a soft constraint, which cannot become unstable:
    MuJoCo's with time constant T/r, damping ratio r and impedance d acts at rest as a spring of
    stiffness 1/(T² (1 - d) w), w the joint's inverse inertia in the reference pose. T is 2h; its
    damping is felt over 4 r h. Impedance has a limit: no joint is stiffer than 1e4/(T² w).
    """
    if not x[0]:
        return None
    compliance = float(x[0])
    hidden = Hidden(
        _added(site, "flex"), site.name, float(x[3]), lambda torque: -compliance * torque
    )
    if spec.joint(hidden.joint) is not None:
        return _closed(spec, hidden, site, machine)
    flex = _second_joint(spec, site, machine, "flex", float(x[2]))
    slow = (2.0 * _step(machine)) ** 2 * _inverse_inertia(spec, flex)
    if compliance > 0.5 * slow:
        flex.stiffness[0] = 1.0 / compliance
        flex.damping[0] = (float(x[1]) + 4.0 * _RATIO * _step(machine)) / compliance
    else:
        impedance = min(1.0 - compliance / slow, _HARDEST)
        add_plain(
            spec,
            "equality",
            name=flex.name,
            type=mujoco.mjtEq.mjEQ_JOINT,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            name1=flex.name,
            solref=[2.0 * _step(machine) / _RATIO, _RATIO],
            solimp=[impedance, impedance, 0.001, 0.5, 2.0],
        )
    return _closed(spec, hidden, site, machine)
