"""`init`: what the names of columns say, as common loggers write them."""

import numpy as np
import pytest

from bo_sysid.mjcf import Model
from bo_sysid.recording import RawTable
from bo_sysid.starter.columns import describe
from bo_sysid.starter.guess import Rules, guess_rules, read
from bo_sysid.starter.movers import with_movers
from bo_sysid.starter.naming import named

TIME = 0.01 * np.arange(600)
ANGLES = {"shoulder": np.sin(2 * TIME) + np.sin(3.1 * TIME), "elbow": np.sin(4.3 * TIME + 1)}
RATES = {n: np.gradient(q, TIME) for n, q in ANGLES.items()}
FORCES = {"shoulder": np.cos(5 * TIME), "elbow": np.cos(7.7 * TIME + 2)}
ARM = """
<mujoco><worldbody><body><joint name="shoulder"/><geom size=".1"/><body><joint name="elbow"/>
  <geom size=".1"/></body></body></worldbody>
  <actuator><motor name="shoulder" joint="shoulder"/><motor name="elbow" joint="elbow"/></actuator>
</mujoco>"""


def guessed(model: str, **columns: dict[str, np.ndarray]) -> Rules:
    """Return what is guessed of a log whose columns are called after joints, as {}_pos."""
    named = {n.format(j): v for n, of in columns.items() for j, v in of.items()}
    return guess_rules(Model.from_xml(model), RawTable("log", {"time": TIME, **named}))


def sources(rules: Rules) -> dict[str, str]:
    """Return the column of each channel of the elbow."""
    return {n: str(r["from"]) for n, r in rules.columns.items() if n.endswith(".elbow")}


@pytest.mark.parametrize(
    ("other", "values"),
    [
        ("joint_acceleration_{}", {n: np.gradient(v, TIME) for n, v in RATES.items()}),
        ("joint_error_{}", {n: 0.01 * v for n, v in ANGLES.items()}),
        ("/error/positions/{}", {n: 0.01 * v for n, v in ANGLES.items()}),
        ("joint_temperatures_{}", {n: 30 + 0.1 * v for n, v in ANGLES.items()}),
    ],
)
def test_errors_accelerations_and_temperatures_are_no_positions(
    other: str, values: dict[str, np.ndarray]
) -> None:
    """They stand before the positions, as in the order of the alphabet."""
    joint = "joint_{}_{{}}".format
    rules = guessed(
        ARM, **{other: values, joint("positions"): ANGLES, joint("torques"): FORCES,
                joint("velocities"): RATES}
    )  # fmt: skip
    assert sources(rules) == {
        "qpos.elbow": "joint_positions_elbow", "qvel.elbow": "joint_velocities_elbow",
        "ctrl.elbow": "joint_torques_elbow",
    }  # fmt: skip
    assert set(rules.unused) == {other.format(j) for j in ANGLES}


def test_german_names_with_units_in_brackets_are_read() -> None:
    columns = {"Zeit [ms]": 1e3 * TIME}
    columns |= {f"Achse{k} Ist [°]": np.rad2deg(a) for k, a in enumerate(ANGLES.values())}
    columns |= {f"Achse{k} Soll [Nm]": f for k, f in enumerate(FORCES.values())}
    rules = guess_rules(Model.from_xml(ARM), RawTable("log", columns))
    assert sources(rules) == {"qpos.elbow": "Achse1 Ist [°]", "ctrl.elbow": "Achse1 Soll [Nm]"}
    assert rules.columns["time"] == {"from": "Zeit [ms]", "unit": "ms"}
    assert rules.columns["qpos.elbow"]["unit"] == "°"
    assert [named(n, "").kind for n in ("th1", "Drehzahl", "Strom1", "q Istwert")] == [
        "position", "velocity", "effort", "position",
    ]  # fmt: skip


