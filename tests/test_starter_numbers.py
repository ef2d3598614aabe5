"""`init`: which column of a log is which joint, by the numbers in their names."""

import numpy as np
import pytest

from bo_sysid.mjcf import Model
from bo_sysid.recording import RawTable
from bo_sysid.starter.guess import guess_rules

TIME = np.arange(0.0, 6.0, 0.01)
ARM = """
<mujoco><worldbody>{}<body name="left"><joint name="finger_joint1" type="slide"/><geom size=".1"/>
  </body><body name="right"><joint name="finger_joint2" type="slide"/><geom size=".1"/></body>{}
  </worldbody><actuator>{}</actuator></mujoco>"""


def fingered(count: int) -> Model:
    """Return an arm whose joints and motors count from 1, with two fingers that nothing drives."""
    return Model.from_xml(
        ARM.format(
            "".join(
                f'<body name="link{k + 1}"><joint name="joint{k + 1}"/><geom size=".1"/>'
                for k in range(count)
            ),
            "</body>" * count,
            "".join(f'<motor name="m{k + 1}" joint="joint{k + 1}"/>' for k in range(count)),
        )
    )


def test_an_array_that_counts_from_0_is_that_of_the_joints_and_not_of_the_fingers() -> None:
    """Counted with the fingers the columns are fewer, and each number but 0 is a joint's, too."""
    count = 7
    waves = {k: np.sin((2 + 0.37 * k) * TIME + k) for k in range(count)}
    log = {f"q.{k}": wave for k, wave in waves.items()}
    log |= {f"dq.{k}": np.gradient(wave, TIME) for k, wave in waves.items()}
    log |= {f"tau.{k}": np.sign(wave) for k, wave in waves.items()}
    guesses = guess_rules(fingered(count), RawTable("log", {"t": TIME, **log})).guesses
    expected = {f"qpos.joint{k + 1}": f"q.{k}" for k in range(count)}
    expected |= {f"qvel.joint{k + 1}": f"dq.{k}" for k in range(count)}
    expected |= {f"ctrl.m{k + 1}": f"tau.{k}" for k in range(count)}
    assert {n: g.column for n, g in guesses.items()} == expected
    assert max(g.confidence for g in guesses.values()) < 0.85  # nothing is sure
    assert "the log counts from another number" in guesses["qpos.joint1"].reason


@pytest.mark.parametrize(
    ("columns", "expected"),
    [
        (["q.0", "q.1", "q.2"], {}),  # of four joints, whichever
        (["q.1", "q.2", "q.3"], {1: "q.1", 2: "q.2", 3: "q.3"}),
        (["r0_q.0", "r0_q.1", "r0_q.2", "r0_q.3"], {k + 1: f"r0_q.{k}" for k in range(4)}),
        (["joint0", "joint1", "joint2", "joint3"], {k + 1: f"joint{k}" for k in range(4)}),
    ],
)
def test_numbers_go_by_their_order_or_say_nothing_where_one_side_alone_counts_from_0(
    columns: list[str], expected: dict[int, str]
) -> None:
    table = RawTable("log", {"time": TIME, **dict.fromkeys(columns, np.sin(TIME))})
    rules = guess_rules(fingered(4), table).columns
    found = {n: rule["from"] for n, rule in rules.items() if n.startswith("qpos.")}
    assert found == {f"qpos.joint{k}": column for k, column in expected.items()}
