"""EMPS: an electric motor that moves a load along a ball screw, one degree of freedom.

Source: Janot, Gautier, Brunot, "Data set and reference models of EMPS", Workshop on Nonlinear
System Identification Benchmarks, 2019 (nonlinearbenchmark.org). 24 841 samples at 1 kHz in closed
loop; the second file adds pulses of force.

| channel | what | unit |
|---|---|---|
| ``qpos.x`` | position of the load, ``qm`` | m |
| ``ctrl.vir`` | output of the controller, ``vir``; motor force = 35.15065188 N/V times it | V |
| ``goal.vir`` | reference of the position loop, ``qg`` | m |
| ``aux.pulses`` | added pulses, ``pulses_N`` (second file only) | N |

Velocities were not recorded. Default split: DATA_EMPS trains, DATA_EMPS_PULSES is held out.
"""

from collections.abc import Mapping

from bo_sysid.recording.datasets.registry import Dataset, dataset
from bo_sysid.recording.datasets.source import SourceFile, locate
from bo_sysid.recording.readers import read_recording
from bo_sysid.recording.value import Recording

_URL = (
    "https://raw.githubusercontent.com/forgi86/sysid-neural-continuous/"
    "93afc131780fb1d5477472935a18ac8405683890/examples/EMPS/data/"
)
_FILES = {
    "DATA_EMPS.mat": "6cf6814ae14618795da0101aae2bb97ff0c6351b0501b5492751b02b07facf7e",
    "DATA_EMPS_PULSES.mat": "0eab75bb1f6b16228ee78791343a88bf9bfd9a51036ac9807d7b5fc11c0e1704",
}
_COLUMNS = {
    "time": {"from": "t", "unit": "s"},
    "qpos.x": {"from": "qm", "unit": "m"},
    "ctrl.vir": {"from": "vir", "unit": "V"},
    "goal.vir": {"from": "qg", "unit": "m"},
}
_PULSES = {"aux.pulses": {"from": "pulses_N", "unit": "N"}}
_HOW = (
    "Download DATA_EMPS.mat and DATA_EMPS_PULSES.mat from nonlinearbenchmark.org (EMPS) into "
    "$BO_SYSID_DATA/emps"
)
CITATION = (
    "A. Janot, M. Gautier, M. Brunot: Data set and reference models of EMPS. Workshop on Nonlinear "
    "System Identification Benchmarks, Eindhoven, 2019."
)


@dataset("emps")
def load() -> Dataset:
    """Return the two recordings of the EMPS benchmark."""
    return Dataset(
        name="emps",
        read_train=lambda: (_read("DATA_EMPS.mat", _COLUMNS),),
        read_holdout=lambda: (_read("DATA_EMPS_PULSES.mat", _COLUMNS | _PULSES),),
        citation=CITATION,
        notes=("Train: DATA_EMPS. Held out: DATA_EMPS_PULSES, with pulses of force.",),
    )


def _read(name: str, columns: Mapping[str, Mapping[str, str]]) -> Recording:
    return read_recording(
        locate("emps", SourceFile(name, _URL + name, _FILES[name]), _HOW), columns
    )
