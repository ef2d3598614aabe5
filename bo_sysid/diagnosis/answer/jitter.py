"""Stamps that jitter: they may be when a log was written, and not when samples were taken."""

from math import sqrt

from bo_sysid.diagnosis.answer.wording import spoken
from bo_sysid.diagnosis.windows.evidence import Evidence
from bo_sysid.effects import Site
from bo_sysid.recording.alignment import Sampling

_SHOWN = 0.5  # [sigma] by which a joint moves in the jitter of its stamps, from which it is told


def jitter_sentence(evidence: Evidence) -> str:
    """Return that jitter of stamps may be what is left, in words; empty where it is too small.

    A joint of speed v that is sampled δt beside its stamp is off by v δt. Intervals jitter by √2
    times what each of their two stamps does.
    """
    most, worst, late = 0.0, "", 0.0
    for recording in evidence.recordings:
        for name, joint in evidence.machine.joints.items():
            channel, sigma = recording.channels.get(f"qpos.{name}"), evidence.sigma
            if channel is None or not sigma.get(f"qpos.{name}"):
                continue
            jitter = Sampling.of(channel.time).jitter / sqrt(2)
            moved = joint.speed * jitter / sigma[f"qpos.{name}"]
            if moved > most:
                most, worst, late = moved, name, jitter
    if most < _SHOWN:
        return ""
    return (
        f"Stamps jitter by {1e3 * late:.2g} ms, in which {spoken(Site('joint', worst))} moves by "
        f"{most:.2g} of its sensor's sigmas: where they say when the log was written, and not when "
        "samples were taken, that alone is left, and nothing acts on the machine. Stamp samples "
        "where they are taken, or count them (`columns: {time: {rate: …}}`)."
    )
