"""Drawing cases: sizes against a closed form, effects against the catalogue, plans, suites."""

from collections import Counter
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest
import yaml

from bo_sysid.effects import CATALOGUE, Site, survey
from bo_sysid.errors import StudyError
from bo_sysid.mjcf import Model
from bo_sysid.proof import conceal
from bo_sysid.proof.case import NoCase, draw_case
from bo_sysid.proof.draft import REALISED, Draft, Place, Scales
from bo_sysid.proof.machine import MotionCommand, load_machine
from bo_sysid.proof.oracle import true_magnitudes
from bo_sysid.proof.physics import Law, nominal_physics
from bo_sysid.proof.plan import GROUPED, Draw, plan
from bo_sysid.proof.rolled import Rolled
from bo_sysid.proof.size import Reference
from bo_sysid.proof.stepped import SteppedPlant, Stepping
from bo_sysid.proof.suite import load_suite
from bo_sysid.recording import Recording

FOLDER = Path(__file__).parent.parent / "studies" / "concealed"
DT = 0.002
FINE = Stepping(8, "RK4")


@pytest.fixture(scope="module")
def machines():
    files = sorted((FOLDER / "machines").glob("*.yaml"))
    return {m.name: m for m in (load_machine(f) for f in files)}


def written(folder, **changes):
    machine = str(FOLDER / "machines" / "cart_pole.yaml")
    suite = {
        "version": 1,
        "seed": 3,
        "cases": 12,
        "machines": ["cart_pole.yaml"],
        "seconds": {"train": 2.5, "holdout": 0.5},
    }
    content = yaml.safe_load(Path(machine).read_text())
    content["model"] = str((FOLDER / "machines" / content["model"]).resolve())
    (folder / "cart_pole.yaml").write_text(yaml.safe_dump(content))
    path = folder / "suite.yaml"
    path.write_text(yaml.safe_dump({**suite, **changes}))
    return path


def test_the_size_of_a_constant_force_is_what_no_start_explains():
    """½at² less its best straight line has the root mean square ½aT²/√180 over a window T."""
    xml = """<mujoco><option timestep="0.002" gravity="0 0 0"/><worldbody><body name="b">
      <joint name="x" type="slide" axis="1 0 0"/><geom size=".1" mass="2"/></body></worldbody>
      <actuator><motor name="m" joint="x"/></actuator></mujoco>"""
    model = Model.from_xml(xml).compile()
    physics = replace(nominal_physics(model), laws=(Law(0, lambda t, q, v, load: 0.6),))
    rolled = SteppedPlant(physics, Stepping(2, "RK4")).roll(lambda k, y: (np.sin(k),), 1000, DT)
    sigma, horizon = 1e-3, 0.3
    size = Reference(model, 2).size(rolled, np.array([sigma]))
    assert size == pytest.approx(0.5 * 0.3 * horizon**2 / np.sqrt(180) / sigma, rel=0.02)


def test_where_nothing_is_concealed_the_size_is_zero(machines):
    machine = machines["two_link_arm"]
    plain = SteppedPlant(nominal_physics(machine.compiled), FINE)
    rolled = roll(machine, plain, 1.5)
    assert Reference(plain.model, 8).size(rolled, np.full(2, 1e-3)) < 1e-3


def roll(machine, plant, seconds):
    dt, n = machine.file.timestep, machine.compiled.nv
    steps = round(seconds / dt)
    motion = MotionCommand(machine, seconds, np.random.default_rng(5), np.zeros((steps, n)))
    return plant.roll(motion, steps, dt)


def scales(machine, rolled):
    return Scales.of(nominal_physics(machine.compiled), rolled)


MODELLED = (
    "viscous_damping", "quadratic_damping", "constant_force", "joint_spring", "cogging",
    "armature", "payload", "link_mass", "actuator_gain", "servo_kp", "servo_kd",
    "actuator_saturation", "gravity_tilt",
)  # fmt: skip
"""Effects that the catalogue writes into MJCF and nowhere else."""


@pytest.mark.parametrize("id", MODELLED)
def test_the_forces_of_the_proof_are_the_edits_of_the_catalogue(machines, id):
    """Two implementations of one kind of physics, under one name and one magnitude."""
    servo = id.startswith("servo")
    machine = machines["two_link_arm_servos" if servo else "rotary_pendulum"]
    nominal = roll(machine, SteppedPlant(nominal_physics(machine.compiled), FINE), 1.0)
    rng = np.random.default_rng(7)
    site = REALISED[id].sites(machine)[-1]
    item = REALISED[id]
    concealed = item.scaled(item.draw(rng, Place(machine, scales(machine, nominal), site)), 3.0)
    if id == "actuator_saturation":
        concealed = item.scaled(concealed, 0.5)
    moved, apart = both(machine, concealed, nominal)
    assert moved > 1e-4
    assert apart < 0.01 * moved