def test_numbered_axes_with_actual_and_set_values_are_joints_and_goals_in_order() -> None:
    """As controllers of machines name them; the eight columns of a SCARA were left to be filled."""
    bodies = "".join(
        f'<body pos="{k} 0 0"><joint name="{n}" range="-170 170"/><geom size=".1"/></body>'
        for k, n in enumerate(("J1", "J2"))
    )
    servos = "".join(f'<position name="servo{k}" joint="J{k}" kp="20" kv="1"/>' for k in (1, 2))
    model = f"<mujoco><worldbody>{bodies}</worldbody><actuator>{servos}</actuator></mujoco>"
    columns = {f"axis{k}_act": np.rad2deg(q) for k, q in enumerate(ANGLES.values(), 1)}
    columns |= {f"axis{k}_set": np.rad2deg(q) for k, q in enumerate(GOALS.values(), 1)}
    rules = guess_rules(Model.from_xml(model), RawTable("log", {"time": TIME, **columns}))
    assert rules.columns == {
        "qpos.J1": {"from": "axis1_act", "unit": "deg"},
        "qpos.J2": {"from": "axis2_act", "unit": "deg"},
        "ctrl.servo1": {"from": "axis1_set", "unit": "deg"},
        "ctrl.servo2": {"from": "axis2_set", "unit": "deg"},
    }
    assert named("motor_applied", "").kind == "other"


def test_a_unit_behind_a_name_of_the_convention_is_read_unless_the_joint_is_called_so() -> None:
    log = RawTable("log", {"time": TIME, "qpos.elbow_deg": np.rad2deg(ANGLES["elbow"])})
    assert guess_rules(Model.from_xml(ARM), log).columns["qpos.elbow"]["unit"] == "deg"
    so_called = Model.from_xml(ARM.replace('"elbow"', '"elbow_deg"'))
    assert "unit" not in guess_rules(so_called, log).columns.get("qpos.elbow_deg", {})


@pytest.mark.parametrize(("output", "input_"), [("y.{}", "u.{}"), ("y_train.{}", "u_train.{}")])
def test_outputs_y_beside_inputs_u_are_positions_in_their_order(output: str, input_: str) -> None:
    """As files of benchmarks have them: they were left to be filled in, though the inputs were
    found."""
    columns = {output.format(k): 0.1 * a for k, a in enumerate(ANGLES.values())}
    columns |= {input_.format(k): f for k, f in enumerate(FORCES.values())}
    rules = guess_rules(Model.from_xml(ARM), RawTable("log", {"time": TIME, **columns}))
    assert sources(rules) == {"qpos.elbow": output.format(1), "ctrl.elbow": input_.format(1)}
    assert rules.guesses["qpos.elbow"].confidence < 0.5
    assert named("bob_y", "").kind == named("bob_x", "").kind == "other"


@pytest.mark.parametrize("name", ["Vm (V)", "Vm"])
def test_the_voltage_of_a_motor_is_not_the_speed_that_goes_with_it(name: str) -> None:
    """Back-EMF holds a geared motor to the speed that its voltage asks for."""
    hub = """<mujoco><worldbody><body><joint name="theta" damping=".08" armature="2e-3"/>
      <geom size=".01" mass=".01"/></body></worldbody>
      <actuator><motor name="Vm" joint="theta" gear=".13"/></actuator></mujoco>"""
    volts = np.sin(2 * TIME) + np.sin(3.1 * TIME)
    theta = np.cumsum(0.13 / 0.08 * volts) * 0.01
    log = {"time": TIME, name: volts, "theta (counts)": np.rint(theta * 4096 / (2 * np.pi))}
    rules = guess_rules(Model.from_xml(hub), RawTable("log", log))
    assert {n: r["from"] for n, r in rules.columns.items()} == {
        "qpos.theta": "theta (counts)",
        "ctrl.Vm": name,
    }
    guess = rules.guesses["qpos.theta"]
    assert guess.confidence <= 0.5
    assert "4096 ticks a turn" in guess.reason


