"""Compile a spec, with MuJoCo's complaints turned into messages for the user."""

import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from math import ceil

import mujoco
import numpy as np

from bo_sysid.errors import ModelError
from bo_sysid.mjcf.joints import QPOS_SIZE, QVEL_SIZE


def compile_spec(spec: mujoco.MjSpec, source: str, after: str = "") -> mujoco.MjModel:
    """Compile `spec`.

    Args:
        spec: the spec; its elements' ids are valid afterwards.
        source: where the model comes from, for the message.
        after: what was done to the model before, for the message; such a model may be singular
            without a warning.

    Raises:
        ModelError: MuJoCo refuses the model.
    """
    with _settotalmass_accepted():
        if after:  # many models are tried; of the one that was read it is said
            warnings.filterwarnings("ignore", message="Inertia matrix is too close to singular")
        try:
            return spec.compile()
        except (ValueError, mujoco.FatalError) as error:
            raise ModelError(
                f"{source}: the model does not compile{after}: {mujoco_message(error)}"
            ) from None


def spec_xml(spec: mujoco.MjSpec) -> str:
    """Return a spec as MJCF."""
    with _settotalmass_accepted():
        return str(spec.to_xml())


@contextmanager
def _settotalmass_accepted() -> Iterator[None]:
    """Silence that `settotalmass` is deprecated.

    It still works, and is released before any mass is edited (inertia.py).
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", message="compiler attribute 'settotalmass'")
        yield


def mujoco_message(error: Exception) -> str:
    """Return MuJoCo's message as one line."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return ", ".join(lines).removeprefix("Error: ")


def refit_keyframes(spec: mujoco.MjSpec, before: mujoco.MjModel, source: str) -> None:
    """Give keyframes the sizes of a spec whose joints or actuators changed.

    A joint or an actuator that is still there keeps its values; a new one starts at its reference
    position, at rest, with zero activation and control.

    Args:
        spec: the changed spec, whose keyframes have the sizes of `before`.
        before: the model compiled before the change.
        source: where the model comes from, for messages.
    """
    held = [(key, {f: np.array(getattr(key, f)) for f in _KEY_FIELDS}) for key in spec.keys]
    for key, _ in held:
        for field in _KEY_FIELDS:
            setattr(key, field, [])
    after = compile_spec(spec, source)
    start = {"qpos": after.qpos0, "qvel": np.zeros(after.nv), "act": np.zeros(after.na)}
    start["ctrl"] = np.zeros(after.nu)
    old, new = _slices(before), _slices(after)
    for key, values in held:
        for field, value in values.items():
            if not value.size:
                continue
            full = start[field].copy()
            for name in old[field].keys() & new[field].keys():
                if old[field][name][1] == new[field][name][1]:
                    (i, n), (k, _) = old[field][name], new[field][name]
                    full[k : k + n] = value[i : i + n]
            setattr(key, field, full.tolist())


def delays(spec: mujoco.MjSpec) -> dict[tuple[bool, str], float]:
    """Return the delays in [s] of actuators (True) and sensors (False) by name."""
    return {
        (actuates, element.name): float(element.delay)
        for actuates, elements in ((True, spec.actuators), (False, spec.sensors))
        for element in elements
    }


def keep_delays(
    spec: mujoco.MjSpec, step: float, written: Mapping[tuple[bool, str], float]
) -> None:
    """Give delayed actuators and sensors buffers that last at a finer step or a longer delay.

    MuJoCo holds `nsample` values, one for each step, and answers a question about earlier ones with
    the oldest: without this a delay shrinks with the step, and none is longer than the buffer.

    Args:
        spec: the changed spec.
        step: the time step for which its buffers were made, in [s].
        written: the `delays` for which they were made.
    """
    finer = spec.option.timestep < step
    for actuates, elements in ((True, spec.actuators), (False, spec.sensors)):
        for e in elements:
            longer = finer or e.delay > written.get((actuates, e.name), 0.0)
            if e.delay > 0 and e.nsample > 0 and longer:
                make_room(spec, e, e.delay)


def make_room(
    spec: mujoco.MjSpec, element: mujoco.MjsActuator | mujoco.MjsSensor, delay: float
) -> None:
    """Give an actuator or a sensor a buffer that is long enough for a delay in [s]."""
    element.nsample = max(element.nsample, ceil(delay / spec.option.timestep) + 1)


_KEY_FIELDS = ("qpos", "qvel", "act", "ctrl")


def _slices(model: mujoco.MjModel) -> dict[str, dict[str, tuple[int, int]]]:
    """Return for each state field the first index and the size of each joint or actuator."""
    return {
        field: {name: (start, size) for name, start, size in coordinates(model, field)}
        for field in _KEY_FIELDS
    }


def coordinates(model: mujoco.MjModel, field: str) -> list[tuple[str, int, int]]:
    """Return (element, first index, size) for "qpos", "qvel", "act", "ctrl" or "sensor".

    Elements without a coordinate in the field are left out; the order is MuJoCo's.
    """
    if field in ("qpos", "qvel"):
        sizes = QPOS_SIZE if field == "qpos" else QVEL_SIZE
        address = model.jnt_qposadr if field == "qpos" else model.jnt_dofadr
        rows = [
            (model.joint(i).name, int(address[i]), sizes[int(model.jnt_type[i])])
            for i in range(model.njnt)
        ]
    elif field == "sensor":
        rows = [
            (model.sensor(i).name, int(model.sensor_adr[i]), int(model.sensor_dim[i]))
            for i in range(model.nsensor)
        ]
    else:
        address = model.actuator_actadr if field == "act" else model.actuator_ctrladr
        number = model.actuator_actnum if field == "act" else model.actuator_ctrlnum
        rows = [
            (model.actuator(i).name, int(address[i]), int(number[i])) for i in range(len(address))
        ]
    return [row for row in rows if row[2] > 0]


def differ(one: mujoco.MjModel, two: mujoco.MjModel) -> bool:
    """Whether two compiled models differ in anything."""
    size = mujoco.mj_sizeModel(one)
    if size != mujoco.mj_sizeModel(two):
        return True
    buffers = [np.empty(size, np.uint8) for _ in range(2)]
    mujoco.mj_saveModel(one, None, buffers[0])
    mujoco.mj_saveModel(two, None, buffers[1])
    return bool((buffers[0] != buffers[1]).any())
