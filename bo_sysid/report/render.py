"""MuJoCo's own picture of a robot, where this machine can render without a display.

MuJoCo chooses its OpenGL when it is imported, and this package imports it without any. So the
picture is made by a process of its own, which is asked for EGL and then for OSMesa; where neither
works (`apt-get install libegl1` or `libosmesa6` provides them), there is none.
"""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path

import mujoco
import numpy as np

from bo_sysid.mjcf import Model
from bo_sysid.mjcf.edits import SkyEdit
from bo_sysid.report.look import NOMINAL
from bo_sysid.report.robot import Posed, view
from bo_sysid.runs import atomic

BACKENDS = ("egl", "osmesa")
_SIZE = (480, 640)  # pixels, rows and columns
_SECONDS = 60.0
_SIDEWAYS, _ABOVE = 20.0, 12.0  # [deg] off the plain side view, for depth
_MARK = 0.07  # of the robot's size
_SEEN_THROUGH = 0.5  # opacity of the robot


def rendered(
    model: Path, pose: Mapping[str, float], points: Sequence[Sequence[float]], out: Path
) -> str | None:
    """Render a robot with marks into a PNG file, which is there as a whole or not at all.

    Args:
        model: an MJCF file.
        pose: by position channel.
        points: places to be marked, in the world, [m].
        out: the PNG file.

    Returns:
        The OpenGL that did it, None where none works.
    """
    out.unlink(missing_ok=True)  # what an earlier run drew is not this one's
    backend_set = os.environ.get("MUJOCO_GL", "")
    request = {"model": str(model), "pose": dict(pose), "points": [list(p) for p in points]}
    for backend in (backend_set,) if backend_set in (*BACKENDS, "glfw") else BACKENDS:
        with tempfile.TemporaryDirectory() as folder:
            asked, drawn = Path(folder) / "request.json", Path(folder) / "drawn.png"
            asked.write_text(json.dumps({**request, "out": str(drawn)}), encoding="utf-8")
            if _drawn(backend, asked) and drawn.is_file():
                with atomic(out) as unfinished:
                    unfinished.write_bytes(drawn.read_bytes())
                return backend
    return None


def _drawn(backend: str, asked: Path) -> bool:
    """Return whether a process of its own could render with one kind of OpenGL."""
    try:
        done = subprocess.run(  # noqa: S603 - this Python, this module
            [sys.executable, "-P", "-m", __name__, str(asked)],  # nothing from the folder we are in
            env={**os.environ, "MUJOCO_GL": backend, "PYOPENGL_PLATFORM": backend},
            capture_output=True,
            timeout=_SECONDS,
            check=False,
        )
    except (OSError, subprocess.TimeoutExpired):
        return False
    return done.returncode == 0


def _draw(model: Path, pose: Mapping[str, float], points: np.ndarray, out: Path) -> None:
    """Render, in a process that has OpenGL."""
    from matplotlib.image import imsave

    made = Model.from_file(model)
    posed = Posed.of(made, pose)
    compiled = made.compile([SkyEdit()], visuals=True)
    data = mujoco.MjData(compiled)
    data.qpos[:] = posed.data.qpos
    mujoco.mj_forward(compiled, data)
    surfaces = np.concatenate([posed.surface(g) for g in posed.geoms])
    low, high = surfaces.min(axis=0), surfaces.max(axis=0)
    size = float((high - low).max())
    seen_through = mujoco.MjvOption()  # a mark may lie inside a thick link
    seen_through.flags[mujoco.mjtVisFlag.mjVIS_TRANSPARENT] = True
    compiled.vis.map.alpha = _SEEN_THROUGH
    camera = _camera(posed, 0.5 * (low + high), size)
    with mujoco.Renderer(compiled, *_SIZE) as renderer:
        renderer.update_scene(data, camera, scene_option=seen_through)
        for point in points:
            _mark(renderer.scene, point, _MARK * size)
        imsave(out, renderer.render())


def _camera(posed: Posed, middle: np.ndarray, size: float) -> mujoco.MjvCamera:
    right, up = view(posed)
    away = -np.cross(right, up)
    camera = mujoco.MjvCamera()
    camera.lookat[:] = middle
    camera.distance = 1.9 * size
    camera.azimuth = np.degrees(np.arctan2(away[1], away[0])) + _SIDEWAYS
    camera.elevation = max(np.degrees(np.arcsin(away[2])) - _ABOVE, -89.0)
    return camera


def _mark(scene: mujoco.MjvScene, point: np.ndarray, radius: float) -> None:
    """Add a ball that shows what is inside."""
    geom = scene.geoms[scene.ngeom]
    red, green, blue = (int(NOMINAL[k : k + 2], 16) / 255 for k in (1, 3, 5))
    colour = np.array([red, green, blue, 0.55], np.float32)
    size, turn = np.full(3, radius), np.eye(3).ravel()
    mujoco.mjv_initGeom(geom, mujoco.mjtGeom.mjGEOM_SPHERE, size, np.array(point), turn, colour)
    geom.emission = 0.6
    scene.ngeom += 1


if __name__ == "__main__":
    job = json.loads(Path(sys.argv[1]).read_text(encoding="utf-8"))
    places = np.array(job["points"], float).reshape(-1, 3)
    _draw(Path(job["model"]), job["pose"], places, Path(job["out"]))