def test_what_is_told_to_be_another_quantity_is_no_control_that_is_left() -> None:
    """A wheel's acceleration goes with its torque, whatever made that."""
    body = '<body><joint name="wheel"/><geom size=".1"/></body>'
    motor = '<actuator><motor name="motor" joint="wheel"/></actuator>'
    wheel = f"<mujoco><worldbody>{body}</worldbody>{motor}</mujoco>"
    angle = ANGLES["shoulder"]
    table = {"time": TIME, "wheel_pos": angle, "wheel_acc": np.gradient(RATES["shoulder"], TIME)}
    rules = guess_rules(Model.from_xml(wheel), RawTable("log", table))
    assert rules.unmatched == ("motor",)
    log = [RawTable("log", table)]
    assert with_movers(Model.from_xml(wheel), log, rules).unmatched == ("motor",)


@pytest.mark.parametrize("name", ["{}_pos", "{}_deg", "theta_{}", "{}"])
def test_joints_that_go_round_a_circle_are_no_rates_of_each_other(name: str) -> None:
    """A joint that follows a cosine moves as the rate of one that follows a sine."""
    circle = {"shoulder": np.sin(2 * TIME), "elbow": np.cos(2 * TIME)}
    rules = guessed(ARM, **{name: circle, "{}_torque": FORCES})
    assert not rules.held
    assert sources(rules) == {"qpos.elbow": name.format("elbow"), "ctrl.elbow": "elbow_torque"}


@pytest.mark.parametrize("name", ["theta_{}_dot", "theta{}dot", "{}_d", "state.{}.1"])
def test_a_rate_is_told_from_a_column_that_is_called_a_position(name: str) -> None:
    rules = guessed(ARM, **{"theta_{}": ANGLES, name: RATES, "{}_torque": FORCES})
    assert sources(rules) == {
        "qpos.elbow": "theta_elbow", "qvel.elbow": name.format("elbow"),
        "ctrl.elbow": "elbow_torque",
    }  # fmt: skip


GOALS = {n: q + 0.1 * FORCES[n] for n, q in ANGLES.items()}
POSITION, VELOCITY, INTEGRAL = (
    ARM.replace("<motor", f"<{servo}").replace("/></act", f' {gain}="9"/></act')
    for servo, gain in (("position", "kp"), ("velocity", "kv"), ("intvelocity", "kp"))
)


@pytest.mark.parametrize("model", [POSITION, VELOCITY])
def test_an_effort_is_no_goal_of_a_servo(model: str) -> None:
    """The joint states of ROS hold efforts, and no goals."""
    states = {"{}_position": ANGLES, "{}_velocity": RATES, "{}_effort": FORCES}
    rules = guessed(model, **states)
    assert rules.unmatched == ("shoulder", "elbow")
    assert set(rules.unused) == {"shoulder_effort", "elbow_effort"}


@pytest.mark.parametrize(
    ("model", "control"),
    [
        (POSITION, "{}_pos_cmd"),
        (VELOCITY, "{}_cmd_rpm"),
        (INTEGRAL, "{}_cmd_rpm"),
        (ARM, "{}_torque"),
    ],
)
@pytest.mark.parametrize("turned", [False, True])
def test_a_control_is_what_its_actuator_takes(model: str, control: str, turned: bool) -> None:
    """Whichever comes first in the log."""
    states = {"{}_pos": ANGLES, "{}_vel": RATES}
    told = {"{}_torque": FORCES, "{}_cmd_rpm": RATES, "{}_pos_cmd": GOALS, "{}_current": FORCES,
            "{}_voltage": FORCES}  # fmt: skip
    rules = guessed(model, **states, **dict(reversed(told.items()) if turned else told))
    assert sources(rules)["ctrl.elbow"] == control.format("elbow")
    assert rules.columns["ctrl.elbow"].get("unit") == ("rpm" if "rpm" in control else None)


