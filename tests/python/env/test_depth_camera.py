"""A depth camera's image is what MuJoCo's rays see of the same ground, `mujoco.mj_ray`."""

import numpy as np
import pytest

import polypod
from common import size
from polypod import rotations, sim2sim
from polypod.export import interfaces
from polypod.mujoco_model import robot as model_robot
from polypod.sim2sim import twin

mujoco = pytest.importorskip("mujoco")

WIDTH, HEIGHT = 24, 16
FOV = 1.4
MOST = 4.0
PITCH = [float(np.cos(0.25)), 0.0, float(np.sin(0.25)), 0.0]

TILES = """[
{name="stairs", type="pyramid_stairs", proportion=1.0, step_height_range=[0.1, 0.2], step_width=0.3, platform_width=1.5,
 border_width=0.5},
{name="rough", type="random_rough", proportion=1.0, noise_range=[0.0, 0.15], noise_step=0.01, border_width=0.25},
{name="stones", type="hf_stepping_stones", proportion=1.0, stone_height_max=0.05, stone_width_range=[0.3, 0.5],
 stone_distance_range=[0.1, 0.2], holes_depth=-0.6, platform_width=1.0},
{name="boxes", type="repeated_boxes", proportion=1.0, platform_width=1.0, platform_height=0.0,
 object_params_start={num_objects=20, height=0.4, size=[0.3, 0.5]},
 object_params_end={num_objects=20, height=0.4, size=[0.3, 0.5]}}]""".replace("\n", " ")


def make(folder, task, robots, num_envs, mount, changes, keys=""):
    """A task whose observation is the image of a camera."""
    camera = (
        f"sensors.ray_caster_camera = {{mount={mount}, max_distance={MOST}, "
        f"pattern_cfg={{width={WIDTH}, height={HEIGHT}, horizontal_fov={FOV}}}{keys}}}"
    )
    lines = [f"extends = '{task}'", "name = 'Camera-v0'", camera, "observations.policy = [{term='image'}]", *changes]
    (folder / "camera.toml").write_text("\n".join(lines))
    env = polypod.make(str(folder / "camera.toml"), num_envs, robots=robots, threads=1, seed=4)
    env.reset()
    return env


class Rays:
    """MuJoCo's rays against the heights of a simulation."""

    def __init__(self, sim):
        """Reads the ground."""
        terrain = sim.terrain()
        cell = terrain["cell"]
        # MuJoCo's height fields just end, polypod's edges go on
        beyond = int(np.ceil(2.0 * MOST / cell))
        heights = np.pad(terrain["heights"].astype(np.float64), beyond, mode="edge")
        first = np.array(terrain["origin"]) - beyond * cell
        lowest, rise = heights.min(), np.ptp(heights)
        half = 0.5 * cell * (np.array(heights.shape) - 1)
        spec = mujoco.MjSpec()
        data = ((heights.T - lowest) / rise).ravel()
        columns, rows = heights.shape
        spec.add_hfield(name="ground", nrow=rows, ncol=columns, size=[*half, rise, 1.0], userdata=data)
        place = [*(half + first), lowest]
        spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_HFIELD, hfieldname="ground", pos=place)
        self.model = spec.compile()
        self.data = mujoco.MjData(self.model)
        mujoco.mj_forward(self.model, self.data)

    def distance(self, place, direction):
        """Along the ray, m; infinity where it meets nothing."""
        geom = np.zeros(1, np.int32)
        found = mujoco.mj_ray(self.model, self.data, place, direction, None, 1, -1, geom)
        return np.inf if found < 0.0 else found


def directions():
    """[pixels, 3] in the camera's axes, 1 along its axis."""
    tan = np.tan(0.5 * FOV)
    across = tan * (1.0 - (2.0 * np.arange(WIDTH) + 1.0) / WIDTH)
    down = tan * HEIGHT / WIDTH * (1.0 - (2.0 * np.arange(HEIGHT) + 1.0) / HEIGHT)
    grid = np.stack(np.broadcast_arrays(1.0, across[None, :], down[:, None]), axis=-1)
    return grid.reshape(-1, 3)


