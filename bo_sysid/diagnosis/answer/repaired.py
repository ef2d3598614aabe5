"""The repaired model's file, and what stands beside it."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import mujoco
import numpy as np

from bo_sysid.diagnosis.windows.candidate import Candidate, followed
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis, edits_and_parts
from bo_sysid.diagnosis.windows.timestep import finer_step
from bo_sysid.effects import Filter, Force, Hidden, Machine, Part, Reading
from bo_sysid.effects.beside import Beside, LearnedLaw, Placed, beside_a_file
from bo_sysid.mjcf import Model
from bo_sysid.runs import atomic
from bo_sysid.simulation import Controller, ForceLaw

MODEL, STUDY = "model_repaired.xml", "study_repaired.yaml"
BESIDE, MODULE = "model_repaired.json", "model_repaired.py"
_STRIBECK = "stribeck_friction"


@dataclass(frozen=True)
class Written:
    """What a model file that was written does not say by itself.

    Attributes:
        beside: in words, what stands beside it.
        unrecorded: joints that were added, each with the joint whose encoder shows it as well.
        timestep: of the file in [s], and of the nominal model.
        bristles: joints whose friction has no presliding, and in the file a little.
    """

    beside: tuple[str, ...]
    unrecorded: Mapping[str, str | None]
    timestep: tuple[float, float] = (0.0, 0.0)
    bristles: tuple[str, ...] = ()

    @property
    def notes(self) -> tuple[str, ...]:
        """What stands beside the file, what nothing measures, and a finer step, in words."""
        step, own = self.timestep
        notes = [
            f"MJCF cannot express {what}; it stands in {BESIDE}, beside {MODEL}"
            for what in self.beside
        ]
        for joint, shown_by in self.unrecorded.items():
            also = f"; the encoder of {shown_by} shows it as well" if shown_by else ""
            notes.append(f"{joint} is a joint of {MODEL} that nothing measures{also}")
        if step < own:
            notes.append(f"{MODEL} steps at {step:.3g} s, since {own:g} s shows in the recordings")
        notes += [
            f"the friction of {joint} is dry friction and stiff bristles in {MODEL}, the nearest "
            "that MJCF has: where the joint stands still they ring a little, and forecasts of the "
            "file are not as good as those that are reported"
            for joint in self.bristles
        ]
        return tuple(notes)


def write_model(
    model: Model,
    machine: Machine,
    hypothesis: Hypothesis,
    folder: Path,
    *,
    timestep: float,
    laws: Collection[Controller | ForceLaw] = (),
) -> Written:
    """Write the model with the findings in it, and beside it what MJCF cannot express.

    Args:
        model: the nominal model.
        machine: the scales of its sites.
        hypothesis: what it lacks.
        folder: to write to.
        timestep: at which the hypothesis was fitted, in [s]; divided where the recordings show the
            finer step of a continuous machine.
        laws: what stands beside the nominal model.
    """
    share = timestep / finer_step(hypothesis.numerics) / machine.model.opt.timestep
    written = _in_file(model, machine, hypothesis, share, laws)
    edits, parts = edits_and_parts(hypothesis, machine, written=written)
    if share != 1:  # first, since effects ask what a step resolves
        edits.insert(0, lambda spec: _scale_step(spec, share))
    model.export(folder / MODEL, edits)
    beside = _beside(model, machine, hypothesis, share, written)
    own = {c.effect.id: c.effect for c in hypothesis.members}
    words = _words(beside.parts(model, own))
    if words:
        beside.write(folder / BESIDE)
        with atomic(folder / MODULE) as unfinished:
            unfinished.write_text(_module(words), encoding="utf-8")
    else:  # those of an earlier diagnosis in the same folder say what is no longer so
        for name in (BESIDE, MODULE):
            (folder / name).unlink(missing_ok=True)
    added = {p.joint: p.of if p.shown else None for p in parts if isinstance(p, Hidden)}
    step = float(machine.model.opt.timestep)
    held = [c for c in written if c.effect.id == _STRIBECK and not c.preslides]
    return Written(words, added, (share * step, step), tuple(c.site.name for c in held))


_MODULE = f'''"""What {MODEL} lacks because MJCF cannot say it; {BESIDE} holds it.

    from model_repaired import load

    simulation = load()
    simulation.data.ctrl[:] = ...
    simulation.step()          # in the place of mujoco.mj_step(model, data)
