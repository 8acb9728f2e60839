"""Loading a robot's MJCF reads no files outside of its folder, never hangs and bounds memory."""

import os
import struct

import pytest

from envs import mjcf
from envs.mjcf import reading, sources
from tests.envs.user_arm import write

_MESH = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n"


@pytest.fixture
def robots(tmp_path):
    """Make a folder with meshes, and a second folder beside it."""
    for folder in ("robot/meshes", "robot/parts", "other"):
        (tmp_path / folder).mkdir(parents=True)
        (tmp_path / folder / "a.obj").write_text(_MESH)
        (tmp_path / folder / "a.xml").write_text("<mujoco/>")
    return tmp_path


def model(robots, asset, compiler="", body='<geom type="mesh" mesh="a"/>'):
    path = robots / "robot" / "x.xml"
    path.write_text(f"<mujoco><compiler {compiler}/>{asset}<worldbody>{body}</worldbody></mujoco>")
    return path


def mesh(name):
    return f'<asset><mesh name="a" file="{name}"/></asset>'


@pytest.mark.parametrize(
    ("name", "compiler"),
    [
        ("meshes/a.obj", ""),
        ("a.obj", 'meshdir="meshes"'),
        ("../meshes/a.obj", 'assetdir="parts"'),
        ("/nowhere/a.obj", 'meshdir="meshes" strippath="true"'),
    ],
)
def test_meshes_inside(name, compiler, robots):
    assert reading.read(model(robots, mesh(name), compiler))[1].nmesh == 1


@pytest.mark.parametrize(
    ("name", "compiler"),
    [
        ("../other/a.obj", ""),
        ("..\\other\\a.obj", ""),
        ("a.obj", 'meshdir="../other"'),
        ("../../other/a.obj", 'assetdir="meshes"'),
        ("{root}/other/a.obj", ""),
        ("x/{root}/other/a.obj", 'meshdir="{root}/other" strippath="true"'),
        ("link.obj", ""),
        ("linked/a.obj", ""),
    ],
)
def test_meshes_outside(name, compiler, robots):
    (robots / "robot" / "link.obj").symlink_to("../other/a.obj")
    (robots / "robot" / "linked").symlink_to("../other")
    path = model(robots, mesh(name.format(root=robots)), compiler.format(root=robots))
    with pytest.raises(ValueError, match=r"a\.obj.* outside of"):
        reading.read(path)
    assert reading.read(path, robots)[1].nmesh == 1


def test_load(robots):
    path = model(robots, mesh("../other/a.obj"))
    with pytest.raises(ValueError, match=r"x\.xml: .*a\.obj.* outside of"):
        mjcf.load(path)
    with pytest.raises(ValueError, match="fingers"):
        mjcf.load(path, folder=robots)


@pytest.mark.parametrize(
    "asset",
    [
        '<include file="../other/a.xml"/>',
        '<include file="parts/b.xml"/>',
        '<asset><model name="m" file="../other/a.xml"/></asset>',
        '<asset><texture name="t" type="cube" fileright="../other/a.obj"/></asset>',
        '<asset><hfield name="t" size="1 1 1 1" file="../other/a.obj"/></asset>',
    ],
)
def test_other_files_outside(asset, robots):
    (robots / "robot" / "parts" / "b.xml").write_text(
        '<mujoco><include file="../../other/a.xml"/></mujoco>'
    )
    with pytest.raises(ValueError, match=r"other/a\.\w+, outside of"):
        reading.read(model(robots, asset, body=""))


@pytest.mark.parametrize("name", ["a.obj", "a.stl", "a.png", "a.xml"])
def test_pipes(name, robots):
    os.mkfifo(robots / "robot" / name)
    asset = f'<include file="{name}"/>' if name == "a.xml" else mesh(name)
    with pytest.raises(ValueError, match=name):
        reading.read(model(robots, asset))


