"""Machines of the benchmark of the diagnosis, how they are driven, and how logs are written."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from bo_sysid.mjcf import Model

MODELS = Path(__file__).parents[1] / "studies" / "diagnosis"


@dataclass(frozen=True)
class Rig:
    """A machine with the way it is driven.

    Attributes:
        file: its model, or domain and task of dm_control.
        drive: amplitude of each control, or of each goal where a loop is closed around motors.
        gains: proportional and derivative gain of that loop, None for open loop.
        fastest: highest frequency of the excitation in [Hz].
        middle: centre of the goals.
        sampling: seconds between the rows of its logs, where nothing else is asked for.
    """

    file: str
    drive: tuple[float, ...]
    gains: tuple[tuple[float, ...], tuple[float, ...]] | None = None
    fastest: float = 1.5
    middle: tuple[float, ...] = ()
    sampling: float = 0.002


_SIX = (0.5, 0.4, 0.5, 0.7, 0.6, 0.8)
_POSE = (0.0, 0.4, 0.6, 0.0, 0.5, 0.0)
RIGS = {
    "two_link_arm": Rig("two_link_arm.xml", (1.5, 0.4)),
    "cart_pole": Rig("cart_pole.xml", (0.8,)),
    "rotary_pendulum": Rig("rotary_pendulum.xml", (0.25,)),
    "six_motors": Rig(
        "six_joint_arm_motors.xml",
        _SIX,
        ((120.0, 400.0, 200.0, 60.0, 40.0, 12.0), (7.0, 24.0, 12.0, 3.6, 2.4, 0.7)),
        1.0,
        _POSE,
    ),
    "six_bare": Rig(
        "six_joint_arm_bare.xml",
        _SIX,
        ((900.0, 1500.0, 900.0, 200.0, 120.0, 40.0), (40.0, 60.0, 36.0, 8.0, 5.0, 1.6)),
        1.0,
        _POSE,
    ),
    "six_servos": Rig("six_joint_arm_servos.xml", _SIX, None, 1.0, _POSE),
    "cheetah": Rig("cheetah run", (1.0,) * 6, None, 2.5, sampling=0.01),
    "hopper": Rig("hopper stand", (1.0,) * 4, None, 2.5, sampling=0.005),
}
CONTACT = ("cheetah", "hopper")


@dataclass(frozen=True)
class Log:
    """How a recording is written: seconds between rows, and the share that they vary by."""

    sampling: float = 0.002
    jitter: float = 0.0


LOGS = {
    "50 Hz": Log(0.02),
    "100 Hz": Log(0.01),
    "200 Hz, uneven": Log(0.005, 0.3),
    "300 Hz": Log(1 / 300),
    "1000 Hz": Log(0.001),
}


def load(rig: str) -> Model:
    if rig in CONTACT:
        return Model.from_dm_control(*RIGS[rig].file.split())
    return Model.from_file(MODELS / RIGS[rig].file)


def excitation(rng: np.random.Generator, rig: Rig, time: np.ndarray) -> np.ndarray:
    """Return a sum of six sines for each input, `T x nu`."""
    out = np.zeros((len(time), len(rig.drive)))
    for a, amplitude in enumerate(rig.drive):
        for _ in range(6):
            frequency, phase = rng.uniform(0.1, rig.fastest), rng.uniform(0, 2 * np.pi)
            out[:, a] += rng.normal() * np.cos(2 * np.pi * frequency * time + phase)
        out[:, a] *= amplitude / 3
    return out
