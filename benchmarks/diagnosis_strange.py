"""Physics outside the catalogue, for the benchmark of the diagnosis."""

import numpy as np

from bo_sysid.effects import Force, Machine

STRANGE = ("magnet", "worn_spot", "warming", "cable")


def strange_force(kind: str, machine: Machine, joint: str, size: float, at: float) -> Force:
    """Return physics outside the catalogue.

    Args:
        kind: a magnet near one angle, a spot of more friction, friction that fades as it warms
            up, a cable that pulls one joint when another moves.
        machine: gives the scales.
        joint: where.
        size: in units of the joint's typical force.
        at: where in the joint's range, 0 to 1.
    """
    j = machine.joints[joint]
    centre, width, force = j.middle + (at - 0.5) * 0.5 * j.span, 0.08 * j.span, size * j.force
    other = next((n for n in machine.joints if n != joint), joint)
    far = machine.joints[other]

    def slip(m) -> np.ndarray:
        return np.tanh(m.qvel[joint] / (1e-3 * j.speed))

    def magnet(m) -> np.ndarray:
        z = (m.qpos[joint] - centre) / width
        return -force * 2.0 * z * np.exp(-(z**2))

    def worn_spot(m) -> np.ndarray:
        z = (m.qpos[joint] - centre) / (1.5 * width)
        return -force * slip(m) * np.exp(-(z**2))

    def warming(m) -> np.ndarray:
        return -force * slip(m) * (0.3 + np.exp(-m.time / 6.0))

    def cable(m) -> np.ndarray:
        z = (m.qpos[other] - far.middle) / far.spread
        return force * (z + 0.5 * z**2)

    laws = {"magnet": magnet, "worn_spot": worn_spot, "warming": warming, "cable": cable}
    return Force(joint, laws[kind])
