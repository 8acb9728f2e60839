"""Test the core of the ROS 2 node, without ROS, on a real server."""

import time

import numpy as np
import pytest

from lorasp_jax.extras.serving import jpeg
from lorasp_jax.extras.serving.client import ServerGone
from tests.extras.serving.stand_in import StandIn, serving

PERIOD = 0.02
POSE = np.array([0.1, 0.2, -0.3, 0.0, 0.5, 0.6, 0.03])
PICTURE = jpeg.encode("picture", np.full((24, 32, 3), 100, np.uint8), 95)
WAIT = 20.0  # s of real time, at most


class Turning(StandIn):
    """Turns the first joint by 0.03 rad an action."""

    def prepare(self, adapter, request, index):
        self.last_request = request
        return request.state

    def run(self, adapter, rows):
        chunks, ranks = super().run(adapter, rows)
        chunks[..., 0] += 0.03 * np.arange(1, self.spec.chunk + 1)
        return chunks, ranks


@pytest.fixture(scope="module")
def core(load):
    return load("ros2/pilot.py")


@pytest.fixture
def server():
    with serving(Turning(metadata={"control_dt": 0.1})) as server:
        yield server


class Arm:
    """A pilot with all that it needs, at a time of its own; the arm follows its targets."""

    def __init__(self, module, server, **options):
        self.ask = module.Server(server.address, "", 5.0, 0.0)
        self.settings = module.Settings(("side", "wrist"), "turn", **options)
        self.pilot, self.now, self.pose = module.Pilot(self.ask, self.settings), 1000.0, POSE.copy()
        self.off = set()

    def tick(self):
        """Return the target after everything has been received that is not in `off`."""
        self.now += PERIOD
        for camera in {"side", "wrist"} - self.off:
            self.pilot.see(camera, PICTURE, self.now)
        if "state" not in self.off:
            self.pilot.feel(self.settings.joints, self.pose, self.now)
        target = self.pilot.tick(self.now, PERIOD)
        self.pose = self.pose if target is None else target
        return target

    def until(self, condition):
        """Tick, at a standstill of its own clock while the server thinks, until something holds."""
        end = time.monotonic() + WAIT
        while not condition(self.tick()):
            assert time.monotonic() < end, self.pilot.holding
            self.now -= PERIOD
            time.sleep(0.001)

    def moves(self):
        self.until(lambda target: target is not None)
        return self


def test_it_follows_the_server_no_faster_than_it_may(core, server):
    arm = Arm(core, server, speed=0.2).moves()
    poses = np.array([arm.tick() for _ in range(20)])
    turned = poses[-1] - POSE
    assert turned[0] == pytest.approx(21 * 0.2 * PERIOD)
    np.testing.assert_allclose(turned[1:], 0, atol=1e-6)
    arm = Arm(core, server, speed=9.0).moves()
    for _ in range(20):
        arm.tick()
    assert arm.pose[0] - POSE[0] == pytest.approx(0.03 * 21 * PERIOD / 0.1)  # 0.03 rad an action


def test_the_server_gets_the_jpeg_files_and_the_state(core, server):
    Arm(core, server).moves()
    request = server.policy.last_request
    assert request.prompt == "turn"
    np.testing.assert_allclose(request.state, POSE, atol=1e-6)
    assert {name: int(x[8, 8, 0]) for name, x in request.images.items()} == {
        "side": 100,
        "wrist": 100,
    }


def test_servers_that_read_no_jpeg_get_pixels(core):
    with serving(Turning(metadata={"encodings": ["raw"]})) as server:
        arm, sent = Arm(core, server), []
        infer = arm.ask._client.infer
        arm.ask._client.infer = lambda request: sent.append(request) or infer(request)
        arm.moves()
        assert sent[0]["image"]["side"].shape == (24, 32, 3)


@pytest.mark.parametrize(
    ("lost", "word"), [("wrist", "camera wrist"), ("state", "joint joint1"), ("side", "camera")]
)
def test_it_falls_silent_while_something_is_stale(core, server, lost, word):
    arm = Arm(core, server).moves()
    arm.off.add(lost)
    silent = [arm.tick() is None for _ in range(20)]
    allowed = 5 if lost == "state" else 15  # 0.1 s, 0.3 s
    assert silent.index(True) in (allowed - 1, allowed, allowed + 1)
    assert all(silent[allowed + 1 :])
    assert word in arm.pilot.holding
    arm.off.clear()
    arm.pose = POSE + 0.4  # somebody has moved it meanwhile
    arm.moves()
    np.testing.assert_allclose(arm.pose, POSE + 0.4, atol=0.5 * PERIOD + 1e-9)


