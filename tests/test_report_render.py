"""MuJoCo's own picture, where this machine can render; else a drawing, which needs nothing."""

from pathlib import Path

import mujoco
import numpy as np
import pytest
from matplotlib.image import imread

from bo_sysid.mjcf import Model
from bo_sysid.mjcf.edits import SkyEdit
from bo_sysid.report.render import rendered
from bo_sysid.report.robot import Posed, find_site, outline, view
from bo_sysid.report.robot_figure import robot

ARM = Path(__file__).parents[1] / "studies" / "diagnosis" / "two_link_arm.xml"
ELBOW = [0.0, 0.0, -0.3]  # [m] in the pose of all zeros
POSE = {"qpos.shoulder": 0.0, "qpos.elbow": -0.5 * np.pi}


def test_a_mark_is_red_where_the_joint_is(tmp_path: Path) -> None:
    if rendered(ARM, POSE, [ELBOW], tmp_path / "marked.png") is None:
        pytest.skip("neither EGL nor OSMesa renders here (apt-get install libegl1)")
    assert rendered(ARM, POSE, [], tmp_path / "plain.png") is not None
    marked, plain = (imread(tmp_path / f"{n}.png")[..., :3] for n in ("marked", "plain"))
    changed = np.abs(marked - plain).max(axis=2) > 0.05
    assert 100 < changed.sum() < 0.1 * changed.size
    red, _, blue = marked[changed].mean(axis=0)
    assert red > 1.5 * blue


def test_rendering_imports_nothing_from_the_folder_it_is_started_in(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "numpy.py").write_text("open('imported', 'w')")
    monkeypatch.chdir(tmp_path)
    rendered(ARM, POSE, [], tmp_path / "plain.png")
    assert not (tmp_path / "imported").exists()


def test_a_model_that_cannot_be_read_is_not_rendered(tmp_path: Path) -> None:
    (tmp_path / "out.png").write_text("of an earlier run")
    assert rendered(tmp_path / "none.xml", {}, [], tmp_path / "out.png") is None
    assert not list(tmp_path.iterdir())


def test_a_model_gets_light_and_a_white_sky_where_it_has_none() -> None:
    ball = "<worldbody>{}<body><freejoint/><geom size='.1'/></body></worldbody>"
    own = (
        "<asset><texture type='skybox' builtin='flat' width='8' height='48' rgb1='0 0 1'/></asset>"
    )
    plain, lit = (Model.from_xml(f"<mujoco>{t}</mujoco>") for t in (
        ball.format(""), own + ball.format("<light pos='0 0 2'/>")
    ))  # fmt: skip
    sky = int(mujoco.mjtTexture.mjTEXTURE_SKYBOX)
    made, kept = (m.compile([SkyEdit()], visuals=True) for m in (plain, lit))
    assert made.tex_type.tolist() == kept.tex_type.tolist() == [sky]
    assert made.tex_data.min() == 255
    assert kept.tex_data[0] == 0
    assert made.vis.headlight.ambient[0] == kept.vis.headlight.ambient[0] == pytest.approx(0.6)
    assert plain.compile(visuals=True).ntex == 0


def test_a_model_whose_own_light_shines_elsewhere_is_seen(tmp_path: Path) -> None:
    text = """<mujoco><worldbody><light pos="0 0 1" dir="0 0 1"/>
      <body><joint axis="0 1 0"/><geom type="box" size=".3 .3 .3" rgba=".7 .7 .7 1"/></body>
    </worldbody></mujoco>"""
    (tmp_path / "box.xml").write_text(text)
    if rendered(tmp_path / "box.xml", {}, [], tmp_path / "box.png") is None:
        pytest.skip("neither EGL nor OSMesa renders here (apt-get install libegl1)")
    middle = imread(tmp_path / "box.png")[200:280, 280:360, :3]
    assert middle.mean() > 0.6


def test_joints_lie_where_kinematics_puts_them() -> None:
    posed = Posed.of(Model.from_file(ARM), POSE)
    np.testing.assert_allclose(posed.joint_place("elbow"), ELBOW, atol=1e-9)
    site = find_site(posed, "actuator", "elbow")
    assert site.point is not None
    np.testing.assert_allclose(site.point, ELBOW, atol=1e-9)
    assert find_site(posed, "world", "world").point is None
    assert find_site(posed, "body", "forearm").geoms == (posed.model.geom("forearm").id,)


