"""Hypotheses as edits and parts."""

from dataclasses import replace
from itertools import permutations
from pathlib import Path
from xml.sax.saxutils import escape

import mujoco
import numpy as np
import pytest
from diagnosis_helpers import SIGMA, arm, posed, record
from effect_bench import MOTOR, SLIDE, Bench, pendulum
from effect_machines import case

from bo_sysid.diagnosis.answer.repaired import BESIDE, MODEL, MODULE, write_model
from bo_sysid.diagnosis.windows.candidate import candidates, parameter_candidates
from bo_sysid.diagnosis.windows.evidence import make_evidence
from bo_sysid.diagnosis.windows.hypothesis import Hypothesis, edits_and_parts
from bo_sysid.diagnosis.windows.recorded_contact import meets_stops
from bo_sysid.diagnosis.windows.timestep import coarsened, finer_step
from bo_sysid.effects import (
    CATALOGUE,
    Component,
    Extent,
    Force,
    Reading,
    catalogue,
    load_effects,
    survey,
)
from bo_sysid.effects.beside import read_beside
from bo_sysid.errors import ModelError, StudyError
from bo_sysid.mjcf import Model
from bo_sysid.mjcf.touching import can_touch
from bo_sysid.parameters import Parameter
from bo_sysid.recording import Channel, Recording
from bo_sysid.simulation import Controller, LawInputs

MINE = Path(__file__).parent.parent / "studies" / "effects" / "my_effect.py"


def test_an_effect_whose_extent_is_wrong_is_named_with_its_site() -> None:
    own = CATALOGUE["viscous_damping"]
    c = case("cheetah")

    def fails(site, machine):
        raise KeyError("scale")

    with pytest.raises(StudyError, match=r"'viscous_damping' at \w+: its extent fails: KeyError"):
        candidates([replace(own, extent=fails)], c.machine)
    two = Extent((1.0, 1.0), (0.0, 0.0), (2.0, 2.0))
    with pytest.raises(StudyError, match=r"has 2 numbers; it needs one for each component"):
        candidates([replace(own, extent=lambda site, machine: two)], c.machine)
    idle = Extent((1.0, 0.0), (0.0, 0.0), (2.0, 2.0))
    both = (Component("force", "N m"), Component("rate", "N m s/rad"))
    with pytest.raises(StudyError, match=r"its extent's probe of rate is 0"):
        candidates([replace(own, extent=lambda s, m: idle, components=both)], c.machine)


def test_each_part_comes_once_however_often_a_model_is_edited() -> None:
    # dm-control's cheetah uses settotalmass: an edit that moves no mass is applied twice
    c = case("cheetah")
    effects = [CATALOGUE[i] for i in ("asymmetric_damping", "encoder_scale")]
    found = candidates(effects, c.machine)
    force = next(f for f in found if f.effect.id == "asymmetric_damping")
    scale = next(f for f in found if f.effect.id == "encoder_scale")
    hypothesis = Hypothesis((force, scale), (force.probe, np.array([0.1])))
    edits, parts = edits_and_parts(hypothesis, c.machine)
    for _ in range(2):
        c.model.compile(edits)
        assert [type(p) for p in parts] == [Force, Reading, Reading]


ROD = """<mujoco><option gravity="0 0 0"/><worldbody><body name="rod">
<joint name="a" axis="0 1 0" damping=".1"/><geom name="g" type="sphere" size=".05" density="900"/>
<body pos="0 0 1"><joint name="b" axis="0 1 0" damping=".5"/><geom size=".1"/></body>
</body></worldbody></mujoco>"""


@pytest.mark.parametrize("order", list(permutations(range(3))))
def test_parameters_are_the_same_model_in_any_order(order: tuple[int, ...]) -> None:
    """A body's mass is what was asked for whatever its geoms' sizes became, its inertia as well."""
    model, t = Model.from_xml(ROD), np.arange(0, 2, 0.01)
    machine = survey(model.compile(), [Recording.from_arrays(t, qpos={"a": t, "b": t})])
    asked = {"body[rod].mass": 0.6, "geom[g].size[0]": 0.02, "body[rod].inertia[0]": 1.5e-4}
    parameters = [Parameter(a, (a,), 1e-6, 2.0) for a in asked]
    held = [parameter_candidates(model, parameters)[k] for k in order]
    change = [np.array([asked[c.site.name] - c.effect.nominal(c.site, machine)]) for c in held]
    edits, _ = edits_and_parts(Hypothesis((), (), tuple(held), tuple(change)), machine)
    made, told = model.compile(edits), list(asked.values())
    assert made.body("rod").mass[0] == pytest.approx(told[0])
    assert made.geom("g").size[0] == pytest.approx(told[1])
    assert made.body("rod").inertia[0] == pytest.approx(told[2])


