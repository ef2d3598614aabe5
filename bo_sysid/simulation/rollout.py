"""The simulation core: many starts, many models, one call on all cores."""

import contextlib
import threading
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace

import mujoco
import numpy as np
from jaxtyping import Bool, Float, Int
from mujoco.batch import Batch, SimulationError

from bo_sysid.arrays import Ctrl
from bo_sysid.simulation.delays import load_past
from bo_sysid.simulation.lockstep import Controller, ForceLaw, LockStep, live_arrays, steps_held
from bo_sysid.simulation.state import State, Trajectory

_STATE = mujoco.mjtState.mjSTATE_QPOS | mujoco.mjtState.mjSTATE_QVEL | mujoco.mjtState.mjSTATE_ACT
_CONTROL = mujoco.mjtState.mjSTATE_CTRL
_CONTROL_AND_FORCE = mujoco.mjtState.mjSTATE_CTRL | mujoco.mjtState.mjSTATE_QFRC_APPLIED


class _Quiet:
    """Keeps MuJoCo's warnings from the terminal and from MUJOCO_LOG.TXT; they are counted anyway.

    MuJoCo has one handler for the whole process: the last thread that leaves puts it back.
    """

    def __init__(self) -> None:
        self._lock, self._inside = threading.Lock(), 0
        self._before: Callable[[str], None] | None = None

    @contextlib.contextmanager
    def __call__(self) -> Iterator[None]:
        with self._lock:
            if not self._inside:
                self._before = mujoco.get_mju_user_warning()
                mujoco.set_mju_user_warning(lambda _: None)
            self._inside += 1
        try:
            yield
        finally:
            with self._lock:
                self._inside -= 1
                if not self._inside:
                    mujoco.set_mju_user_warning(self._before)


quietly = _Quiet()


