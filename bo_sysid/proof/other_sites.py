"""What can be concealed in actuators, bodies, encoders, gravity and the ground."""

import mujoco
import numpy as np

from bo_sysid.proof.bodies import add_mass, end_of, scale_body, settle, tilt
from bo_sysid.proof.draft import Draft, Place, Realised, realised
from bo_sysid.proof.joints import driven, joints, sign
from bo_sysid.proof.machine import ProofMachine
from bo_sysid.proof.physics import Concealed


def _actuators(machine: ProofMachine) -> tuple[str, ...]:
    m = machine.compiled
    return tuple(str(m.actuator(machine.actuator_on(j)).name) for j in driven(machine))


def _motors(machine: ProofMachine) -> tuple[str, ...]:
    m = machine.compiled
    return tuple(a for a in _actuators(machine) if not m.actuator(a).biasprm[1])


def _servos(machine: ProofMachine) -> tuple[str, ...]:
    return tuple(a for a in _actuators(machine) if a not in _motors(machine))


def _at(draft: Draft, c: Concealed) -> int:
    return int(draft.machine.compiled.actuator(c.site).id)


def _gain(rng: np.random.Generator, place: Place) -> Concealed:
    return Concealed("actuator_gain", "actuator", place.site, 0.03 * sign(rng), "relative")


def _compose_gain(draft: Draft, c: Concealed) -> None:
    a, factor = _at(draft, c), 1.0 + c.value
    drive = draft.drives[a]
    b0, b1, b2 = (b * factor for b in drive.bias)
    draft.change_drive(a, gain=drive.gain * factor, bias=(b0, b1, b2))


def _own_kp(place: Place) -> float:
    """Return what a servo does per length of its own."""
    return -float(place.machine.compiled.actuator_biasprm[place.actuator, 1])


def _kp(rng: np.random.Generator, place: Place) -> Concealed:
    unit = _servo_unit(place, "N m/rad")
    return Concealed("servo_kp", "actuator", place.site, 0.05 * _own_kp(place) * sign(rng), unit)


def _compose_kp(draft: Draft, c: Concealed) -> None:
    a = _at(draft, c)
    drive = draft.drives[a]
    b0, b1, b2 = drive.bias
    gain = drive.gain - c.value * (drive.gain / b1)  # the goal (gain u + b0) / -b1 stays
    draft.change_drive(a, gain=gain, bias=(b0 - c.value * (b0 / b1), b1 - c.value, b2))


def _kd(rng: np.random.Generator, place: Place) -> Concealed:
    kd = -float(place.machine.compiled.actuator_biasprm[place.actuator, 2])
    unit = _servo_unit(place, "N m s/rad")
    return Concealed("servo_kd", "actuator", place.site, 0.05 * kd * sign(rng), unit)


def _compose_kd(draft: Draft, c: Concealed) -> None:
    a = _at(draft, c)
    b0, b1, b2 = draft.drives[a].bias
    draft.change_drive(a, bias=(b0, b1, b2 - c.value))


def _servo_unit(place: Place, unit: str) -> str:
    m = place.machine.compiled
    return place.unit(unit, int(m.jnt_dofadr[m.actuator_trnid[place.actuator, 0]]))


def _kp_most(place: Place) -> float:
    return 0.7 * _own_kp(place)


def _kd_most(place: Place) -> float:
    return -0.7 * float(place.machine.compiled.actuator_biasprm[place.actuator, 2])


def _saturation(rng: np.random.Generator, place: Place) -> Concealed:
    """The value is what is lost of the largest force commanded, which is known at the end."""
    effort = float(place.scales.effort[place.actuator])
    unit = _servo_unit(place, "N m")
    details = {"of": effort}
    return Concealed("actuator_saturation", "actuator", place.site, 0.3 * effort, unit, details)


def _compose_saturation(draft: Draft, c: Concealed) -> None:
    draft.change_drive(_at(draft, c), limit=c.details["of"] - c.value)


def _deadzone(rng: np.random.Generator, place: Place) -> Concealed:
    value = 0.1 * float(place.scales.command[place.actuator])
    return Concealed("actuator_deadzone", "actuator", place.site, value, "control units")


