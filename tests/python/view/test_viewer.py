"""The page shows what is simulated, in step, and does what it is asked for."""

import contextlib
import dataclasses
import http.client
import threading
import time
import urllib.request
from types import SimpleNamespace

import numpy as np
import pytest

import polypod.cli
from browser import PROGRAM, Page
from common import FLAT_POLICY, ROOT, ROUGH_POLICY, SMALL_TERRAIN, size
from polypod import _core, bundled, rotations
from polypod.play import Player, session
from polypod.play.live import FROM_TASK, OWN, TOGETHER, Choice, Live, columns_of
from polypod.play.panel import KEYS, Panel
from polypod.play.viewer import GROUP, NOTHING, Viewer

PICTURE = 0.1
"""Time between two pictures of a slow page, s."""


in_chromium = pytest.mark.skipif(
    size(True, False) or PROGRAM is None, reason="of the extended tier, and needs Chromium"
)
"""It takes half a minute where there is no graphics card."""


class Client:
    """A page like viser's: nodes move when a picture is drawn.

    All else that is new is seen one picture later.
    """

    def __init__(self, url):
        """Connects as a page does."""
        import viser
        from websockets.sync.client import connect

        socket = url.replace("http", "ws", 1)
        self._socket = connect(socket, subprotocols=[f"viser-v{viser.__version__}"], max_size=1 << 28)
        self.windows = []
        self.nodes: dict[str, dict] = {}
        self._thread = threading.Thread(target=self._listen, daemon=True)
        self._thread.start()

    def _listen(self):
        import msgspec
        import zstandard

        try:
            for data in self._socket:
                size = int.from_bytes(data[8:16], "little")
                window = msgspec.msgpack.decode(zstandard.ZstdDecompressor().decompress(data[16 : 16 + size]))
                self.windows.append(window["messages"])
        except Exception:
            return

    def picture(self):
        """Draws what has arrived; returns how many windows that was."""
        windows, self.windows = self.windows, []
        self._shown = {name: dict(node) for name, node in self.nodes.items()}
        self.places_before = {name: self.place(name) for name in self.nodes}
        for message in (message for window in windows for message in window):
            name = message.get("name")
            if message["type"] == "SetPositionMessage":
                self.nodes[name]["position"] = np.array(message["position"])
            elif message["type"] == "SetOrientationMessage" and name:
                self.nodes[name]["wxyz"] = np.array(message["wxyz"])
            elif message["type"] == "RemoveSceneNodeMessage":
                self.nodes.pop(name, None)
            elif name and "props" in message:
                self.nodes[name] = {"position": np.zeros(3), "wxyz": np.array([1.0, 0, 0, 0]), "type": message["type"]}
        return len(windows)

    def place(self, name):
        """Position in the picture's world."""
        position = np.zeros(3)
        while name:
            node = self.nodes.get(name)
            if node is not None:
                if node["type"] == "LabelMessage":
                    # viser puts labels where the node above was when the last picture was drawn
                    parent = name.rsplit("/", 1)[0]
                    return self.places_before.get(parent, np.zeros(3)) + node["position"]
                position = node["position"] + rotations.matrix(node["wxyz"]) @ position
            name = name.rsplit("/", 1)[0]
        return position

    def close(self):
        """Ends the connection."""
        self._socket.close()


def wait_until(holds, seconds=20.0):
    end = time.monotonic() + seconds
    while not holds():
        assert time.monotonic() < end, "nothing happens"
        time.sleep(0.01)


@pytest.fixture
def group():
    """Four robots that walk forward."""
    robots = ["unitree_a1", "anymal_b", "spot", "unitree_b2"]
    player = Player(FLAT_POLICY, robots, command=(0.9, 0.0, 0.0), threads=1)
    for _ in range(50):
        player.step()
    return player


@pytest.fixture
def viewer(group):
    viewer = Viewer(group, port=0, columns=columns_of(group))
    yield viewer
    viewer.close()


