"""Logs whose wiring is wrong in a known way, for `benchmarks/check.py`.

A machine is simulated at a fourth of the model's step, with masses, damping and dry friction that
the model does not know; its log is sampled, noisy, and then spoilt as logs are spoilt: a sign, a
unit, an order, commands in the place of measurements, another clock, an encoder's zero.
"""

from dataclasses import dataclass, field, replace
from math import pi
from pathlib import Path

import mujoco
import numpy as np

from bo_sysid.mjcf import Model
from bo_sysid.recording import Channel, Recording
from bo_sysid.simulation import Engine, State

MODELS = Path(__file__).parent.parent / "studies" / "diagnosis"
SECONDS = 16.0


@dataclass(frozen=True)
class Machine:
    """A machine that logs come from.

    Attributes:
        file: its model in studies/diagnosis.
        drive: amplitude of each actuator's control.
        zeroed: joints whose zero acts on the motion (gravity, or links that follow).
        plain: a unit of the controls other than SI, with its factor.
    """

    file: str
    drive: dict[str, float]
    zeroed: tuple[str, ...]
    plain: tuple[tuple[str, float], ...]

    def model(self) -> Model:
        """Return the nominal model."""
        return Model.from_file(MODELS / self.file)


MILLI = ("mN m", 1e-3)
MACHINES = {
    "two_link_arm": Machine(
        "two_link_arm.xml",
        {"shoulder": 2.0, "elbow": 0.8},
        ("shoulder", "elbow"),
        (MILLI,),
    ),
    "cart_pole": Machine("cart_pole.xml", {"belt": 0.6}, ("hinge",), (("%", 1e-2),)),
    "rotary_pendulum": Machine(
        "rotary_pendulum.xml", {"motor": 0.6}, ("pendulum",), (("PWM", 1 / 255),)
    ),
    "six_joint_arm": Machine(
        "six_joint_arm_servos.xml",
        dict.fromkeys(("base", "shoulder", "elbow", "roll", "pitch", "flange"), 0.6),
        ("shoulder", "elbow"),
        (("deg", pi / 180),),
    ),
}


@dataclass(frozen=True)
class Log:
    """A recording and what is wrong with it.

    Attributes:
        machine: name of the machine.
        recording: as a user has it.
        wrong: what was done, in words; empty for a clean log.
        rules: by channel, what reads it right: (from, sign, scale, offset).
        shift: what is to be added to the stamps of the controls, in [s].
    """

    machine: str
    recording: Recording
    wrong: tuple[str, ...] = ()
    rules: dict[str, tuple[str, int, float, float]] = field(default_factory=dict)
    shift: float = 0.0


