"""Test the files of deploy/: what they start, how it is watched, and that managers accept them."""

import contextlib
import os
import re
import shlex
import shutil
import signal
import socket
import string
import subprocess
import sys
import time
import zipfile
from configparser import RawConfigParser

import pytest
import yaml

from lorasp_jax.base.errors import INTERRUPTED
from lorasp_jax.cli.commands import COMMANDS
from lorasp_jax.extras.piper import __main__ as piper
from lorasp_jax.extras.serving import __main__ as serving
from lorasp_jax.extras.serving.client import PolicyClient, ServerGone
from tests import ROOT
from tests.extras.serving.stand_in import observation
from tests.test_wheel import pip

FOLDER = ROOT / "deploy"
UNITS = {"lorasp-serve": serving, "lorasp-piper": piper}


def works(*words):
    """Return whether a command exists here and succeeds."""
    if not shutil.which(words[0]):
        return False
    return subprocess.run(words, capture_output=True, timeout=60, check=False).returncode == 0


def instructions():
    """Return the Dockerfile's instructions, pairs of a name and its rest."""
    text = (FOLDER / "Dockerfile").read_text().replace("\\\n", " ")
    lines = [line for line in text.splitlines() if line and not line.startswith("#")]
    return [tuple(line.split(maxsplit=1)) for line in lines]


def unit(name):
    """Return the sections of a unit; a setting given twice is an error, as none is a list here."""
    parser = RawConfigParser(delimiters="=", comment_prefixes="#", inline_comment_prefixes=None)
    parser.optionxform = str
    parser.read_string((FOLDER / f"{name}.service").read_text())
    return parser


def compose(**values):
    """Return the compose file with its variables at these values or their defaults."""
    given = lambda variable: values.get(variable[1], variable[2])  # noqa: E731
    text = re.sub(r"\$\{(\w+):-([^}]*)\}", given, (FOLDER / "compose.yaml").read_text())
    return yaml.safe_load(text)


def parse(module, words):
    """Parse the arguments of a command as it would, which exits if one is wrong."""
    environment = {"CREDENTIALS_DIRECTORY": "/run/credentials"}
    words = [string.Template(word).substitute(environment) for word in words]
    return module.parser("x").parse_args(words)


@pytest.mark.parametrize("name", UNITS)
def test_units_start_our_commands(name):
    program, command, *words = shlex.split(unit(name)["Service"]["ExecStart"])
    assert program.endswith("/lorasp-jax")
    assert COMMANDS[command][0] == UNITS[name].__name__
    options = parse(UNITS[name], words)
    assert str(options.token_file) == "/run/credentials/token"
    assert unit(name)["Service"]["LoadCredential"].startswith("token:")


def test_the_server_is_started_again_and_the_arm_is_not():
    server, arm = unit("lorasp-serve"), unit("lorasp-piper")
    service = server["Service"]
    assert (service["Type"], service["Restart"]) == ("notify", "on-failure")
    assert int(service["WatchdogSec"]) >= 30  # more than a slow batch
    assert int(service["TimeoutStopSec"]) > serving.GRACE
    assert server["Unit"]["StartLimitBurst"]
    assert {**arm["Service"]}.items() >= {
        "Restart": "no",
        "KillSignal": "SIGTERM",
        "KillMode": "mixed",
        "SuccessExitStatus": str(INTERRUPTED),
    }.items()
    assert "Install" not in arm


@pytest.mark.skipif(not works("systemd-analyze", "--version"), reason="there is no systemd-analyze")
@pytest.mark.parametrize("name", UNITS)
def test_systemd_accepts_the_units(name, tmp_path):
    """Apart from the program, which lies elsewhere here."""
    text = (FOLDER / f"{name}.service").read_text()
    path = tmp_path / f"{name}.service"
    path.write_text(text.replace("/opt/lorasp_jax/bin/lorasp-jax", sys.executable))
    words = ["systemd-analyze", "verify", "--man=no", "--recursive-errors=no", str(path)]
    found = subprocess.run(words, capture_output=True, text=True, timeout=60, check=False)
    assert (found.returncode, found.stderr) == (0, "")
    path.write_text(path.read_text().replace("Restart=", "Restrat=").replace("Type=", "Typ="))
    found = subprocess.run(words, capture_output=True, text=True, timeout=60, check=False)
    assert "Restrat" in found.stderr