@pytest.mark.parametrize(
    ("name", "unit", "kind"),
    [
        ("elbow_pos_turns", "turns", "position"),
        ("elbow_pos_rev", "rev", "position"),
        ("rev_pos", "", "position"),
        ("cart_cm", "cm", "position"),
        ("elbow_velocity_deg_s", "deg/s", "velocity"),
        ("elbow_vel_deg_per_sec", "deg/s", "velocity"),
        ("elbow_vel_turns_s", "turn/s", "velocity"),
        ("elbow_vel_dps", "deg/s", "velocity"),
        ("elbow_degps_2", "deg/s", "velocity"),
        ("elbow vel (Deg/Sec)", "deg/s", "velocity"),
        ("elbow vel [deg/sec]", "deg/sec", "velocity"),
        ("elbow_vel_deg", "deg/s", "velocity"),
        ("enc_ticks_s", "", "velocity"),
        ("elbow_rad_s", "rad/s", "velocity"),
        ("cart_vel_mm_s", "mm/s", "velocity"),
        ("elbow_current_ma", "mA", "effort"),
        ("arm_ma", "", "other"),
        ("elbow_torque_Ncm", "Ncm", "effort"),
        ("elbow torque (N-m)", "N-m", "effort"),
    ],
)
def test_names_carry_the_units_of_common_logs(name: str, unit: str, kind: str) -> None:
    (column,) = (c for c in describe(RawTable("log", {"time": TIME, name: TIME})) if c.name == name)
    assert (column.unit, column.kind) == (unit, kind)


def test_speeds_in_degrees_and_positions_in_turns_are_read_so() -> None:
    turns = {n: q / (2 * np.pi) for n, q in ANGLES.items()}
    degrees = {n: np.rad2deg(v) for n, v in RATES.items()}
    log = {"{}_pos_turns": turns, "{}_vel_deg_s": degrees, "{}_current_ma": FORCES}
    named = {n.format(j): v for n, of in log.items() for j, v in of.items()}
    table = RawTable("log", {"time": TIME, **named})
    channels = read(table, guess_rules(Model.from_xml(ARM), table)).channels
    np.testing.assert_allclose(channels["qpos.elbow"].values, ANGLES["elbow"])
    np.testing.assert_allclose(channels["qvel.elbow"].values, RATES["elbow"])
    np.testing.assert_allclose(channels["ctrl.elbow"].values, 1e-3 * FORCES["elbow"])


def test_a_current_position_is_a_position_and_no_current() -> None:
    log = {"current_position_{}": ANGLES, "{}_current_speed": RATES, "joint_current_{}": FORCES}
    rules = guessed(ARM, **log)
    assert sources(rules) == {
        "qpos.elbow": "current_position_elbow", "qvel.elbow": "elbow_current_speed",
        "ctrl.elbow": "joint_current_elbow",
    }  # fmt: skip


def test_what_is_called_like_another_column_with_a_d_is_what_that_was_to_be() -> None:
    """As the states of a Franka; commanded speeds are smoother than the measured ones."""
    rng = np.random.default_rng(0)
    measured = {n: v + 0.02 * rng.standard_normal(len(TIME)) for n, v in RATES.items()}
    wished = {n: q + 0.01 * np.sin(9 * TIME) for n, q in ANGLES.items()}
    states = {"q_d_{}": wished, "q_{}": ANGLES, "dq_d_{}": RATES, "dq_{}": measured}
    expected = {"qpos.elbow": "q_elbow", "qvel.elbow": "dq_elbow"}
    assert sources(guessed(ARM, **states)) == expected
    assert sources(guessed(POSITION, **states)) == expected | {"ctrl.elbow": "q_d_elbow"}
    rate = guessed(ARM, **{"theta_{}": ANGLES, "theta_{}_d": RATES})  # no wish goes so far from it
    assert sources(rate)["qpos.elbow"] == "theta_elbow"


@pytest.mark.parametrize("goal", ["{}_goal_pos", "target_velocity_{}", "q_ref_{}"])
def test_a_goal_is_no_torque_of_a_motor(goal: str) -> None:
    """As of servos on a machine whose URDF says nothing of them."""
    rules = guessed(ARM, **{"{}_pos": ANGLES, goal: GOALS})
    assert rules.unmatched == ("shoulder", "elbow")
    assert set(rules.unused) == {goal.format(j) for j in ANGLES}


