"""A robot whose URDF names meshes touches the ground with the same shapes in both simulators."""

import xml.etree.ElementTree as ElementTree

import mujoco
import numpy as np
import pytest

import polypod.cli
from common import LEGGED_POLICY
from polypod import _core, rotations, simulated
from polypod.accuracy.standing import FRICTION, hold, pose
from polypod.mujoco_model import contact_shapes
from polypod.mujoco_model import robot as model_robot
from polypod.mujoco_model.reference import Ground, Reference

MADE_OF = "box_quadruped"
FEET = ["FL_contact", "FR_contact", "BL_contact", "BR_contact"]
TAIL = """
<robot>
  <link name="imu">
    <inertial>
      <mass value="1e-6"/><inertia ixx="1e-6" ixy="1e-6" ixz="1e-6" iyy="1e-6" iyz="1e-6" izz="1e-6"/>
    </inertial>
  </link>
  <joint name="imu_fixed" type="fixed">
    <origin xyz="0.05 0 0.03" rpy="0.3 0 1"/><parent link="base_link"/><child link="imu"/>
  </joint>
  <link name="tail">
    <inertial><mass value="0.1"/><inertia ixx="1e-4" ixy="0" ixz="0" iyy="1e-4" iyz="0" izz="1e-4"/></inertial>
    <collision>
      <origin xyz="-0.05 0 0" rpy="0 0.4 0"/><geometry><mesh filename="meshes/plate.stl"/></geometry>
    </collision>
    <collision>
      <origin xyz="-0.1 0 0" rpy="0 1.5 0"/><geometry><cylinder radius="0.01" length="0.1"/></geometry>
    </collision>
  </link>
  <joint name="tail_joint" type="revolute">
    <origin xyz="-0.2 0 0.02" rpy="0 0 0.2"/><parent link="base_link"/><child link="tail"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/><mimic joint="FL_HFE"/>
  </joint>
</robot>
"""
"""A frame with token inertia, and a tail on a joint that is held and follows another one."""


def stl(triangles):
    facets = (
        "facet normal 0 0 0\nouter loop\n"
        + "".join(f"vertex {x} {y} {z}\n" for x, y, z in corners)
        + "endloop\nendfacet\n"
        for corners in triangles
    )
    return f"solid s\n{''.join(facets)}endsolid s\n"


def ball(radius):
    """An octahedron."""
    return [
        np.diag([x, y, z])[:: 1 if x * y * z > 0 else -1] * radius for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)
    ]


FLAT = [[(-0.04, -0.02, 0.0), (0.04, -0.02, 0.0), (0.0, 0.02, 0.0)]]
"""A mesh without volume."""


@pytest.fixture(params=["there", "missing"])
def config(request, tmp_path):
    """Config of a quadruped whose feet, shanks and tail are meshes; their files exist or do not."""
    tree = ElementTree.fromstring(_core.robot_urdf(MADE_OF))
    tree.remove(tree.find("mujoco"))
    compiler = ElementTree.SubElement(ElementTree.SubElement(tree, "mujoco"), "compiler")
    compiler.set("discardvisual", "false")
    tree.extend(ElementTree.fromstring(TAIL))
    for link in tree.findall("link"):
        name = link.get("name")
        if not name.endswith(("_contact", "_shank")):
            continue
        for kind in ("visual", "collision"):
            for geometry in link.iterfind(f"{kind}/geometry"):
                geometry.clear()
                ElementTree.SubElement(geometry, "mesh", filename="meshes/foot.stl")
        if name.endswith("_shank"):
            link.remove(link.find("collision"))
        else:
            inertial = ElementTree.SubElement(link, "inertial")
            ElementTree.SubElement(inertial, "mass", value="0.02")
            ElementTree.SubElement(
                inertial, "inertia", dict.fromkeys(("ixx", "iyy", "izz"), "5e-6"), ixy="0", ixz="0", iyz="0"
            )
    (tmp_path / "robot.urdf").write_text(ElementTree.tostring(tree, encoding="unicode"))
    if request.param == "there":
        (tmp_path / "meshes").mkdir()
        (tmp_path / "meshes/foot.stl").write_text(stl(ball(0.03)))
        (tmp_path / "meshes/plate.stl").write_text(stl(FLAT))
    path = tmp_path / "hound.toml"
    path.write_text(
        f'extends = "{MADE_OF}"\nname = "hound"\ntitle = "Hound"\nurdf = "robot.urdf"\n'
        "[locked_joints]\ntail_joint = 0.5\n"
    )
    return path


def described(config):
    sim = _core.VecSim(model_robot.TASK, 1, robots=[str(config)], threads=1)
    return model_robot.of(sim, "hound", str(config)), simulated.shapes(sim)["hound"]


def corners(model, data, geom):
    """Points of a hull in the world, sorted, m."""
    mesh = model.geom_dataid[geom]
    first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
    return sorted_rows(
        data.geom_xpos[geom] + model.mesh_vert[first : first + count] @ data.geom_xmat[geom].reshape(3, 3).T
    )


def sorted_rows(points):
    return points[np.lexsort(np.round(points, 5).T)]