def compare(env, robot, link, pos, rot, images=None):
    """Differences of the images from MuJoCo's rays, m, and what 0.2 mm to a side changes."""
    sim = env.sim
    rays, local = Rays(sim), directions()
    places, quaternions = sim.link_pose(robot)
    images = sim.observation_of("policy").reshape(sim.num_envs, -1) if images is None else images
    differences, spreads = [], []
    for row, number in enumerate(range(*sim.env_ids(robot))):
        matrix = rotations.matrix(quaternions[row, link])
        origin = sim.env_origins()[number]
        eye = places[row, link] + matrix @ pos + [origin[0], origin[1], 0.0]
        turned = local @ (matrix @ rotations.matrix(np.array(rot))).T
        for pixel, direction in enumerate(turned):
            length = np.linalg.norm(direction)
            unit = direction / length

            def depth(shift, eye=eye, unit=unit, length=length):
                return min(rays.distance(eye + shift, unit) / length, MOST)

            exact = depth(np.zeros(3))
            differences.append(images[number, pixel] - exact)
            # rays that pass an edge within 0.2 mm may meet either side of it
            shifts = 2e-4 * np.vstack([np.eye(3), -np.eye(3)])
            spreads.append(max(abs(depth(shift) - exact) for shift in shifts) if abs(differences[-1]) > 1e-4 else 0.0)
    return np.array(differences), np.array(spreads)


def check(differences, spreads):
    off = np.abs(differences) > 1e-4
    print(f"{len(differences)} rays, largest difference {np.abs(differences[~off]).max():.2e} m, {off.sum()} at edges")
    assert off.mean() < 0.002
    # a ray that differs by more passes an edge, or grazes the ground
    assert (np.abs(differences[off]) <= 1.5 * spreads[off] + 2e-4).all()


def test_images_are_what_mujoco_sees(tmp_path):
    ground = (
        f"scene.terrain.sub_terrains={TILES}",
        "scene.terrain.num_rows=1",
        "scene.terrain.num_cols=4",
        "scene.terrain.max_init_terrain_level=0",
        "scene.terrain.border_width=4.0",
        # any heading, and tilts that no gait has
        "events.reset_base.roll=[-0.3, 0.3]",
        "events.reset_base.pitch=[-0.3, 0.3]",
    )
    pos = [0.25, 0.05, 0.15]
    env = make(tmp_path, "velocity_rough_play", ["unitree_go2"], size(8, 64), f"{{pos={pos}, rot={PITCH}}}", ground)
    differences, spreads = compare(env, "unitree_go2", 0, pos, PITCH)
    assert (np.abs(env.sim.observation_of("policy")) < MOST).mean() > 0.5
    check(differences, spreads)


def test_a_camera_turns_with_its_link(tmp_path):
    ground = ("scene.terrain.num_rows=1", "scene.terrain.num_cols=4", "scene.terrain.max_init_terrain_level=0")
    names = polypod.make("velocity_rough_humanoid", 1, robots=["unitree_g1"], threads=1).sim.link_names("unitree_g1")
    link = names.index("torso_link")
    pos = [0.06, 0.02, 0.45]
    mount = f"{{body='torso_link', pos={pos}, rot={PITCH}}}"
    env = make(tmp_path, "velocity_rough_humanoid", ["unitree_g1"], size(4, 16), mount, ground)
    for _ in range(10):
        env.step(np.random.default_rng(0).uniform(-1.0, 1.0, env.action_space.shape).astype(np.float32))
    differences, spreads = compare(env, "unitree_g1", link, pos, PITCH)
    check(differences, spreads)


class Standing:
    """A folded policy that sees the image and holds the default pose."""

    def __init__(self, interface):
        """Holds the pose of a robot."""
        self.inputs, self.pose = {"image": WIDTH * HEIGHT}, interface.default_pose
        self.num_actions, self.seen = interface.num_actions, []

    def __call__(self, *, image):
        """Remembers the images."""
        self.seen.append(image)
        shape = (len(image), self.num_actions)
        return {"joint_pos_target": np.tile(self.pose, (len(image), 1)), "actions": np.zeros(shape, np.float32)}

    def reset(self):
        """Remembers nothing else."""


def twin_of(env, robot, folder):
    """The robots of an env in MuJoCo, before their first reset, and their policy."""
    sim = env.sim
    manifest = {
        "task": str(folder / "camera.toml"),
        "robot_sources": {robot: robot},
        "overrides": [],
        "canonical_joint_names": sim.canonical_joint_names,
        "observation_layout": [{"term": term, "size": count} for term, count in sim.observation_layout],
    }
    interface = interfaces(manifest, [robot])[robot]
    policy, described = Standing(interface), model_robot.of(sim, robot, robot)
    drive = twin.Drive(
        interface,
        policy,
        step_dt=sim.step_dt,
        physics_dt=0.005,
        delays=np.zeros((sim.num_envs, described.num_joints)),
        heights=sim2sim.heights(sim),
        places=sim.env_origins() * [1.0, 1.0, 0.0],
    )
    return twin.Twin(described, [], twin.Physics(dt=0.0025), drive), policy


