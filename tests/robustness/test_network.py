"""Nothing here talks to anybody: no network, no telemetry, from the imports to the report."""

import subprocess
import sys

import pytest

from tests import ROOT

# Installed before anything is imported. A socket that is only made, as to see whether there is IPv6, and what a process
# says to itself or a child of its own through a Unix socket or a pipe, are no network.
NO_NETWORK = """
import socket, sys

def refused(what):
    def refuse(*arguments, **options):
        print("NETWORK", what, arguments[1:], file=sys.stderr, flush=True)
        raise OSError("no network in this test")
    return refuse

class Alone(socket.socket):
    def connect(self, address):
        if self.family in (socket.AF_INET, socket.AF_INET6):
            refused("connect")(self, address)
        return super().connect(address)

    connect_ex = sendto = connect

socket.socket = socket.SocketType = Alone
for name in ("create_connection", "getaddrinfo", "gethostbyname"):
    setattr(socket, name, refused(name))

def audit(event, arguments):
    if event in ("socket.connect", "socket.sendto") and not isinstance(arguments[1], (str, bytes)):
        print("NETWORK", event, arguments[1], file=sys.stderr, flush=True)
    if event in ("socket.getaddrinfo", "socket.gethostbyname", "urllib.Request"):
        print("NETWORK", event, arguments, file=sys.stderr, flush=True)

sys.addaudithook(audit)
"""


def alone(program: str, *arguments: str) -> subprocess.CompletedProcess:
    asked = [sys.executable, "-c", NO_NETWORK + program, *map(str, arguments)]
    return subprocess.run(asked, cwd=ROOT, capture_output=True, text=True, timeout=300, check=False)


@pytest.mark.parametrize(
    "program",
    ["import urllib.request as u; u.urlopen('http://192.0.2.1')", "socket.socket().connect(('127.0.0.1', 9))"],
)
def test_the_network_would_be_noticed(program):
    done = alone(program)
    assert "NETWORK" in done.stderr and done.returncode != 0


def test_a_study_is_played_and_reported_without_a_network(tmp_path):
    done = alone("from guidance.evaluate import main; main()", "+preset=smoke", f"hydra.run.dir={tmp_path}/run")
    assert done.returncode == 0 and "NETWORK" not in done.stderr, done.stderr
    page = (tmp_path / "run" / "report.html").read_text()
    for loading in ("<script", "<link", "<iframe", "@import", 'src="http', "url(http"):
        assert loading not in page


@pytest.mark.slow
def test_a_training_asks_nobody_either(tmp_path):
    done = alone("from airhockey_marl.train import main; main()", "+preset=smoke", f"hydra.run.dir={tmp_path}/run")
    assert done.returncode == 0 and "NETWORK" not in done.stderr, done.stderr
