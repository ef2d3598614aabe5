"""The catalogue: effects by id, the package's own and those of a study."""

import inspect
from collections import defaultdict
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from types import MappingProxyType
from typing import Any, get_args

import pandas as pd

from bo_sysid.effects.contract import Apply, Effect, Extent, Site, SiteKind
from bo_sysid.effects.guard import as_study_error, guarded
from bo_sysid.effects.machine import Machine
from bo_sysid.errors import StudyError, nearest
from bo_sysid.execution.files import run_file

_FEW = 4  # components that a table names

_EFFECTS: dict[str, Effect] = {}

CATALOGUE: Mapping[str, Effect] = MappingProxyType(_EFFECTS)


def effect(id: str, **fields: Any) -> Callable[[Apply], Effect]:
    """Register an effect: a decorator on the one function that applies it.

    Args:
        id: name of the effect in studies and answers.
        **fields: the other fields of `Effect`.

    Raises:
        StudyError: an effect of this id exists, its kind of site does not, or all its components
            are shapes.

    Example:
        >>> @effect(
        ...     "my_spring", kind="joint", components=(Component("stiffness", "N m/rad"),),
        ...     extent=lambda site, machine: Extent((0.1,), (0.0,), (10.0,)),
        ...     noun="a spring", sentence="{site} has a spring of {value}.",
        ...     evidence="a force that grows with position", separation="rest at two positions",
        ... )
        ... def my_spring(spec, site, x, machine):
        ...     spec.joint(site.name).stiffness[0] += x[0]
    """

    def register(apply: Apply) -> Effect:
        if id in _EFFECTS:
            raise StudyError(_twice(id))
        _require_valid(id, fields)
        _EFFECTS[id] = Effect(id=id, apply=apply, **fields)
        return _EFFECTS[id]

    return register


def _require_valid(id: str, fields: Mapping[str, Any]) -> None:
    kind, kinds = str(fields.get("kind")), get_args(SiteKind)
    if kind not in kinds:
        raise StudyError(f"effect {id!r}: unknown kind of site {kind!r}; {nearest(kind, kinds)}")
    shapes, count = fields.get("shapes", 0), len(fields.get("components", ()))
    if not 0 <= shapes < count:
        raise StudyError(
            f"effect {id!r}: shapes is {shapes} of {count} components; at least one of them must "
            "be a magnitude"
        )
    _require_placeholders(id, fields)


def _require_placeholders(id: str, fields: Mapping[str, Any]) -> None:
    """Refuse a sentence that asks for what a finding does not have, or as text cannot be given."""
    known = ["site", "value", "interval", *(c.name for c in fields.get("components", ()))]
    words: dict[str, str] = dict.fromkeys(known, "")
    if fields.get("details") is not None:  # it says by itself which details there are
        words = defaultdict(str)
    try:
        str(fields.get("sentence", "")).format_map(words)
    except KeyError as error:
        name = str(error.args[0])
        raise StudyError(
            f"effect {id!r}: sentence: nothing is called {{{name}}}; {nearest(name, known)}"
        ) from None
    except (ValueError, LookupError, AttributeError, TypeError) as error:
        raise StudyError(
            f"effect {id!r}: sentence: {error}; a brace is written twice, and what stands for "
            "{value} is text"
        ) from None


def load_effects(path: Path) -> tuple[Effect, ...]:
    """Run a user's file of effects and return those that it registers.

    They are the caller's: the registry is left as it was, so that no other study gets them.

    Raises:
        StudyError: the file cannot be read, fails, registers nothing or an effect that exists.
    """
    before = dict(_EFFECTS)
    try:
        run_file(path)
        made = tuple(guarded(e, path) for id, e in _EFFECTS.items() if id not in before)
    except StudyError as error:
        raise StudyError(f"{path}: {error}") from error
    except Exception as error:  # whatever it is, it is for the file's author
        raise StudyError(f"{path}: {type(error).__name__}: {error}") from error
    finally:
        _EFFECTS.clear()
        _EFFECTS.update(before)
    if not made:
        raise StudyError(f"{path}: registers no effect; use the decorator bo_sysid.effects.effect")
    return made