def test_shapes_and_masses_are_the_same(config):
    robot, outline = described(config)
    reference = Reference.of(robot, dt=0.002, ground=Ground(FRICTION), bounded=True)
    model, data = reference.model, reference.data
    start = pose(robot, 0.01)
    reference.set_state(start)
    sim = polypod.Simulation(str(config), threads=1)
    sim.set_state(start)
    places, turns = (numbers[0] for numbers in sim.link_pose())
    owners = [model.body(body).name for body in model.geom_bodyid]
    geoms_of = {
        body["name"]: [geom for geom, owner in enumerate(owners) if owner == body["name"]] for body in outline["bodies"]
    }
    assert sum(map(len, geoms_of.values())) == model.ngeom - 1
    assert {"tail", *FEET} <= geoms_of.keys()
    kinds = set()
    for body in outline["bodies"]:
        assert len(geoms_of[body["name"]]) == len(body["shapes"])
        place, turn = places[body["link"]], rotations.matrix(turns[body["link"]])
        for geom, shape in zip(geoms_of[body["name"]], body["shapes"], strict=True):
            kinds.add(shape["shape"])
            at, axes = place + turn @ shape["position"], turn @ rotations.matrix(shape["quaternion"])
            if shape["shape"] == "hull":
                wanted = at + np.array(shape["points"]) @ axes.T
                found = corners(model, data, geom)
                if len(wanted) == len(found):
                    np.testing.assert_allclose(found, sorted_rows(wanted), rtol=0.0, atol=1e-6)
                else:  # a flat one has two faces in MuJoCo
                    nearest = np.linalg.norm(found[:, np.newaxis] - wanted, axis=2).min(axis=1)
                    assert len(found) == 2 * len(wanted)
                    np.testing.assert_allclose(nearest, 0.5 * contact_shapes.THINNEST, rtol=0.01)
                continue
            size = {
                "box": lambda shape: 0.5 * np.array(shape["size"]),
                "cylinder": lambda shape: np.array([shape["radius"], 0.5 * shape["length"]]),
            }[shape["shape"]](shape)
            assert model.geom_type[geom] == getattr(mujoco.mjtGeom, f"mjGEOM_{shape['shape'].upper()}")
            np.testing.assert_allclose(model.geom_size[geom][: len(size)], size, rtol=1e-12)
            np.testing.assert_allclose(data.geom_xpos[geom], at, rtol=0.0, atol=1e-6)
            np.testing.assert_allclose(data.geom_xmat[geom].reshape(3, 3), axes, rtol=0.0, atol=1e-6)
    assert kinds == {"box", "cylinder"} | ({"hull"} if (config.parent / "meshes").exists() else set())
    masses = [float(mass.get("value")) for mass in ElementTree.parse(config.parent / "robot.urdf").iter("mass")]
    assert model.body_mass.sum() == pytest.approx(sum(masses), rel=1e-9)
    np.testing.assert_allclose(reference.mass_matrix(), sim.mass_matrix()[0], rtol=0.0, atol=1e-6)


def test_it_stands_as_in_polypod(config):
    robot, _ = described(config)
    reference = Reference.of(robot, dt=0.002, ground=Ground(FRICTION), bounded=True)
    sim = polypod.Simulation(str(config), dt=0.002, friction=FRICTION, self_collision=False, threads=1)
    for each in (reference, sim):
        each.set_state(pose(robot, 0.0))
    reference.step(robot.default_position, 500)
    hold(sim, robot, 1.0)
    np.testing.assert_allclose(reference.qpos, sim.qpos[0], rtol=0.0, atol=5e-3)
    assert reference.qpos[2] == pytest.approx(sim.qpos[0][2], abs=5e-4)
    carried = []
    for _ in range(100):
        reference.step(robot.default_position)
        carried.append(reference.contact_forces(FEET)[:, 2].sum())
    assert np.mean(carried) == pytest.approx(9.81 * reference.model.body_mass.sum(), rel=0.01)


def test_a_policy_plays_on_it_in_mujoco(config, capsys):
    command = [
        "sim2sim",
        "--checkpoint",
        str(LEGGED_POLICY),
        "--robots",
        str(config),
        "--num-envs",
        "2",
        "--steps",
        "50",
    ]
    assert polypod.cli.main(command) in (0, 3)
    assert "hound" in capsys.readouterr().out


def test_a_file_that_mujoco_refuses_is_named(config, capsys):
    urdf = config.parent / "robot.urdf"
    urdf.write_text(urdf.read_text().replace('<axis xyz="0 1 0" />', 2 * '<axis xyz="0 1 0" />'))
    assert polypod.cli.main(["sim2sim", "--checkpoint", str(LEGGED_POLICY), "--robots", str(config)]) == 2
    assert "MuJoCo does not compile robot.urdf: XML Error: repeated element: 'axis'" in capsys.readouterr().err


def test_urdfs_without_meshes_are_compiled_as_they_are():
    for name in model_robot.names():
        robot = model_robot.load(name)
        assert robot.outline is None
        assert ("<collision>" in robot.urdf) == ("<collision>" in _core.robot_urdf(name))
        assert contact_shapes.without_shapes(_core.robot_urdf(name)) is None