@pytest.mark.parametrize(
    ("task", "robot", "body"),
    [("velocity_rough_play", "unitree_go2", None), ("velocity_rough_humanoid", "unitree_g1", "torso_link")],
)
def test_a_robot_sees_the_same_in_mujoco(tmp_path, task, robot, body):
    ground = ("scene.terrain.num_rows=1", "scene.terrain.num_cols=4", "scene.terrain.max_init_terrain_level=0")
    pos = [0.2, 0.02, 0.3]
    mount = f"{{{'' if body is None else f'body={body!r}, '}pos={pos}, rot={PITCH}}}"
    env = make(tmp_path, task, [robot], 2, mount, ground)
    for _ in range(10):
        env.step(np.random.default_rng(0).uniform(-1.0, 1.0, env.action_space.shape).astype(np.float32))
    made, _ = twin_of(env, robot, tmp_path)
    made.reset(env.sim.qpos(robot), env.sim.qvel(robot))
    images = made.sensors()["image"]
    assert (images < MOST).mean() > 0.3
    # the same numbers as MuJoCo's rays from polypod's pose, and so as polypod's image
    link = 0 if body is None else env.sim.link_names(robot).index(body)
    differences, spreads = compare(env, robot, link, np.array(pos), PITCH, images)
    check(differences, spreads)
    ours = env.sim.observation_of("policy").reshape(images.shape)
    assert (np.abs(images - ours) > 1e-3).mean() < 0.01


def test_frames_in_mujoco_are_held_and_late(tmp_path):
    mount, keys = f"{{pos=[0.3, 0.0, 0.1], rot={PITCH}}}", ", update_period=0.06, delay=[0.0, 0.08]"
    ground = ("scene.terrain.num_rows=1", "scene.terrain.num_cols=4", "scene.terrain.max_init_terrain_level=0")
    env = make(tmp_path, "velocity_rough_play", ["unitree_go2"], 3, mount, ground, keys)
    made, policy = twin_of(env, "unitree_go2", tmp_path)
    made.reset(env.sim.qpos("unitree_go2"), env.sim.qvel("unitree_go2"))
    fresh = [made.sensors()["image"]]
    for _ in range(14):
        made.step(np.zeros((3, 3), np.float32), np.ones(3, dtype=bool))
        fresh.append(np.stack([made._camera.render(*made._link_pose(row, None)) for row in range(3)]))
    # a frame in every third step, at another step for each env, is shown two steps later
    for row in range(3):
        shown = 0
        for step, seen in enumerate(policy.seen):
            if step >= 3 + row and (step - 3 - row) % 3 == 0:
                shown = step - 2
            np.testing.assert_array_equal(seen[row], fresh[shown][row], err_msg=f"env {row}, step {step}")


def test_a_held_image_is_the_one_of_its_frame(tmp_path):
    """An image that did not change is not written again; a history writes it in every step."""
    mount, keys = f"{{pos=[0.3, 0.0, 0.1], rot={PITCH}}}", ", update_period=0.1, delay=[0.0, 0.06]"
    changes = (
        "scene.terrain.num_rows=1",
        "scene.terrain.num_cols=4",
        "scene.terrain.max_init_terrain_level=0",
        "sim.episode_length_s=0.3",
        "observations.critic=[{term='image', history_length=2}]",
    )
    env = make(tmp_path, "velocity_rough_play", ["unitree_go2", "spot"], 6, mount, changes, keys)
    sim, rng = env.sim, np.random.default_rng(0)
    last, held, saved = None, 0, None

    def seen():
        newest = sim.observation_of("critic").reshape(6, 2, -1)[:, 1]
        image = sim.observation_of("policy").copy()
        np.testing.assert_array_equal(image, newest)
        return image

    for step in range(40):
        env.step(rng.uniform(-1.0, 1.0, env.action_space.shape).astype(np.float32))
        image = seen()
        if last is not None:
            held += int((image == last).all(axis=1).sum())
        last = image
        if step == 20:
            saved = sim.snapshot()
        if step == 25:
            sim.reset(mask=np.array([True, False] * 3))
            seen()
        if step == 30:
            sim.restore(saved)
            seen()
    assert held > 100, "most steps show the frame of the step before"