def test_bodies_names_and_arrows_are_in_step_at_ten_pictures_a_second(group, viewer):
    """Whatever hangs on a robot is drawn on it, though the page draws seldom and the robots run."""
    client = Client(viewer.url)
    try:
        viewer.follow(NOTHING)
        wait_until(lambda: any(message["type"] == "ReplayDoneMessage" for w in client.windows for message in w))
        client.picture()
        moved = []
        for _ in range(10):
            for _ in range(round(PICTURE / group.step_dt)):
                group.step()
            viewer.show(group.frame())
            # a frame comes as one piece, or the page would draw a part of it
            wait_until(lambda: client.windows)
            time.sleep(0.02)
            before = {name: client.place(name) for name in client.nodes}
            assert client.picture() == 1
            for index, robot in enumerate(viewer.frame.robots):
                root = f"/world/{index}_{robot.name}"
                base = client.place(root)
                moved.append(np.linalg.norm(base - before[root]))
                for part in ("name", "command", "velocity"):
                    place = client.place(f"{root}/level/{part}")
                    np.testing.assert_allclose(place[:2], base[:2], atol=1e-6)
                    assert 0.1 < place[2] - base[2] < 0.8
                for link in range(1, len(robot.position)):
                    shown = client.place(f"{root}/{link}") - base
                    np.testing.assert_allclose(shown, robot.position[link] - robot.position[0], atol=1e-6)
                for contact in robot.contacts:
                    arrow = client.place(f"{root}/{contact.link}/force{contact.body}")
                    np.testing.assert_allclose(arrow - base, contact.point - robot.position[0], atol=1e-6)
        assert max(moved) > 0.05, "robots that stand still are in step with anything"
    finally:
        client.close()


def test_the_view_follows_the_group_a_robot_or_nothing(group, viewer, monkeypatch):
    """The followed robot stays in the middle of the picture, and the camera is the user's own."""
    camera = SimpleNamespace(position=np.array([9.0, 9.0, 9.0]), look_at=np.zeros(3))
    monkeypatch.setattr(viewer._server, "get_clients", lambda: {0: SimpleNamespace(camera=camera)})

    def walk(steps):
        for _ in range(steps):
            group.step()
            viewer.show(group.frame())

    def middle():
        return np.mean([robot.position[0] for robot in viewer.frame.robots], axis=0)

    start = middle()
    walk(150)
    assert viewer.followed == GROUP
    assert np.linalg.norm(middle() - start) > 1.5
    assert np.linalg.norm(middle() + viewer._world.position) < 0.4
    np.testing.assert_array_equal(camera.position, 9.0)
    viewer.follow(2)
    assert 1.0 < np.linalg.norm(camera.position) < 5.0
    walk(50)
    assert np.linalg.norm(viewer.frame.robots[2].position[0] + viewer._world.position) < 0.4
    viewer.follow(NOTHING)
    left = np.array(viewer._world.position)
    walk(50)
    np.testing.assert_array_equal(viewer._world.position, left)