def test_one_value_for_numbers_that_differ_in_the_model_is_no_jump() -> None:
    model, t = Model.from_xml(ROD), np.arange(0, 2, 0.01)
    machine = survey(model.compile(), [Recording.from_arrays(t, qpos={"a": t, "b": t})])
    held = parameter_candidates(model, [Parameter("damping", ("joint[*].damping",), 0.0, 1.0)])
    for change in (0.0, 1e-9):
        h = Hypothesis((), (), held, (np.array([change]),))
        made = model.compile(edits_and_parts(h, machine)[0])
        np.testing.assert_allclose(np.ravel(made.dof_damping)[:2], 0.3, atol=1e-8)


def test_laws_of_drives_are_of_what_others_made_of_them() -> None:
    """Friction by load of a motor whose gain is off, whichever was named first."""
    bench = pendulum(MOTOR)
    share, gain = (
        next(c for c in candidates([CATALOGUE[e]], bench.machine) if not c.preslides)
        for e in ("load_dependent_friction", "actuator_gain")
    )
    more = {share.key: np.array([0.1]), gain.key: np.array([0.5])}
    for members in ((share, gain), (gain, share)):
        h = Hypothesis(members, tuple(more[c.key] for c in members))
        edits, parts = edits_and_parts(h, bench.machine)
        bench.model.compile(edits)
        (law,) = (p.law for p in parts if isinstance(p, Force))
        moving = {"hinge": np.array([5.0])}
        motion = LawInputs(np.zeros(1), moving, moving, {"motor": np.array([0.8])}, {}, 1e-4)
        assert law(motion)[0] == pytest.approx(-0.1 * 1.5 * 0.8)


def test_an_effect_with_which_no_model_compiles_is_named() -> None:
    def breaks(spec, site, x, machine):
        spec.geoms[0].mass = -1.0

    problem, _ = posed(record(duration=2.0), horizon=100)
    own = replace(CATALOGUE["viscous_damping"], apply=breaks)
    c = candidates([own], problem.machine)[0]
    with pytest.raises(ModelError, match=r"negative.*; tried was viscous_damping at"):
        problem.compiled(Hypothesis((c,), (c.probe,)))


def test_an_effect_that_raises_is_named_where_a_law_makes_controls() -> None:
    def fails(spec, site, x, machine):
        raise RuntimeError("of its author")

    own = replace(CATALOGUE["viscous_damping"], apply=fails)
    law = Controller("elbow", lambda inputs: 0.1 * np.sin(5 * inputs.time))
    with pytest.raises(StudyError, match=r"'viscous_damping' at shoulder fails: .*of its author"):
        make_evidence(
            arm(), [record(duration=2.0)], effects=[own], noise={"qpos": SIGMA}, laws=[law]
        )


def test_what_would_change_a_known_number_is_not_looked_for() -> None:
    recording = record(duration=2.0)
    names = ("viscous_damping", "armature", "link_mass", "gravity_tilt")
    effects = [CATALOGUE[n] for n in names]
    known = ("joint[elbow].damping", "body[forearm].mass", "option.gravity[2]")

    def found(known: tuple[str, ...]) -> set[tuple[str, str]]:
        evidence = make_evidence(arm(), [recording], effects=effects, known=known)
        return {c.key for c in evidence.candidates}

    gone = found(()) - found(known)
    assert gone == {
        ("viscous_damping", "elbow"), ("link_mass", "forearm"), ("gravity_tilt", "world"),
    }  # fmt: skip
    with pytest.raises(ModelError, match=r"joint\[elbw\].damping.*did you mean 'elbow'"):
        found(("joint[elbw].damping",))


@pytest.mark.parametrize(
    ("halved", "numerics", "division"), [(1, 0.0, 1), (2, 0.0, 2), (2, 1.0, 8)]
)
def test_the_repaired_model_has_the_step_at_which_it_was_fitted(
    tmp_path, halved: int, numerics: float, division: int
) -> None:
    _, machine = posed(record(duration=2.0))
    own = machine.model.opt.timestep
    write_model(arm(), machine, Hypothesis(numerics=numerics), tmp_path, timestep=own / halved)
    written = mujoco.MjModel.from_xml_path(str(tmp_path / MODEL))
    assert written.opt.timestep == pytest.approx(own / division)


