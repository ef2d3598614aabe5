"""Masses and inertias of bodies, and edits that keep the two consistent."""

from dataclasses import dataclass

import mujoco
import numpy as np
from jaxtyping import Float

from bo_sysid.errors import ModelError, nearest
from bo_sysid.mjcf.compiling import compile_spec
from bo_sysid.mjcf.strip import stripped


@dataclass(frozen=True)
class Inertial:
    """The inertial of one body, as compiled.

    Attributes:
        mass: mass, kg.
        ipos: centre of mass in the body's frame, m.
        iquat: orientation of the principal axes in the body's frame, unit quaternion w x y z.
        inertia: principal moments of inertia about the centre of mass, kg m².
    """

    mass: float
    ipos: Float[np.ndarray, " 3"]
    iquat: Float[np.ndarray, " 4"]
    inertia: Float[np.ndarray, " 3"]


def find_body(spec: mujoco.MjSpec, name: str) -> mujoco.MjsBody:
    """Return a body by its name.

    Raises:
        ModelError: there is no such body.
    """
    body = spec.body(name)
    if body is None:
        raise ModelError(f"no body {name!r}; {nearest(name, [b.name for b in spec.bodies])}")
    return body


def drop_overruled_inertials(spec: mujoco.MjSpec) -> None:
    """Remove inertials that `inertiafromgeom="true"` overrules, and then the flag, in place.

    The model stays the same to the last bit. Under the flag no inertial could be given to a body
    with geoms, and MuJoCo writes none to a file, not even that of a body without geoms.
    """
    geoms_win = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    overruled = [body for body in spec.bodies if body.compiler.inertiafromgeom == geoms_win]
    for body in overruled:
        low, high = body.compiler.inertiagrouprange
        if any(low <= geom.group <= high for geom in body.geoms):
            body.explicitinertial = False
            body.ipos[0] = body.fullinertia[0] = np.nan  # undefined: AUTO then asks the geoms
    for compiler in (spec.compiler, *(body.compiler for body in overruled)):  # attached have theirs
        if compiler.inertiafromgeom == geoms_win:
            compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO


def has_inertial(body: mujoco.MjsBody) -> bool:
    """Return whether an `<inertial>`, and not the geoms, gives the body its mass."""
    geoms_win = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    return bool(body.explicitinertial and body.compiler.inertiafromgeom != geoms_win)


def inertial(spec: mujoco.MjSpec, body: str) -> Inertial:
    """Return what `body` weighs in the spec as it is now (compiles a stripped copy)."""
    find_body(spec, body)
    model = compile_spec(stripped(spec), f"body {body!r}")
    compiled = model.body(body)
    return Inertial(
        float(compiled.mass[0]),
        compiled.ipos.copy(),
        compiled.iquat.copy(),
        compiled.inertia.copy(),
    )


def make_explicit(spec: mujoco.MjSpec, body: str) -> mujoco.MjsBody:
    """Freeze what the geoms give the body into an explicit `<inertial>`, in place.

    From then on `mass`, `ipos`, `iquat` and `inertia` of the returned body count and its geoms'
    masses do not. A body that has an inertial already only has its full inertia matrix, where
    it was given as one, replaced by principal axes.
    """
    element = find_body(spec, body)
    if has_inertial(element) and np.isnan(element.fullinertia[0]):
        return element
    now = inertial(spec, body)
    element.explicitinertial = True
    element.fullinertia[0] = np.nan
    element.ialt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
    element.mass, element.ipos, element.iquat = now.mass, now.ipos, now.iquat
    element.inertia = now.inertia
    return element


def scale_mass(spec: mujoco.MjSpec, body: str, ratio: float) -> None:
    """Multiply the mass of a body, and its inertia with it, in place.

    Where geoms give the body its mass, all of theirs are scaled; the centre of mass stays.

    Args:
        spec: the spec to change.
        body: name of the body.
        ratio: new mass over present mass.
    """
    element = find_body(spec, body)
    if has_inertial(element):
        element.mass = element.mass * ratio
        element.inertia = element.inertia * ratio
        if not np.isnan(element.fullinertia[0]):
            element.fullinertia = element.fullinertia * ratio
        return
    for geom in element.geoms:
        if np.isnan(geom.mass):
            geom.density = geom.density * ratio
        else:
            geom.mass = geom.mass * ratio


def mass_key(spec: mujoco.MjSpec, body: str) -> tuple[object, ...]:
    """Return all that gives the body its mass and inertia: unequal after any edit of them."""
    element = find_body(spec, body)
    if has_inertial(element):
        return (element.mass, *element.inertia, *element.fullinertia[1:], *element.ipos)
    return tuple(
        (geom.density, None if np.isnan(geom.mass) else geom.mass, *geom.size, *geom.pos)
        for geom in element.geoms
    )


def release_total_mass(spec: mujoco.MjSpec, source: str) -> mujoco.MjSpec:
    """Return a copy whose masses are what `settotalmass` makes of them, without `settotalmass`.

    With the attribute in force MuJoCo rescales all bodies after every edit, so that no body's
    mass could be changed by itself. Masses of the copy agree with the original's to rounding.

    Args:
        spec: a stripped or a full spec that uses the attribute.
        source: where the model comes from, for messages.

    Returns:
        The copy.

    Raises:
        ModelError: masses that MJCF geoms and inertials do not hold (flexes) take part.
    """
    total = spec.compiler.settotalmass
    wanted = compile_spec(stripped(spec), source)
    released = spec.copy()
    released.compiler.settotalmass = -1
    bare = compile_spec(stripped(released), source)
    for body in released.bodies[1:]:
        scale_mass(released, body.name, total / float(bare.body_mass.sum()))
    reached = compile_spec(stripped(released), source)
    if not np.allclose(reached.body_mass, wanted.body_mass, rtol=1e-9):
        raise ModelError(
            f"{source}: compiler settotalmass: cannot be written into the masses of the geoms; "
            "give the masses themselves and remove it"
        )
    return released


def same_inertia(one: mujoco.MjModel, other: mujoco.MjModel) -> bool:
    """Return whether all bodies of two models have bitwise the same mass and inertia."""
    return one.nbody == other.nbody and all(
        np.array_equal(getattr(one, field), getattr(other, field))
        for field in ("body_mass", "body_inertia", "body_ipos", "body_iquat")
    )