def test_a_load_is_pointed_at_where_it_is() -> None:
    text = """<mujoco><worldbody><body name="beam" pos="0 0 1"><joint name="a" axis="0 -1 0"/>
      <geom type="capsule" fromto="0 0 0 .4 0 0" size=".01" mass="1"/>
      {}</body></worldbody></mujoco>"""
    point_mass = '<inertial pos="0 0 0" mass=".1" diaginertia="0 0 0"/>'
    load = f'<body name="beam_payload" pos=".4 0 0">{point_mass}</body>'
    pose = {"qpos.a": np.pi / 2}
    for more, reach in (("", 0.2), (load, 0.4)):
        point = find_site(Posed.of(Model.from_xml(text.format(more)), pose), "body", "beam").point
        np.testing.assert_allclose(point, [0, 0, 1 + reach], atol=1e-9)


@pytest.mark.parametrize("count", [1, 2, 4])
def test_words_of_sites_stand_in_a_list_and_their_numbers_at_the_sites(count: int) -> None:
    posed = Posed.of(Model.from_file(ARM), POSE)
    named = [("actuator", "elbow"), ("joint", "elbow"), ("body", "forearm"), ("joint", "shoulder")]
    sites = [(find_site(posed, kind, name), f"{name}:\n{kind}") for kind, name in named[:count]]
    drawing, beside = robot(posed, sites).axes
    (said,) = (t.get_text() for t in beside.texts)
    assert [line for line in said.splitlines() if line[0].isdigit()] == [
        f"{k}  {name}:" for k, (_, name) in enumerate(named[:count], start=1)
    ]
    at = {t.get_text(): t.xy for t in drawing.texts if t.get_text()[0].isdigit()}
    assert at.keys() == {1: {"1"}, 2: {"1, 2"}, 4: {"1, 2", "3", "4"}}[count]
    elbow = next(n for n in at if n.startswith("1"))
    np.testing.assert_allclose(at[elbow], view(posed) @ ELBOW, atol=1e-3)


def test_names_of_joints_keep_away_from_marks_and_stand_once() -> None:
    posed = Posed.of(Model.from_file(ARM), POSE)
    figure = robot(posed, [(find_site(posed, "actuator", "elbow"), "elbow:\nlag")])
    figure.draw_without_rendering()
    drawing = figure.axes[0]
    said = {t.get_text(): t for t in drawing.texts}
    assert {"shoulder", "elbow", "1"} <= said.keys()
    ring = next(x for x in drawing.lines if x.get_markersize() > 20)
    middle = drawing.transData.transform(ring.get_xydata()[0])
    words = said["elbow"].get_window_extent()
    nearest = np.clip(middle, words.min, words.max)
    assert np.linalg.norm(nearest - middle) > 11 * figure.dpi / 72  # the ring's radius
    marked = robot(posed, [(find_site(posed, "joint", "elbow"), "elbow:\nfriction")])
    assert "elbow" not in {t.get_text() for t in marked.axes[0].texts}


def test_the_view_shows_the_plane_in_which_the_arm_moves() -> None:
    posed = Posed.of(Model.from_file(ARM), POSE)
    onto = view(posed)
    axis = posed.data.xaxis[posed.model.joint("elbow").id]
    np.testing.assert_allclose(onto @ axis, 0, atol=1e-9)
    np.testing.assert_allclose(onto[1], [0, 0, 1], atol=1e-9)


def test_an_outline_is_as_long_as_the_link() -> None:
    posed = Posed.of(Model.from_file(ARM), {})
    geom = posed.model.geom("upper").id
    radius, half = posed.model.geom_size[geom, :2]
    flat = outline(posed.surface(geom), view(posed))
    np.testing.assert_allclose(np.ptp(flat, axis=0), [2 * radius, 2 * (half + radius)], rtol=0.02)


def test_a_propeller_is_shown_where_it_acts(tmp_path: Path) -> None:
    path = tmp_path / "quad.xml"
    path.write_text(
        '<mujoco><worldbody><body name="frame" pos="0 0 1"><freejoint name="base"/>'
        '<geom size=".1"/><site name="rotor" pos=".2 .1 0"/></body></worldbody>'
        '<actuator><motor name="m1" site="rotor" gear="0 0 1 0 0 0"/></actuator></mujoco>'
    )
    posed = Posed.of(Model.from_file(path), {})
    np.testing.assert_allclose(find_site(posed, "actuator", "m1").point, [0.2, 0.1, 1.0])