@pytest.mark.parametrize(("effect", "lost"), [("command_rate", 0.98), ("actuator_delay", 0.2)])
def test_a_filter_is_read_as_it_was_written_at_a_finer_step(
    tmp_path, effect: str, lost: float
) -> None:
    """A rate is told from the recorded ones by the step; a delay is shorter than the file's."""
    _, machine = posed(record(duration=2.0))
    step = machine.model.opt.timestep
    late = next(c for c in candidates([CATALOGUE[effect]], machine) if c.site.name == "elbow")
    x = np.array([lost * (late.high[0] if effect == "command_rate" else step)])
    own = Hypothesis((late,), (x,), numerics=1.0)  # which a quarter of the step shows
    write_model(arm(), machine, own, tmp_path, timestep=step)
    repaired = Model.from_file(tmp_path / MODEL)
    assert repaired.compile().opt.timestep == pytest.approx(step / 4)
    (read,) = read_beside(tmp_path / BESIDE, repaired.compile()).parts(repaired)
    (made,) = late.effect.parts(arm().spec(), late.site, late.full(x), machine)
    time = np.arange(0.0, 1.0, 0.01)
    command = Channel(time, np.sign(np.sin(20 * time)), "", "", "zero")
    shown, expected = (p.change(command, step / 4).at(time + step / 8) for p in (read, made))
    np.testing.assert_allclose(shown, expected)
    assert np.abs(shown - command.at(time + step / 8)).max() > 0.1 * np.ptp(command.values)


def test_a_delay_of_between_two_steps_is_written_once(tmp_path) -> None:
    """The model steps at 5 ms, its file at 1.25 ms, and 4 ms are in the file alone."""
    slow = Bench(SLIDE.replace("0.001", "0.005"))
    (late,) = candidates([CATALOGUE["actuator_delay"]], slow.machine)[:1]
    own = Hypothesis((late,), (np.array([0.004]),))
    written = write_model(slow.model, slow.machine, own, tmp_path, timestep=0.00125)
    assert not written.beside
    assert {p.name for p in tmp_path.iterdir()} == {MODEL}
    model = mujoco.MjModel.from_xml_path(str(tmp_path / MODEL))
    data, force = mujoco.MjData(model), []
    for k in range(12):
        data.ctrl[:] = float(k >= 4)
        mujoco.mj_step(model, data)
        force.append(float(data.actuator_force[0]))
    first = int(np.flatnonzero(force)[0])
    assert (first - 4) * model.opt.timestep == pytest.approx(0.004, abs=model.opt.timestep)


def test_effects_on_a_control_that_a_law_makes_are_not_looked_for() -> None:
    recorded = record(duration=2.0)
    law = Controller("elbow", lambda inputs: 0.1 * np.sin(5 * inputs.time))
    names = ("actuator_delay", "actuator_deadzone", "actuator_gain")
    made = make_evidence(
        arm(), [recorded], effects=[CATALOGUE[n] for n in names], noise={"qpos": SIGMA},
        threads=1, laws=[law],
    )  # fmt: skip
    found = {c.key for c in made.candidates}
    assert found == {
        ("actuator_delay", "shoulder"), ("actuator_deadzone", "shoulder"),
        ("actuator_gain", "shoulder"), ("actuator_gain", "elbow"),
    }  # fmt: skip


def test_a_force_of_a_users_own_is_written_beside_the_model(tmp_path) -> None:
    _, machine = posed(record(duration=2.0))
    (mine,) = load_effects(MINE)
    spot = next(iter(candidates([mine], machine)))
    own = Hypothesis(members=(spot,), x=(spot.probe,))
    written = write_model(arm(), machine, own, tmp_path, timestep=machine.model.opt.timestep)
    assert written.beside == (f"a force on joint {spot.site}",)
    (force,) = read_beside(tmp_path / BESIDE, machine.model).parts(arm(), catalogue([MINE]))
    assert isinstance(force, Force)
    with pytest.raises(ModelError, match=r"model_repaired\.json: unknown effect 'worn_spot'"):
        read_beside(tmp_path / BESIDE, machine.model).parts(arm())


def test_no_name_of_a_model_is_run_as_code(tmp_path) -> None:
    name = 'x""";raise(SystemExit("ran"))#\\'
    quoted = escape(name, {'"': "&quot;"})
    xml = MOTOR.replace('name="motor"', f'name="{quoted}"')
    bench = pendulum(xml)
    zone = next(c for c in candidates([CATALOGUE["actuator_deadzone"]], bench.machine))
    assert zone.site.name == name
    own = Hypothesis(members=(zone,), x=(zone.probe,))
    write_model(bench.model, bench.machine, own, tmp_path, timestep=0.001)
    text = (tmp_path / MODULE).read_text(encoding="utf-8")
    made: dict[str, object] = {"__file__": str(tmp_path / MODULE)}
    exec(compile(text, MODULE, "exec"), made)  # noqa: S102 - runs what is tested
    stepper = made["load"]()
    stepper.step()
    assert "raise(SystemExit" in text  # in a comment


