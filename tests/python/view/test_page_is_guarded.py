"""The page of `polypod play` serves its own pages alone and takes what it offers.

No message ends the program.
"""

import contextlib
import http.client
import math
import random
import string
import threading
import time

import numpy as np
import pytest

import polypod.cli
from common import FLAT_POLICY, size
from polypod import _core
from polypod.play import Player, gate, session
from polypod.play.gate import Gate, offers
from polypod.play.live import FROM_TASK, OWN, Choice, Live
from polypod.play.panel import Panel
from polypod.play.viewer import GROUP, Viewer

SECONDS = size(4.0, 60.0)
"""Duration of the rubbish, s."""
CAMERA = {
    "type": "ViewerCameraMessage",
    "wxyz": [1, 0, 0, 0],
    "position": [1, 1, 1],
    "fov": 1.0,
    "near": 0.1,
    "far": 100.0,
    "image_height": 100,
    "image_width": 100,
    "look_at": [0, 0, 0],
    "up_direction": [0, 0, 1],
}


class Page:
    """A WebSocket of viser's protocol."""

    def __init__(self, url, **headers):
        """Connects with additional headers."""
        import viser
        from websockets.sync.client import connect

        self._socket = connect(
            url.replace("http", "ws", 1),
            subprotocols=[f"viser-v{viser.__version__}"],
            max_size=1 << 28,
            additional_headers=headers,
            proxy=None,
        )
        self.closed = threading.Event()
        threading.Thread(target=self._drain, daemon=True).start()

    def _drain(self):
        with contextlib.suppress(Exception):
            for _ in self._socket:
                pass
        self.closed.set()

    def send(self, message):
        """Sends a message, or bytes and texts as they are."""
        import msgspec

        self._socket.send(message if isinstance(message, bytes | str) else msgspec.msgpack.encode(message))

    def close(self):
        """Ends the connection."""
        self._socket.close()


@pytest.fixture
def live():
    player = Player(FLAT_POLICY, ["spot"], command=(0.0, 0.0, 0.0), threads=1)
    viewer = Viewer(player, port=0)

    def build(choice):
        robots = ["spot"] if choice.robot is None else [choice.robot]
        return Player(FLAT_POLICY, robots, task=choice.task, threads=1)

    live = Live(player, viewer, build, Choice("flat"))
    live.panel = Panel(live, ["flat"], ["velocity_flat_universal_play"])
    live.speed = 1e9
    yield live
    viewer.close()


def control(live, label):
    """The control of the panel with this label."""
    (found,) = (handle for handle in live.viewer.gate._controls.values() if handle.label == label)
    return found


def update(handle, value, key="value"):
    return {"type": "GuiUpdateMessage", "uuid": handle._impl.uuid, "updates": {key: value}}


def run(live, steps=1):
    live.run(steps * live.player.step_dt)


def go_on_through_last_messages(live):
    """Lets messages of pages that are gone arrive, which may pause."""
    done = threading.Event()

    def go_on():
        while not done.wait(0.02):
            live.later(lambda: live.pause(False))

    thread = threading.Thread(target=go_on, daemon=True)
    thread.start()
    settle(live)
    done.set()
    thread.join()


def settle(live, seconds=0.5):
    """Lets messages arrive, and does what they ask for."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        run(live)


def answer(url, **headers):
    """Status of a request for the page."""
    connection = http.client.HTTPConnection(url.removeprefix("http://"), timeout=10)
    connection.putrequest("GET", "/", skip_host=True)
    for name, value in headers.items():
        connection.putheader(name, value)
    connection.endheaders()
    status = connection.getresponse().status
    connection.close()
    return status


def port_of(url):
    return url.rpartition(":")[2]


def test_a_foreign_page_can_do_nothing(live):
    from websockets.exceptions import InvalidStatus

    for origin in (
        "http://evil.example",
        "http://localhost:1",
        "https://127.0.0.1.evil.example",
        "null",
        "file://",
        "x",
    ):
        with pytest.raises(InvalidStatus, match="403"):
            Page(live.viewer.url, Origin=origin)
        assert answer(live.viewer.url, Host=live.viewer.url.removeprefix("http://"), Origin=origin) == 403, origin
    assert not live.viewer._server._websock_server._live_connections


def test_a_name_that_an_attacker_resolves_to_this_machine_reaches_nothing(live):
    """DNS rebinding: host and origin agree, and neither is this page's."""
    from websockets.exceptions import InvalidStatus

    port = port_of(live.viewer.url)
    for name in ("evil.example", f"evil.example:{port}", "localhost.evil.example", "203.0.113.7", "", "[", "a b"):
        assert answer(live.viewer.url, Host=name) == 403, name
    with pytest.raises((InvalidStatus, ValueError)):
        Page(live.viewer.url, Host=f"evil.example:{port}", Origin=f"http://evil.example:{port}")