def catalogue(files: Iterable[Path] = ()) -> Mapping[str, Effect]:
    """Return the effects by id: those of the registry, and those of a study's files.

    Raises:
        StudyError: a file cannot be loaded, or two register the same effect.
    """
    found = dict(_EFFECTS)
    for path in files:
        for made in load_effects(path):
            if made.id in found:
                raise StudyError(f"{path}: {_twice(made.id)}")
            found[made.id] = made
    return MappingProxyType(found)


def _twice(id: str) -> str:
    return f"effect {id!r} is registered twice; choose another id"


def chosen(
    effects: Mapping[str, Effect],
    include: str | list[str] | tuple[str, ...] = "all",
    exclude: tuple[str, ...] = (),
) -> tuple[Effect, ...]:
    """Return the effects that a study asks for.

    Args:
        effects: all that there are, by id.
        include: "all" or ids.
        exclude: ids.

    Raises:
        StudyError: an id is unknown.
    """
    wanted = list(effects) if include == "all" else list(include)
    for id in [*wanted, *exclude]:
        if id not in effects:
            raise StudyError(f"diagnosis.effects: unknown effect {id!r}; {nearest(id, effects)}")
    return tuple(effects[i] for i in wanted if i not in exclude)


def listing(effects: Iterable[Effect]) -> pd.DataFrame:
    """Return effects as a table, one row each, by kind of site.

    Columns: ``id``; ``site``, its kind; ``unit`` of the value at a hinge; ``components``, names
    and units of the magnitudes; ``model``, what it becomes in a model; ``evidence`` and
    ``separation``, what gives it away and what tells it from what looks alike; ``sentence``;
    ``source``, the file of an effect of a user's own.
    """
    own = Path(__file__).resolve().parent
    rows = [
        {
            "id": e.id,
            "site": e.kind,
            "unit": e.unit,
            "components": ", ".join(f"{c.name} [{c.unit}]" for c in e.components[:_FEW])
            + (f" and {len(e.components) - _FEW} more" if len(e.components) > _FEW else ""),
            "model": e.form,
            "evidence": e.evidence,
            "separation": e.separation,
            "sentence": e.sentence,
            "source": "" if (file := _file_of(e)) is None or own in file.parents else str(file),
        }
        for e in sorted(effects, key=lambda e: get_args(SiteKind).index(e.kind))
    ]
    return pd.DataFrame(rows)


def applicable(effect: Effect, machine: Machine) -> tuple[Site, ...]:
    """Return the sites of a machine at which an effect can act."""
    sites = [Site(effect.kind, name) for name in machine.names(effect.kind)]
    return tuple(s for s in sites if extent_at(effect, s, machine) is not None)


def extent_at(effect: Effect, site: Site, machine: Machine) -> Extent | None:
    """Return how large an effect can be at a site, None where it does not apply.

    Nor does one where nothing that was recorded gives it a size, as of a command that never varies.

    Raises:
        StudyError: the effect's function raises, or tells of other components than the effect has.
    """
    with as_study_error(f"effect {effect.id!r} at {site}: its extent"):
        extent = effect.extent(site, machine)
    if not isinstance(extent, Extent | None):
        raise StudyError(
            f"effect {effect.id!r} at {site}: its extent is {extent!r}; it must be an Extent, or "
            "None where the effect does not apply"
        )
    if extent is not None and len(extent.probe) != len(effect.components):
        raise StudyError(
            f"effect {effect.id!r} at {site}: its extent has {len(extent.probe)} numbers; it needs "
            f"one for each component, {', '.join(c.name for c in effect.components)}"
        )
    if extent is None or not effect.linear:
        return extent
    probes = extent.probe[: effect.acting] if effect.acting else extent.probe[: effect.linear]
    if not any(probes):
        return None
    if not all(probes):
        which = effect.components[probes.index(0.0)].name
        raise StudyError(
            f"effect {effect.id!r} at {site}: its extent's probe of {which} is 0; each magnitude "
            "needs one that moves the predictions"
        )
    return extent


def _file_of(effect: Effect) -> Path | None:
    code = getattr(inspect.unwrap(effect.apply), "__code__", None)
    return Path(code.co_filename).resolve() if code is not None else None
