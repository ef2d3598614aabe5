"""The simulating copy of a spec: same physics, nothing that only the eye needs.

Textures make a dm-control model compile in 40 ms instead of 0.2 ms and weigh 12 MB instead of
20 kB.
"""

import mujoco

# Sensors that see geoms as they look, or through a camera, or that may be of all geoms of a body.
_SEEING = (
    "mjSENS_RANGEFINDER",
    "mjSENS_CAMPROJECTION",
    "mjSENS_GEOMDIST",
    "mjSENS_GEOMNORMAL",
    "mjSENS_GEOMFROMTO",
)


def stripped(spec: mujoco.MjSpec) -> mujoco.MjSpec:
    """Return a copy without textures, skins, lights, cameras and visual-only meshes.

    A visual-only mesh is a mesh geom that collides with nothing, carries no mass, feels no fluid
    and is named by nothing. Cameras and such meshes stay where a sensor looks at or through
    them. Materials stay, without their textures: they weigh nothing, rays see their
    transparency, and a compiled tendon cannot give its material up. Nothing falls asleep: who
    sleeps is no part of a state, so that many simulations at once cannot know it. Where all that
    moves hangs together, nobody looks for islands: there is one, and steps with constraints are
    the same to the last bit, and a tenth faster.
    """
    lean = spec.copy()
    lean.option.enableflags &= ~int(mujoco.mjtEnableBit.mjENBL_SLEEP)
    if _trees(lean.worldbody) <= 1:
        lean.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_ISLAND)
    for material in lean.materials:
        for role in range(len(material.textures)):
            material.textures[role] = ""
    for group in (lean.textures, lean.skins, lean.lights):
        for element in list(group):
            lean.delete(element)
    if any(sensor.type.name in _SEEING for sensor in lean.sensors):
        return lean
    named = _names_in_use(lean)
    for camera in list(lean.cameras):
        if not camera.name or camera.name not in named:
            lean.delete(camera)
    for geom in list(lean.geoms):
        if _only_visual(geom) and geom.name not in named:
            lean.delete(geom)
    used = {geom.meshname for geom in lean.geoms} | named  # tactile sensors name a mesh
    for mesh in list(lean.meshes):
        if mesh.name and mesh.name not in used:
            lean.delete(mesh)
    return lean


def _trees(body: mujoco.MjsBody) -> int:
    """Return how many trees of moving bodies hang on a body."""
    return 1 if body.joints else sum(_trees(child) for child in body.bodies)


def _names_in_use(spec: mujoco.MjSpec) -> set[str]:
    """Return every name that a sensor, pair, tuple or tendon refers to, of whatever kind."""
    names: set[str] = set()
    for sensor in spec.sensors:
        names |= {sensor.objname, sensor.refname}
    for pair in spec.pairs:
        names |= {pair.geomname1, pair.geomname2}
    for group in spec.tuples:
        names |= set(group.objname)
    for tendon in spec.tendons:
        for wrap in tendon.path:
            names |= {e.name for e in (wrap.target, wrap.sidesite) if e is not None}
    return names


def _only_visual(geom: mujoco.MjsGeom) -> bool:
    body, compiler = geom.parent, geom.compiler
    low, high = compiler.inertiagrouprange
    from_geoms = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    massless = (
        geom.mass == 0
        or (geom.density == 0 and not geom.mass > 0)
        or not low <= geom.group <= high
        or (body.explicitinertial and compiler.inertiafromgeom != from_geoms)
        or body.name == "world"
    )
    return bool(
        geom.type == mujoco.mjtGeom.mjGEOM_MESH
        and geom.contype == 0
        and geom.conaffinity == 0
        and massless
        and not geom.fluid_ellipsoid
        and not geom.plugin.active
    )