@pytest.mark.parametrize("what", [GROUP, 1])
def test_the_opening_shot_frames_what_is_followed(viewer, what):
    """All of it is inside a picture of 16 to 9, and fills at least a quarter of its width."""
    viewer.follow(what)
    camera = viewer._server.initial_camera
    forward = np.array(camera.look_at) - camera.position
    distance = np.linalg.norm(forward)
    forward /= distance
    right = np.cross(forward, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    up = np.cross(right, forward)
    robots = viewer.frame.robots if what == GROUP else [viewer.frame.robots[what]]
    places = np.concatenate([robot.position for robot in robots]) + viewer._world.position - camera.position
    height = np.tan(0.5 * camera.fov)
    across = places @ right / (places @ forward) / (height * 16.0 / 9.0)
    along = places @ up / (places @ forward) / height
    assert (np.abs(along) < 0.95).all()
    assert (across > -0.95).all()
    assert (across < 0.5).all(), "behind the panel"
    assert np.ptp(across) > 0.25


def test_robots_that_fall_come_back_to_the_group(group):
    """On a separate flat ground an env may be drawn where the others are, not at its start."""
    group.stand(2)
    for _ in range(100):
        group.step()
    here = np.stack([robot.position[0] for robot in group.frame().robots])
    assert here[:, 0].mean() > 1.0
    began = np.array([False, True, False, False])
    group.sim.reset(None, began)
    group._stay_together(began)
    now = np.stack([robot.position[0] for robot in group.frame().robots])
    # in its place of two by two at a distance of 1.2 m
    assert np.linalg.norm(now[1, :2] - here[[0, 2, 3], :2].mean(axis=0)) < 1.8
    np.testing.assert_array_equal(now[0], here[0])


def test_rewards_and_velocities_of_an_env_are_plotted(group):
    """The terms add up to the reward, and the plotted velocity is that of the robot."""
    from polypod.play.plots import History

    history = History(group, 2)
    assert history.robot == "spot"
    rewards = []
    for _ in range(20):
        group.step()
        history.add()
        rewards.append(float(group.sim.reward[2]))
    seconds, *terms = history.rewards()
    assert len(terms) == len(history.terms) == len(set(history.terms))
    np.testing.assert_allclose(np.sum(terms, axis=0) * group.step_dt, rewards, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(np.diff(seconds), group.step_dt)
    _, command, velocity = history.velocities(0)
    np.testing.assert_allclose(command, 0.9, rtol=1e-6)
    assert velocity[-1] == pytest.approx(group.sim.state("base_lin_vel")[2, 0])
    group.sim.reset()
    history.clear()
    assert np.allclose(history.rewards()[1], 0.0)


def test_a_push_adds_the_velocity(group):
    before = {robot: group.sim.qvel(robot) for robot in group.sim.robots}
    group.push((0.5, -0.25, 0.0), env=2)
    for robot, velocity in before.items():
        added = group.sim.qvel(robot)[:, :3] - velocity[:, :3]
        expected = [0.5, -0.25, 0.0] if robot == "spot" else [0.0, 0.0, 0.0]
        np.testing.assert_allclose(added, [expected], atol=1e-6)
    for wrong in (np.nan, 1e3):
        with pytest.raises(_core.ConfigError, match="velocity: x of env"):
            group.push((wrong, 0.0, 0.0))


def test_height_scans_lie_on_the_ground():
    player = Player(ROUGH_POLICY, ["spot"], envs_per_robot=10, threads=1, overrides=SMALL_TERRAIN)
    for _ in range(10):
        player.step()
    scan = player.sim.height_scan()
    assert scan.shape == (10, 187, 3)
    np.testing.assert_allclose(scan[..., 2], player.ground.heights(scan[..., :2]), atol=2e-3)
    for robot, points in zip(player.frame().robots, scan, strict=True):
        np.testing.assert_allclose(points[:, :2].mean(axis=0), robot.position[0][:2], atol=1e-3)
        # the first ray is behind the robot on its right, the last in front of it on its left
        about_z = rotations.of_angles(0.0, 0.0, float(rotations.heading(robot.quaternion[0])))
        ahead = rotations.matrix(about_z).T @ (points[-1] - points[0])
        np.testing.assert_allclose(ahead[:2], [1.6, 1.0], atol=1e-3)
    assert Player(FLAT_POLICY, ["spot"], threads=1).sim.height_scan().shape == (1, 0, 3)


@pytest.fixture
def live(group, viewer):
    def build(choice):
        file = {"flat": FLAT_POLICY, "rough": ROUGH_POLICY}[choice.policy]
        changes = SMALL_TERRAIN if "rough" in (choice.task or choice.policy).lower() else ()
        robots = ["spot", "unitree_a1"] if choice.robot is None else [choice.robot]
        return Player(file, robots, task=choice.task, threads=1, overrides=changes)

    live = Live(group, viewer, build, Choice("flat"))
    live.panel = Panel(live, ["flat", "rough"], [entry["name"] for entry in _core.tasks()])
    return live


def run(live, steps):
    """Runs this number of control steps, as fast as they come."""
    live.speed = 1e9
    live.run(steps * live.player.step_dt)


def test_it_pauses_steps_and_resets(live, group):
    begun = group.time
    live.later(lambda: live.pause(True))
    live.later(live.single)
    live.later(live.single)
    run(live, 2)
    assert live.paused
    assert group.time == pytest.approx(begun + 2 * group.step_dt)
    live.later(live.reset)
    live.later(lambda: live.pause(False))
    run(live, 1)
    assert (group.sim.episode_length == 1).all()
    assert not live.paused


def test_it_runs_as_fast_as_it_is_asked_to(live, group):
    live.speed = 0.5
    began = time.monotonic()
    live.run(0.4)
    assert 0.7 < time.monotonic() - began < 3.0


def test_commands_come_from_the_task_the_group_or_the_user(live, group):
    live.steer((0.5, 0.0, 5.0))
    assert live.source == OWN
    np.testing.assert_allclose(group.sim.command, np.tile([[0.5, 0.0, 1.0]], (4, 1)))
    live.nudge(0, 0.1)
    np.testing.assert_allclose(group.sim.command[:, 0], 0.6, rtol=1e-6)
    live.command_by(TOGETHER)
    run(live, 1)
    drawn = group.sim.command.copy()
    assert (drawn == drawn[0]).all()
    assert (drawn != 0.0).all()
    live.command_by(FROM_TASK)
    run(live, 1)
    group.sim.reset()
    assert len(np.unique(group.sim.command[:, 0])) > 1
    assert live.panel._source.value == FROM_TASK


def test_policy_task_and_robot_are_switched_in_place(live, viewer):
    client = Client(viewer.url)
    try:
        run(live, 5)
        live.open(Choice("rough"))
        assert live.player.ground is not None
        assert viewer.followed == 0
        run(live, 5)
        wait_until(lambda: any(message.get("name") == "/world/0_spot" for w in client.windows for message in w))
        client.picture()
        assert client.nodes["/world/ground"]["type"] == "GlbMessage"
        assert {name.count("/") for name in client.nodes if name.endswith("_spot")} == {2}
        assert not any("unitree_b2" in name for name in client.nodes)
        live.open(Choice("flat", robot="spot"))
        run(live, 5)
        assert [robot.name for robot in viewer.frame.robots] == ["spot"]
        # a policy for flat ground does not take the observations of rough ground
        told = []
        viewer.tell = lambda title, body: told.append(body)
        live.open(Choice("flat", task="velocity_rough"))
        assert "gives 235" in told[0]
        assert live.choice == Choice("flat", robot="spot")
        run(live, 1)
    finally:
        client.close()


def test_terrain_and_obstacles_are_on_the_page():
    """The task's shapes, meshes among them, stand where the simulator has them."""
    corners = [[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]]
    faces = [[0, 2, 1], [0, 1, 3], [0, 3, 2], [1, 2, 3]]
    shape = f'{{ shape = "mesh", scale = [1.0, 1.0, 1.0], position = [2.0, 0.0, 0.0], vertices = {corners}'
    obstacle = f"scene.obstacles=[{shape}, triangles = {faces} }}]"
    player = Player(FLAT_POLICY, ["spot"], threads=1, overrides=[obstacle])
    viewer = Viewer(player, port=0)
    client = Client(viewer.url)
    try:
        wait_until(lambda: any(message["type"] == "ReplayDoneMessage" for w in client.windows for message in w))
        client.picture()
        assert client.nodes["/world/obstacles/0_0"]["type"] == "MeshMessage"
        assert client.nodes["/world/ground"]["type"] == "GridMessage"
        # it has a place about the env's origin: the robot alone is followed
        assert viewer.followed == 0
    finally:
        client.close()
        viewer.close()


@pytest.mark.parametrize("arguments", [(), ("--command", "0.3", "0", "0"), ("--robots", "spot")])
def test_the_command_serves_the_page(capsys, arguments):
    line = ["play", "--checkpoint", str(FLAT_POLICY), "--seconds", "0.1", "--port", "0", "--threads", "1", *arguments]
    assert polypod.cli.main(line) == 0
    output = capsys.readouterr().out
    assert "open http://127.0.0.1:" in output
    assert "0.1 s" in output


def test_other_checkpoints_of_a_run_can_be_chosen(tmp_path):
    for number in (5, 100, 20):
        (tmp_path / f"model_{number}.pt").touch()
    names = list(session._policies(tmp_path / "model_20.pt"))
    shipped = [f"bundled: {name}" for name in ("flat", "rough", "legged", "quadruped", "two_legs")]
    assert names == ["model_20.pt", "model_5.pt", "model_100.pt", *shipped]
    assert list(session._policies(bundled.checkpoint("rough")))[:2] == ["bundled: rough", "bundled: flat"]


@pytest.mark.parametrize("host", ["nowhere.invalid", "203.0.113.1", "x y", "a" * 300, "\udcff"])
def test_a_host_that_is_not_this_machine_is_refused(group, host):
    with pytest.raises(_core.ConfigError, match="--host"):
        Viewer(group, port=0, host=host)


def test_a_health_check_is_no_traceback(viewer, caplog, capfd):
    address = viewer.url.removeprefix("http://")
    connection = http.client.HTTPConnection(address, timeout=10)
    connection.request("HEAD", "/")
    with contextlib.suppress(http.client.HTTPException, OSError):
        connection.getresponse()
    connection.close()
    with urllib.request.urlopen(viewer.url) as page:
        assert b"<html" in page.read(2000).lower()
    assert "Traceback" not in caplog.text + capfd.readouterr().err


def test_the_page_is_for_this_machine_alone_unless_it_is_asked_for(group, viewer):
    assert viewer.url.startswith("http://127.0.0.1:")
    other = Viewer(group, port=0, host="0.0.0.0")
    try:
        assert other.url.startswith("http://localhost:")
    finally:
        other.close()


def test_every_key_is_documented_and_does_something(live):

    page = (ROOT / "docs" / "viewer.md").read_text()
    for key, label in KEYS:
        assert f"| {key} |" in page, label
    handles = live.viewer.gui._command_handle_from_uuid.values()
    assert {handle.hotkey for handle in handles} == {key for key, _ in KEYS}


@in_chromium
def test_chromium_draws_a_robot_and_its_name_together():
    """A robot jumps to and fro ten times a second; in every picture its name is above it."""
    player = Player(FLAT_POLICY, ["spot"], command=(0.0, 0.0, 0.0), threads=1)
    viewer = Viewer(player, port=0)
    frame = player.frame()

    def jump():
        for number in range(100_000):
            (robot,) = frame.robots
            moved = dataclasses.replace(robot, position=robot.position + np.array([0.0, 0.4 * (number % 2), 0.0]))
            viewer.show(dataclasses.replace(frame, robots=[moved]))
            if stop.wait(PICTURE):
                return

    def middles(picture):
        """Columns of the dark plate with the name and of the orange thighs.

        They lie left of the panel and below notices.
        """
        red, green, blue = np.moveaxis(picture[:, 320:940].astype(int), 2, 0)
        plate = (np.maximum(np.maximum(red, green), blue) < 70)[:220]
        thighs = (red - blue > 50)[220:]
        if plate.sum() < 200 or thighs.sum() < 200:
            return None
        return np.median(np.nonzero(plate)[1]), np.median(np.nonzero(thighs)[1])

    viewer.follow(NOTHING)
    viewer.shows_forces = viewer.shows_velocity = False
    stop = threading.Event()
    try:
        with Page(viewer.url, (1280, 720)) as page:
            wait_until(lambda: middles(page.picture()) is not None, 60.0)
            thread = threading.Thread(target=jump, daemon=True)
            thread.start()
            try:
                seen = np.array([middles(page.picture()) for _ in range(12)])
            finally:
                stop.set()
                thread.join()
    finally:
        viewer.close()
    assert np.ptp(seen[:, 0]) > 40, "it does not jump"
    # in a picture of one without the other they would be apart by the whole jump
    apart = seen[:, 0] - seen[:, 1]
    assert np.ptp(apart) < 0.2 * np.ptp(seen[:, 0]), seen


@in_chromium
def test_keys_work_in_chromium(live):
    with Page(live.viewer.url) as page:
        wait_until(lambda: "Reward terms" in page.text(), 60.0)
        stop = threading.Event()
        thread = threading.Thread(target=run_until, args=(live, stop), daemon=True)
        thread.start()
        try:
            page.press(" ", "Space")
            wait_until(lambda: live.paused)
            wait_until(lambda: "paused" in page.text())
            page.press("i", "KeyI")
            wait_until(lambda: live.own[0] > 0.0)
            page.press(" ", "Space")
            wait_until(lambda: not live.paused)
        finally:
            stop.set()
            thread.join()


def run_until(live, stop):
    while not stop.is_set():
        live.run(live.player.step_dt)
