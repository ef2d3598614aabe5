"""The law of a Dynamixel XL-330 in position mode, as its manual and its bridge say.

The servo sets the duty of its bridge in proportion to the position error, counted in encoder
ticks; what the windings feel is that share of the bus voltage, less what the turning motor induces.
With the torque off the bridge is open: no current flows.
"""

import numpy as np

from bo_sysid.simulation import LawInputs

TICKS = 4096 / (2 * np.pi)  # a turn of the encoder
FULL_DUTY = 256 * 885  # gain's divisor times the register of a bridge that is always on
INDUCED = 0.354  # V s/rad: stall torque over stall current, 0.52 N m / 1.47 A


def voltage(now: LawInputs) -> np.ndarray:
    """Return the voltage across the windings in [V]."""
    error = now.signals["goal.motor"] - now.qpos["pendulum"]
    duty = np.clip(now.signals["aux.kp"] * error * TICKS / FULL_DUTY, -1.0, 1.0)
    return _across_windings(now, duty)


def voltage_of_measured_duty(now: LawInputs) -> np.ndarray:
    """Return the same with the duty that the servo reported: the position loop stays open."""
    return _across_windings(now, now.signals["aux.duty"])


def _across_windings(now: LawInputs, duty: np.ndarray) -> np.ndarray:
    driven = duty * now.signals["aux.voltage"] - INDUCED * now.qvel["pendulum"]
    return np.where(now.signals["aux.torque_enable"] > 0.5, driven, 0.0)