def make(seed: int, *, clean: bool) -> Log:
    """Return the log of one seed: 0 to 3 are one of each machine, and so on."""
    rng = np.random.default_rng((seed, int(clean), 20_931))
    name = list(MACHINES)[seed % len(MACHINES)]
    machine = MACHINES[name]
    log = Log(name, _recorded(machine, rng))
    if clean:
        return log
    kinds = [_sign, _unit, _order, _swapped, _shifted, _zeroed]
    spoil = kinds[(seed // len(MACHINES)) % len(kinds)]
    log = spoil(log, machine, rng)
    if spoil not in (_shifted, _swapped) and rng.random() < 0.3:
        log = _shifted(log, machine, rng)
    return log


def _recorded(machine: Machine, rng: np.random.Generator) -> Recording:
    """Simulate the machine and return what its sensors say."""
    model = machine.model()
    spec = model.spec()
    for body in spec.bodies[1:]:
        for geom in body.geoms:
            geom.mass *= rng.uniform(0.9, 1.1)
    compiled = model.compile()
    for joint in spec.joints:
        scale = compiled.dof_M0[compiled.joint(joint.name).dofadr[0]]
        joint.damping[0] += scale * rng.uniform(0.0, 0.5)
        joint.frictionloss = scale * rng.uniform(0.0, 0.4)
    spec.option.timestep = 0.0005
    plant = spec.compile()
    dt = float(rng.choice([0.002, 0.004, 0.005]))
    hold = round(dt / plant.opt.timestep)
    rows = round(SECONDS / dt)
    time = np.arange(rows) * dt
    ctrl = np.stack(
        [machine.drive[plant.actuator(a).name] * _tones(time, rng) for a in range(plant.nu)], axis=1
    )
    start = State(np.zeros((1, plant.nq)), np.zeros((1, plant.nv)), np.zeros((1, plant.na)))
    done = Engine(1).rollout(plant, start, np.repeat(ctrl, hold, axis=0)[None])
    qpos, qvel = done.qpos[0, ::hold][:rows], done.qvel[0, ::hold][:rows]
    sigma = 10 ** rng.uniform(-4, -3)
    kinds: dict[str, dict[str, np.ndarray]] = {"qpos": {}, "ctrl": {}}
    for j in range(plant.njnt):
        slide = int(plant.jnt_type[j]) == int(mujoco.mjtJoint.mjJNT_SLIDE)
        noise = sigma * (0.2 if slide else 1.0) * rng.standard_normal(rows)
        kinds["qpos"][plant.joint(j).name] = qpos[:, j] + noise
    for a in range(plant.nu):
        kinds["ctrl"][plant.actuator(a).name] = ctrl[:, a]
    if rng.random() < 0.5:
        kinds["qvel"] = {
            plant.joint(j).name: qvel[:, j] + 20 * sigma * rng.standard_normal(rows)
            for j in range(plant.njnt)
        }
    return Recording.from_arrays(time, name="log", **kinds)


def _tones(time: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a sum of sines of 0.15 to 2.5 Hz with a largest value of 1, faded in."""
    s = sum(
        np.sin(2 * pi * f * time + rng.uniform(0, 2 * pi))
        for f in np.exp(rng.uniform(np.log(0.15), np.log(2.5), 6))
    )
    return np.asarray(s / np.abs(s).max() * np.minimum(time / 0.5, 1.0))


def _changed(
    log: Log, values: dict[str, np.ndarray], wrong: str, rules: dict, **more: float
) -> Log:
    channels = dict(log.recording.channels)
    for name, v in values.items():
        c = channels[name]
        channels[name] = Channel(c.time, v, c.unit, c.source, c.hold)
    recording = Recording(log.recording.name, channels)
    return replace(
        log, recording=recording, wrong=(*log.wrong, wrong), rules={**log.rules, **rules}, **more
    )


def _values(log: Log, name: str) -> np.ndarray:
    return log.recording.channels[name].values


def _with_speed(log: Log, rng: np.random.Generator, joints: list[str]) -> list[str]:
    """Return the position channels of joints, and the speeds where the driver derives them."""
    speeds = [f"qvel.{j}" for j in joints if f"qvel.{j}" in log.recording.channels]
    derived = bool(rng.random() < 0.5)
    return [f"qpos.{j}" for j in joints] + (speeds if derived else [])


def _sign(log: Log, machine: Machine, rng: np.random.Generator) -> Log:
    """Turn the sign of a joint's encoder or of a command."""
    model = machine.model()
    name = str(rng.choice([*model.qpos_channels, *model.ctrl_channels]))
    kind, element = name.split(".")
    names = _with_speed(log, rng, [element]) if kind == "qpos" else [name]
    return _changed(
        log, {n: -_values(log, n) for n in names}, f"sign of {', '.join(names)}",
        {n: (n, -1, 1.0, 0.0) for n in names},
    )  # fmt: skip


def _unit(log: Log, machine: Machine, rng: np.random.Generator) -> Log:
    """Write all positions of hinges, one position, or all commands, in another unit."""
    model = machine.model()
    compiled = model.compile()
    hinge = int(mujoco.mjtJoint.mjJNT_HINGE)
    kinds = {j: int(compiled.joint(j).type[0]) == hinge for j in model.joints}
    which = int(rng.integers(3))
    if which == 0:
        joints = [j for j, turns in kinds.items() if turns]
    else:
        joints = [str(rng.choice(list(kinds)))]
    if which < 2:
        factor = {j: pi / 180 if kinds[j] else 1e-3 for j in joints}
        names = {n: factor[n.split(".")[1]] for n in _with_speed(log, rng, joints)}
    else:
        names = dict.fromkeys(model.ctrl_channels, machine.plain[0][1])
    return _changed(
        log, {n: _values(log, n) / f for n, f in names.items()}, f"unit of {', '.join(names)}",
        {n: (n, 1, f, 0.0) for n, f in names.items()},
    )  # fmt: skip


def _order(log: Log, machine: Machine, rng: np.random.Generator) -> Log:
    """Permute the joints, or the actuators."""
    model = machine.model()
    joints, actuators = list(model.joints), list(model.actuators)
    of_joints = len(actuators) < 2 or rng.random() < 0.5
    names = joints if of_joints else actuators
    shuffled = names
    while shuffled == names:
        shuffled = [str(n) for n in rng.permutation(names)]
    kinds = (
        ["qpos", *(["qvel"] if log.recording.of_kind("qvel") else [])] if of_joints else ["ctrl"]
    )
    values, rules = {}, {}
    for kind in kinds:
        for name, other in zip(names, shuffled, strict=True):
            values[f"{kind}.{name}"] = _values(log, f"{kind}.{other}")
            if name != other:
                rules[f"{kind}.{other}"] = (f"{kind}.{name}", 1, 1.0, 0.0)
    return _changed(log, values, f"order of {' and '.join(kinds)}", rules)


def _swapped(log: Log, machine: Machine, rng: np.random.Generator) -> Log:
    """Put commands where measurements belong, and the other way round."""
    model = machine.model()
    compiled = model.compile()
    pairs = [
        (model.joints[int(compiled.actuator_trnid[a, 0])], n) for a, n in enumerate(model.actuators)
    ]
    values, rules = {}, {}
    for joint, actuator in pairs:
        q, u = f"qpos.{joint}", f"ctrl.{actuator}"
        values |= {q: _values(log, u), u: _values(log, q)}
        rules |= {q: (u, 1, 1.0, 0.0), u: (q, 1, 1.0, 0.0)}
    return _changed(log, values, "commands and positions swapped", rules)


def _zeroed(log: Log, machine: Machine, rng: np.random.Generator) -> Log:
    """Move the zero of one encoder; the goal of a servo moves along in half of the logs."""
    joint = str(rng.choice(machine.zeroed))
    offset = float(rng.choice([-1, 1]) * rng.uniform(0.1, 0.8))
    names = [f"qpos.{joint}"]
    if machine.file.endswith("servos.xml") and rng.random() < 0.5:
        names.append(f"ctrl.{joint}")
    return _changed(
        log, {n: _values(log, n) + offset for n in names}, f"zero of {', '.join(names)}",
        {n: (n, 1, 1.0, -offset) for n in names},
    )  # fmt: skip


def _shifted(log: Log, machine: Machine, rng: np.random.Generator) -> Log:
    """Give the commands a clock that is 0 to 80 ms late or early."""
    shift = float(rng.uniform(0.0, 0.08) * rng.choice([-1, 1]))
    channels = dict(log.recording.channels)
    for name, c in channels.items():
        if name.startswith("ctrl."):
            channels[name] = Channel(c.time - shift, c.values, c.unit, c.source, c.hold)
    return replace(
        log,
        recording=Recording(log.recording.name, channels),
        wrong=(*log.wrong, f"clock of the commands, {1e3 * shift:.1f} ms"),
        shift=shift,
    )