@pytest.mark.parametrize(
    ("asset", "body"),
    [
        ('<size nkey="1000000000"/>', ""),
        ("", '<replicate count="1000000000"><site/></replicate>'),
        ("", '<replicate count="1000"><replicate count="1000"><site/></replicate></replicate>'),
        ("", '<flexcomp name="f" count="999 999 9"/>'),
        (f"<!--{' ' * 2**25}-->", ""),
        ('<asset><hfield name="h" nrow="9999999" ncol="9999999" size="1 1 1 1"/></asset>', ""),
        ('<asset><texture name="t" type="2d" file="t.png"/></asset>', ""),
        ('<asset><mesh name="m" builtin="cone" params="1000000000 1"/></asset>', ""),
        ('<sensor><user dim="500000000"/></sensor>', ""),
        ('<asset><model name="m" file="circle.xml"/></asset>', ""),
        ("<a>" * 5000 + "</a>" * 5000, ""),
        ("<!DOCTYPE x>&nothing;", ""),
    ],
)
def test_sizes(asset, body, robots):
    head = b"\x89PNG\r\n\x1a\n" + b"\0\0\0\rIHDR" + struct.pack(">2I", 2**31 - 1, 2**31 - 1)
    (robots / "robot" / "t.png").write_bytes(head)
    circle = '<mujoco><include file="x.xml"/></mujoco>'
    (robots / "robot" / "circle.xml").write_text(circle)
    with pytest.raises(ValueError, match=r"x\.xml|t\.png|its |circle"):
        reading.read(model(robots, asset, body=body))


@pytest.mark.parametrize("kind", ["attach", "include"])
def test_nested_descriptions(kind, robots):
    """Ten includes in each of five levels: more elements than MuJoCo could build."""
    for i in range(5):
        model = f'<asset><model name="m" file="x{i + 1}.xml"/></asset>'
        ten = "".join(f'<attach model="m" body="b" prefix="{j}"/>' for j in range(10))
        if kind == "include":
            model, ten = "", 10 * f'<include file="x{i + 1}.xml"/>'
        text = f'<mujoco>{model}<worldbody><body name="b">{ten}</body></worldbody></mujoco>'
        (robots / "robot" / f"x{i}.xml").write_text(text)
    end = '<mujoco><worldbody><body name="b"><geom size="1"/></body></worldbody></mujoco>'
    (robots / "robot" / "x5.xml").write_text(end)
    with pytest.raises(ValueError, match=r"x1\.xml expands"):
        reading.read(robots / "robot" / "x0.xml")
    assert sources.check(robots / "robot" / "x3.xml", robots / "robot") is None


def test_many_elements_and_deep_descriptions(robots):
    path = model(robots, "", body="<geom/>" * 10_000)
    with pytest.raises(ValueError, match=r"x\.xml expands"):
        reading.read(path)
    for i in range(25):
        text = f'<mujoco><include file="{i + 1}.xml"/></mujoco>'
        (robots / "robot" / f"{i}.xml").write_text(text)
    with pytest.raises(ValueError, match=r"20\.xml .*deep"):
        reading.read(robots / "robot" / "0.xml")


def test_memory_attribute_is_ignored(robots):
    path = model(robots, mesh("a.obj") + '<size memory="100T"/>', 'meshdir="meshes"')
    assert reading.read(path)[0].memory == -1


def test_each_file_is_read_once(robots, monkeypatch):
    """Files may include one another."""
    read, count = sources.read_text, []
    monkeypatch.setattr(sources, "read_text", lambda *a: count.append(a) or read(*a))
    for name, other in (("b", "c"), ("c", "b")):
        text = f'<mujoco><include file="{other}.xml"/></mujoco>'
        (robots / "robot" / f"{name}.xml").write_text(text)
    with pytest.raises(ValueError, match="includes itself"):
        reading.read(model(robots, '<include file="b.xml"/>', body=""))
    assert len(count) == 3


def test_mujocos_warnings_become_python_warnings(robots, monkeypatch):
    """MuJoCo would write them to a file in the working folder."""
    monkeypatch.chdir(robots)
    before = sorted(robots.rglob("*"))
    path = model(robots, "", body='<geom size="1" pos="nan 0 0"/>')
    finite = pytest.raises(ValueError, match="must be finite")
    with pytest.warns(UserWarning, match="MuJoCo: XML contains a 'NaN'"), finite:
        reading.read(path)
    assert sorted(robots.rglob("*")) == sorted([*before, path])


@pytest.mark.filterwarnings("ignore")
def test_no_log_in_the_working_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    path = write(tmp_path, ("</mujoco>", '<size nuser_body="3"/></mujoco>'))
    mjcf.load(path)
    assert os.listdir(tmp_path) == ["arm.xml"]
