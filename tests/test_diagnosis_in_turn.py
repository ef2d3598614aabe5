"""Effects that change one command: which of two comes first is found, and written."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
from diagnosis_helpers import SIGMA, arm, candidate, posed, record

from bo_sysid.diagnosis.answer.repaired import BESIDE, MODEL, write_model
from bo_sysid.diagnosis.search.search import Search
from bo_sysid.diagnosis.windows.candidate import Candidate, followed, orders
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis
from bo_sysid.diagnosis.windows.windowing import prepare
from bo_sysid.effects import Machine, survey
from bo_sysid.recording import Channel, Recording
from bo_sysid.simulation.stepper import Stepper

LAG, DEAD = 0.05, 0.1


@pytest.fixture(scope="module")
def machine() -> Machine:
    return survey(arm().compile(), [record([], duration=2.0)])


def held(machine: Machine, *effects: str, at: str = "shoulder") -> tuple[Candidate, ...]:
    return tuple(candidate(machine, effect, at) for effect in effects)


def test_orders_are_those_of_what_acts_on_one_command(machine: Machine) -> None:
    lag, dead, delay = held(machine, "actuator_lag", "actuator_deadzone", "actuator_delay")
    (other,) = held(machine, "actuator_lag", at="elbow")
    assert orders([lag, delay]) == []  # both are linear and the same at all times
    assert orders([dead, other]) == []
    assert orders([delay, lag, other, dead]) == [(0, 3, 2, 1)]
    both = held(machine, "actuator_lag", "actuator_deadzone", at="elbow")
    assert orders([lag, dead, *both]) == [(0, 1, 3, 2), (1, 0, 2, 3), (1, 0, 3, 2)]
    (rate,) = held(machine, "command_rate")
    assert len(orders([lag, dead, rate])) == 5
    assert [followed([lag, delay, dead], k) for k in range(3)] == [True, False, False]


def moved(*effects: str, finer: int = 4) -> Recording:
    """A recording of an arm whose shoulder has a lag and a dead zone in that or the other order."""
    commanded, model = record([], duration=6.0), arm().compile(timestep=0.002 / finer)
    time = commanded.channels["ctrl.shoulder"].time
    ctrl = np.stack([commanded.channels[f"ctrl.{n}"].values for n in ("shoulder", "elbow")], 1)
    data, qpos = mujoco.MjData(model), np.empty((len(time), 2))
    state = ctrl[0, 0] if effects[0] == "actuator_lag" else beyond(ctrl[0, 0])
    for k, (first, second) in enumerate(ctrl):
        qpos[k] = data.qpos
        for _ in range(finer):
            entering = first if effects[0] == "actuator_lag" else beyond(first)
            state += (entering - state) * -np.expm1(-model.opt.timestep / LAG)
            data.ctrl[:] = beyond(state) if effects[0] == "actuator_lag" else state, second
            mujoco.mj_step(model, data)
    qpos += SIGMA * np.random.default_rng(3).normal(size=qpos.shape)
    shown = {"shoulder": qpos[:, 0], "elbow": qpos[:, 1]}
    return Recording.from_arrays(
        time, qpos=shown, ctrl={"shoulder": ctrl[:, 0], "elbow": ctrl[:, 1]}
    )


def beyond(command: float) -> float:
    """What a dead zone leaves of a command."""
    return float(np.sign(command) * max(abs(command) - DEAD, 0.0))


@pytest.mark.parametrize(
    "effects", [("actuator_lag", "actuator_deadzone"), ("actuator_deadzone", "actuator_lag")]
)
def test_which_comes_first_is_found_from_either(effects: tuple[str, str]) -> None:
    problem, there = posed(moved(*effects), horizon=150)
    for begun in (effects, effects[::-1]):
        members = held(there, *begun)
        search = Search.on(prepare(problem), list(members), 2, None)
        fit = search.fit(members, [c.probe for c in members])
        assert tuple(c.effect.id for c in fit.members) == effects
        assert fit.rms < 1.3 < search.nominal.rms / 10
        found = {c.effect.id: float(x[0]) for c, x in zip(fit.members, fit.x, strict=True)}
        assert found["actuator_lag"] == pytest.approx(LAG, rel=0.05)
        assert found["actuator_deadzone"] == pytest.approx(DEAD, rel=0.05)


def test_a_file_says_a_lag_only_where_nothing_follows_it(tmp_path: Path, machine: Machine) -> None:
    for effects, written in (
        (("actuator_lag", "actuator_deadzone"), False),
        (("actuator_deadzone", "actuator_lag"), True),
    ):
        h = Hypothesis(held(machine, *effects), (np.array([LAG]), np.array([DEAD])))
        write_model(arm(), machine, h, tmp_path, timestep=0.002)
        model = mujoco.MjModel.from_xml_path(str(tmp_path / MODEL))
        assert bool(model.na) is written
        beside = (tmp_path / BESIDE).read_text()
        assert "actuator_deadzone" in beside
        assert ("actuator_lag" in beside) is not written


def test_a_stepper_applies_all_that_changes_a_command(tmp_path: Path, machine: Machine) -> None:
    h = Hypothesis(
        held(machine, "actuator_lag", "actuator_deadzone"), (np.array([LAG]), np.array([DEAD]))
    )
    write_model(arm(), machine, h, tmp_path, timestep=0.002)
    simulation = Stepper(tmp_path / MODEL, tmp_path / BESIDE)
    shoulder = simulation.model.joint("shoulder").dofadr[0]
    steps, force = 40, []
    for k in range(2 * steps):
        simulation.data.ctrl[0] = 0.0 if k < steps else 1.0
        simulation.step()
        force.append(simulation.data.qfrc_actuator[shoulder])
    after = (np.arange(steps) + 0.5) * 0.002  # the middle of a step
    expected = np.maximum(1.0 - np.exp(-after / LAG) - DEAD, 0.0)
    assert np.abs(force[:steps]).max() == 0.0
    assert force[steps:] == pytest.approx(expected, abs=1e-3)


@pytest.mark.parametrize(
    ("effects", "x"),
    [
        (("command_rate",), (0.2,)),
        (("actuator_lag", "actuator_deadzone"), (1.5, DEAD)),
        (("actuator_deadzone", "command_rate", "actuator_lag"), (DEAD, 0.15, 0.7)),
    ],
)
def test_a_stepper_keeps_the_state_of_slow_filters(
    tmp_path: Path, machine: Machine, effects: tuple[str, ...], x: tuple[float, ...]
) -> None:
    """A command is answered for longer than the commands are remembered."""
    members = held(machine, *effects)
    h = Hypothesis(members, tuple(np.array([v]) for v in x))
    write_model(arm(), machine, h, tmp_path, timestep=0.002)
    simulation = Stepper(tmp_path / MODEL, tmp_path / BESIDE)
    shoulder = simulation.model.joint("shoulder").dofadr[0]
    command = np.where((np.arange(2500) > 200) & (np.arange(2500) < 2000), 1.0, 0.0)
    force = np.empty_like(command)
    for k, u in enumerate(command):
        simulation.data.ctrl[0] = u
        simulation.step()
        force[k] = simulation.data.qfrc_actuator[shoulder]
    time = 0.002 * np.arange(2500)
    whole = Channel(time, command, hold="zero")
    for c, v in zip(members, x, strict=True):
        (acting,) = c.effect.parts(arm().spec(), c.site, c.full(np.array([v])), machine)
        whole = acting.change(whole, 0.002)
    assert force == pytest.approx(whole.at(time + 1e-9), abs=2e-3)
