"""Many simulations of one task, with their fields by name."""

from collections.abc import Mapping, Sequence
from typing import Any

import mujoco
import numpy as np
from mujoco import batch

from bo_sysid.simulation.lockstep import ForceLaw, LockStep, live_arrays

_BAD_STATE = [
    int(mujoco.mjtWarning.mjWARN_BADQPOS),
    int(mujoco.mjtWarning.mjWARN_BADQVEL),
    int(mujoco.mjtWarning.mjWARN_BADQACC),
]


class Simulations:
    """A `mujoco.batch.Batch` with cached named views and a goal per simulation.

    The batch keeps one `MjData` per simulation, so that the position- and velocity-dependent
    fields of the new state, which observations and rewards read, cost nothing extra: the next
    step goes on from them. It falls out of the processor's cache near 256 simulations.

    Attributes:
        model: the model that gives layout, names and time step, and that every simulation runs on
            unless `set_models` says otherwise; for numbers of a model see `constant`.
        qpos: live `n x nq` positions.
        qvel: live `n x nv` velocities.
        ctrl: live `n x nu` controls.
        goal: `n x g` quantities of the task that are redrawn at every start and are no part of
            the physics, such as the position of a target.
    """

    def __init__(self, model: mujoco.MjModel, n: int, goal_size: int, threads: int) -> None:
        self.model = model
        self._batch = batch.Batch(model, n, threads, persistent=True)
        self.qpos = self._batch.bind("qpos")
        self.qvel = self._batch.bind("qvel")
        self.ctrl = self._batch.bind("ctrl")
        self.goal = np.zeros((n, goal_size))
        self._views: dict[tuple[str, str, str], np.ndarray] = {}
        self._models: Sequence[mujoco.MjModel] = [model] * n
        self._constants: dict[tuple[str, str, str], np.ndarray] = {}
        self._laws: tuple[ForceLaw, ...] = ()
        self._lockstep: LockStep | None = None
        self._lockstep_counts = np.zeros(n, np.int64)

    def __len__(self) -> int:
        return int(self._batch.nsim)

    @property
    def state(self) -> np.ndarray:
        """Live `n x nstate` integration states; writing them sets the simulations."""
        return np.asarray(self._batch.state)

    def field(self, name: str) -> np.ndarray:
        """Return the live `n x ...` array of a field of `MjData`."""
        return np.asarray(self._batch.bind(name))

    def named(self, kind: str, name: str, field: str) -> np.ndarray:
        """Return the live `n x k` slice of a field, such as ``("geom", "nose", "xpos")``.

        Like `field`, it is zero until the call after the first time that it is asked for.
        """
        key = (kind, name, field)
        if key not in self._views:
            self._views[key] = getattr(getattr(self._batch, kind)(name), field)
        return self._views[key]

    def constant(self, kind: str, name: str, field: str) -> np.ndarray:
        """Return `n x k` numbers of the models, such as ("geom", "finger", "size").

        Each simulation has those of its own model, which may be a candidate of its own.
        """
        key = (kind, name, field)
        if key not in self._constants:
            of_model = {
                id(m): np.atleast_1d(getattr(getattr(m, kind)(name), field)).copy()
                for m in {id(m): m for m in self._models}.values()
            }
            self._constants[key] = np.stack([of_model[id(m)] for m in self._models])
        return self._constants[key]

    def set_models(self, models: Sequence[mujoco.MjModel]) -> None:
        """Run simulation i on `models[i]`; the models must share one layout and time step."""
        self._batch.set_models(models)
        self._models, self._constants = list(models), {}

    def set_laws(self, laws: Sequence[ForceLaw]) -> None:
        """Step force laws with every simulation, one physics step at a time: slower."""
        self._laws = tuple(laws)
        self.begin_laws()

    def begin_laws(self) -> None:
        """Let the laws forget all simulations."""
        if self._laws:
            views = live_arrays(self.model, self._batch.bind)
            self._lockstep = LockStep(self.model, self._laws, {}, views, None)
            self._lockstep_counts[:] = 0

    def law_state(self) -> dict[str, np.ndarray]:
        """Return copies of what laws know beside the state; nothing without laws."""
        if self._lockstep is None:
            return {}
        return {"steps": self._lockstep_counts.copy(), **self._lockstep.remembered()}

    def set_law_state(self, state: Mapping[str, np.ndarray]) -> None:
        """Restore what `law_state` returned; the laws forget where it is empty."""
        self.begin_laws()
        if self._lockstep is not None and state:
            self._lockstep_counts[:] = state["steps"]
            self._lockstep.remember({k: x for k, x in state.items() if k != "steps"})

    def restart(self, rows: np.ndarray) -> None:
        """Put simulations `rows` at the model's defaults, without computing anything yet.

        Laws forget them.
        """
        self._batch.reset(ids=rows, stage=int(mujoco.mjtStage.mjSTAGE_NONE))
        self._lockstep_counts[rows] = 0

    def forward(self, rows: np.ndarray | None = None) -> None:
        """Compute every field at the present state."""
        self._batch.forward(ids=rows)

    def advance(self, steps: int, rows: np.ndarray | None = None, *, fields: bool = True) -> None:
        """Advance by `steps` physics steps.

        Args:
            steps: the number of physics steps.
            rows: which simulations; all by default.
            fields: compute the fields that depend on position and velocity at the new state, as
                dm_control does; sensors of acceleration stay those of the last physics step.
        """
        stage = mujoco.mjtStage.mjSTAGE_VEL if fields else mujoco.mjtStage.mjSTAGE_NONE
        if self._lockstep is None:
            self._batch.step(ids=rows, nstep=steps, stage=int(stage))
            return
        stepped = np.arange(len(self)) if rows is None else rows
        for _ in range(steps):
            time = self.field("time")[stepped]
            self._lockstep.apply_to(stepped, time, forget=self._lockstep_counts[stepped] == 0)
            self._lockstep_counts[stepped] += 1
            self._batch.step(ids=rows, nstep=1, stage=int(stage))

    def trace(self, steps: int, fields: Sequence[str]) -> dict[str, np.ndarray]:
        """Advance like `advance`; return `n x steps x ...` values after each physics step.

        Beside the asked `fields` there is always "time".

        A simulation that diverges stops, and its remaining rows repeat the last one.
        """
        if self._lockstep is not None:
            return self._traced(steps, ("time", *fields))
        time = int(mujoco.mjtState.mjSTATE_TIME)
        rows: dict[Any, np.ndarray] = self._batch.rollout(steps, record=(*fields, time))
        self._batch.forward(stage=int(mujoco.mjtStage.mjSTAGE_VEL))
        return {"time": rows.pop(time)[:, :, 0], **rows}

    def _traced(self, steps: int, fields: Sequence[str]) -> dict[str, np.ndarray]:
        rows: dict[str, list[np.ndarray]] = {field: [] for field in fields}
        for _ in range(steps):
            self.advance(1)
            for field, values in rows.items():
                values.append(self.field(field).copy())
        return {field: np.stack(values, axis=1) for field, values in rows.items()}

    def diverged(self) -> np.ndarray:
        """Return which simulations met a state that is not finite since their restart."""
        counts: Any = self._batch.warning
        return np.asarray(counts[:, _BAD_STATE, 1].any(axis=1))