"""

from pathlib import Path

from bo_sysid.simulation.stepper import Stepper


def load(*effect_files: str | Path) -> Stepper:
    """Return the simulation; with the study's effect files where effects are your own."""
    folder = Path(__file__).parent
    return Stepper(folder / "{MODEL}", folder / "{BESIDE}", effect_files)
'''


def _module(words: Sequence[str]) -> str:
    """Return the module that steps the repaired model.

    Names are a model's, which may hold anything: they only stand quoted, in comments.
    """
    return _MODULE + "\n\n# It adds:\n" + "".join(f"# {w!r}\n" for w in words)


def _in_file(
    model: Model,
    machine: Machine,
    hypothesis: Hypothesis,
    share: float,
    laws: Collection[Controller | ForceLaw],
) -> tuple[Candidate, ...]:
    """Return the members that a model file says as far as MJCF can.

    A file's lag or delay acts after all that changes the command beside the file, and forces
    beside it read the command as it was before. Where a member acts on what a filter makes of a
    command, or any force is there that may read it, the filter stands beside the file as well.
    """
    pairs, members = list(zip(hypothesis.members, hypothesis.x, strict=True)), hypothesis.members
    remaining = [_made(c.effect.write, model, machine, c, x, share) for c, x in pairs]
    read = bool(laws) or any(isinstance(p, Force) for made in remaining for p in made)
    return tuple(
        c
        for k, (c, x) in enumerate(pairs)
        if not (read or followed(members, k))
        or not any(
            isinstance(p, Filter) for p in _made(c.effect.parts, model, machine, c, x, share)
        )
    )


def _made(
    make: Callable[..., tuple[Part, ...]],
    model: Model,
    machine: Machine,
    c: Candidate,
    x: np.ndarray,
    share: float,
) -> tuple[Part, ...]:
    """Return what a member leaves beside a spec, which is thrown away.

    The time step is `share` of the model's: effects ask what the file's resolves.
    """
    spec = model.spec()
    _scale_step(spec, share)
    return make(spec, c.site, c.full(x), machine)


def _beside(
    model: Model,
    machine: Machine,
    hypothesis: Hypothesis,
    share: float,
    written: Collection[Candidate],
) -> Beside:
    """Return the members of a hypothesis of which something remains beside a model file."""
    effects, laws = [], []
    for c, x in zip(hypothesis.members, hypothesis.x, strict=True):
        if c.effect.id == "unknown":
            laws += _learned(model, machine, c, x)
            continue
        make = c.effect.write if c in written else c.effect.parts
        if beside_a_file(_made(make, model, machine, c, x, share)):
            effects.append(Placed(c.effect.id, c.site, tuple(map(float, c.full(x)))))
    return Beside(machine, tuple(effects), tuple(laws))


def _learned(model: Model, machine: Machine, c: Candidate, x: np.ndarray) -> list[LearnedLaw]:
    names = (k.name for k in c.effect.components)
    weights = {n: float(w) for n, w in zip(names, x, strict=True) if w}
    forces = c.effect.parts(model.spec(), c.site, c.full(x), machine)
    return [LearnedLaw(f.joint, weights, f.hold) for f in forces if isinstance(f, Force)]


def _scale_step(spec: mujoco.MjSpec, share: float) -> None:
    spec.option.timestep = spec.option.timestep * share


def _words(parts: Sequence[Part]) -> tuple[str, ...]:
    """Return in words what stands beside the repaired model."""
    words = []
    for p in parts:
        if isinstance(p, Force):
            words.append(f"a force on joint {p.joint}")
        elif isinstance(p, Filter):
            words.append(f"a change of the control of {p.actuator}")
        elif isinstance(p, Reading):
            words.append(f"a change of what {p.channel} reads")
    return tuple(dict.fromkeys(words))
