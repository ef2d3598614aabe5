"""Dynamixel XL-330 servo that swings a pendulum: 12 runs of 6 s.

Source: Rhoban's BAM (Duclusaud, Passault, Padois, Ly: "Extended friction models for the physics
simulation of servo actuators", ICRA 2025; github.com/Rhoban/bam, Apache-2.0). Four trajectories at
three gains of the servo. A point mass of 0.49 kg swings at 0.10 m in a vertical plane; q = 0 hangs.

| channel | what | unit |
|---|---|---|
| ``qpos.pendulum`` ``qvel.pendulum`` | angle, and the servo's own filtered speed | rad, rad/s |
| ``goal.motor`` | goal position sent to the servo | rad |
| ``ctrl.motor`` | voltage on the motor: duty times bus voltage, 0 while torque is off | V |
| ``aux.duty`` | measured duty of the bridge, -1 to 1 (``load`` as signed 16 bits over 885) | – |
| ``aux.voltage`` | measured bus voltage, which sags under load | V |
| ``aux.torque_enable`` | 1 while the servo drives, 0 in the free drop | – |
| ``aux.kp`` | gain set in the servo, constant in a run (100, 200 or 400) | – |
| ``aux.temperature`` | of the servo | °C |

The servo's law is duty = clip(kp · (goal − q) · 4096 / (2π · 256 · 885), −1, 1). Stamps are uneven,
3.4 to 6 ms. Default split: kp 100 and 400 train, kp 200 is held out.
"""

import json

import numpy as np

from bo_sysid.errors import RecordingError
from bo_sysid.recording.datasets.registry import Dataset, dataset
from bo_sysid.recording.datasets.source import SourceFile, locate
from bo_sysid.recording.mapping import to_recording
from bo_sysid.recording.table import RawTable
from bo_sysid.recording.value import Recording

_URL = (
    "https://raw.githubusercontent.com/Rhoban/bam/"
    "af2260462471ff45ac18af159b1327ea51d8db15/bam/data.bak/raw/"
)
_TRAIN = {  # gains 100 and 400
    "2026-01-15_10h28m10": "e58f3c2a08a5e0e37a2c5e930d0830a438bc102b8d21482767124f495b92f2ce",
    "2026-01-15_10h28m17": "ef6507934ba465eb31529d7d98715ecc70bd5c87be049fd4618a94ce39290569",
    "2026-01-15_10h28m24": "165b171df12b3e8b39504ce36d37e373ad105c0dddf4d3d073c747fd492e8bef",
    "2026-01-15_10h28m32": "fdc255edae6995298af437f37582eb8cd0c4a5ddcec4f49fb7c4d6f3303aaa9c",
    "2026-01-15_10h29m14": "016d15d21c464457aa30eaeab3977228b08cd5acf7542f24067440126c0bf480",
    "2026-01-15_10h29m21": "fe68cff62e976c87a2fcab925a517fbff83be16c862693310fdc1eff743eddab",
    "2026-01-15_10h29m29": "b9ce9fc0f396e6b03bd514e9254cb83b8a64e1a5df1728b9a10e3b4a5a9513ca",
    "2026-01-15_10h29m37": "838d390b7190c4ce1608157cf629989648773b7336728a0931a61c6018c6700b",
}
_HOLDOUT = {  # gain 200
    "2026-01-15_10h28m42": "1c6386bfa3be021c8ca8a96a7cbee93914f6271a050282b1c3b7d5ef373427db",
    "2026-01-15_10h28m49": "e2223826274fca7799a2be0cb371e4269ead88cd9077fbb68498ef93e4e0de97",
    "2026-01-15_10h28m57": "c10a350d9c7222d4d3499d140edd3ac4e63fe94f3b59a675116a34db7d66152c",
    "2026-01-15_10h29m04": "7996c43314a9f60094a6119346b54ff9ff84cb6726c967f4a88a7175278f6515",
}
_HOW = (
    "Copy bam/data.bak/raw/*.json of github.com/Rhoban/bam at commit af2260462471 into "
    "$BO_SYSID_DATA/bam_xl330"
)
_COLUMNS = {
    "time": {"from": "timestamp", "unit": "s"},
    "qpos.pendulum": {"from": "position", "unit": "rad"},
    "qvel.pendulum": {"from": "speed", "unit": "rad/s"},
    "goal.motor": {"from": "goal_position", "unit": "rad"},
    "ctrl.motor": {"from": "motor_voltage", "unit": "V"},
    "aux.duty": {"from": "duty"},
    "aux.voltage": {"from": "input_volts", "unit": "V"},
    "aux.torque_enable": {"from": "torque_enable"},
    "aux.kp": {"from": "kp"},
    "aux.temperature": {"from": "temp", "unit": "°C"},
}
_FULL_DUTY = 885  # register value of a bridge that is always on
CITATION = (
    "M. Duclusaud, G. Passault, V. Padois, O. Ly: Extended friction models for the physics "
    "simulation of servo actuators. ICRA, 2025. Data: github.com/Rhoban/bam, Apache-2.0."
)


@dataset("bam_xl330")
def load() -> Dataset:
    """Return the runs of the XL-330, split by gain."""
    return Dataset(
        name="bam_xl330",
        read_train=lambda: tuple(_read(run, digest) for run, digest in _TRAIN.items()),
        read_holdout=lambda: tuple(_read(run, digest) for run, digest in _HOLDOUT.items()),
        citation=CITATION,
        notes=("Train: gains 100 and 400. Held out: gain 200.",),
    )


def _read(run_id: str, digest: str) -> Recording:
    file = SourceFile(f"{run_id}.json", f"{_URL}{run_id}.json", digest)
    path = locate("bam_xl330", file, _HOW)
    try:
        run = json.loads(path.read_text(encoding="utf-8"))
        entries = run["entries"]
        columns = {key: np.array([e[key] for e in entries]) for key in entries[0]}
        duty = columns["load"].astype(np.uint16).astype(np.int16) / _FULL_DUTY
        columns["duty"] = duty
        columns["motor_voltage"] = duty * columns["input_volts"]
        columns["kp"] = np.full(len(entries), float(run["kp"]))
        name = f"xl330_{run['trajectory']}_kp{run['kp']}"
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise RecordingError(f"{path}: not a log of the BAM XL-330 bench: {error!r}") from None
    return to_recording(RawTable(str(path), columns), _COLUMNS, name=name)
