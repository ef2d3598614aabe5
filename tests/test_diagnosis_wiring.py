"""Signs and swaps of channels: what no slope leads to, beside missing physics as well."""

from dataclasses import replace

import pytest
from diagnosis_helpers import SIGMA, arm, record

from bo_sysid.diagnosis.answer.findings import findings
from bo_sysid.diagnosis.search.locate import Located, locate
from bo_sysid.diagnosis.windows.evidence import make_evidence
from bo_sysid.effects import CATALOGUE
from bo_sysid.recording import Recording

LOOKED_FOR = (
    "viscous_damping", "dry_friction", "armature", "joint_spring", "payload", "actuator_gain",
    "encoder_offset", "encoder_scale", "sensor_sign", "channel_swap", "sensor_delay",
)  # fmt: skip
FRICTION = 0.12


def rewired(recording: Recording, wiring: str) -> Recording:
    """Return a recording of an arm with the elbow's sign turned, or both positions swapped."""
    shoulder, elbow = (recording.channels[f"qpos.{j}"] for j in ("shoulder", "elbow"))
    shown = {"qpos.shoulder": shoulder, "qpos.elbow": replace(elbow, values=-elbow.values)}
    if wiring == "swap":
        shown = {"qpos.shoulder": elbow, "qpos.elbow": shoulder}
    return replace(recording, channels={**recording.channels, **shown})


def found(recording: Recording) -> Located:
    effects = [CATALOGUE[name] for name in LOOKED_FOR]
    noise = {"qpos": SIGMA}
    return locate(make_evidence(arm(), [recording], effects=effects, noise=noise, threads=1))


@pytest.mark.parametrize(
    ("wiring", "key", "told"),
    [
        ("sign", ("sensor_sign", "qpos.elbow"), "Channel qpos.elbow counts the other way; `sign"),
        ("swap", ("channel_swap", "qpos.shoulder"),
         "Channel qpos.shoulder is swapped with qpos.elbow; exchange"),
    ],
)  # fmt: skip
def test_a_wrong_wiring_is_named(wiring: str, key: tuple[str, str], told: str) -> None:
    """The other joint's sign was named for one, and a rotor for the other."""
    located = found(rewired(record(duration=4.0), wiring))
    decision = located.decision
    assert [c.key for c in decision.best.members] == [key]
    assert decision.best.rms < 1.05
    (finding,) = findings(decision.best, located.evidence.machine, 1.0)
    assert finding.sentence.startswith(told)
    assert (finding.quantity.value, *finding.quantity.interval) == (1.0, 1.0, 1.0)


def test_a_swap_is_named_beside_friction() -> None:
    rubbing = record([("dry_friction", "joint", "elbow", [FRICTION, 0.0])], duration=4.0)
    best = found(rewired(rubbing, "swap")).decision.best
    magnitudes = {c.key: x[0] for c, x in zip(best.members, best.x, strict=True)}
    assert magnitudes.keys() == {("channel_swap", "qpos.shoulder"), ("dry_friction", "elbow")}
    assert magnitudes["dry_friction", "elbow"] == pytest.approx(FRICTION, rel=0.03)
