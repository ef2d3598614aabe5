"""Whether parts of a model can touch, against what MuJoCo's own collision finds."""

import mujoco
import pytest

from bo_sysid.mjcf.touching import can_touch

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