def test_the_image():
    steps = instructions()
    names = [name for name, _ in steps]
    values = dict(steps)  # of those that occur once
    assert values["FROM"] == "python:3.12-slim"
    assert values["ARG"] == 'JAX="jax[cuda12]"'
    assert values["USER"] != "root"
    assert names.index("USER") < names.index("ENTRYPOINT")
    assert "/healthz" in values["HEALTHCHECK"]
    assert yaml.safe_load(values["ENTRYPOINT"]) == ["lorasp-jax", "serve"]
    options = parse(serving, yaml.safe_load(values["CMD"]))
    assert options.host == "0.0.0.0", "a container's own loopback is out of reach"
    assert str(options.token_file.parent) == "/home/policy/.cache", "which that user can write"


def test_the_image_has_all_of_the_package(tmp_path):
    """What the Dockerfile copies makes the same wheel as the whole project."""
    source = tmp_path / "source"
    source.mkdir()
    for name, rest in instructions():
        *paths, target = rest.split() if name == "COPY" else [""]
        for path in paths:
            to = tmp_path / target.strip("/")
            if (ROOT / path).is_dir():
                shutil.copytree(ROOT / path, to, ignore=shutil.ignore_patterns("__pycache__"))
            else:
                shutil.copy(ROOT / path, to)
    contents = []
    for number, folder in enumerate((source, ROOT)):
        wheels = tmp_path / str(number)
        pip("wheel", str(folder), "--no-build-isolation", "--wheel-dir", str(wheels))
        (wheel,) = wheels.glob("*.whl")
        contents.append(sorted(zipfile.ZipFile(wheel).namelist()))
    assert contents[0] == contents[1]


def test_the_compose_file():
    file = compose()
    service = file["services"]["policy"]
    options = parse(serving, shlex.split(service["command"]))
    assert options.policy == [("press", "press")]
    several = compose(POLICY="press=a pour=b --route exact")["services"]["policy"]["command"]
    assert parse(serving, shlex.split(several)).policy == [("press", "a"), ("pour", "b")]
    assert str(options.token_file) == "/run/secrets/token"
    assert options.host == "0.0.0.0"
    assert service["restart"] == "unless-stopped"
    assert float(service["stop_grace_period"].removesuffix("s")) > serving.GRACE
    assert (FOLDER / service["build"]["context"] / service["build"]["dockerfile"]).is_file()
    assert service["build"]["args"]["JAX"] in dict(instructions())["ARG"]
    kept = [volume.split(":")[:2] for volume in service["volumes"]]
    assert ["cache", "/home/policy/.cache"] in kept
    assert {"cache"} == {*file["volumes"]}
    assert set(service["secrets"]) == {*file["secrets"]}
    (device,) = service["deploy"]["resources"]["reservations"]["devices"]
    assert (device["driver"], device["capabilities"]) == ("nvidia", ["gpu"])


SERVER = """
import sys, time
from lorasp_jax.extras.serving import __main__ as command, batching
from tests.extras.serving.stand_in import StandIn
batching.HUNG, policy = 0.3, StandIn()
def load(*_):
    time.sleep(0.5)
    print("warm", flush=True)
    return policy
command._load = load
if "hung" in sys.argv:
    policy.gate.clear()
    command.GRACE = 0.1
sys.exit(command.main(["x", "--port", sys.argv[1], "--token-file", sys.argv[2]]))
"""


