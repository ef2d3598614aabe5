"""Read a spec from a file, a text, a dm-control task or MuJoCo Menagerie, and name its parts."""

import os
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any
from unittest import mock

import mujoco

from bo_sysid.errors import ModelError, nearest
from bo_sysid.mjcf.commands import ALONG_JOINT
from bo_sysid.mjcf.compiling import compile_spec, mujoco_message, refit_keyframes
from bo_sysid.mjcf.loops import tied_by

MENAGERIE = "BO_SYSID_MENAGERIE"


def spec_from_file(path: Path) -> mujoco.MjSpec:
    """Parse an MJCF or URDF file; `<include>`, meshes and textures are relative to it.

    Raises:
        ModelError: the file is missing or is not a model.
    """
    if not path.is_file():
        folder = path if path.is_dir() else path.parent
        there = [p.name for p in folder.iterdir()] if folder.is_dir() else []
        models = [n for n in there if n.lower().endswith((".xml", ".mjcf", ".urdf"))]
        hint = nearest(path.name, models) if models else f"no model file in {folder}"
        raise ModelError(f"{path}: no such model file; {hint}")
    try:
        return mujoco.MjSpec.from_file(str(path))
    except (ValueError, mujoco.FatalError) as error:
        raise ModelError(f"{path}: not a model: {mujoco_message(error)}") from None


def spec_from_text(text: str, source: str, assets: Mapping[str, bytes | str]) -> mujoco.MjSpec:
    """Parse MJCF text; `assets` holds included XML files and meshes or textures by file name."""
    data = {
        os.path.normpath(name): content.encode() if isinstance(content, str) else content
        for name, content in assets.items()
    }
    include = {name: content for name, content in data.items() if name.endswith(".xml")}
    others = {name: content for name, content in data.items() if name not in include}
    try:
        return mujoco.MjSpec.from_string(text, include=include, assets=others)
    except (ValueError, mujoco.FatalError) as error:
        raise ModelError(f"{source}: not a model: {mujoco_message(error)}") from None


def spec_from_dm_control(domain: str, task: str) -> mujoco.MjSpec:
    """Return the MJCF that the suite builds for a task.

    "swimmerN" names a swimmer with N links for any N from 3 on, as domain or as task.

    Raises:
        ModelError: the suite has no such domain or task.
    """
    swimmer = re.fullmatch(r"swimmer(\d+)", domain if domain != "swimmer" else task)
    text, assets = (
        _swimmer(int(swimmer[1])) if swimmer and int(swimmer[1]) >= 3 else _suite(domain, task)
    )
    text = text.decode() if isinstance(text, bytes) else text
    return spec_from_text(text, f"dm_control {domain} {task}", assets)


def _swimmer(links: int) -> tuple[Any, Mapping[str, bytes | str]]:
    from dm_control.suite import swimmer

    text, assets = swimmer.get_model_and_assets(links)
    return text, assets


def _suite(domain: str, task: str) -> tuple[Any, Mapping[str, bytes | str]]:
    from dm_control import suite
    from dm_control.mujoco import Physics

    tasks = {d: [t for e, t in suite.ALL_TASKS if e == d] for d, _ in suite.ALL_TASKS}
    if domain not in tasks:
        raise ModelError(
            f"dm_control has no domain {domain!r}; {nearest(domain, [*tasks, 'swimmer3'])}"
        )
    if task not in tasks[domain]:
        raise ModelError(
            f"dm_control {domain} has no task {task!r}; {nearest(task, tasks[domain])}"
        )
    # Tasks pass arguments of their own to the domain's MJCF builder (number of poles, of boxes,
    # size of the floor): what reaches the loader is the only complete answer.
    try:
        with mock.patch.object(Physics, "from_xml_string", side_effect=_caught):
            suite.load(domain, task, task_kwargs={"random": 0})
    except _Loaded as loaded:
        return loaded.text, loaded.model_assets
    raise ModelError(f"dm_control {domain} {task}: does not load its model from MJCF text")


class _Loaded(Exception):  # noqa: N818 - not an error: carries what a task asked to load
    def __init__(self, text: Any, assets: Mapping[str, bytes | str]) -> None:
        super().__init__()
        self.text, self.model_assets = text, assets


def _caught(xml_string: Any, assets: Mapping[str, bytes | str] | None = None) -> None:
    raise _Loaded(xml_string, assets or {})