def test_its_own_pages_and_programs_without_an_origin_are_let_in(live):
    port = port_of(live.viewer.url)
    for host in (f"127.0.0.1:{port}", f"localhost:{port}", f"[::1]:{port}"):
        assert answer(live.viewer.url, Host=host) == 200, host
        assert answer(live.viewer.url, Host=host, Origin=f"http://{host}") == 200, host
    for headers in ({}, {"Origin": f"http://127.0.0.1:{port}"}):
        page = Page(live.viewer.url, **headers)
        page.send(CAMERA)
        page.send(update(control(live, "speed"), "2 x"))
        settle(live)
        assert live.speed == 2.0
        live.speed = 1e9
        control(live, "speed").value = "1 x"
        page.close()


def test_a_page_that_is_open_to_others_is_reached_by_address_and_own_name():
    import socket

    public = Gate("0.0.0.0")
    assert public.is_public
    for host in ("203.0.113.7:8080", "localhost:9", socket.gethostname(), "[2001:db8::1]:80"):
        assert public.refusal([host], []) is None, host
        assert public.refusal([host], ["http://evil.example"]) is not None, host
        assert public.refusal([host], [f"https://{host}"]) is None, host
    assert public.refusal(["evil.example"], ["http://evil.example"]) is not None
    assert Gate("lab.example").refusal(["lab.example:8080"], ["http://LAB.example:8080"]) is None
    assert not Gate("::1").is_public
    assert not Gate("127.8.8.8").is_public


def test_two_pages_of_one_machine_are_not_one_origin():
    ours = Gate("127.0.0.1")
    assert ours.refusal(["localhost:8080"], ["http://localhost:8081"]) is not None
    assert ours.refusal(["localhost:8080"], ["http://127.0.0.1:8080"]) is not None
    assert ours.refusal(["localhost"], ["http://localhost:80"]) is None
    assert ours.refusal(["localhost:8080", "localhost:8080"], []) is not None
    assert ours.refusal(["localhost:8080"], ["http://localhost:8080"] * 2) is not None
    assert ours.refusal([], []) is not None


BAD_VALUES = [math.nan, math.inf, -math.inf, 1e308, -2, 3, "0.5", None, [], [0.1], {}, True, "x" * 10_000, b"1"]


def test_a_slider_takes_numbers_of_its_range(live):
    live.command_by(OWN)
    slider = control(live, "forward (m/s)")
    page = Page(live.viewer.url)
    page.send(CAMERA)
    for value in BAD_VALUES:
        assert not offers(slider, value), value
        page.send(update(slider, value))
    settle(live)
    assert slider.value == 0.0
    np.testing.assert_array_equal(live.own, 0.0)
    page.send(update(slider, 0.5))
    settle(live)
    page.close()
    np.testing.assert_array_equal(live.own, (0.5, 0.0, 0.0))
    live.command_by(FROM_TASK)
    assert not offers(slider, 0.25), "it is disabled"


BAD_CHOICES = {
    "env": ["zzz", "1: spot", 0],
    "speed": ["0 x", "nan x"],
    "policy": ["/etc/passwd", ""],
    "from": ["x"],
    "follow": ["7: spot"],
    "do": ["quit"],
    "names": ["yes", 1],
    "Frame it (F)": ["yes"],
}


def test_a_choice_takes_its_options(live):
    page = Page(live.viewer.url)
    page.send(CAMERA)
    before = {label: getattr(control(live, label), "value", None) for label in BAD_CHOICES}
    for label, values in BAD_CHOICES.items():
        for value in values:
            page.send(update(control(live, label), value))
    settle(live)
    page.close()
    assert {label: getattr(control(live, label), "value", None) for label in BAD_CHOICES} == before
    assert live.choice == Choice("flat")


