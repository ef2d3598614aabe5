"""Positions and speeds beside each other, where no forces are known: motions by formula."""

import mujoco
import numpy as np
import pytest

from bo_sysid.checks.rates import rate_flags
from bo_sysid.checks.wiring import find_wiring
from bo_sysid.recording import Recording

MODEL = mujoco.MjModel.from_xml_string("""<mujoco><worldbody><body><freejoint name="root"/>
<geom size=".1" mass="1"/>
<body><joint name="wheel" axis="0 1 0"/><geom size=".05" mass=".1"/></body>
<body><joint name="rod" type="slide" axis="1 0 0"/><geom size=".05" mass=".1"/></body></body>
</worldbody></mujoco>""")


def logged(position: float = 1.0, speed: float = 1.0, noise: float = 1e-4) -> Recording:
    """A wheel that turns to and fro by 2 rad at 1.3 rad/s, a rod that moves beside it."""
    time, rng = np.arange(0, 10, 0.01), np.random.default_rng(0)
    root = np.tile([0.0, 0, 1, 1, 0, 0, 0], (len(time), 1))
    wheel = 2 * np.sin(1.3 * time) + noise * rng.standard_normal(len(time))
    rod = 0.1 * np.sin(2.1 * time)
    return Recording.from_arrays(
        time,
        qpos={"root": root, "wheel": position * wheel, "rod": rod},
        qvel={"wheel": speed * 2.6 * np.cos(1.3 * time), "rod": 0.21 * np.cos(2.1 * time)},
    )


@pytest.mark.parametrize(
    ("position", "speed", "kinds"),
    [
        (1.0, 1.0, []),
        (-1.0, -1.0, []),  # which of the two that is, no speed tells
        (1.0, -1.0, ["sign"]),
        (-1.0, 1.0, ["sign"]),
        (180 / np.pi, 1.0, ["unit"]),
        (1.0, 30 / np.pi, ["unit"]),
        (-180 / np.pi, 1.0, ["sign", "unit"]),
        (1.0, 1.2, []),  # no unit is that near another
    ],
)
def test_a_speed_is_the_rate_of_its_position(position, speed, kinds) -> None:
    flags = rate_flags(MODEL, [logged(position, speed)])
    assert [f.kind for f in flags] == kinds
    for flag in flags:
        assert flag.level == "wrong"
        assert flag.channels == ("qpos.wheel", "qvel.wheel")
        assert flag.evidence["factor"] == pytest.approx(abs(position / speed), rel=0.02)


def test_it_is_told_where_the_wiring_is_not_tested() -> None:
    flags = find_wiring(MODEL, [logged(speed=-1.0)]).flags
    assert [f.kind for f in flags] == ["balance", "sign"]


def test_nothing_is_told_of_what_rests_or_was_not_recorded() -> None:
    rests = logged(position=0.0)
    assert not rate_flags(MODEL, [rests])
    alone = Recording("log", {n: c for n, c in logged().channels.items() if "qvel" not in n})
    assert not rate_flags(MODEL, [alone])
