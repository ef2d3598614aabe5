"""A double pendulum with two quasi-direct-drive motors, in two builds (designs C.0 and C.1).

Source: Wiebe et al., "Open Source Dual-Purpose Acrobot and Pendubot Platform", IEEE Robotics &
Automation Magazine, 2023 (github.com/dfki-ric-underactuated-lab/double_pendulum, BSD-3-Clause).
Open-loop sinusoidal torques of 10 s and swing-ups of 6 s at about 500 Hz, with gaps.

| channel | what | unit |
|---|---|---|
| ``qpos.shoulder`` ``qpos.elbow`` | angles; 0 hangs, the elbow is relative to link 1 | rad |
| ``qvel.shoulder`` ``qvel.elbow`` | rates as the motors report them (noisy) | rad/s |
| ``ctrl.shoulder`` ``ctrl.elbow`` | commanded torque at the joint | N m |
| ``aux.torque_shoulder`` ``aux.torque_elbow`` | measured torque; lags the command | N m |

The builds differ in friction, so each is a dataset of its own: ``dfki_double_pendulum`` is C.1,
``dfki_double_pendulum_c0`` is C.0. Default split: the last sinusoid and the last swing-up of a
build are held out.
"""

from collections.abc import Mapping

from bo_sysid.recording.datasets.registry import Dataset, dataset
from bo_sysid.recording.datasets.source import SourceFile, locate
from bo_sysid.recording.readers import read_recording
from bo_sysid.recording.value import Recording

_FOLDER = "dfki_double_pendulum"
_URL = (
    "https://raw.githubusercontent.com/dfki-ric-underactuated-lab/double_pendulum/"
    "{commit}/data/experiment_records/{path}"
)
# where the runs are published; those of C.1 were moved when the repository was tidied
_C0, _OLD, _NEW = (
    "design_C.0/20220914/sys_id/{}.csv",
    "design_C.1/20230629/sysid/{}/trajectory.csv",
    "design_C.1/sys_id/20230629/{}/trajectory.csv",
)
_PUBLISHED = {
    "0": ("33b5db87afc0a3228b3e7ed10c83d885af73e995", _C0),
    "a": ("d7d3cc80e1fe1414e48e5e72a396ea49157366f4", _OLD),
    "b": ("2b055e76caac222322a30384ce61024e0743d0ca", _NEW),
    "c": ("2ff9b9b834fb009ac1a2386e87643d5694ec5245", _OLD),
    "d": ("252bfbec3f8e9ce2128055bc2daa5ed8b067be5d", _OLD),
    "e": ("951376611d7c6af7ba61629cd7e8cb5812b63cfb", _NEW),
}
# by run: where it is published, and its checksum
_SINUSOIDS_C0 = {
    "trajectory_00": ("0", "56a084a814614be4e71a9b1fb954565119159a6a0560a84b7f430039366aa68f"),
    "trajectory_01": ("0", "43c348acc4bbfb4b8d43096c1b8e539a9fbf3b212ebf2a9b2f2f5d8f426fb671"),
    "trajectory_02": ("0", "c12a77f7ea1b37a63fb7e97af7799f3244e058c3b1f966ba7a1ed2493ba32142"),
    "trajectory_03": ("0", "6260a0f8c636db5b6ad0b6581fc687e4df497c6a698616cf608ec0504a8463ba"),
    "trajectory_04": ("0", "915b8196403f0dbe9ef902aca9aa433739554f8bd568c5e7db9744bfd526edc9"),
    "trajectory_05": ("0", "02fa2a83e5d63ebd63af2bb91daf1bc58c3617a940e77f813e54b9902a092e47"),
    "trajectory_06": ("0", "7c0db1e5dd964534a2acef59c1104f73938a4c6ef3cd8dd9cfcb4290e6224b4e"),
}
_SWING_UPS_C0 = {
    "trajectory_12": ("0", "6a2edd8ccfe17e57d27cb60830e9dbfa47b0a67666841f3b3436dd2947e08f39"),
    "trajectory_13": ("0", "b6b9fd74619336ddb72c225db591717876eaad304c7b4fcf8a748ee081a0cbc2"),
}
_SINUSOIDS_C1 = {
    "20230629-143339": ("a", "94f17287b53187dfe8f4ce131f4e7c49918309fcc915cbae2f64ed3101e7c23b"),
    "20230629-143524": ("b", "03fc5e18915e80afabb3e2674b627f9d849d43675aeacbf586ccd24b3ebd7ca5"),
    "20230629-143601": ("b", "e028c1d7a6a45cfe1b96b7cb33aae412b8888f022677d392f6f9cd4d4f63886d"),
    "20230629-143704": ("c", "e19682394cb7dc8847db9010e568b139a85a447bfbc4547b8828ad58da64a2a9"),
    "20230629-143747": ("a", "8b3f8f25dceec77dbe05c2e687d86485b272fbcabd3af5485a119c9944243a1e"),
    "20230629-143906": ("d", "45c7ed0eb4811ee0b11650b6ae344222bfcf4f7a313c7da611442149ee91e70c"),
    "20230629-144003": ("d", "6841154d567f064208961b2829907fc8457dfd857472286627a0e84da8ab36ed"),
    "20230629-144115": ("e", "c7ec2483e9dd10bfd536e5797002f39af56933ff697da1082aaf28012cda14ed"),
}
_SWING_UPS_C1 = {
    "20230629-154220": ("b", "c14a6334d98e6c86883cc3a84d41f41d25aab7d5d7a30e4690c0024a20e8972a"),
    "20230629-154548": ("c", "0af9a5f9ef4442a0bd5004cebdaf0eec12c10c01e14d58b722ff7c88b4ce450d"),
}
_HOW = (
    "Copy the trajectory files of data/experiment_records (design_C.0/20220914/sys_id and "
    "design_C.1, 20230629) of github.com/dfki-ric-underactuated-lab/double_pendulum into "
    "$BO_SYSID_DATA/dfki_double_pendulum/design_C.0/<run>.csv and design_C.1/<run>.csv"
)
_COLUMNS = {
    "time": {"from": "time", "unit": "s"},
    **{
        f"{kind}.{joint}": {"from": f"{column}{number}", "unit": unit}
        for number, joint in ((1, "shoulder"), (2, "elbow"))
        for kind, column, unit in (
            ("qpos", "pos_meas", "rad"),
            ("qvel", "vel_meas", "rad/s"),
            ("ctrl", "tau_con", "N m"),
        )
    },
    "aux.torque_shoulder": {"from": "tau_meas1", "unit": "N m"},
    "aux.torque_elbow": {"from": "tau_meas2", "unit": "N m"},
}
CITATION = (
    "F. Wiebe, S. Kumar, L. J. Shala, S. Vyas, M. Javadi, F. Kirchner: Open source dual-purpose "
    "Acrobot and Pendubot platform. IEEE Robotics & Automation Magazine, 2023."
)