def test_no_message_opens_a_file(live, tmp_path):
    """Neither an existing file, whose keys an error would tell, nor a pipe.

    On a pipe the program would wait.
    """
    import os

    (tmp_path / "x.toml").write_text('password = "hunter2"')
    os.mkfifo(tmp_path / "pipe.toml")
    told = []
    live.viewer.tell = lambda title, body: told.append(body)
    page = Page(live.viewer.url)
    page.send(CAMERA)
    for label in ("task", "robots", "policy"):
        for name in ("x.toml", "pipe.toml"):
            page.send(update(control(live, label), str(tmp_path / name)))
    settle(live)
    page.close()
    assert not told
    assert live.choice == Choice("flat")


@pytest.mark.parametrize(
    "choice", [Choice("/etc/passwd"), Choice("flat", task="x.toml"), Choice("flat", robot="./x.toml")]
)
def test_the_session_builds_what_the_page_lists(choice):
    with pytest.raises(_core.ConfigError, match="choose from the list of the page"):
        session._check_offered(choice, Choice("flat"), ["flat"], ["velocity_flat_play"], ["spot"])
    session._check_offered(
        Choice("flat", "velocity_flat_play", "spot"), Choice("flat"), ["flat"], ["velocity_flat_play"], ["spot"]
    )


def test_a_page_sets_values_and_nothing_else_of_a_control(live):
    """Viser sets whatever attribute a message names."""
    handle = control(live, "speed")
    page = Page(live.viewer.url)
    page.send(CAMERA)
    for key, value in (("update_cb", []), ("sync_cb", None), ("removed", True), ("nothing", 1), ("disabled", True)):
        page.send(update(handle, value, key))
    page.send({**update(handle, "2 x"), "more": 1})
    page.send({"type": "ShareUrlRequest"})
    settle(live, 0.3)
    assert handle.value == "1 x"
    page.send(update(handle, "2 x"))
    settle(live, 0.5)
    page.close()
    assert handle.value == "2 x"
    assert live.speed == 2.0


def test_what_a_caller_asks_for_is_checked_too(live):
    """Whatever reaches `Live`, by whatever way, is told and dropped."""
    told = []
    live.viewer.tell = lambda title, body: told.append(body)
    wishes = [
        lambda: live.steer((math.nan, 0.0, 0.0)),
        lambda: live.steer((0.0, 0.0)),
        lambda: live.command_by("x"),
        lambda: live.choose_env(1),
        lambda: live.choose_env(-1),
        lambda: live.follow(5),
        lambda: live.follow("x"),
        lambda: live.run_at(0.0),
        lambda: live.run_at(math.nan),
        lambda: 1 // 0,
    ]
    for wish in wishes:
        live.later(wish)
    begun = live.player.time
    run(live, 2)
    assert len(told) == len(wishes)
    assert live.player.time == pytest.approx(begun + 2 * live.player.step_dt)
    assert live.source == FROM_TASK
    assert (live.env, live.viewer.followed) == (0, GROUP)


def test_a_flood_of_messages_does_not_stop_the_simulation(live):
    done = []

    def wish():
        done.append(1)
        live.later(wish)

    for _ in range(10_000):
        live.later(wish)
        live.later(lambda: done.append("last"), "a control")
    run(live, 3)
    assert 0 < len(done) < 10_000
    assert done.count("last") == 1


def rubbish(draw, live):
    """A message of a random type of viser's, or bytes of no type, with values of every sort."""
    from viser import _messages

    def text():
        return "".join(draw.choices(string.printable, k=draw.choice((0, 1, 8, 10_000))))

    def value(depth=0):
        sorts = [
            lambda: draw.choice([math.nan, math.inf, -math.inf, 0.0, -0.0, 1e308, 1e-320, 2**63, -(2**63), 0, 1, -1]),
            lambda: draw.uniform(-2.0, 2.0),
            text,
            lambda: draw.choice([None, True, False, b"", b"\xff" * 100]),
            lambda: draw.choice(known),
        ]
        if depth < 3:
            sorts.append(lambda: [value(depth + 1) for _ in range(draw.choice((0, 1, 3, 4, 20)))])
            sorts.append(lambda: {text()[:20]: value(depth + 1) for _ in range(draw.choice((0, 1, 3)))})
        return draw.choice(sorts)()

    known = [*live.viewer.gate._controls, *live.viewer.gate._keys, "value", "0: spot", "all robots", "2 x", "my own"]
    known += ["/world", "/world/0_spot", "/etc/passwd", "spot", "flat", "drawn by the task"]
    kind = draw.choice(_messages.Message.get_subclasses())
    sort = draw.random()
    if sort < 0.05:
        return draw.randbytes(draw.choice((0, 1, 100, 70_000)))
    if sort < 0.1:
        return text()
    if sort < 0.5:
        handle = draw.choice(list(live.viewer.gate._controls.values()))
        offered = [*getattr(handle, "options", ()), value(), value()]
        return {"type": "GuiUpdateMessage", "uuid": handle._impl.uuid, "updates": {"value": draw.choice(offered)}}
    if sort < 0.6:
        return {**CAMERA, draw.choice(list(CAMERA)): value()}
    fields = {name: value() for name in kind.__dataclass_fields__} if draw.random() < 0.8 else value()
    return {"type": kind.__name__, **fields} if isinstance(fields, dict) else fields