def _lag(rng: np.random.Generator, place: Place) -> Concealed:
    return Concealed("actuator_lag", "actuator", place.site, 0.005, "s")


def _delay(rng: np.random.Generator, place: Place) -> Concealed:
    return Concealed("actuator_delay", "actuator", place.site, 0.004, "s")


def _slowest(place: Place) -> float:
    servo = place.site in _servos(place.machine)
    return 0.1 if servo else 0.06


def _channels(machine: ProofMachine) -> tuple[str, ...]:
    return tuple(f"qpos.{j}" for j in joints(machine))


def _sensor_delay(rng: np.random.Generator, place: Place) -> Concealed:
    return Concealed("sensor_delay", "channel", place.site, 0.003, "s")


def _compose_sensor_delay(draft: Draft, c: Concealed) -> None:
    draft.change_encoder(draft.machine.dof(c.site.removeprefix("qpos.")), delay=c.value)


def _offset(rng: np.random.Generator, place: Place) -> Concealed:
    value = 0.03 * float(place.scales.travel[place.dof]) * sign(rng)
    return Concealed("encoder_offset", "joint", place.site, value, place.unit("rad"))


def _compose_encoder(draft: Draft, c: Concealed) -> None:
    """Change what the encoder reads, and with it what a servo on the joint follows."""
    field = "offset" if c.effect == "encoder_offset" else "scale"
    draft.change_encoder(draft.machine.dof(c.site), **{field: c.value})
    a = draft.machine.actuator_on(c.site)
    if a is not None and draft.drives[a].servo:
        draft.change_drive(a, **{field: c.value})


def _most_offset(place: Place) -> float:
    return 0.4 * (1.0 if place.unit("rad") == "rad" else float(place.scales.span[place.dof]))


def _scale(rng: np.random.Generator, place: Place) -> Concealed:
    return Concealed("encoder_scale", "joint", place.site, 0.02 * sign(rng), "relative")


def _bodies(machine: ProofMachine) -> tuple[str, ...]:
    m = machine.compiled
    moving = [b for b in range(1, m.nbody) if m.body_dofnum[b] and m.body_mass[b] > 1e-9]
    return tuple(str(m.body(b).name) for b in moving if m.body(b).name)


def _loaded(machine: ProofMachine) -> tuple[str, ...]:
    m = machine.compiled
    return tuple(b for b in _bodies(machine) if end_of(m, b) is not None)


def _mass(place: Place) -> float:
    return float(place.machine.compiled.body(place.site).mass[0])


def _most_mass(place: Place) -> float:
    return 0.8 * _mass(place)


def _payload(rng: np.random.Generator, place: Place) -> Concealed:
    return Concealed("payload", "body", place.site, 0.05 * _mass(place), "kg")


def _compose_payload(draft: Draft, c: Concealed) -> None:
    at = end_of(draft.model, c.site)
    if at is None:
        raise ValueError(f"{c.site} has no end to hold a load")
    add_mass(draft.model, c.site, c.value, at)


def _link_mass(rng: np.random.Generator, place: Place) -> Concealed:
    return Concealed("link_mass", "body", place.site, 0.05 * _mass(place) * sign(rng), "kg")


def _compose_link_mass(draft: Draft, c: Concealed) -> None:
    own = float(draft.model.body(c.site).mass[0])
    scale_body(draft.model, c.site, 1.0 + c.value / own)


def _tilt(rng: np.random.Generator, place: Place) -> Concealed:
    felt = _felt_tilts(place)
    angle = rng.uniform(-np.pi, np.pi)
    x, y = np.cos(angle) * felt[0], np.sin(angle) * felt[1]
    x, y = (x, y) if all(felt) else (np.sign(x), np.sign(y))
    details = {"about x": 0.02 * float(x), "about y": 0.02 * float(y)}
    return Concealed("gravity_tilt", "world", "world", 0.02, "rad", details)