def both(machine, concealed, nominal):
    """Return how far a change moves a plant, and how far the catalogue's edit ends from it."""
    draft = Draft.begin(machine, machine.compiled)
    REALISED[concealed.effect].compose(draft, concealed)
    commands = iter(nominal.ctrl)
    ours = SteppedPlant(draft.finished(), FINE).roll(lambda k, y: next(commands), 500, DT)
    moved = np.abs(ours.qpos - nominal.qpos).max()
    edited = catalogued(machine, concealed, nominal)
    commands = iter(nominal.ctrl)
    theirs = SteppedPlant(nominal_physics(edited), FINE)
    theirs.model.actuator_forcelimited[:] = edited.actuator_forcelimited
    theirs.model.actuator_forcerange[:] = edited.actuator_forcerange
    theirs = theirs.roll(lambda k, y: next(commands), 500, DT)
    return moved, np.abs(ours.qpos - theirs.qpos).max()


def surveyed(machine, nominal):
    """Return the scales of a machine, as the diagnosis measures them."""
    m = machine.compiled
    recording = Recording.from_arrays(
        nominal.time,
        qpos={machine.joint(j): nominal.qpos[:, j] for j in range(m.nv)},
        ctrl={m.actuator(a).name: nominal.ctrl[:, a] for a in range(m.nu)},
    )
    return survey(m, (recording,))


def catalogued(machine, concealed, nominal):
    """Return the nominal model with the catalogue's edit of the same magnitudes."""
    scaled = surveyed(machine, nominal)
    truth = concealed.plain()
    if concealed.effect == "actuator_saturation":
        truth["value"] = concealed.details["of"] - concealed.value  # the limit itself
    x = np.array(true_magnitudes(truth, scaled))
    site = Site(concealed.kind, concealed.site)
    effect = CATALOGUE[concealed.effect]
    return machine.model.compile([lambda spec: effect.parts(spec, site, x, scaled) and None])


@pytest.mark.parametrize("id", sorted(i for i, r in REALISED.items() if r.known))
def test_the_oracle_has_all_magnitudes_of_the_truth(machines, id):
    """A length that differs from the catalogue's would leave the case out of the comparison."""
    machine = next(m for m in machines.values() if REALISED[id].sites(m))
    nominal = roll(machine, SteppedPlant(nominal_physics(machine.compiled), FINE), 0.3)
    place = Place(machine, scales(machine, nominal), REALISED[id].sites(machine)[0])
    drawn = REALISED[id].draw(np.random.default_rng(4), place)
    made = true_magnitudes(drawn.plain(), surveyed(machine, nominal))
    if not CATALOGUE[id].hidden:
        assert len(made) == len(CATALOGUE[id].components)


@pytest.mark.parametrize("id", ["dry_friction", "stribeck_friction"])
def test_bristles_of_the_proof_are_those_of_the_catalogue(machines, id):
    """Dahl's and Canudas de Wit's forms against MuJoCo's, which damps bristles otherwise."""
    machine = machines["rotary_pendulum"]
    nominal = roll(machine, SteppedPlant(nominal_physics(machine.compiled), FINE), 1.0)
    place = Place(machine, scales(machine, nominal), "arm")
    concealed = REALISED[id].scaled(REALISED[id].draw(np.random.default_rng(7), place), 3.0)
    moved, apart = both(machine, concealed, nominal)
    assert apart < 0.02 * moved


def test_magnitude_zero_changes_nothing(machines):
    for name in ("two_link_arm_servos", "cart_pole"):
        machine = machines[name]
        plain = nominal_physics(machine.compiled)
        nominal = roll(machine, SteppedPlant(plain, FINE), 0.3)
        for id, item in REALISED.items():
            if not item.sites(machine) or id in ("backlash", "joint_compliance"):
                continue
            place = Place(machine, scales(machine, nominal), item.sites(machine)[0])
            nothing = item.scaled(item.draw(np.random.default_rng(1), place), 0.0)
            draft = Draft.begin(machine, machine.compiled)
            item.compose(draft, nothing)
            rolled = roll(machine, SteppedPlant(draft.finished(), FINE), 0.3)
            np.testing.assert_allclose(rolled.qpos, nominal.qpos, atol=1e-9, err_msg=id)


