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
    driven = duty * now.signals["aux.voltage"] - INDUCED * now.qvel["pendulum"]
    return np.where(now.signals["aux.torque_enable"] > 0.5, driven, 0.0)
