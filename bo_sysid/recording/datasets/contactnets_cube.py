"""400 tosses of a cube onto a table, tracked by cameras at 148 Hz.

Source: Pfrommer, Halm, Posa: "ContactNets: Learning Discontinuous Contact Dynamics with Smooth,
Implicit Representations", CoRL 2020 (github.com/DAIRLab/contact-nets, BSD-3-Clause). The cube has a
side of 0.1048 m and a mass of 0.37 kg; the table is z = 0.

| channel | what | unit |
|---|---|---|
| ``qpos.cube.0`` to ``.2`` | position of the centre | m |
| ``qpos.cube.3`` to ``.6`` | orientation, quaternion with w first | – |
| ``qvel.cube.0`` to ``.2`` | linear velocity in the world | m/s |
| ``qvel.cube.3`` to ``.5`` | angular velocity in the body | rad/s |

These are MuJoCo's conventions for a free joint. The source gives lengths in units of half a side
(0.0524 m) and the angular velocity in the body (its differences of quaternions agree with that).
Its velocities are backward differences: row k holds the mean velocity since row k − 1.

The authors publish torch files; this adapter reads ``tosses_0_399.npz`` with ``data`` (rows × 19:
position, quaternion, velocity, angular velocity, control), ``lengths`` and ``ids`` (one a toss).
Default split: the last fifth of the tosses is held out.
"""

import numpy as np

from bo_sysid.errors import RecordingError
from bo_sysid.recording.datasets.registry import Dataset, dataset
from bo_sysid.recording.datasets.source import SourceFile, locate
from bo_sysid.recording.value import Recording

_FILE = SourceFile("tosses_0_399.npz")
_HOW = (
    "Its source is torch files: concatenate data/tosses_processed/0.pt to 399.pt of "
    "github.com/DAIRLab/contact-nets into `data`, their numbers of rows into `lengths` and their "
    "numbers into `ids`, and save these with numpy.savez as "
    "$BO_SYSID_DATA/contactnets_cube/tosses_0_399.npz"
)
HALF_SIDE = 0.0524  # m, the source's unit of length
RATE = 148.0  # Hz
_HELD_OUT = 80  # tosses, of 400
_UNITS = {
    **{f"qpos.cube.{i}": "m" for i in range(3)},
    **{f"qvel.cube.{i}": "m/s" for i in range(3)},
    **{f"qvel.cube.{i}": "rad/s" for i in range(3, 6)},
}
_NOTE = "Lengths converted from half sides (0.0524 m); velocities are the source's differences."
CITATION = (
    "S. Pfrommer, M. Halm, M. Posa: ContactNets: Learning Discontinuous Contact Dynamics with "
    "Smooth, Implicit Representations. CoRL, 2020. Data: github.com/DAIRLab/contact-nets."
)


@dataset("contactnets_cube")
def load() -> Dataset:
    """Return one recording a toss, the last fifth held out."""
    return Dataset(
        name="contactnets_cube",
        read_train=lambda: _read(slice(None, -_HELD_OUT)),
        read_holdout=lambda: _read(slice(-_HELD_OUT, None)),
        citation=CITATION,
        notes=("Held out: the last fifth of the tosses.", _NOTE),
    )


def _read(part: slice) -> tuple[Recording, ...]:
    """Read a part of the tosses."""
    path = locate("contactnets_cube", _FILE, _HOW)
    with np.load(path, allow_pickle=False) as archive:
        if not {"data", "lengths", "ids"} <= set(archive.files):
            raise RecordingError(f"{path}: needs the arrays data, lengths and ids. {_HOW}")
        data, lengths, ids = archive["data"], archive["lengths"], archive["ids"]
    if data.ndim != 2 or data.shape[1] != 19 or lengths.sum() != len(data):
        raise RecordingError(
            f"{path}: data {data.shape} must have 19 columns and one row for each of the "
            f"{lengths.sum()} rows that lengths announce"
        )
    tosses = list(zip(ids, np.split(data, np.cumsum(lengths)[:-1]), strict=True))
    return tuple(_toss(int(number), rows) for number, rows in tosses[part])


def _toss(number: int, rows: np.ndarray) -> Recording:
    length = np.array([HALF_SIDE] * 3)
    return Recording.from_arrays(
        np.arange(len(rows)) / RATE,
        name=f"toss_{number}",
        units=_UNITS,
        qpos={"cube": np.hstack([rows[:, :3] * length, rows[:, 3:7]])},
        qvel={"cube": np.hstack([rows[:, 7:10] * length, rows[:, 10:13]])},
    ).with_notes([_NOTE])