@pytest.mark.parametrize("id", sorted(REALISED))
def test_all_that_can_be_concealed_has_a_name_and_a_unit(machines, id):
    item = REALISED[id]
    fits = [m for m in machines.values() if item.sites(m)]
    assert fits, "no machine of the suites can conceal it"
    assert (id in CATALOGUE) == item.known
    flat = np.ones(fits[0].compiled.nv)
    scale = Scales(*([flat] * 6), np.ones(fits[0].compiled.nu), np.ones(fits[0].compiled.nu))
    drawn = item.draw(np.random.default_rng(0), Place(fits[0], scale, item.sites(fits[0])[0]))
    assert drawn.unit
    assert drawn.effect == id
    assert bool(drawn.depends_on) != item.known
    if item.known:
        assert drawn.kind == CATALOGUE[id].kind


def test_a_case_has_the_size_that_was_drawn_and_can_be_drawn_again(tmp_path):
    loaded = load_suite(written(tmp_path, sizes=[4.0, 8.0]))
    draw = Draw("case-1", 11, 2, "cart_pole", ("joint_spring",))
    case = draw_case(draw, loaded)
    again = draw_case(draw, loaded)
    assert case.truth == again.truth
    assert 3.0 < case.truth["size"] < 11.0
    train = case.recordings["train"]
    assert set(train.channels) == {"qpos.slider", "qpos.hinge", "ctrl.belt"}
    assert train.channels["qpos.slider"].unit == "m"
    np.testing.assert_array_equal(
        train.channels["qpos.hinge"].values, again.recordings["train"].channels["qpos.hinge"].values
    )
    assert train.span == (0.0, 2.498)


def test_a_suite_is_another_one_with_another_model(tmp_path):
    """An interrupted concealment is not gone on with after a model was changed."""
    suite = written(tmp_path)
    machine = tmp_path / "cart_pole.yaml"
    content = yaml.safe_load(machine.read_text())
    xml = Path(content["model"]).read_text()
    (tmp_path / "model.xml").write_text(xml)
    machine.write_text(yaml.safe_dump({**content, "model": str(tmp_path / "model.xml")}))
    before = conceal.suite_record(suite, {})
    assert conceal.suite_record(suite, {}) == before
    (tmp_path / "model.xml").write_text(xml.replace('gear="10"', 'gear="11"'))
    assert conceal.suite_record(suite, {}) != before


def test_in_the_place_of_a_case_that_cannot_be_had_another_is_drawn(tmp_path, monkeypatch):
    loaded = load_suite(written(tmp_path), {})
    draws = plan(loaded)
    wanted = next(d for d in draws if d.effects)

    def refused(draw, loaded):
        if draw.seed == wanted.seed:
            raise NoCase(draw.name)
        return draw_case(draw, loaded)

    monkeypatch.setattr(conceal, "draw_case", refused)
    made = conceal._drawn(wanted, draws, loaded).draw
    assert (made.name, made.tier) == (wanted.name, wanted.tier)
    assert made.effects
    assert made.seed != wanted.seed
    assert conceal._drawn(wanted, draws, loaded).draw == made


def test_parameters_are_off_where_the_draw_says_so(tmp_path):
    loaded = load_suite(written(tmp_path))
    case = draw_case(Draw("case-1", 5, 3, "cart_pole", parameters=True), loaded)
    (parameter,) = case.parameters
    true = case.truth["parameters"][parameter.name]
    assert parameter.low < true < parameter.high
    assert true not in parameter.grid
    assert case.truth["size"] < 0.01


def test_no_mass_is_concealed_that_the_study_lists(tmp_path):
    loaded = load_suite(written(tmp_path))
    machine = loaded.machines["cart_pole"]
    assert machine.bodies_of_masses(["geom[cart].mass", "joint[*].damping"]) == {"cart"}
    for seed in range(4):  # of cart and pole only the pole's mass is left
        case = draw_case(
            Draw("case-1", seed, 2, "cart_pole", ("link_mass",), parameters=True), loaded
        )
        assert [e["site"] for e in case.truth["effects"]] == ["pole"]


def test_a_plan_deals_evenly_and_conceals_nothing_often_enough(tmp_path):
    loaded = load_suite(written(tmp_path, cases=200, nothing=0.3, groups=0.1, pairs=0.2))
    draws = plan(loaded)
    assert plan(loaded) == draws
    assert len(draws) == 200
    assert [d.name for d in draws] == sorted(d.name for d in draws)
    nothing = [d for d in draws if not d.effects]
    assert len(nothing) == 60
    assert {d.tier for d in nothing} == {2, 3}
    tiers = Counter(d.tier for d in draws if d.effects)
    assert tiers == {2: 56, 3: 56, 4: 28}
    assert sum(len(d.effects) == 2 for d in draws) == 22
    assert all(d.effects[0] in GROUPED for d in draws if d.grouped)
    kinds = Counter(i for d in draws if d.tier == 3 for i in d.effects if not d.grouped)
    assert max(kinds.values()) - min(kinds.values()) <= 3
    assert len({d.seed for d in draws}) == 200