def _felt_tilts(place: Place) -> tuple[bool, bool]:
    """Return about which horizontal axes a tilt is felt to first order."""
    model = place.machine.compiled
    data, rng = mujoco.MjData(model), np.random.default_rng(0)
    felt = [0.0, 0.0]
    for _ in range(5):
        data.qpos[:] = rng.normal(0, 0.5, model.nq)
        torques = []
        for about in ((0.0, 0.0), (1e-3, 0.0), (0.0, 1e-3)):
            gravity = model.opt.gravity.copy()
            tilt(model, *about)
            mujoco.mj_forward(model, data)
            model.opt.gravity[:] = gravity
            torques.append(data.qfrc_bias.copy())
        felt = [
            max(f, float(np.abs(x - torques[0]).max()))
            for f, x in zip(felt, torques[1:], strict=True)
        ]
    scale = max(felt)
    return felt[0] > 0.01 * scale, felt[1] > 0.01 * scale


def _ground(machine: ProofMachine) -> tuple[str, ...]:
    if not machine.file.contact:
        return ()
    m = machine.compiled
    planes = [g for g in range(m.ngeom) if int(m.geom_type[g]) == int(mujoco.mjtGeom.mjGEOM_PLANE)]
    return tuple(str(m.geom(g).name) for g in planes[:1] if m.geom(g).name)


def _grip(rng: np.random.Generator, place: Place) -> Concealed:
    own = float(place.machine.compiled.geom(place.site).friction[0])
    value = 0.2 * own * sign(rng)
    return Concealed("contact_friction", "geom", place.site, value, "coefficient")


def _compose_grip(draft: Draft, c: Concealed) -> None:
    """Change the sliding friction of every contact of the ground, which then takes priority."""
    g = draft.model.geom(c.site).id
    touching = draft.model.geom_contype != 0
    grip = float(draft.machine.compiled.geom_friction[touching, 0].max()) + c.value
    draft.model.geom_friction[g, 0] = max(grip, 0.0)
    draft.model.geom_priority[g] = int(draft.model.geom_priority.max()) + 1
    settle(draft.model)


for _item in (
    Realised("actuator_gain", _actuators, _gain, _compose_gain, lambda place: 0.6),
    Realised("servo_kp", _servos, _kp, _compose_kp, _kp_most),
    Realised("servo_kd", _servos, _kd, _compose_kd, _kd_most),
    Realised(
        "actuator_saturation", _actuators, _saturation, _compose_saturation,
        lambda place: 0.9 * float(place.scales.effort[place.actuator]),
    ),
    Realised(
        "actuator_deadzone", _motors, _deadzone,
        lambda draft, c: draft.change_drive(_at(draft, c), deadzone=c.value),
        lambda place: 0.8 * float(place.scales.command[place.actuator]),
    ),
    Realised(
        "actuator_lag", _actuators, _lag,
        lambda draft, c: draft.change_drive(_at(draft, c), lag=c.value), _slowest,
    ),
    Realised(
        "actuator_delay", _actuators, _delay,
        lambda draft, c: draft.change_drive(_at(draft, c), delay=c.value), _slowest,
    ),
    Realised(
        "sensor_delay", _channels, _sensor_delay, _compose_sensor_delay,
        lambda place: 0.05,
    ),
    Realised(
        "encoder_offset", joints, _offset, _compose_encoder,
        _most_offset,
    ),
    Realised("encoder_scale", joints, _scale, _compose_encoder, lambda place: 0.4),
    Realised("payload", _loaded, _payload, _compose_payload, lambda p: 3 * _mass(p)),
    Realised("link_mass", _bodies, _link_mass, _compose_link_mass, _most_mass),
    Realised(
        "gravity_tilt", lambda machine: ("world",), _tilt,
        lambda draft, c: tilt(draft.model, c.details["about x"], c.details["about y"]),
        lambda place: 0.5, along=("about x", "about y"),
    ),
    Realised("contact_friction", _ground, _grip, _compose_grip,
        lambda p: 0.9 * float(p.machine.compiled.geom(p.site).friction[0]), tiers=(2,)),
):  # fmt: skip
    realised(_item)
