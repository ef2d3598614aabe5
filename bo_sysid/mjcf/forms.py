"""The forms in which a model keeps its spec."""

from dataclasses import dataclass, field
from typing import Any

import mujoco

from bo_sysid.mjcf import sources
from bo_sysid.mjcf.compiling import compile_spec
from bo_sysid.mjcf.derived import settle, switch_on
from bo_sysid.mjcf.inertia import drop_overruled_inertials, release_total_mass
from bo_sysid.mjcf.strip import stripped


@dataclass(frozen=True, eq=False)
class Forms:
    """The forms in which a model keeps its spec; private to this package, never changed.

    Attributes:
        full: as read, elements named, what MuJoCo derives from masses and poses settled.
        lean: `full` without what only the eye needs.
        full_base: what mass edits start from: `full` with its masses released from
            `settotalmass`; `full` itself where the model does not use that.
        base: the same of `lean`.
        model: `lean` compiled.
        base_model: `base` compiled.
        resolved: targets by address (address.py), filled as they are asked for.
    """

    full: mujoco.MjSpec
    lean: mujoco.MjSpec
    full_base: mujoco.MjSpec
    base: mujoco.MjSpec
    model: mujoco.MjModel
    base_model: mujoco.MjModel
    resolved: dict[str, Any] = field(default_factory=dict)

    @classmethod
    def of(cls, spec: mujoco.MjSpec, source: str) -> "Forms":
        """Return the forms of a spec that was just read.

        Raises:
            ModelError: it does not compile.
        """
        compile_spec(spec, source)  # a copy silently drops what refers to nothing
        full = spec.copy()
        drop_overruled_inertials(full)
        compiled = compile_spec(full, source)  # numbers the elements and fuses static bodies
        settle(full, compiled)
        switch_on(full, compiled)
        sources.name_elements(full)
        lean = stripped(full)
        model = compile_spec(lean, source)
        if full.compiler.settotalmass <= 0:
            return cls(full, lean, full, lean, model, model)
        full_base, base = release_total_mass(full, source), release_total_mass(lean, source)
        return cls(full, lean, full_base, base, model, compile_spec(base, source))
