"""An effect of your own: a spot of a joint's range where it is worn and grips harder.

Name this file in a study (diagnosis: {effect_files: [my_effect.py]}) and run it with
--trust-code; the diagnosis then tries the effect at every joint like any of its own.
"""

import mujoco
import numpy as np

from bo_sysid.effects import Component, Extent, Force, Machine, Motion, Part, Site, effect

SPOTS = 5  # places over the joint's range at which the spot is looked for
WIDTH = 0.06  # of that range


def extent(site: Site, machine: Machine) -> Extent:
    """Return how large the effect can be, from how strong the joint is and how far it moves."""
    joint = machine.joints[site.name]
    probe, most = 0.05 * joint.force, 5 * joint.force
    low, high = joint.middle - 0.5 * joint.span, joint.middle + 0.5 * joint.span
    places = np.linspace(low, high, SPOTS)
    return Extent(
        (probe, joint.middle), (0.0, low), (most, high), tuple((probe, float(p)) for p in places)
    )


@effect(
    "worn_spot",
    kind="joint",
    components=(Component("friction", "N m"), Component("place", "rad")),
    shapes=1,  # the place: what the joint does is not linear in it
    extent=extent,
    noun="a worn spot",
    sentence="{site} has a worn spot with friction of {value}.",
    form="force law",
    evidence="friction at one place of the range",
    separation="slow moves across the place in both directions",
)
def worn_spot(spec: mujoco.MjSpec, site: Site, x: np.ndarray, machine: Machine) -> Part:
    """Friction x[0] against the motion near the position x[1].

    What MJCF can say is an edit of `spec`, as in spec.joint(site.name).frictionloss += x[0];
    a force that it cannot say is a law of the motion.
    """
    joint = machine.joints[site.name]

    def law(motion: Motion) -> np.ndarray:
        q, v = motion.qpos[site.name], motion.qvel[site.name]
        near = np.exp(-(((q - x[1]) / (WIDTH * joint.span)) ** 2))
        return -x[0] * near * np.tanh(v / (0.02 * joint.speed))

    return Force(site.name, law)