def test_what_an_earlier_diagnosis_left_beside_the_model_is_gone(tmp_path) -> None:
    _, machine = posed(record(duration=2.0))
    zone = next(c for c in candidates([CATALOGUE["actuator_deadzone"]], machine))
    step = machine.model.opt.timestep
    own = replace(Hypothesis(), members=(zone,), x=(zone.probe,))
    written = write_model(arm(), machine, own, tmp_path, timestep=step)
    assert written.beside
    assert {BESIDE, MODULE} <= {p.name for p in tmp_path.iterdir()}
    written = write_model(arm(), machine, Hypothesis(), tmp_path, timestep=step)
    assert not written.beside
    assert {p.name for p in tmp_path.iterdir()} == {MODEL}


@pytest.mark.parametrize(
    ("share", "change", "division"),
    [
        (1.15, 10.0, 8),  # a step 8 times finer shows 7/6 of the correction, 4 times finer 1
        (1.15, 2.5, 8),
        (1.15, 0.25, 4),
        (1.15, 0.1, 2),
        (1.15, 0.02, 1),
        (1.33, 1.0, 8),  # a machine, which moves continuously, shows 4/3 of it
        (1.33, 5.0, 16),
        (1.85, 0.58, 8),  # no step shows as much: the rest is something else's
    ],
)
def test_a_step_is_as_coarse_as_its_error_lets_it_be(
    share: float, change: float, division: int
) -> None:
    fitted = Hypothesis(numerics=share)
    assert finer_step(coarsened(fitted, change).numerics) == division


@pytest.mark.parametrize(("nearest_approach", "contact"), [(0.3, False), (0.02, True)])
def test_contact_counts_where_the_machine_came_to_touch(
    nearest_approach: float, contact: bool
) -> None:
    # a slide with a ball of 5 cm that comes as near as that to a wall
    model = Model.from_xml(
        '<mujoco><worldbody><geom name="wall" type="plane" size="1 1 .1" zaxis="1 0 0"/>'
        '<body name="cart"><joint name="x" type="slide" axis="1 0 0"/>'
        '<geom name="ball" size=".05"/></body></worldbody>'
        '<actuator><motor name="push" joint="x"/></actuator></mujoco>'
    )
    time = np.arange(0, 4, 0.01)
    position = nearest_approach + 0.2 * (1 + np.cos(3 * time))
    recording = Recording.from_arrays(time, qpos={"x": position}, ctrl={"push": 0 * time})
    evidence = make_evidence(model, [recording], effects=(), threads=1)
    assert can_touch(evidence.model.compile()) is contact
    assert can_touch(evidence.given.compile())
    assert bool(evidence.notes) is not contact
    assert (evidence.window < 0.2) is contact


@pytest.mark.parametrize(("reach", "met"), [(0.9, False), (1.1, True)])
def test_a_machine_that_meets_its_stops_is_one_with_impacts(reach: float, met: bool) -> None:
    model = Model.from_xml(
        '<mujoco><worldbody><body><joint name="a" axis="0 1 0" range="-30 60"/>'
        '<geom size=".1"/></body></worldbody></mujoco>'
    )
    time = np.arange(0, 6, 0.01)
    swing = np.deg2rad(15 + reach * 45 * np.sin(4 * time)) + 1e-4 * np.cos(99 * time)
    recording = Recording.from_arrays(time, qpos={"a": swing})
    assert meets_stops(model.compile(), [recording]) is met
    assert (make_evidence(model, [recording], effects=(), threads=1).window < 0.2) is met


@pytest.mark.parametrize(("hop", "window"), [(0.0, 0.3), (0.02, 0.1)])
def test_windows_are_long_where_a_contact_lasts(hop: float, window: float) -> None:
    """A ball rolls on the floor; impacts decide where it hops, in what is set aside as well."""
    model = Model.from_xml(
        '<mujoco><worldbody><geom name="floor" type="plane" size="5 5 .1"/>'
        '<body name="ball"><joint name="z" type="slide" axis="0 0 1"/>'
        '<joint name="x" type="slide" axis="1 0 0"/><geom name="ball" size=".05"/></body>'
        '</worldbody><actuator><motor name="push" joint="x"/></actuator></mujoco>'
    )

    def rolling(hop: float) -> Recording:
        time, rng = np.arange(0, 4, 0.005), np.random.default_rng(0)
        z = 0.05 + hop * np.maximum(0, np.sin(3 * time)) + 2e-4 * rng.standard_normal(time.size)
        return Recording.from_arrays(
            time, qpos={"x": np.sin(2 * time), "z": z}, ctrl={"push": 0 * time}
        )

    evidence = make_evidence(model, [rolling(hop)], effects=(), threads=1)
    assert evidence.model is model  # contact is simulated
    assert evidence.window == window
    assert evidence.machine.impacts is (hop > 0)
    assert evidence.with_contact_of([rolling(0.02)]).machine.impacts
    assert evidence.with_contact_of([rolling(0.0)]) is evidence
