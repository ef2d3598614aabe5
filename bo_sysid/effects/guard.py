"""What a user's own effect gets wrong, told as an error of the effect, with its file and line."""

import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import wraps
from pathlib import Path
from typing import Any, TypeAlias, TypeVar, cast, get_args

import mujoco
import numpy as np

from bo_sysid.effects.contract import Apply, Effect, Magnitudes, Site
from bo_sysid.effects.machine import Machine
from bo_sysid.effects.parts import Filter, Force, Motion, Part, Signal
from bo_sysid.errors import StudyError, UserError, nearest
from bo_sysid.recording import Channel

_Function = TypeVar("_Function", bound=Callable[..., Any])
_LawOf: TypeAlias = Callable[[Site, Magnitudes, Machine], Callable[[Motion], Signal]]

_ABSURD = 1e6  # beyond it a simulation has diverged, and a force that is no number tells nothing


def guarded(effect: Effect, file: Path) -> Effect:
    """Return an effect whose functions name it, its file and the line where they fail.

    Args:
        effect: as the file registers it.
        file: the user's file.
    """
    e, id = effect, effect.id
    return replace(
        e,
        apply=_apply(e.apply, id, file),
        written=None if e.written is None else _apply(e.written, id, file),
        force=None if e.force is None else _force(e.force, id, file),
        extent=_named(e.extent, "extent", id, file),
        nominal=_named(e.nominal, "nominal value", id, file),
        details=None if e.details is None else _named(e.details, "details", id, file),
        absolute=None if e.absolute is None else _named(e.absolute, "value", id, file),
    )


def _named(function: _Function, what: str, id: str, file: Path) -> _Function:
    """Return a function of a site, and of other things, that says that it fails."""

    @wraps(function)
    def made(*args: Any) -> Any:
        site = next(a for a in args if isinstance(a, Site))
        with as_study_error(f"effect {id!r} at {site}: its {what}", file):
            return function(*args)

    return cast(_Function, made)


def _apply(apply: Apply, id: str, file: Path) -> Apply:
    """Return what makes nothing but parts whose laws and filters say that they fail."""

    @wraps(apply)
    def made(
        spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine
    ) -> "tuple[Part, ...]":
        name = f"effect {id!r} at {site}"
        with as_study_error(name, file):
            found = apply(spec, site, x, machine)
        parts = found if isinstance(found, tuple) else () if found is None else (found,)
        for part in parts:
            if not isinstance(part, get_args(Part)):
                kinds = ", ".join(k.__name__ for k in get_args(Part))
                raise StudyError(
                    f"{name} returns {part!r} ({file.name}); it may return None, or one or "
                    f"a tuple of {kinds}"
                )
            if isinstance(part, Force):
                _require_joint(part.joint, spec, machine, f"{name} ({file.name})")
        return tuple(_part(p, name, file) for p in parts)

    return made


def _require_joint(joint: str, spec: mujoco.MjSpec, machine: Machine, name: str) -> None:
    """Refuse a force at a joint that neither the model has nor the effect has added.

    Raises:
        StudyError: there is no such joint.
    """
    if spec.joint(joint) is None:
        joints = [machine.model.joint(j).name for j in range(machine.model.njnt)]
        if joint not in joints:
            raise StudyError(
                f"{name} returns a force at {joint!r}; the model has no such joint; "
                f"{nearest(joint, joints)}"
            )


def _force(force: _LawOf, id: str, file: Path) -> _LawOf:
    """Return what gives the law of an effect, which says that it fails."""
    law_of = _named(force, "force", id, file)

    def made(site: Site, x: Magnitudes, machine: Machine) -> Callable[[Motion], Signal]:
        return _law(law_of(site, x, machine), f"effect {id!r} at {site}", file)

    return made


def _part(part: Part, name: str, file: Path) -> Part:
    """Return a part whose law or filter says that it fails."""
    if isinstance(part, Force):
        return replace(part, law=_law(part.law, name, file))
    if isinstance(part, Filter):
        return replace(part, change=_change(part.change, name, file))
    return part


def _change(
    change: Callable[[Channel, float], Channel], name: str, file: Path
) -> Callable[[Channel, float], Channel]:
    """Return a change of a control that gives a channel, or says that it fails."""

    def changed(channel: Channel, timestep: float) -> Channel:
        with as_study_error(f"{name}: its filter", file):
            made = change(channel, timestep)
        if not isinstance(made, Channel):
            raise StudyError(f"{name}: its filter returns {made!r} and no channel ({file.name})")
        return made

    return changed


def _law(law: Callable[[Motion], Signal], name: str, file: Path) -> Callable[[Motion], Signal]:
    """Return a force law that gives one finite force for each simulation, or says that it fails."""

    def finite(motion: Motion) -> Signal:
        shape = next(iter(motion.qvel.values())).shape
        with as_study_error(f"{name}: its law", file):
            force = np.broadcast_to(np.asarray(law(motion), float), shape)
        if not np.isfinite(force).all() and _sane(motion, np.isfinite(force)):
            raise StudyError(
                f"{name}: its law gives a force that is no finite number ({file.name})"
            )
        return force

    return finite


def _sane(motion: Motion, right: np.ndarray) -> bool:
    """Whether a motion is that of a machine, where a law is not `right`: none that diverged."""
    moved = np.stack([*motion.qpos.values(), *motion.qvel.values()])
    return bool((np.abs(moved) < _ABSURD).all(axis=0)[~right].any())


@contextmanager
def as_study_error(what: str, file: Path | None = None) -> Iterator[None]:
    """Raise what the code within raises as an error of the study.

    Args:
        what: fails.
        file: whose line is named, where it is known.

    Raises:
        StudyError: the code within raises anything but a `UserError`.
    """
    try:
        yield
    except UserError:
        raise
    except Exception as error:  # whatever it is, it is for the effect's author
        where = "" if file is None else f" ({_line(error, file)})"
        raise StudyError(f"{what} fails: {type(error).__name__}: {error}{where}") from error


def _line(error: Exception, file: Path) -> str:
    """Return a file with its last line on the way to an error."""
    frames: Any = traceback.extract_tb(error.__traceback__)
    lines = [f.lineno for f in frames if Path(f.filename).resolve() == file.resolve()]
    return f"{file.name}, line {lines[-1]}" if lines else file.name
