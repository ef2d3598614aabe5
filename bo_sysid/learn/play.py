"""A learned policy on its plant: returns, a recording, and pictures where they can be made."""

import os
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np
from jaxtyping import Float

from bo_sysid.errors import RunError, UserError
from bo_sysid.learn.hand_over import machine_names
from bo_sysid.learn.scene import Scene
from bo_sysid.learn.values import Estimate
from bo_sysid.mjcf import Model
from bo_sysid.plants.build import build_plant
from bo_sysid.plants.plant import PlantError
from bo_sysid.policy.store import LearnedPolicy
from bo_sysid.recording import Recording
from bo_sysid.recording.writers import write_recording
from bo_sysid.runs import atomic, read_record
from bo_sysid.study import Study

_SEED = 700_001  # starts are none of those of training, valuation or evaluation
_PICTURES, _WIDTH, _HEIGHT = 8, 320, 240


@dataclass(frozen=True)
class Played:
    """What a policy did on the plant.

    Attributes:
        returns: `E` sums of rewards of whole episodes.
        recording: path of one recorded episode.
        pictures: path of a strip of pictures; None where this machine cannot render.
        not_rendered: why not, else empty.
    """

    returns: Float[np.ndarray, " E"]
    recording: Path
    pictures: Path | None
    not_rendered: str

    @property
    def sentence(self) -> str:
        """The returns in words."""
        estimate = Estimate.of(self.returns)
        count = len(self.returns)
        half = float(f"{estimate.half_width:.2g}")
        error = f" ± {half:g} (95 %)" if count > 1 else ""
        return f"Return on the plant: {estimate.mean:.4g}{error}, {count} episodes."


def play(
    folder: Path,
    *,
    policy: Path | None = None,
    episodes: int = 20,
    out: Path | None = None,
    trust_code: bool = False,
) -> Played:
    """Evaluate and record the policy of a run of `learn` on the plant of its study.

    Args:
        folder: the run folder.
        policy: another policy; the run's last one by default.
        episodes: number of evaluated episodes.
        out: folder of the recording and the pictures; `play` in the run folder by default.
        trust_code: run the Python files that the study names.

    Raises:
        RunError: the folder is no run of `learn`, or holds no policy yet.
        UserError: the policy belongs to another model, or the machine is a person's.
    """
    if episodes < 1:
        raise UserError(f"play: --episodes is {episodes}; at least 1")
    record = read_record(folder)
    if record["command"] != "learn":
        raise RunError(f"{folder}: a run of {record['command']}; play shows runs of learn")
    study = Study.load(folder / "study.yaml", trust_code=trust_code)
    if study.plant is None:
        raise study.error(
            ("plant",), "play needs a simulated plant; a policy for your machine is in policy.pt"
        )
    file = policy or folder / "policy.npz"
    if not file.is_file():
        raise RunError(f"{file}: no such policy" + ("" if policy else "; the run has none yet"))
    if file.suffix == ".pt":
        raise RunError(
            f"{file}: a TorchScript module, for programs without this package; play takes the .npz "
            f"of the same policy, as {folder / 'policy.npz'}"
        )
    learned, scene = LearnedPolicy.load(file), Scene.of(study)
    environment = scene.environment(scene.compiled(scene.candidates.points[0]), 1)
    learned.require(environment.observation_size, environment.action_size, str(file))
    _require_machine(learned, scene, file)
    plant = build_plant(study, seed=scene.seed + _SEED)
    act = learned.acting(*plant.command_range)
    returns = plant.evaluate(act, episodes, seed=scene.seed + _SEED)
    try:
        recording = plant.record(act)
    except PlantError as error:
        if error.recording is None:
            raise
        recording = error.recording
    place = out or folder / "play"
    path = write_recording(recording, place / "recording.parquet")
    pictures, why = _pictures(scene.model, recording, plant.goal, place / "pictures.png")
    return Played(returns, path, pictures, why)


def _require_machine(policy: LearnedPolicy, scene: Scene, file: Path) -> None:
    """Refuse a policy for other joints or actuators: equal numbers of them are no sign.

    A repair may have added joints to those of the plant.
    """
    here = machine_names(scene)
    own = policy.about.get("machine", here)
    for kind in ("joints", "actuators"):
        if not set(here[kind]) <= set(own[kind]):
            raise UserError(
                f"{file}: learned for the {kind} {', '.join(own[kind])}; those of this plant are "
                f"{', '.join(here[kind])}"
            )


def _pictures(
    model: Model, recording: Recording, goal: np.ndarray, path: Path
) -> tuple[Path | None, str]:
    """Draw a strip of pictures of a recording; return its path, or why there is none."""
    setting = os.environ.get("MUJOCO_GL", "")
    if setting in ("", "disable", "off", "0", "false"):
        return None, "No pictures: set MUJOCO_GL=egl (or osmesa, glfw) where rendering works."
    try:
        strip = render(model, recording, goal=goal)
    except Exception as error:  # whatever the graphics driver raises
        return None, f"No pictures: rendering with MUJOCO_GL={setting} failed ({error})."
    from matplotlib.image import imsave

    with atomic(path) as place:
        imsave(place, strip)
    return path, ""


def render(model: Model, recording: Recording, goal: np.ndarray | None = None) -> np.ndarray:
    """Return eight pictures of a recording side by side, `height x (8 width) x 3`.

    Args:
        model: drawn at the recorded positions; other joints stay where it puts them.
        recording: with joints' positions.
        goal: where the geom named target was, its first coordinates; see `Plant.goal`.
    """
    compiled = model.compile(visuals=True)
    target = mujoco.mj_name2id(compiled, mujoco.mjtObj.mjOBJ_GEOM, "target")
    if goal is not None and target >= 0:
        compiled.geom_pos[target, : len(goal)] = goal
    data = mujoco.MjData(compiled)
    start, stop = recording.span
    frames = []
    with mujoco.Renderer(compiled, _HEIGHT, _WIDTH) as renderer:
        for time in np.linspace(start, stop, _PICTURES):
            for k, name in enumerate(model.qpos_channels):
                if name in recording.channels:
                    data.qpos[k] = recording.channels[name].at(np.array([time]))[0]
            mujoco.mj_forward(compiled, data)
            renderer.update_scene(data, camera=0 if compiled.ncam else -1)
            frames.append(renderer.render())
    return np.concatenate(frames, axis=1)
