"""No network access and no telemetry, from the imports to the report."""

import subprocess
import sys
from pathlib import Path

import pytest

from tests import ROOT

# Installed before any other import. Sockets that are created but not connected, as to probe for IPv6, and Unix sockets
# and pipes between a process and its children are allowed.
NO_NETWORK = """
import socket, sys

def refusal(name):
    def refuse(*arguments, **options):
        print("NETWORK", name, arguments[1:], file=sys.stderr, flush=True)
        raise OSError("no network in this test")
    return refuse

class LocalSocket(socket.socket):
    def connect(self, address):
        if self.family in (socket.AF_INET, socket.AF_INET6):
            refusal("connect")(self, address)
        return super().connect(address)

    connect_ex = sendto = connect

socket.socket = socket.SocketType = LocalSocket
for name in ("create_connection", "getaddrinfo", "gethostbyname"):
    setattr(socket, name, refusal(name))

def audit(event, arguments):
    if event in ("socket.connect", "socket.sendto") and not isinstance(arguments[1], (str, bytes)):
        print("NETWORK", event, arguments[1], file=sys.stderr, flush=True)
    if event in ("socket.getaddrinfo", "socket.gethostbyname", "urllib.Request"):
        print("NETWORK", event, arguments, file=sys.stderr, flush=True)

sys.addaudithook(audit)
"""


def run_without_network(program: str, *arguments: str) -> subprocess.CompletedProcess:
    command = [sys.executable, "-c", NO_NETWORK + program, *map(str, arguments)]
    return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300, check=False)


def run_command(module: str, tmp_path: Path) -> subprocess.CompletedProcess:
    program = f"from airhockey_marl.experiment.command import run; run('{module}')"
    return run_without_network(program, "+preset=smoke", f"hydra.run.dir={tmp_path}/run")


@pytest.mark.parametrize(
    "program",
    ["import urllib.request as u; u.urlopen('http://192.0.2.1')", "socket.socket().connect(('127.0.0.1', 9))"],
)
def test_network_access_is_noticed(program):
    done = run_without_network(program)
    assert "NETWORK" in done.stderr and done.returncode != 0


def test_a_study_needs_no_network(tmp_path):
    done = run_command("guidance.commands.evaluate", tmp_path)
    assert done.returncode == 0 and "NETWORK" not in done.stderr, done.stderr
    page = (tmp_path / "run" / "report.html").read_text()
    for loading in ("<script", "<link", "<iframe", "@import", 'src="http', "url(http"):
        assert loading not in page


@pytest.mark.slow
def test_a_training_needs_no_network(tmp_path):
    done = run_command("airhockey_marl.commands.train", tmp_path)
    assert done.returncode == 0 and "NETWORK" not in done.stderr, done.stderr