class Engine:
    """MuJoCo's batch, kept from call to call while the models keep one structure.

    The results do not depend on the number of threads.

    Args:
        threads: number of threads, 0 for all cores.
    """

    def __init__(self, threads: int = 0) -> None:
        self.threads = threads
        self._batch: Batch | None = None

    def rollout(
        self,
        models: mujoco.MjModel | Sequence[mujoco.MjModel],
        start: State,
        ctrl: Ctrl,
        *,
        force: Float[np.ndarray, "W S nv"] | None = None,
        laws: Sequence[Controller | ForceLaw] = (),
        signals: Mapping[str, Float[np.ndarray, "W S"]] | None = None,
        sensors: bool = False,
    ) -> Trajectory:
        """Simulate W starts for S steps.

        Args:
            models: one model for all windows or one for each, of one spec with other numbers.
            start: the `W` starts.
            ctrl: `W x S x nu` controls, each held during its step.
            force: `W x S x nv` generalised forces in [N m] or [N], each held during its step.
            laws: controllers and force laws, evaluated before every step in this order.
            signals: recorded inputs of the laws by channel name, `W x S`.
            sensors: whether to record `sensordata`.

        Returns:
            The trajectory; a simulation that diverges is flagged, never raised.
        """
        signals, groups = signals or {}, _of_one_layout(models)
        if len(groups) > 1:
            parts = [
                self.rollout(
                    [models[w] for w in rows], start.rows(rows), ctrl[rows],
                    force=None if force is None else force[rows], laws=laws,
                    signals={n: x[rows] for n, x in signals.items()}, sensors=sensors,
                )
                for rows in groups
            ]  # fmt: skip
            return Trajectory.concatenated(parts).rows(np.argsort(np.concatenate(groups)))
        batch = self._prepare(models, start, ctrl[:, :1])
        before = _warnings(batch)
        with quietly():
            written = np.array(ctrl) if any(isinstance(w, Controller) for w in laws) else None
            if not laws:
                recorded = self._open_loop(batch, ctrl, force, sensors)
            else:
                model = _first(models)  # the batch's may have other names and another time step
                alone = force is None and not sensors
                every = steps_held(laws, model.opt.timestep) if alone else 1
                lockstep = LockStep(
                    model, tuple(laws), signals, live_arrays(model, batch.bind), force, every
                )
                if every > 1:
                    recorded = self._with_held_forces(batch, ctrl, lockstep, every)
                else:
                    recorded = self._lockstep(batch, ctrl, lockstep, sensors, written)
        states, sensordata, failed = recorded
        diverged = failed | (_warnings(batch) > before)
        return replace(_trajectory(batch.model, start, states, sensordata, diverged), ctrl=written)

    def final(
        self,
        models: mujoco.MjModel | Sequence[mujoco.MjModel],
        start: State,
        ctrl: Float[np.ndarray, "W nu"],
        steps: int,
    ) -> tuple[Float[np.ndarray, "W n"], Bool[np.ndarray, " W"]]:
        """Simulate W starts for `steps` steps under constant controls; return the last states.

        This is the hot path of one-step predictions: nothing in between is recorded.

        Returns:
            `W x (nq + nv + na)` final states, valid until the next call, and the `W` flags of
            those that diverged.
        """
        groups = _of_one_layout(models)
        if len(groups) > 1:
            parts = []
            for rows in groups:
                own = [models[w] for w in rows]
                states, diverged = self.final(own, start.rows(rows), ctrl[rows], steps)
                parts.append((states.copy(), diverged))
            order = np.argsort(np.concatenate(groups))
            states, diverged = (np.concatenate(p)[order] for p in zip(*parts, strict=True))
            return states, diverged
        batch = self._prepare(models, start, ctrl[:, None])
        before = _warnings(batch)
        if batch.model.nu:
            batch.bind("ctrl")[:] = ctrl
        failed = np.zeros(len(start), bool)
        try:
            with quietly():
                batch.step(nstep=steps)
        except SimulationError as error:
            failed[error.ids] = True
        first = _offset(batch)
        size = batch.model.nq + batch.model.nv + batch.model.na
        states = batch.state[:, first : first + size]
        return states, failed | (_warnings(batch) > before)

    def _prepare(
        self, models: mujoco.MjModel | Sequence[mujoco.MjModel], start: State, held: Ctrl
    ) -> Batch:
        """Return a batch loaded with the models and the starts, everything else reset.

        Delayed actuators act on the controls of the past first; where it is not known, on those
        that were `held`.
        """
        batch = self._loaded(models, len(start))
        if batch.model.nmocap:
            batch.reset(stage=mujoco.mjtStage.mjSTAGE_NONE)  # mocap poses may differ by model
        else:  # all defaults that matter are equal: one reset, copied, at a tenth of the time
            # counters of warnings are no state; where MuJoCo resets what diverged they return to 1,
            # so that one that was left at 1 would not show it
            warned = batch.warning[:, :, 1].any(axis=1)
            warned[0] = True
            batch.reset(ids=np.flatnonzero(warned), stage=mujoco.mjtStage.mjSTAGE_NONE)
            batch.state[:] = batch.state[0]
        batch.bind("qpos")[:] = start.qpos
        batch.bind("qvel")[:] = start.qvel
        if batch.model.na:
            batch.bind("act")[:] = start.act
        if start.warmstart is not None:
            batch.bind("qacc_warmstart")[:] = start.warmstart
        if batch.model.nhistory:
            load_past(
                batch.model, batch.bind("history"), held if start.past is None else start.past
            )
        return batch

    def _loaded(self, models: mujoco.MjModel | Sequence[mujoco.MjModel], count: int) -> Batch:
        """Return the kept batch where the models fit its structure, else a new one."""
        if self._batch is not None and self._batch.nsim == count:
            try:
                self._batch.set_models(models)
            except (mujoco.FatalError, ValueError):
                pass  # another structure: a new batch below
            else:
                return self._batch
        self._batch = Batch(_first(models), nsim=count, nthread=self.threads)
        self._batch.set_models(models)
        return self._batch

    def _open_loop(
        self,
        batch: Batch,
        ctrl: Ctrl,
        force: Float[np.ndarray, "W S nv"] | None,
        sensors: bool,
    ) -> tuple[np.ndarray, np.ndarray | None, Bool[np.ndarray, " W"]]:
        steps = ctrl.shape[1]
        control = ctrl if force is None else np.concatenate([ctrl, force], axis=2)
        spec = int(_CONTROL if force is None else _CONTROL_AND_FORCE)
        if sensors:  # sensordata trails the state by one step: run one step more
            control = np.concatenate([control, control[:, -1:]], axis=1)
        record = (int(_STATE), "sensordata") if sensors else (int(_STATE),)
        n = batch.model.nq + batch.model.nv + batch.model.na
        out: dict[int | str, np.ndarray] = {
            int(_STATE): np.zeros((batch.nsim, control.shape[1], n)),
        }
        if sensors:
            out["sensordata"] = np.zeros((batch.nsim, control.shape[1], batch.model.nsensordata))
        failed = np.zeros(batch.nsim, bool)
        try:
            batch.rollout(
                control.shape[1],
                control=control if control.shape[2] else None,
                control_spec=spec,
                record=record,
                out=out,
            )
        except SimulationError as error:
            failed[error.ids] = True
        return out[int(_STATE)][:, :steps], out.get("sensordata"), failed

    def _with_held_forces(
        self,
        batch: Batch,
        ctrl: Ctrl,
        lockstep: LockStep,
        every: int,
    ) -> tuple[np.ndarray, np.ndarray | None, Bool[np.ndarray, " W"]]:
        """Step with force laws that are evaluated every so many steps, and held between."""
        steps, model, spec = ctrl.shape[1], batch.model, int(_STATE)
        driven = batch.bind("ctrl")
        states = np.zeros((batch.nsim, steps, model.nq + model.nv + model.na))
        alive = np.ones(batch.nsim, bool)
        before = _warnings(batch)
        for k in range(0, steps, every):
            if model.nu:
                driven[:] = ctrl[:, k]
            lockstep.apply(k)
            rows, part = np.flatnonzero(alive), slice(k, min(k + every, steps))
            inputs = ctrl[rows, part] if model.nu else None
            count = part.stop - part.start
            out = {spec: np.zeros((len(rows), count, states.shape[2]))}
            states[~alive, part] = states[~alive, max(k - 1, 0), None]
            try:
                batch.rollout(count, control=inputs, record=(spec,), ids=rows, out=out)
            except SimulationError as error:
                alive[error.ids] = False
            states[rows, part] = out[spec]
            alive &= _warnings(batch) == before
        return states, None, ~alive

    def _lockstep(
        self,
        batch: Batch,
        ctrl: Ctrl,
        lockstep: LockStep,
        sensors: bool,
        written: Ctrl | None,
    ) -> tuple[np.ndarray, np.ndarray | None, Bool[np.ndarray, " W"]]:
        """Step with laws; the controls that they write are kept in `written`."""
        steps, model = ctrl.shape[1], batch.model
        driven, sensordata = batch.bind("ctrl"), batch.bind("sensordata") if sensors else None
        first, size = _offset(batch), model.nq + model.nv + model.na
        states = np.zeros((batch.nsim, steps, size))
        sensed = np.zeros((batch.nsim, steps + 1, model.nsensordata)) if sensors else None
        alive = np.ones(batch.nsim, bool)
        before = _warnings(batch)
        for k in range(steps + sensors):
            k_input = min(k, steps - 1)
            if model.nu:
                driven[:] = ctrl[:, k_input]
            lockstep.apply(k_input)
            if written is not None and k < steps:
                written[:, k] = driven
            try:
                batch.step(ids=None if alive.all() else np.flatnonzero(alive))
            except SimulationError as error:
                alive[error.ids] = False
            alive &= _warnings(batch) == before
            if sensed is not None:
                sensed[:, k] = sensordata
            if k < steps:
                good = batch.state[:, first : first + size]
                states[:, k] = np.where(alive[:, None], good, states[:, max(k - 1, 0)])
        return states, sensed, ~alive