def test_the_name_of_a_joint_says_nothing_of_its_control() -> None:
    model = ARM.replace("elbow", "q2").replace("shoulder", "theta")
    log = {"theta_cmd": GOALS["elbow"], "u_q2": GOALS["shoulder"], "theta": TIME, "q2": -TIME}
    rules = guess_rules(Model.from_xml(model), RawTable("log", {"time": TIME, **log}))
    assert rules.columns["ctrl.theta"] == {"from": "theta_cmd"}
    assert rules.columns["ctrl.q2"] == {"from": "u_q2"}


@pytest.mark.parametrize(
    ("name", "unit"),
    [
        ("t_s", "s"), ("timestamp_s", "s"), ("timestamp_sec", "s"), ("elapsed", "s"),
        ("seconds", "s"), ("ts", "s"), ("millis", "ms"), ("t_millis", "ms"), ("epoch_ms", "ms"),
        ("micros", "us"), ("timestamp_usec", "us"), ("stamp_nsec", "ns"), ("Zeit [s]", "s"),
    ],
)  # fmt: skip
def test_clocks_are_found_by_their_names_in_logs_with_a_pause(name: str, unit: str) -> None:
    """The pause keeps the clock from being found by its equal steps."""
    per = {"s": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}[unit]
    time = np.where(TIME > 2, TIME + 5, TIME)
    table = RawTable("log", {name: time / per, "elbow_pos": ANGLES["elbow"]})
    rules = guess_rules(Model.from_xml(ARM), table)
    assert rules.columns["time"].get("from") == name
    np.testing.assert_allclose(read(table, rules).channels["qpos.elbow"].time, time)


def test_a_count_of_rows_is_a_clock_that_is_looked_at() -> None:
    """It may count ms, but most likely it does not."""
    table = RawTable("log", {"frame": np.arange(600), "elbow_pos": ANGLES["elbow"]})
    guess = guess_rules(Model.from_xml(ARM), table).guesses["time"]
    assert guess.confidence < 0.55
    assert "it counts the rows" in guess.reason


def test_whole_seconds_are_no_clock() -> None:
    """ROS stamps have their seconds and nanoseconds apart."""
    stamps = {"stamp_sec": np.floor(TIME), "stamp_nanosec": 1e9 * (TIME % 1.0)}
    table = RawTable("log", {**stamps, "elbow_pos": ANGLES["elbow"], "log_time": TIME})
    assert guess_rules(Model.from_xml(ARM), table).columns["time"] == {"from": "log_time"}


def test_a_name_that_two_columns_carry_is_a_guess() -> None:
    log = {f"{side}_elbow_{what}": v for side, of in (("left", ANGLES), ("right", FORCES))
           for what, v in zip(("pos", "torque"), of.values(), strict=True)}  # fmt: skip
    rules = guess_rules(Model.from_xml(ARM), RawTable("log", {"time": TIME, **log}))
    for channel, other in (("qpos.elbow", "pos"), ("ctrl.elbow", "torque")):
        guess = rules.guesses[channel]
        assert guess.confidence < 0.55
        assert f"_elbow_{other} has as well" in guess.reason
    sure = guessed(ARM, **{"{}_pos": ANGLES, "{}_torque": FORCES, "{}_current": FORCES})
    assert sure.guesses["ctrl.elbow"].confidence > 0.9  # a torque goes before a current


@pytest.mark.parametrize("side", ["{}_wheel_joint", "{}_wheel"])
def test_words_that_all_joints_have_need_not_be_in_the_log(side: str) -> None:
    model = ARM.replace("shoulder", side.format("left")).replace("elbow", side.format("right"))
    angles = dict(zip(("left", "right"), ANGLES.values(), strict=True))
    rules = guessed(model, **{"enc_{}": angles})
    found = {n: rule["from"] for n, rule in rules.columns.items() if n.startswith("qpos")}
    assert found == {f"qpos.{side.format(n)}": f"enc_{n}" for n in ("left", "right")}


