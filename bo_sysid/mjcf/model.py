"""A model: read once, never changed, handed out as copies."""

import hashlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import InitVar, dataclass, field
from pathlib import Path
from types import MappingProxyType
from typing import Literal

import mujoco
import numpy as np

from bo_sysid.errors import ModelError, nearest
from bo_sysid.mjcf import sources
from bo_sysid.mjcf.commands import controlled
from bo_sysid.mjcf.compiling import (
    compile_spec,
    coordinates,
    delays,
    keep_delays,
    refit_keyframes,
    spec_xml,
)
from bo_sysid.mjcf.export import attached_folders, write_mjcf
from bo_sysid.mjcf.forms import Forms
from bo_sysid.mjcf.inertia import same_inertia
from bo_sysid.mjcf.loops import Loops

Edit = Callable[[mujoco.MjSpec], None]
"""Changes a spec in place; may be called more than once in a compilation, on fresh copies.

One with an attribute `moves_mass` that is false says that it changes no mass, size or density;
models that use `settotalmass` then compile once instead of twice."""


@dataclass(frozen=True, eq=False)
class Model:
    """An MJCF model. Immutable: specs and compiled models are handed out as copies.

    Unnamed elements are named after their kind and index ("geom_3"), an unnamed actuator after
    what it drives, so that addresses and channels can name everything.

    Attributes:
        name: name of the model.
        source: where it comes from, for messages: a path, or "dm_control cheetah run".
        unrecorded: joints that nothing measures, each with the joint whose encoder shows it as
            well, or None; a joint with several coordinates stands for all of them.
        attached: folders of the models that the file attaches, for an export of their assets.
    """

    name: str
    source: str
    _spec: InitVar[mujoco.MjSpec]
    unrecorded: Mapping[str, str | None] = field(default_factory=dict)
    attached: Sequence[Path] = ()
    _forms: Forms = field(init=False, repr=False)

    def __post_init__(self, _spec: mujoco.MjSpec) -> None:
        object.__setattr__(self, "_forms", Forms.of(_spec, self.source))
        known = self.qpos_channels
        object.__setattr__(self, "unrecorded", _by_coordinate(self.unrecorded, known))
        for name in (n for pair in self.unrecorded.items() for n in pair if n is not None):
            if f"qpos.{name}" not in known:
                near = nearest(name, [n.removeprefix("qpos.") for n in known])
                message = f"{self.source}: no joint {name!r}; {near}"
                raise ModelError(message, key="unrecorded")

    @classmethod
    def from_file(
        cls,
        path: str | Path,
        *,
        base: Literal["free", "fixed"] = "free",
        hold: Sequence[str] = (),
        unrecorded: Mapping[str, str | None] = MappingProxyType({}),
        name: str = "",
    ) -> "Model":
        """Read an MJCF or URDF file.

        Args:
            path: the file.
            base: "fixed" holds a floating robot where the file puts it: its free joint is
                removed.
            hold: joints that are held where the file puts them, with their actuators and sensors
                left out: those that a log says nothing about.
            unrecorded: joints that move though nothing measures them.
            name: name of the model; the file's by default.

        Raises:
            ModelError: the file is missing, is not a model, or does not compile.
        """
        spec = sources.spec_from_file(Path(path))
        if base == "fixed":
            sources.hold_base(spec, str(path))
        sources.hold_joints(spec, hold, str(path))
        attached = attached_folders(Path(path))
        return cls(name or Path(path).stem, str(path), spec, unrecorded, attached)

    @classmethod
    def from_xml(
        cls,
        text: str,
        *,
        name: str = "model",
        assets: Mapping[str, bytes | str] | None = None,
    ) -> "Model":
        """Read MJCF text.

        Args:
            text: the MJCF.
            name: name of the model, also in messages.
            assets: included XML files, meshes and textures by file name.

        Raises:
            ModelError: the text is not a model or does not compile.
        """
        return cls(name, name, sources.spec_from_text(text, name, assets or {}))

    @classmethod
    def from_dm_control(cls, domain: str, task: str) -> "Model":
        """Return the MJCF of a dm-control suite task.

        The suite registers swimmers with 6 and 15 links; here ("swimmer", "swimmer3") and any
        other number of links work as well, also as ("swimmer3", "swim").

        Raises:
            ModelError: the suite has no such domain or task.
        """
        spec = sources.spec_from_dm_control(domain, task)
        return cls(f"{domain}-{task}", f"dm_control {domain} {task}", spec)

    @classmethod
    def from_menagerie(
        cls,
        robot: str,
        *,
        base: Literal["free", "fixed"] = "free",
        hold: Sequence[str] = (),
        unrecorded: Mapping[str, str | None] = MappingProxyType({}),
    ) -> "Model":
        """Read a robot from the MuJoCo Menagerie under `$BO_SYSID_MENAGERIE`.

        Args:
            robot: its folder, whose `scene.xml` is taken where there is one, or a file in it.
            base: as in `from_file`.
            hold: as in `from_file`.
            unrecorded: as in `from_file`.

        Raises:
            ModelError: the variable is not set, the robot is not there, or does not compile.
        """
        file = sources.menagerie_file(robot)
        name = Path(robot).stem
        return cls.from_file(file, base=base, hold=hold, unrecorded=unrecorded, name=name)

    @property
    def loops(self) -> Loops:
        """The closed kinematic chains, and which joints follow from the others."""
        silent = [n for n, shown_by in self.unrecorded.items() if shown_by is None]
        return Loops.of(self._forms.model, silent, set(self.unrecorded) - set(silent))

    def without_contact(self) -> "Model":
        """Return the model in which nothing touches anything."""
        spec = self.spec()
        spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        return Model(self.name, self.source, spec, self.unrecorded, self.attached)

    def spec(self) -> mujoco.MjSpec:
        """Return a fresh copy of the spec, visuals kept."""
        return self._forms.full.copy()

    def compile(
        self, edits: Sequence[Edit] = (), *, timestep: float | None = None, visuals: bool = False
    ) -> mujoco.MjModel:
        """Return a fresh compiled model.

        Args:
            edits: applied in order, to a copy.
            timestep: simulation step, s; the model's own by default.
            visuals: keep textures, lights and cameras, for rendering. Without them compiling
                takes some 0.2 ms and the physics is the same to the last bit.

        Raises:
            ModelError: an edit does not fit the model, or MuJoCo refuses the edited model.
        """
        return self._edited(edits, timestep, visuals)[1]

    @property
    def sha256(self) -> str:
        """Hash of the model as written, with the meshes and height fields that its files hold."""
        digest, compiled = (
            hashlib.sha256(spec_xml(self.spec()).encode()),
            self.compile(visuals=True),
        )
        for name in ("mesh_vert", "mesh_face", "hfield_data"):
            array = np.ascontiguousarray(getattr(compiled, name))
            digest.update(f"{name} {array.shape}".encode() + array.tobytes())
        return digest.hexdigest()

    def export(self, path: str | Path, edits: Sequence[Edit] = ()) -> None:
        """Write a plain MJCF file with the edits in it, visuals kept.

        Meshes, textures and height fields are copied into a folder `<stem>_assets` beside the
        file, so that both can be moved together. The file replaces `path` in one step.

        Raises:
            ModelError: the edited model does not compile, or an asset's file has gone, or attached
                models have others of its name.
        """
        spec, _ = self._edited(edits, None, visuals=True)
        write_mjcf(spec, Path(path), self.source, self.attached)

    @property
    def joints(self) -> tuple[str, ...]:
        """Names of the joints in MuJoCo's order."""
        return self._names("joint", self._forms.model.njnt)

    @property
    def actuators(self) -> tuple[str, ...]:
        """Names of the actuators in MuJoCo's order."""
        return self._names("actuator", self._forms.model.nactuator)

    @property
    def controlled(self) -> tuple[str, ...]:
        """Name of the actuator of each entry of `ctrl`; one that is told nothing has none."""
        return tuple(self.actuators[a] for a in controlled(self._forms.model))

    @property
    def bodies(self) -> tuple[str, ...]:
        """Names of the bodies in MuJoCo's order; the first is "world"."""
        return self._names("body", self._forms.model.nbody)

    @property
    def geoms(self) -> tuple[str, ...]:
        """Names of the geoms that take part in the physics, in MuJoCo's order."""
        return self._names("geom", self._forms.model.ngeom)

    @property
    def sensors(self) -> tuple[str, ...]:
        """Names of the sensors in MuJoCo's order."""
        return self._names("sensor", self._forms.model.nsensor)

    @property
    def qpos_channels(self) -> tuple[str, ...]:
        """Channel of each entry of `qpos`: "qpos.elbow", "qpos.root.3"."""
        return self._channels("qpos")

    @property
    def qvel_channels(self) -> tuple[str, ...]:
        """Channel of each entry of `qvel`: "qvel.elbow", "qvel.root.0" to "qvel.root.5"."""
        return self._channels("qvel")

    @property
    def act_channels(self) -> tuple[str, ...]:
        """Channel of each entry of `act`; actuators without activation have none."""
        return self._channels("act")

    @property
    def ctrl_channels(self) -> tuple[str, ...]:
        """Channel of each entry of `ctrl`: "ctrl.elbow"."""
        return self._channels("ctrl")

    @property
    def sensor_channels(self) -> tuple[str, ...]:
        """Channel of each entry of `sensordata`: "sensor.touch", "sensor.gyro.2"."""
        return self._channels("sensor")

    @property
    def shown_channels(self) -> tuple[str, ...]:
        """Channels that a simulation shows: of `qpos`, of `qvel` and of the sensors."""
        return (*self.qpos_channels, *self.qvel_channels, *self.sensor_channels)

    def _names(self, kind: str, number: int) -> tuple[str, ...]:
        return tuple(getattr(self._forms.model, kind)(i).name for i in range(number))

    def _channels(self, group: str) -> tuple[str, ...]:
        return tuple(
            f"{group}.{name}" if size == 1 else f"{group}.{name}.{i}"
            for name, _, size in coordinates(self._forms.model, group)
            for i in range(size)
        )

    def _edited(
        self, edits: Sequence[Edit], timestep: float | None, visuals: bool
    ) -> tuple[mujoco.MjSpec, mujoco.MjModel]:
        """Return the edited copy and what it compiles to.

        A model with `settotalmass` is edited with its masses released from it; where the edits
        then turn out to touch no mass, the model as written is taken, equal to the last bit.
        """
        forms = self._forms
        written, base = (forms.full, forms.full_base) if visuals else (forms.lean, forms.base)
        if base is not written and any(getattr(edit, "moves_mass", True) for edit in edits):
            spec, model = self._apply(base.copy(), edits, timestep)
            if not same_inertia(model, forms.base_model):
                return spec, model
        return self._apply(written.copy(), edits, timestep)

    def _apply(
        self, spec: mujoco.MjSpec, edits: Sequence[Edit], timestep: float | None
    ) -> tuple[mujoco.MjSpec, mujoco.MjModel]:
        written, late = spec.option.timestep, delays(spec)
        if timestep is not None and not timestep > 0:
            raise ModelError(f"{self.source}: timestep {timestep:g} s must be above 0")
        spec.option.timestep = timestep or written  # edits ask what a step resolves
        for edit in edits:
            edit(spec)
        if timestep is not None:  # whatever the edits make of it
            spec.option.timestep = timestep
        keep_delays(spec, written, late)
        if spec.keys and self._changes_coordinates(spec):
            refit_keyframes(spec, self._forms.model, self.source)
        done = "; ".join(str(edit) for edit in edits if hasattr(edit, "moves_mass"))
        after = f" after the edits {done}" if done else " after the edits" if edits else ""
        return spec, compile_spec(spec, self.source, after)

    def _changes_coordinates(self, spec: mujoco.MjSpec) -> bool:
        joints = {(joint.name, int(joint.type)) for joint in spec.joints}
        before = set(zip(self.joints, self._forms.model.jnt_type.tolist(), strict=True))
        return joints != before or {a.name for a in spec.actuators} != set(self.actuators)


def _by_coordinate(
    unrecorded: Mapping[str, str | None], channels: Sequence[str]
) -> dict[str, str | None]:
    """Return unrecorded joints, those with several coordinates by each of them."""
    found: dict[str, str | None] = {}
    for name, shown in unrecorded.items():
        own = [c.removeprefix("qpos.") for c in channels if c.startswith(f"qpos.{name}.")]
        found |= dict.fromkeys(own, shown) if own and shown is None else {name: shown}
    return found
