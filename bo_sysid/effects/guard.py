"""What a user's own effect gets wrong, told as an error of the effect, with its file and line."""

import traceback
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from functools import wraps
from pathlib import Path
from typing import Any, get_args

import mujoco
import numpy as np

from bo_sysid.effects.contract import (
    Apply,
    Effect,
    Force,
    Magnitudes,
    Motion,
    Part,
    Signal,
    Site,
)
from bo_sysid.effects.machine import Machine
from bo_sysid.errors import StudyError, UserError

_ABSURD = 1e6  # beyond it a simulation has diverged, and a force that is no number tells nothing


def guarded(effect: Effect, file: Path) -> Effect:
    """Return an effect whose functions name it, its file and the line where they fail.

    Args:
        effect: as the file registers it.
        file: the user's file.
    """

    def guard(apply: Apply) -> Apply:
        @wraps(apply)
        def made(
            spec: mujoco.MjSpec, site: Site, x: Magnitudes, machine: Machine
        ) -> "tuple[Part, ...]":
            name = f"effect {effect.id!r} at {site}"
            with _told(name, file):
                found = apply(spec, site, x, machine)
            parts = found if isinstance(found, tuple) else () if found is None else (found,)
            for part in parts:
                if not isinstance(part, get_args(Part)):
                    kinds = ", ".join(k.__name__ for k in get_args(Part))
                    raise StudyError(
                        f"{name} returns {part!r} ({file.name}); it may return None, or one or "
                        f"a tuple of {kinds}"
                    )
            return tuple(
                replace(p, law=_law(p.law, name, file)) if isinstance(p, Force) else p
                for p in parts
            )

        return made

    written = None if effect.written is None else guard(effect.written)
    return replace(effect, apply=guard(effect.apply), written=written)


def _law(law: Callable[[Motion], Signal], name: str, file: Path) -> Callable[[Motion], Signal]:
    """Return a force law that gives one finite force for each simulation, or says that it fails."""

    def told(motion: Motion) -> Signal:
        shape = next(iter(motion.qvel.values())).shape
        with _told(f"{name}: its law", file):
            force = np.broadcast_to(np.asarray(law(motion), float), shape)
        if not np.isfinite(force).all() and _sane(motion, np.isfinite(force)):
            raise StudyError(
                f"{name}: its law gives a force that is no finite number ({file.name})"
            )
        return force

    return told


def _sane(motion: Motion, right: np.ndarray) -> bool:
    """Whether a motion is that of a machine, where a law is not `right`: none that diverged."""
    moved = np.stack([*motion.qpos.values(), *motion.qvel.values()])
    return bool((np.abs(moved) < _ABSURD).all(axis=0)[~right].any())


@contextmanager
def _told(what: str, file: Path) -> Iterator[None]:
    """Tell what the code within raises as an error of the study.

    Raises:
        StudyError: the code within raises anything but a `UserError`.
    """
    try:
        yield
    except UserError:
        raise
    except Exception as error:
        frames: Any = traceback.extract_tb(error.__traceback__)
        lines = [f.lineno for f in frames if Path(f.filename).resolve() == file.resolve()]
        where = f"{file.name}, line {lines[-1]}" if lines else file.name
        raise StudyError(f"{what} fails: {type(error).__name__}: {error} ({where})") from error