def test_it_needs_every_joint_once(core, server):
    arm = Arm(core, server)
    arm.off.add("state")
    arm.tick()
    arm.pilot.feel(core.PIPER[:6], POSE[:6], arm.now)
    arm.tick()
    assert "joint gripper" in arm.pilot.holding
    arm.pilot.feel(["gripper"], [float("nan")], arm.now)
    arm.tick()
    assert "joint gripper" in arm.pilot.holding
    arm.off.clear()
    arm.moves()


def test_stamps_ahead_are_stale_too(core, server):
    arm = Arm(core, server).moves()
    arm.off.add("side")
    arm.pilot.see("side", PICTURE, arm.now + 100)
    assert arm.tick() is None
    assert "camera side" in arm.pilot.holding


def test_it_does_not_follow_an_old_chunk(core, server):
    arm = Arm(core, server, patience=0.2).moves()
    server.policy.gate.clear()
    followed = 0
    while arm.tick() is not None:
        followed += 1
    assert followed * PERIOD == pytest.approx(0.5 + 0.2, abs=2 * PERIOD)
    assert "actions" in arm.pilot.holding
    server.policy.gate.set()
    arm.moves()


def lose_server(core):
    """Return an arm that holds since its server is gone, and the port of that."""
    with serving(Turning()) as server:
        arm, port = Arm(core, server).moves(), server.port
    while arm.tick() is not None:
        if arm.pilot._open:
            arm.pilot._open[0].exception(WAIT)
    return arm, port


def test_it_holds_when_the_server_is_lost_and_goes_on_when_it_is_back(core):
    arm, port = lose_server(core)
    assert "no actions" in arm.pilot.holding
    with serving(Turning(), port=port):
        arm.now += core.RETRY
        arm.moves()


def test_it_does_not_follow_another_policy_after_the_server_was_lost(core):
    arm, port = lose_server(core)
    with serving(Turning(metadata={"robot": "panda"}), port=port):
        arm.now += core.RETRY
        arm.until(lambda target: target is not None or "panda" in arm.pilot.holding)
        assert arm.pilot.holding


def test_settings_must_be_positive(core):
    for name in ("speed", "control_dt", "patience", "execute"):
        for wrong in (-0.5, 0, np.nan, np.inf):
            with pytest.raises(ValueError, match=name):
                core.Settings(("side",), "turn", **{name: wrong})


@pytest.mark.parametrize("wrong", [np.nan, "short"])
def test_it_does_not_follow_actions_that_are_none(core, server, wrong):
    arm = Arm(core, server)
    good = np.tile(POSE, (10, 1))
    answer = good[:, :6] if wrong == "short" else np.where(np.arange(7) == 3, wrong, good)
    arm.pilot._ask = lambda request: answer
    arm.until(lambda target: target is not None or "actions must be" in arm.pilot.holding)
    assert arm.pilot.holding


def test_the_node_takes_what_the_server_says(core, server):
    cameras = ["side=/a/compressed", "wrist=/b/compressed"]
    parameters = {"server": server.address, "prompt": "turn", "cameras": cameras}
    _, topics, settings = core.connect(parameters.get)
    assert topics == {"side": "/a/compressed", "wrist": "/b/compressed"}
    assert settings.control_dt == 0.1
    with pytest.raises(ValueError, match="wrist"):
        core.connect((parameters | {"cameras": cameras[:1]}).get)
    with pytest.raises(ValueError, match="prompt"):
        core.connect((parameters | {"prompt": ""}).get)
    server.policy.metadata["robot"] = "panda"
    with pytest.raises(ValueError, match="panda"):
        core.connect(parameters.get)
    assert core.connect((parameters | {"robot": "panda"}).get)
    with pytest.raises(ValueError, match="panda"):
        core.connect((parameters | {"robot": "piper"}).get)
    server.policy.metadata.clear()
    with pytest.raises(ValueError, match="7 numbers"):
        core.connect((parameters | {"joints": ["joint1"]}).get)
    with pytest.raises(ServerGone):
        core.Server("ws://127.0.0.1:9", "", 0.5, 0.0)
