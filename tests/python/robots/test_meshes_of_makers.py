"""`--meshes` shows the makers' meshes of robot_descriptions where they fit the robot.

Elsewhere it shows the robot's own shapes.
"""

import importlib
import io
import sys
import xml.etree.ElementTree as ElementTree

import numpy as np
import pytest

import polypod.cli
from common import FLAT_POLICY
from polypod import _core
from polypod.play import Player, descriptions
from polypod.play.looks import Look, Model
from polypod.play.viewer import Viewer

trimesh = pytest.importorskip("trimesh")
ROBOT = "unitree_go2"
MODULE = """
REPOSITORY_PATH = {folder!r}
PACKAGE_PATH = {folder!r} + "/go2_description"
URDF_PATH = PACKAGE_PATH + "/urdf/go2_description.urdf"
"""


@pytest.fixture
def description(tmp_path, monkeypatch):
    """A package like robot_descriptions, with meshes in place of a library robot's shapes."""
    for name in [name for name in sys.modules if name.partition(".")[0] == "robot_descriptions"]:
        monkeypatch.delitem(sys.modules, name)
    package = tmp_path / "site" / "robot_descriptions"
    package.mkdir(parents=True)
    (package / "__init__.py").write_text("")
    (package / "go2_description.py").write_text(MODULE.format(folder=str(tmp_path)))
    monkeypatch.syspath_prepend(str(tmp_path / "site"))
    importlib.invalidate_caches()
    meshes = tmp_path / "go2_description" / "meshes"
    meshes.mkdir(parents=True)
    trimesh.creation.box((0.2, 0.1, 0.04)).export(meshes / "block.stl")
    tree = ElementTree.fromstring(_core.robot_urdf(ROBOT))
    for link in tree.iter("link"):
        for visual in link.findall("visual"):
            link.remove(visual)
    for link, place in (("base", "0 0 0.1"), ("FL_thigh", "0.01 0.02 -0.1"), ("FL_foot", "0 0 0")):
        visual = ElementTree.SubElement(next(node for node in tree.iter("link") if node.get("name") == link), "visual")
        ElementTree.SubElement(visual, "origin", xyz=place, rpy="0 0 1.5707963267948966")
        geometry = ElementTree.SubElement(visual, "geometry")
        ElementTree.SubElement(geometry, "mesh", filename="package://go2_description/meshes/block.stl", scale="1 1 2")
        material = ElementTree.SubElement(visual, "material", name="red")
        ElementTree.SubElement(material, "color", rgba="0.9 0.1 0.1 1")
    urdf = tmp_path / "go2_description" / "urdf" / "go2_description.urdf"
    urdf.parent.mkdir()
    urdf.write_text(ElementTree.tostring(tree, encoding="unicode"))
    yield urdf
    for name in [name for name in sys.modules if name.partition(".")[0] == "robot_descriptions"]:
        del sys.modules[name]


@pytest.fixture
def player():
    return Player(FLAT_POLICY, [ROBOT], command=(0.0, 0.0, 0.0), threads=1)


def models_of(player):
    links = player.outlines[ROBOT]["links"]
    models = descriptions.models(ROBOT, links, player.rest(ROBOT))
    return {links[model.link]: trimesh.load(io.BytesIO(model.glb), file_type="glb") for model in models}


def test_meshes_hang_on_their_links(description, player):
    """Meshes lie in their links' frames, turned and scaled as the URDF says.

    A fixed link's meshes lie on the link that moves.
    """
    models = models_of(player)
    assert set(models) == {"base", "FL_thigh", "FL_calf"}
    # a quarter turn about z exchanges length and width
    np.testing.assert_allclose(models["base"].extents, [0.1, 0.2, 0.08], atol=1e-6)
    np.testing.assert_allclose(models["base"].bounds.mean(axis=0), [0.0, 0.0, 0.1], atol=1e-6)
    np.testing.assert_allclose(models["FL_thigh"].bounds.mean(axis=0), [0.01, 0.02, -0.1], atol=1e-6)
    foot = next(
        joint.find("origin").get("xyz")
        for joint in ElementTree.parse(description).getroot().iter("joint")
        if joint.find("child").get("link") == "FL_foot"
    )
    middle = models["FL_calf"].bounds.mean(axis=0)
    np.testing.assert_allclose(middle, [float(x) for x in foot.split()], atol=1e-6)
    (block,) = models["base"].geometry.values()
    np.testing.assert_array_equal(block.visual.material.baseColorFactor, [230, 26, 26, 255])


def test_the_viewer_shows_them(description, player):
    viewer = Viewer(player, port=0, meshes=True)
    try:
        assert viewer.warnings == []
        assert all(isinstance(look, Model) for look in viewer._looks(ROBOT, (0, 0, 0)))
    finally:
        viewer.close()


def test_a_description_of_another_body_is_not_shown(description, player):
    """A robot whose hip is elsewhere gets its own shapes, and the page's owner is told why."""
    text = description.read_text()
    tree = ElementTree.fromstring(text)
    joint = next(joint for joint in tree.iter("joint") if joint.find("child").get("link") == "FL_hip")
    joint.find("origin").set("xyz", "0.3 0.0465 0")
    description.write_text(ElementTree.tostring(tree, encoding="unicode"))
    viewer = Viewer(player, port=0, meshes=True)
    try:
        (warning,) = viewer.warnings
        assert "'FL_hip' is 0.1" in warning
        assert all(isinstance(look, Look) for look in viewer._looks(ROBOT, (0, 0, 0)))
    finally:
        viewer.close()


@pytest.mark.parametrize(
    ("break_it", "message"),
    [
        (lambda urdf: urdf.unlink(), "cannot be had"),
        (lambda urdf: urdf.write_text("<robot"), "cannot be had"),
        (lambda urdf: (urdf.parents[1] / "meshes" / "block.stl").unlink(), "no file"),
        (lambda urdf: urdf.write_text(urdf.read_text().replace("FL_calf", "other")), "FL_calf"),
    ],
)
def test_what_is_wrong_with_a_description_is_told(description, player, break_it, message):
    break_it(description)
    with pytest.raises(_core.ConfigError, match=message):
        models_of(player)


def test_a_robot_without_a_description_is_told():
    with pytest.raises(_core.ConfigError, match="phantomx"):
        descriptions.models("phantomx", ["base"], (np.zeros((1, 3)), np.array([[1.0, 0.0, 0.0, 0.0]])))


def test_descriptions_are_of_robots_of_the_library():
    assert set(descriptions.modules()) <= {entry["name"] for entry in _core.robots()}


def test_the_missing_extra_is_named(monkeypatch, capsys):
    monkeypatch.setitem(sys.modules, "robot_descriptions", None)
    line = ["play", "--checkpoint", str(FLAT_POLICY), "--robots", "spot", "--port", "0", "--seconds", "0", "--meshes"]
    assert polypod.cli.main(line) == 2
    assert "pip install 'polypod[meshes]'" in capsys.readouterr().err
