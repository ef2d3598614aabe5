"""Quanser Qube, a Furuta pendulum driven by a voltage: 5 chirps and 5 swing-ups.

Source: SimuRLacra (Muratore et al., TU Darmstadt; data from github.com/fdamken/SimuRLacra,
``Pyrado/data/perma/evaluation``, BSD-3-Clause style). Chirps: 10 to 0 Hz about +1.5 V, open loop,
250 Hz, 10 s. Swing-ups: energy controller, 500 Hz, 5 s.

| channel | what | unit |
|---|---|---|
| ``qpos.arm`` ``qpos.pendulum`` | angles θ and α; α = 0 hangs | rad |
| ``qvel.arm`` ``qvel.pendulum`` | their rates, filtered by the authors (they lag) | rad/s |
| ``ctrl.motor`` | voltage applied to the motor, after its limit | V |

The authors publish pickles; this adapter reads one ``.npz`` a run with the arrays ``time`` (N+1),
``states`` (N+1 × 4), ``u`` and ``u_applied`` (N × 1). Default split: the last chirp and the last
swing-up are held out. The chirps are of April 2021, the swing-ups of June: two sessions.
``quanser_qube_swing_ups`` trains on one of them alone and holds out the same two runs.
"""

from collections.abc import Mapping

from bo_sysid.recording.datasets.registry import Dataset, dataset
from bo_sysid.recording.datasets.source import SourceFile, locate
from bo_sysid.recording.readers import read_recording
from bo_sysid.recording.value import Recording

_CHIRP = "qq_chrip_10to0Hz_+1.5V_250Hz_10s__rollout_real_2021-04-14_{}.npz"
_SWING_UP = "qq-su_ectrl_500Hz_5s__rollout_real_2021-06-11_{}.npz"
_CHIRPS = {"chirp": (_CHIRP, ("18-52-33", "18-53-40", "18-54-23", "18-55-12", "18-55-54"))}
_SWING_UPS = {"swing_up": (_SWING_UP, ("12-09-08", "12-10-11", "12-10-51", "12-11-36", "12-12-17"))}
_RUNS = {**_CHIRPS, **_SWING_UPS}
_Runs = Mapping[str, tuple[str, tuple[str, ...]]]
_HOW = (
    "Its source is pickles, which are not read here: from each pickle of Pyrado/data/perma/"
    "evaluation (github.com/fdamken/SimuRLacra) save time, states, u and u_applied with "
    "numpy.savez under the same name (.npz) into $BO_SYSID_DATA/quanser_qube"
)
_COLUMNS = {
    "qpos.arm": {"from": "states.0", "unit": "rad"},
    "qpos.pendulum": {"from": "states.1", "unit": "rad"},
    "qvel.arm": {"from": "states.2", "unit": "rad/s"},
    "qvel.pendulum": {"from": "states.3", "unit": "rad/s"},
    "ctrl.motor": {"from": "u_applied", "unit": "V"},
}
CITATION = (
    "F. Muratore et al.: SimuRLacra, a framework for reinforcement learning from randomized "
    "simulations. Recordings of a Quanser Qube, github.com/fdamken/SimuRLacra."
)


@dataset("quanser_qube")
def load() -> Dataset:
    """Return the runs of the Qube, the last of each sort held out."""
    return _load("quanser_qube", _RUNS)


@dataset("quanser_qube_swing_ups")
def load_swing_ups() -> Dataset:
    """Return the swing-ups to train on; the last run of each sort is held out."""
    return _load("quanser_qube_swing_ups", _SWING_UPS)


def _load(name: str, trained: _Runs) -> Dataset:
    return Dataset(
        name=name,
        read_train=lambda: _read(trained, slice(None, -1)),
        read_holdout=lambda: _read(_RUNS, slice(-1, None)),
        citation=CITATION,
        notes=("Held out: the last chirp and the last swing-up.",),
    )


def _read(runs: _Runs, part: slice) -> tuple[Recording, ...]:
    """Read a part of the runs of each sort."""
    recordings = []
    for sort, (pattern, stamps) in runs.items():
        for stamp in stamps[part]:
            path = locate("quanser_qube", SourceFile(pattern.format(stamp)), _HOW)
            read = read_recording(path, _COLUMNS)
            recordings.append(Recording(f"qube_{sort}_{stamp}", read.channels, read.notes))
    return tuple(recordings)