def menagerie_file(robot: str) -> Path:
    """Return the model file of a robot in MuJoCo Menagerie.

    Args:
        robot: a folder such as "franka_emika_panda", whose `scene.xml` (with the floor) is taken
            where there is one, or a file in it such as "franka_emika_panda/panda.xml".

    Raises:
        ModelError: `$BO_SYSID_MENAGERIE` is not set, or the robot is not there.
    """
    home = os.environ.get(MENAGERIE)
    if not home or not Path(home).is_dir():
        raise ModelError(
            f"menagerie {robot!r}: set ${MENAGERIE} to a folder with MuJoCo Menagerie"
            + (f"; {home} is not a folder" if home else "")
        )
    place = Path(home) / robot
    if place.suffix == ".xml":
        return place
    if not place.is_dir():
        robots = [p.name for p in Path(home).iterdir() if any(p.glob("*.xml"))]
        raise ModelError(f"menagerie: no robot {robot!r} in {home}; {nearest(robot, robots)}")
    files = sorted(place.glob("*.xml"))
    if (place / "scene.xml") in files:
        return place / "scene.xml"
    if len(files) != 1:
        names = ", ".join(repr(f"{robot}/{f.name}") for f in files)
        raise ModelError(f"menagerie {robot!r}: name one of its files: {names or 'there are none'}")
    return files[0]


def hold_base(spec: mujoco.MjSpec, source: str) -> None:
    """Remove the free joint of every floating robot; a model without one stays as it is.

    What drives it and the sensors of both are removed, too.

    A floating robot is a free body with further joints below it; a lone free body (an object in
    the scene) keeps its joint unless the model has nothing but such bodies.
    """
    free = [j for j in spec.joints if j.type == mujoco.mjtJoint.mjJNT_FREE]
    robots = [j for j in free if len(j.parent.find_all("joint")) > 1]
    if not free:
        return
    compile_spec(spec, source)
    name_elements(spec)
    before = compile_spec(spec, source)
    for joint in robots or free:
        _remove(spec, joint)
    if spec.keys:
        refit_keyframes(spec, before, source)


def hold_joints(spec: mujoco.MjSpec, names: Sequence[str], source: str) -> None:
    """Remove joints, so that their bodies stay where the file puts them, with what drives them.

    Sensors of the joints and of what drives them are removed, too.

    Raises:
        ModelError: the model has no such joint, or ties it to others.
    """
    if not names:
        return
    compile_spec(spec, source)
    name_elements(spec)
    before = compile_spec(spec, source)
    joints = {j.name: j for j in spec.joints}
    for name in dict.fromkeys(names):  # deleted twice, a joint ends the process
        if name not in joints:
            message = f"{source}: no joint {name!r}; {nearest(name, joints)}"
            raise ModelError(message, key="hold")
        if tie := tied_by(before, name):
            raise ModelError(
                f"{source}: {tie} moves {name} with other joints, so that it cannot be held; "
                f"unrecorded: {{{name}: null}} lets it move unmeasured",
                key="hold",
            )
        _remove(spec, joints[name])
    if spec.keys:
        refit_keyframes(spec, before, source)


def _remove(spec: mujoco.MjSpec, joint: mujoco.MjsJoint) -> None:
    """Remove a joint with the actuators that drive it, and the sensors of both."""
    name = joint.name
    drives = [a for a in spec.actuators if int(a.trntype) in ALONG_JOINT and a.target == name]
    gone = {(mujoco.mjtObj.mjOBJ_ACTUATOR, a.name) for a in drives}
    gone.add((mujoco.mjtObj.mjOBJ_JOINT, name))
    sensors = [s for s in spec.sensors if (s.objtype, s.objname) in gone]
    for element in (*sensors, *drives, joint):
        spec.delete(element)


NAMED_KINDS = {
    "body": "bodies",
    "joint": "joints",
    "geom": "geoms",
    "site": "sites",
    "tendon": "tendons",
    "actuator": "actuators",
    "sensor": "sensors",
    "equality": "equalities",
    "pair": "pairs",
}


def name_elements(spec: mujoco.MjSpec) -> None:
    """Name the unnamed elements of a compiled spec, in place.

    An unnamed actuator takes the name of what it drives where no other actuator has it; anything
    else is called by its kind and its MuJoCo index, such as "geom_3".
    """
    for kind, group in NAMED_KINDS.items():
        elements = list(getattr(spec, group))
        taken = {e.name for e in elements if e.name}
        targets = [e.target for e in elements] if kind == "actuator" else []
        for element in elements:
            if element.name:
                continue
            name = f"{kind}_{element.id}"
            if kind == "actuator" and targets.count(element.target) == 1 and element.target:
                name = element.target
            while name in taken:
                name += "_"
            element.name = name
            taken.add(name)