@pytest.mark.parametrize("name", ["imu.angular_velocity.y", "gyro_x", "/imu/gyro/z"])
def test_an_axis_of_a_gyroscope_is_no_speed_of_a_joint(name: str) -> None:
    assert named(name, "").kind == "foreign"
    assert named("gyro_position", "").kind == "position"


@pytest.mark.parametrize("names", [("肩", "肘"), ("Hüfte", "Hände")])
def test_names_in_any_letters_are_compared_as_they_are(names: tuple[str, str]) -> None:
    """Of joints whose letters no column has nothing is likely by its name."""
    model = ARM.replace('"shoulder"', f'"{names[0]}"').replace('"elbow"', f'"{names[1]}"')
    moved = dict(zip(names, ANGLES.values(), strict=True))
    rules = guessed(model, **{"{}_pos": moved})
    assert {n: r["from"] for n, r in rules.columns.items() if n.startswith("qpos.")} == {
        f"qpos.{n}": f"{n}_pos" for n in names
    }
    foreign = dict(zip(("delta", "alpha"), ANGLES.values(), strict=True))
    rules = guessed(model, **{"{}_pos": foreign})
    assert not any("similar name" in guess.reason for guess in rules.guesses.values())


def test_volts_behind_an_actuators_name_and_counts_behind_a_joints_are_read() -> None:
    """A V at the end is none of the name's where no axis or phase is called so."""
    assert (named("valve_V", "").kind, named("valve_V", "").unit) == ("effort", "V")
    assert named("axis_V", "").unit == named("phase_V", "").unit == ""
    assert (named("arm_counts", "").kind, named("arm_counts", "").unit) == ("position", "ticks")
    assert named("arm_volts_V", "").unit == "V"


def test_a_greek_letter_beside_a_joints_name_is_a_position_unless_it_behaves_like_a_rate() -> None:
    """As of rotary pendulums, whose angles are theta and alpha."""
    names = {"theta_shoulder": ANGLES["shoulder"], "alpha_elbow": ANGLES["elbow"]}
    rates = {"beta_elbow": RATES["elbow"]}
    table = RawTable("log", {"time": TIME, **names, **rates, "tau": FORCES["elbow"]})
    found = guess_rules(Model.from_xml(ARM), table)
    assert found.columns["qpos.shoulder"]["from"] == "theta_shoulder"
    assert found.columns["qpos.elbow"]["from"] == "alpha_elbow"
    assert found.columns["qvel.elbow"]["from"] == "beta_elbow"
    assert not found.held


@pytest.mark.parametrize(
    ("column", "unit"),
    [("u_elbow_MPa", "MPa"), ("p_elbow_cmd_bar", "bar"), ("elbow_cmd [kPa]", "kPa")],
)
def test_pressures_of_a_cylinder_are_read_in_pascals(column: str, unit: str) -> None:
    """A bar that no pressure stands beside is a link, as of a four-bar."""
    model = Model.from_xml(
        ARM.replace('<motor name="elbow" joint="elbow"/>',
                    '<cylinder name="elbow" joint="elbow" area="1e-4"/>')
    )  # fmt: skip
    angles = {f"{n}_pos": q for n, q in ANGLES.items()}
    table = RawTable("log", {"time": TIME, **angles, column: FORCES["elbow"]})
    rule = guess_rules(model, table).columns["ctrl.elbow"]
    assert rule == {"from": column, "unit": unit}
    pressed = read(table, guess_rules(model, table)).channels["ctrl.elbow"]
    one = {"MPa": 1e6, "bar": 1e5, "kPa": 1e3}[unit]
    assert pressed.values == pytest.approx(one * FORCES["elbow"])
    assert named("coupler_bar", "").unit == ""
