"""Whether parts of a model can touch, against what MuJoCo's own collision finds."""

import mujoco
import numpy as np
import pytest

from bo_sysid.mjcf.touching import can_touch, comes_and_goes, joints_to_contact

ALONE = '<body><joint/><geom size=".1"/><geom size=".1"/></body>'
TWO = (
    '<body name="a"><joint/><geom size=".1"/></body><body name="b"><joint/><geom size=".1"/></body>'
)
CHAIN = '<body><joint/><geom size=".1"/><body name="c"><joint/><geom size=".1"/>{}</body></body>'
FLOOR = '<geom type="plane" size="1 1 .1"/>'
EXCLUDED = '<contact><exclude body1="b" body2="a"/></contact>'


@pytest.mark.parametrize(
    ("world", "rest", "expected"),
    [
        (ALONE, "", False),
        (FLOOR + ALONE, "", True),
        (TWO, "", True),
        (TWO, EXCLUDED, False),
        (TWO, '<option><flag contact="disable"/></option>', False),
        (CHAIN.format(""), "", False),
        (CHAIN.format(""), '<option><flag filterparent="disable"/></option>', True),
        (CHAIN.format('<body><joint/><geom size=".1"/></body>'), "", True),
        (CHAIN.format('<body><geom size=".1"/></body>'), "", False),
        (TWO.replace("/></body><body", ' contype="0" conaffinity="0"/></body><body'), "", False),
        (TWO.replace('size=".1"', 'size=".1" contype="2" conaffinity="4"'), "", False),
    ],
)
def test_it_says_what_mujoco_collides(world: str, rest: str, expected: bool) -> None:
    model = mujoco.MjModel.from_xml_string(f"<mujoco>{rest}<worldbody>{world}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)  # every geom lies at the origin
    assert (data.ncon > 0) is expected
    assert can_touch(model) is expected


@pytest.mark.parametrize("noise", [0.0, 5e-4])
@pytest.mark.parametrize(("hop", "goes"), [(0.0, False), (0.01, True)])
def test_a_contact_lasts_where_only_noise_lifts_it(noise: float, hop: float, goes: bool) -> None:
    """A ball that rolls on a floor, and may hop a centimetre high in a tenth of the time."""
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco><worldbody>{FLOOR}"
        '<body><joint type="slide"/><joint type="slide" axis="1 0 0"/><geom size=".1"/></body>'
        "</worldbody></mujoco>"
    )
    t, rng = np.linspace(0, 1, 500), np.random.default_rng(0)
    height = 0.1 - 1e-5 + hop * np.maximum(np.sin(np.pi * np.clip(10 * t - 4, 0, 1)), 0)
    true = np.stack([height, np.sin(6 * t)], axis=1)
    poses = true + noise * rng.standard_normal(true.shape)
    moved = poses + noise * rng.standard_normal(true.shape)
    assert comes_and_goes(model, poses, moved) is goes


def test_where_these_poses_miss_what_touches_nothing_is_known_to_last() -> None:
    model = mujoco.MjModel.from_xml_string(
        f"<mujoco><worldbody>{FLOOR}"
        '<body><joint type="slide" axis="0 0 1"/><geom size=".1"/></body></worldbody></mujoco>'
    )
    poses = np.full((20, 1), 0.15)
    assert comes_and_goes(model, poses, poses)


@pytest.mark.parametrize("off", [False, True])
def test_a_listed_pair_is_moved_by_the_joints_of_its_bodies(off: bool) -> None:
    flag = '<option><flag contact="disable"/></option>' if off else ""
    model = mujoco.MjModel.from_xml_string(
        f'<mujoco>{flag}<worldbody><geom name="floor" type="plane" size="1 1 .1" contype="0"/>'
        '<body><joint name="fall" type="slide"/><inertial pos="0 0 0" mass="1" '
        'diaginertia="1 1 1"/><body><joint name="tilt"/>'
        '<geom name="foot" size=".1" contype="0"/></body></body></worldbody>'
        '<contact><pair geom1="floor" geom2="foot"/></contact></mujoco>'
    )
    assert joints_to_contact(model) == (set() if off else {"fall", "tilt"})