def _of_one_layout(
    models: mujoco.MjModel | Sequence[mujoco.MjModel],
) -> list[Int[np.ndarray, " _"]]:
    """Return the rows of the models that one batch can hold together; none where there is one.

    MuJoCo keeps less of a free body whose centre of mass is where its frame is: where candidates
    have it there and elsewhere, those there take a batch of their own.
    """
    if isinstance(models, mujoco.MjModel):
        return []
    sizes = np.array([m.nbuffer for m in models])
    return [np.flatnonzero(sizes == size) for size in np.unique(sizes)]


def _first(models: mujoco.MjModel | Sequence[mujoco.MjModel]) -> mujoco.MjModel:
    return models if isinstance(models, mujoco.MjModel) else models[0]


def _warnings(batch: Batch) -> Int[np.ndarray, " W"]:
    """Return how often MuJoCo has warned in each simulation."""
    return np.asarray(batch.warning[:, :, 1].sum(axis=1))


def _offset(batch: Batch) -> int:
    """Return where qpos, qvel and act (adjacent in MuJoCo's state) begin in a state row."""
    return int(mujoco.mj_stateSize(batch.model, int(mujoco.mjtState.mjSTATE_TIME)))


def _trajectory(
    model: mujoco.MjModel,
    start: State,
    states: np.ndarray,
    sensordata: np.ndarray | None,
    diverged: Bool[np.ndarray, " W"],
) -> Trajectory:
    nq, nv = model.nq, model.nv
    whole = np.concatenate(
        [np.concatenate([start.qpos, start.qvel, start.act], axis=1)[:, None], states], axis=1
    )
    return Trajectory(
        whole[..., :nq], whole[..., nq : nq + nv], whole[..., nq + nv :], sensordata, diverged
    )