@contextlib.contextmanager
def managed(tmp_path, *words):
    """Start a server as systemd does; yields its process, its address and what it notifies."""
    credentials = tmp_path / "credentials"
    credentials.mkdir()
    (credentials / "token").write_text("secret\n")
    (credentials / "token").chmod(0o440)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind(str(tmp_path / "notify"))
        manager.settimeout(60)
        environment = {
            "NOTIFY_SOCKET": str(tmp_path / "notify"),
            "WATCHDOG_USEC": "200000",
            "CREDENTIALS_DIRECTORY": str(credentials),
        }
        arguments = [sys.executable, "-c", SERVER, str(port), str(credentials / "token"), *words]
        options = {"stdout": subprocess.PIPE, "text": True, "cwd": ROOT}
        with subprocess.Popen(arguments, **options, env=os.environ | environment) as process:
            try:
                yield process, f"ws://127.0.0.1:{port}", lambda: manager.recv(4096).decode()
            finally:
                process.kill()


def test_the_manager_hears_of_a_server_that_is_warm(tmp_path):
    """Clients with the credential's token connect at once then; its mode is left alone."""
    with managed(tmp_path) as (process, address, heard):
        assert heard() == "READY=1"
        assert process.stdout.readline() == "warm\n"
        PolicyClient(address, token="secret").close()
        with pytest.raises(ServerGone, match="401"):
            PolicyClient(address)
        assert [heard(), heard()] == ["WATCHDOG=1\nSTATUS=serving"] * 2
        process.send_signal(signal.SIGTERM)
        while (state := heard()).startswith("WATCHDOG"):
            pass
        assert state == "STOPPING=1"
        assert process.wait(60) == 0
        assert "open to other users" not in process.stdout.read()
    assert (tmp_path / "credentials" / "token").stat().st_mode & 0o777 == 0o440


def test_the_manager_hears_no_more_of_a_hung_policy(tmp_path):
    with managed(tmp_path, "hung") as (process, address, heard):
        assert heard() == "READY=1"
        with (
            PolicyClient(address, token="secret") as client,
            pytest.raises(ServerGone, match="did not reply"),
        ):
            client.infer(observation(), timeout=0.1)
        while (state := heard()).startswith("WATCHDOG"):
            pass
        assert state.startswith("STATUS=the policy has not answered for")
        assert heard().startswith("STATUS=")
        process.send_signal(signal.SIGTERM)  # the unit's WatchdogSignal
        assert process.wait(60) == 1


IMAGE = "lorasp-serve-test"
DOCKER = pytest.mark.skipif(not works("docker", "info"), reason="no Docker daemon answers")


@DOCKER
@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_the_image_serves_and_is_started_again():
    """Without an accelerator; a container whose server was killed comes back."""
    build = ["docker", "build", "--file", "deploy/Dockerfile", "--build-arg", "JAX=jax"]
    subprocess.run([*build, "--tag", IMAGE, "."], cwd=ROOT, check=True)
    options = ["--detach", "--restart", "unless-stopped", "--network", "host", "--name", IMAGE]
    words = ["assets/pi0_nano", "--joints", "7", "--max-batch", "1"]
    subprocess.run(["docker", "run", *options, IMAGE, *words], check=True)
    try:
        for restarts in ("0", "1"):
            wait_for("{{.RestartCount}} {{.State.Health.Status}}", f"{restarts} healthy")
            with PolicyClient("ws://127.0.0.1:8000") as client:
                assert client.metadata["action_dim"] == 8
            subprocess.run(["docker", "exec", IMAGE, "sh", "-c", "kill 1"], check=True)
    finally:
        subprocess.run(["docker", "rm", "--force", IMAGE], check=True)


def wait_for(template, expected):
    """Wait until the container's state reads so."""
    deadline = time.monotonic() + 600
    words = ["docker", "inspect", "--format", template, IMAGE]
    while (found := subprocess.check_output(words, text=True).strip()) != expected:
        assert time.monotonic() < deadline, found
        time.sleep(1)