def test_a_suite_without_effects_of_groups_has_no_groups() -> None:
    chosen = {"effects": ["payload"], "cases": 20, "seed": 1, "groups": 0.5}
    assert "payload" not in GROUPED
    draws = plan(load_suite(FOLDER / "quick.yaml", chosen))
    assert len(draws) == 20
    assert not any(d.grouped for d in draws)


def test_without_a_seed_nobody_draws_the_same_plan_again(tmp_path):
    loaded = load_suite(written(tmp_path, seed=None))
    one, other = plan(loaded), plan(loaded)
    assert {d.seed for d in one}.isdisjoint(d.seed for d in other)


def test_names_of_cases_say_nothing(tmp_path):
    """Over many plans the place of a case in the order is unrelated to what it conceals."""
    loaded, first = load_suite(written(tmp_path, cases=12, nothing=0.5)), 0
    for seed in range(60):
        draws = plan(replace(loaded, suite=loaded.suite.model_copy(update={"seed": seed})))
        first += sum(not d.effects for d in draws[:6])
    assert 150 < first < 210  # 180 on average, its standard deviation is about 7


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"nothing": 0.1}, "greater than or equal to 0.25"),
        ({"sizes": [3, 3]}, "3 must be below 3"),
        ({"tiers": {1: 1.0}}, "tiers: weights of 2, 3, 4"),
        ({"effects": ["dry_frction"]}, "did you mean 'dry_friction'"),
        ({"machines": ["none-*.yaml"]}, "matches no file"),
        ({"machine": ["a.yaml"]}, "unknown key; did you mean 'machines'"),
        ({"pairs": 0.7, "groups": 0.7}, "together at most 1"),
    ],
)
def test_a_wrong_suite_is_refused_with_the_rule(tmp_path, changes, match):
    with pytest.raises(StudyError, match=match):
        load_suite(written(tmp_path, **changes))


def test_a_wrong_machine_is_refused(tmp_path):
    written(tmp_path)
    content = yaml.safe_load((tmp_path / "cart_pole.yaml").read_text())
    for change, match in (
        ({"move": {}}, "does not say how 'belt' is moved"),
        ({"limits": {"slidr": {}}}, "not in the model; did you mean 'slider'"),
        ({"equations": "cart"}, "unknown 'cart'; did you mean 'cart_pole'"),
    ):
        (tmp_path / "cart_pole.yaml").write_text(yaml.safe_dump({**content, **change}))
        with pytest.raises(StudyError, match=match):
            load_suite(tmp_path / "suite.yaml")


def test_scales_of_a_motion():
    t = np.arange(4000) * 0.001
    q = np.sin(2 * np.pi * t)[:, None]
    v = 2 * np.pi * np.cos(2 * np.pi * t)[:, None]
    xml = """<mujoco><option gravity="0 0 0"/><worldbody><body><joint name="x" type="slide"/>
      <geom size=".1" mass="3"/></body></worldbody>
      <actuator><motor name="m" joint="x" gear="2"/></actuator></mujoco>"""
    physics = nominal_physics(mujoco.MjModel.from_xml_string(xml))
    found = Scales.of(physics, Rolled(t, q, v, np.full((4000, 1), 0.7), q))
    assert found.speed[0] == pytest.approx(2 * np.pi / np.sqrt(2), rel=1e-3)
    assert found.span[0] == pytest.approx(2.0, rel=1e-3)
    assert found.inertia[0] == pytest.approx(3.0)
    assert found.force[0] == pytest.approx(3 * (2 * np.pi) ** 2 / np.sqrt(2), rel=1e-2)
    assert found.effort[0] == pytest.approx(1.4)


def test_machines_of_a_suite_may_be_named_by_absolute_paths(tmp_path: Path) -> None:
    suite = tmp_path / "suite.yaml"
    suite.write_text(f"cases: 4\nmachines: ['{FOLDER / 'machines'}/cart_pole.yaml']\n")
    assert list(load_suite(suite).machines) == ["cart_pole"]


@pytest.mark.parametrize("changed", [{"effects": []}, {"effects": ["backlash"], "tiers": {4: 1.0}}])
def test_a_suite_of_which_nothing_can_be_concealed_is_told(changed: dict[str, object]) -> None:
    suite = load_suite(FOLDER / "quick.yaml", changed)
    with pytest.raises(StudyError, match="none of its effects can be concealed in its tiers"):
        plan(suite)
    assert plan(load_suite(FOLDER / "quick.yaml", {**changed, "nothing": 1.0}))
