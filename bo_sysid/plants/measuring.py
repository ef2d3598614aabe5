"""What a plant's sensors measure: channels by name, with noise."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np

from bo_sysid.errors import UserError, nearest
from bo_sysid.mjcf import Model
from bo_sysid.mjcf.compiling import coordinates
from bo_sysid.mjcf.joints import joint_units
from bo_sysid.recording.value import Recording, stated_for

KINDS = ("qpos", "qvel", "act")
_MOTION = ("qpos", "qvel")


@dataclass(frozen=True)
class Measuring:
    """Turns fields of a simulation into a recording.

    Joints of the model that are `unrecorded` are in none of its channels but those that show them.

    Attributes:
        model: the nominal model; only channels that it has are recorded.
        plant: the simulated model, which may have joints and actuators of its own.
        kinds: which of "qpos", "qvel", "act" are recorded; controls always are.
        noise: standard deviation by kind or by channel, in the channel's unit.
        seed: of the noise.
    """

    model: Model
    plant: mujoco.MjModel
    kinds: Sequence[str]
    noise: Mapping[str, float] | None
    seed: int

    def __post_init__(self) -> None:
        for kind in self.kinds:
            if kind not in KINDS:
                raise UserError(f"plant: cannot measure {kind!r}; {nearest(kind, KINDS)}")
        known = [*KINDS, *(c for kind in KINDS for c in self._columns(kind))]
        for key, sigma in (self.noise or {}).items():
            if key not in known:
                raise UserError(f"noise of {key!r}; {nearest(key, known)}", key="noise")
            if not (np.isfinite(sigma) and sigma >= 0):
                raise UserError(f"noise of {key!r} is {sigma}; it must be at least 0", key="noise")

    def recording(
        self, name: str, number: int, rows: Mapping[str, np.ndarray], *, warmstart: bool
    ) -> Recording:
        """Return a recording of `T` rows.

        Args:
            name: of the recording.
            number: of the trajectory; the noise of each is its own.
            rows: `T x ...` fields "time", "qpos", "qvel", "act", "ctrl" and "qacc_warmstart".
            warmstart: also record the solver's warm start, as ``aux.qacc_warmstart.<i>``.
        """
        rng = np.random.default_rng((self.seed, number, 2))
        noise = self.noise or {}
        kinds: dict[str, dict[str, np.ndarray]] = {}
        for kind in (*self.kinds, "ctrl"):
            group = {}
            columns, hidden = self._columns(kind), self.model.unrecorded
            for channel, column in columns.items():
                error = rng.standard_normal(len(rows["time"]))
                joint = channel.split(".", 1)[1]
                if kind in _MOTION and joint in hidden:
                    continue
                also = [columns[f"{kind}.{n}"] for n, by in hidden.items() if by == joint]
                shown = rows[kind][:, [column, *(also if kind in _MOTION else ())]].sum(axis=1)
                group[joint] = shown + stated_for(channel, noise, 0.0) * error
            if group:
                kinds[kind] = group
        if warmstart:
            kinds["aux"] = {"qacc_warmstart": rows["qacc_warmstart"]}
        units = joint_units(self.plant)
        return Recording.from_arrays(rows["time"], name=name, units=units, **kinds)

    def _columns(self, kind: str) -> dict[str, int]:
        """Return the plant's column of each channel of a kind that the nominal model has, too."""
        nominal = getattr(self.model, f"{kind}_channels")
        columns = {}
        for name, first, size in coordinates(self.plant, kind):
            for i in range(size):
                channel = f"{kind}.{name}" if size == 1 else f"{kind}.{name}.{i}"
                if channel in nominal:
                    columns[channel] = first + i
        return columns