def test_no_rubbish_ends_the_program(live, capfd):
    """Messages of all types of viser's with random values, from several pages that come and go."""
    stop = threading.Event()
    sent = []

    def send(seed):
        draw = random.Random(seed)
        page = None
        while not stop.is_set():
            try:
                if page is None:
                    page = Page(live.viewer.url)
                    page.send(CAMERA)
                page.send(rubbish(draw, live))
                sent.append(1)
                time.sleep(0.001)
                if page.closed.is_set() or draw.random() < 0.005:
                    page.close()
                    page = None
            except Exception:
                page = None

    threads = [threading.Thread(target=send, args=(seed,), daemon=True) for seed in range(3)]
    for thread in threads:
        thread.start()
    try:
        end = time.monotonic() + SECONDS
        while time.monotonic() < end:
            # a page may pause
            live.later(lambda: live.pause(False))
            run(live)
    finally:
        stop.set()
        for thread in threads:
            thread.join()
    assert len(sent) > 20 * SECONDS
    go_on_through_last_messages(live)
    live.later(lambda: live.pause(False))
    live.later(live.reset)
    run(live, 3)
    assert (live.player.sim.episode_length == 3).all()
    assert np.isfinite(live.player.sim.observation).all()
    assert answer(live.viewer.url, Host=live.viewer.url.removeprefix("http://")) == 200
    said = capfd.readouterr()
    assert "Traceback" not in said.out + said.err


class Waiters(list):
    """Events' waiters; it keeps the threads that read them."""

    def __init__(self):
        """Nobody waits yet."""
        super().__init__()
        self.threads = []

    def __iter__(self):
        """Asyncio goes through them to wake them."""
        self.threads.append(threading.current_thread())
        return super().__iter__()


def test_events_of_viser_are_set_in_their_loop(live):
    """A page that leaves while a thread adds a message ends no thread (`deque mutated`)."""
    sockets = live.viewer._server._websock_server
    page = Page(live.viewer.url)
    page.send(CAMERA)
    settle(live, 0.3)
    (client,) = live.viewer._server.get_clients().values()
    for buffer in (sockets.get_message_buffer(), client._websock_connection.get_message_buffer()):
        waiters = Waiters()
        buffer.message_event._value, buffer.message_event._waiters = False, waiters
        buffer.message_event.set()
        time.sleep(0.2)
        assert waiters.threads == [sockets._server_thread]
    page.close()


def test_a_viser_that_cannot_be_guarded_is_refused(monkeypatch):
    class Server:
        """A server that starts in another way."""

        def __init__(self, **options):
            """Takes anything."""

        def stop(self):
            """Ends nothing."""

    import viser

    monkeypatch.setattr(viser, "ViserServer", Server)
    with pytest.raises(_core.ConfigError, match=r"pip install 'polypod\[play\]'"):
        gate.open_server(Gate("127.0.0.1"), "127.0.0.1", 0)


def test_an_open_page_says_its_address_and_who_may_steer(capsys):
    line = ["play", "--checkpoint", str(FLAT_POLICY), "--seconds", "0.1", "--port", "0", "--threads", "1"]
    assert polypod.cli.main([*line, "--robots", "spot", "--host", "0.0.0.0"]) == 0
    said = capsys.readouterr().out
    shown = next(line for line in said.splitlines() if "open http://" in line)
    assert "open http://localhost" not in shown
    assert "on this machine http://localhost:" in shown
    assert "warning: everyone who reaches this address can steer" in said
    assert polypod.cli.main([*line, "--robots", "spot"]) == 0
    assert "warning" not in capsys.readouterr().out