@dataset("dfki_double_pendulum")
def load() -> Dataset:
    """Return the runs of design C.1."""
    return _load("dfki_double_pendulum", "C.1", _SINUSOIDS_C1, _SWING_UPS_C1)


@dataset("dfki_double_pendulum_c0")
def load_c0() -> Dataset:
    """Return the runs of design C.0."""
    return _load("dfki_double_pendulum_c0", "C.0", _SINUSOIDS_C0, _SWING_UPS_C0)


def _load(name: str, build: str, *sorts: Mapping[str, tuple[str, str]]) -> Dataset:
    """Return the runs of a build; the last one of each sort is held out."""

    def read(part: slice) -> tuple[Recording, ...]:
        runs = [run for sort in sorts for run in list(sort.items())[part]]
        return tuple(_read(build, run, *published) for run, published in runs)

    return Dataset(
        name=name,
        read_train=lambda: read(slice(None, -1)),
        read_holdout=lambda: read(slice(-1, None)),
        citation=CITATION,
        notes=(f"Design {build}. Held out: the last sinusoid and the last swing-up.",),
    )


def _read(build: str, run: str, published: str, digest: str) -> Recording:
    commit, pattern = _PUBLISHED[published]
    url = _URL.format(commit=commit, path=pattern.format(run))
    path = locate(_FOLDER, SourceFile(f"design_{build}/{run}.csv", url, digest), _HOW)
    recording = read_recording(path, _COLUMNS)
    return Recording(f"{build}_{run}", recording.channels, recording.notes)
