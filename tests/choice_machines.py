"""Machines with known physics missing, for the tests of the choice between sets."""

from diagnosis_helpers import ARM, SIGMA, arm

from bo_sysid.diagnosis.search.locate import Located, locate
from bo_sysid.diagnosis.windows.evidence import make_evidence
from bo_sysid.effects import CATALOGUE
from bo_sysid.mjcf import Model


def located(*recordings, effects) -> Located:
    noise = {"qpos": SIGMA}
    chosen = [CATALOGUE[e] for e in effects]
    return locate(make_evidence(arm(), recordings, effects=chosen, noise=noise, threads=1))


def walled() -> Model:
    """Return the arm between two walls that its hand reaches at .4 rad."""
    walls = "".join(
        f'<geom type="box" size=".01 1 1" pos="{x} 0 -.5" contype="1" conaffinity="1"/>'
        for x in (-0.2, 0.2)
    )
    text = ARM.read_text().replace("<worldbody>", f"<worldbody>{walls}", 1)
    return Model.from_xml(text.replace('mass="0.6"', 'mass="0.6" contype="1" conaffinity="1"'))
